"""A serial port with a deadline on every call, and one typed error for each way in which it can fail.

Wraps pyserial. Which exception pyserial raises for a lost port depends on the call, so all are caught around every
call. Deadlines are in the host's time, since pyserial knows no other clock; an emulated port (`Endpoint.serial_port`)
brings its own clock. Network ports are refused, because those of pyserial 3.5 write without a deadline.
"""

import errno
import os
import select
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import Any

import serial
from serial.tools import list_ports

from drivers.clock import Clock, SystemClock, now_s
from drivers.errors import (
    DeviceBusy,
    DeviceDisconnected,
    DeviceError,
    DeviceNotFound,
    DevicePermission,
    DeviceTimeout,
    ProtocolError,
)
from drivers.transports.endpoints import UDEV_RULES, Endpoint, one_line, resolve
from drivers.transports.tap import IN, OUT, Tap

try:
    from termios import error as _termios_error
except ImportError:  # no such module, and no such error, on Windows
    _termios_error = OSError  # type: ignore[assignment,misc]

_FOREIGN = (serial.SerialException, OSError, _termios_error)
_SLICE_S = 0.02
"""One wait inside pyserial: the granularity of deadlines, in seconds."""
_MOST_WAIT_S = 2 * _SLICE_S
"""Longest time that one wait counts, however late it ends: what holds this process up may hold up the bytes too."""
_WRITE_S = 1.0
"""Longest time for all bytes of a write. 1 s is 11 520 characters at 115 200 baud."""
BAUD = 115_200
"""Rate of a port whose device asks for no other."""
AGAIN_S = 0.11
"""Pause after bytes that are sent several times: a Cobolt ignores a command within 0.1 s of its last answer
(docs/reference/devices/cobolt.md)."""
_MAX_LINE_BYTES = 65_536
"""Longer than any reply to a command: beyond it the line is noise without an end."""

_ABSENT = (errno.ENOENT, errno.ENXIO, errno.ENODEV, errno.EIO)
_FORBIDDEN = (errno.EACCES, errno.EPERM)
_HELD = (errno.EBUSY, errno.EAGAIN)


