"""The base of all devices on a serial line: raw commands without a reply, and a port that may get lost."""

from typing import Protocol

from drivers.interfaces.device import OPEN_STATES, Device
from drivers.transports.serial_port import SerialPort


class SerialLine(Protocol):
    """The dialogue with one kind of device, over a serial port."""

    @property
    def port(self) -> SerialPort:
        """The port that the dialogue uses."""

    def send(self, command: str) -> None:
        """Send a command as the device expects it, and do not wait for a reply. A reply that comes all the same is not
        taken for that of a later command."""


class SerialDevice(Device):
    """A device that communicates through `self._line`."""

    _line: SerialLine

    def send(self, command: str) -> None:
        """Send a raw command that the device does not answer; `ask` would wait for a reply in vain. A reply that comes
        all the same is dropped.

        Nothing is checked: such a command can make light or raise the gate. Raises `DeviceError` if the port is lost or
        takes nothing.
        """
        self._require("send", *OPEN_STATES)
        self._line.send(command)

    @property
    def port_lost(self) -> bool:
        """Whether the port is gone, found out without sending anything. May be called from any thread."""
        return self._line.port.lost