class SerialPort:
    """An open serial port, held exclusively, 8N1 without flow control. `close` may be called more than once.

    Not thread-safe: a driver that is polled from several threads must lock around a whole command and reply.
    """

    def __init__(self, name: str, endpoint: Endpoint, tap: Tap | None = None, baud: int = BAUD) -> None:
        """Open the port. name: the device's name in messages. tap: records all that passes. baud: bits per second.

        Addresses: a path or COM port, "serial=ABC" (serial number of the USB device) or "usb=VVVV:PPPP" (hexadecimal
        vendor and product, the only one attached). Raises `DeviceNotFound`, `DevicePermission` or `DeviceBusy`.
        """
        self._name = name
        self.path = _find(name, endpoint.address)
        """The port's path, also if the address was a serial number or USB ids."""
        self._received = bytearray()
        self._tap = tap
        self._endpoint = endpoint
        self._port = self._open(endpoint, baud)
        self.clock: Clock = SystemClock() if endpoint.serial_port is None else self._port.clock
        """The clock of its deadlines."""

    @property
    def lost(self) -> bool:
        """Whether the port has hung up; always False on Windows. Asks only the kernel. Allowed from any thread."""
        if not hasattr(select, "poll"):
            return False  # on Windows the next read shows it
        try:
            hung_up = select.poll()
            hung_up.register(self._port.fileno(), 0)  # hang-ups and errors are always reported
            return bool(hung_up.poll(0))
        except (*_FOREIGN, TypeError, ValueError):
            return True

    @property
    def usb_ids(self) -> tuple[int, int] | None:
        """Vendor and product of the USB device behind the port; None: it is not on USB, or cannot tell."""
        if self._endpoint.usb_ids is not None or self._endpoint.serial_port is not None:
            return self._endpoint.usb_ids
        here = os.path.realpath(self.path)  # links like /dev/serial/by-id are not listed
        for port in list_ports.comports():
            if port.vid is not None and port.pid is not None and os.path.realpath(port.device) == here:
                return int(port.vid), int(port.pid)
        return None

    def write_again(self, data: bytes, times: int) -> None:
        """Send `data` several times, with a pause of AGAIN_S after each, to a device whose answers are not read. Errors
        as in `write`."""
        for _ in range(times):
            self.write(data)
            self.clock.sleep(AGAIN_S)

    def write(self, data: bytes) -> None:
        """Send all of `data`. Raises `DeviceTimeout` if that takes over a second, or `DeviceDisconnected`."""
        self._note(OUT, data)
        with self._translated():
            try:
                self._port.write(data)
            except serial.SerialTimeoutException:
                raise DeviceTimeout(
                    f"{self._name} took no data for {_WRITE_S:g} s on {self.path}; it hangs: power-cycle it"
                ) from None

    def read_line(self, terminator: bytes, deadline_s: float) -> bytes:
        """The next line without its terminator. Raises `DeviceTimeout` after `deadline_s`, and keeps the part received
        for the next call. Raises `ProtocolError` if no line ends within 64 KiB, and `DeviceDisconnected` if the port is
        lost.

        If the host was held up, the deadline is later, and what has arrived meanwhile is read before it counts.
        """
        searched, waited_s = 0, 0.0
        while (end := self._received.find(terminator, searched)) < 0:
            if len(self._received) > _MAX_LINE_BYTES:
                raise ProtocolError(f"{self._name} sent {len(self._received)} bytes without an end of line: noise")
            searched = max(0, len(self._received) - len(terminator) + 1)
            begun_s = now_s(self.clock)
            came = self._receive_some()
            waited_s += min(now_s(self.clock) - begun_s, _MOST_WAIT_S)
            if waited_s >= deadline_s and not came and not self._receive_some(0):
                raise DeviceTimeout(
                    f"{self._name} did not send a whole line within {deadline_s:g} s on {self.path} "
                    f"({len(self._received)} bytes came); check its power and cable"
                )
        return self._take(end, len(terminator))

    def reset_input(self) -> bytes:
        """Drop everything received so far and not read; returns what was dropped. More may still arrive: see
        `drain`."""
        with self._translated():
            data = self._port.read(self._port.in_waiting)
        self._note(IN, data)
        self._received += data
        return self._take(len(self._received), 0)

    def drain(self, quiet_s: float, deadline_s: float) -> bytes:
        """Drop what was received and not read, and what arrives until the line is quiet for `quiet_s`, at most for
        `deadline_s`; returns what was dropped."""
        ends_at = now_s(self.clock) + deadline_s
        quiet_at = now_s(self.clock) + quiet_s
        while now_s(self.clock) < min(quiet_at, ends_at):
            if self._receive_some():
                quiet_at = now_s(self.clock) + quiet_s
        return self._take(len(self._received), 0)

    def close(self) -> None:
        """Close the port; a second call does nothing. Never raises: a lost port counts as closed."""
        with suppress(*_FOREIGN):  # the port is gone, so there is nothing left to release
            self._port.close()

    def _open(self, endpoint: Endpoint, baud: int) -> Any:
        if "://" in self.path:
            raise DeviceNotFound(
                f"{self._name}: port {self.path} is on the network; make a local one of it (socat PTY,raw,link=PATH "
                "TCP:HOST:PORT) and write its path"
            )
        try:
            if endpoint.serial_port is not None:
                return endpoint.serial_port()
            return serial.Serial(self.path, baud, timeout=_SLICE_S, write_timeout=_WRITE_S, exclusive=True)
        except _FOREIGN as error:
            raise self._refused(error) from None

    def _refused(self, error: Exception) -> DeviceError:
        number = getattr(error, "errno", None)
        where = f"{self._name}: port {self.path}"
        if number in _ABSENT:
            return DeviceNotFound(f"{where} is not there; plug the device in, switch it on, or correct 'port'")
        if number in _FORBIDDEN:
            return DevicePermission(
                f"{where} may not be opened by this user; install the udev rules {UDEV_RULES} and plug in again"
            )
        if number in _HELD:
            return DeviceBusy(
                f"{where} is held by another program; close that program, or the device if this program has it open, "
                "and try again"
            )
        return DeviceNotFound(f"{where} cannot be opened as a serial port ({one_line(error)}); correct 'port'")

    def _receive_some(self, least: int = 1) -> bool:
        """Receive what has come; waits up to a slice for `least` bytes. Returns whether anything came."""
        with self._translated():
            data = self._port.read(max(least, self._port.in_waiting))
        self._note(IN, data)
        self._received += data
        return bool(data)

    def _note(self, direction: str, data: bytes) -> None:
        if self._tap is not None:
            self._tap.note("serial", direction, data)

    def _take(self, n: int, terminator: int) -> bytes:
        taken = bytes(self._received[:n])
        del self._received[: n + terminator]
        return taken

    @contextmanager
    def _translated(self) -> Iterator[None]:
        """Raise `DeviceDisconnected` for everything that pyserial raises on an open port: it means that the port is
        gone.
        """
        try:
            yield
        except (*_FOREIGN, TypeError) as error:
            # TypeError: what pyserial's calls raise on the handle of a port that was closed under them.
            raise DeviceDisconnected(
                f"{self._name}: port {self.path} is lost ({one_line(error)}); plug it in again"
            ) from None


def configured_port(name: str, config: Any, ports: Mapping[str, Endpoint]) -> SerialPort:
    """Open the port of a device's config, at the config's rate if it names one. Raises what `SerialPort` raises."""
    return SerialPort(name, resolve(config.port, ports), baud=getattr(config, "baud", BAUD))


def _find(name: str, address: str) -> str:
    """The path that an address means."""
    key, given, value = address.partition("=")
    if not given or key not in ("serial", "usb"):
        return address
    attached = list_ports.comports()
    if key == "serial":
        matches = [port.device for port in attached if port.serial_number == value]
        other = "give the port's path"
    else:
        usb = [port for port in attached if port.vid is not None]
        matches = [port.device for port in usb if f"{port.vid:04x}:{port.pid:04x}" == value.lower()]
        other = "give serial=... or the port's path"
    if not matches:
        choices = ", ".join(f"{p.device} (serial={p.serial_number})" for p in attached if p.serial_number)
        raise DeviceNotFound(f"{name}: no serial port with {address}; attached: {choices or 'none'}")
    if len(matches) > 1:
        raise DeviceNotFound(f"{name}: {len(matches)} serial ports with {address} ({', '.join(matches)}); {other}")
    return str(matches[0])
