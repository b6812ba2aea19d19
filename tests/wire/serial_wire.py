"""A serial line within this process, in place of pyserial. It runs on the model's clock, so that a test on virtual time
gives the same result on any machine, however busy it is."""

import errno
import os
from typing import Self

import pytest
import serial

from drivers.clock import NS_PER_S, Clock
from drivers.transports.endpoints import Endpoint
from drivers.transports.serial_port import SerialPort
from sim_backend.wire.serve.serial import SerialServer
from sim_backend.wire.serve.wire_server import WireServer
from tests.wire.faults import Faulty

MOST_UNHEARD_BYTES = 4096
"""Bytes that a port keeps for a device that hangs, as a pseudo terminal does."""
_WRITE_S, _SLICE_S = 1.0, 0.02
"""Time after which a port gives up a write, and longest wait of one read."""
_TURN_S = 0.001


class SerialWire(Faulty, SerialServer):
    """No thread serves it: the host's calls let it act."""

    _plugged = False
    _port: "EmulatedPort | None" = None
    _from_host = b""
    _wire_s = WireServer._now_s

    @property
    def endpoint(self) -> Endpoint:
        """Its address only serves for messages."""
        return Endpoint(f"/dev/emulated-{id(self):x}", serial_port=self._open)

    def start(self) -> Self:
        self.plug()
        return self

    def plug(self) -> None:
        self._plugged = True

    def unplug(self) -> None:
        with self.lock:
            self._plugged, self._from_host = False, b""
            self._outbox.clear()
            if self._port is not None:
                self._port.hang_up()
                self._port = None

    def _open(self) -> "EmulatedPort":
        with self.lock:
            if not self._plugged:
                raise serial.SerialException(errno.ENOENT, "no such port")
            if self._port is not None:
                raise serial.SerialException(errno.EBUSY, "port is locked")
            self._port = EmulatedPort(self, self._clock)
            return self._port

    def exchange(self, port: "EmulatedPort", data: bytes = b"") -> None:
        """Let the device act, at the present time and on the host's data."""
        with self.lock:
            if self._port is not port:
                raise serial.SerialException(errno.EIO, "the cable was pulled or the port closed")
            if self._hung and data and len(self._from_host) + len(data) > MOST_UNHEARD_BYTES:
                self._clock.sleep(_WRITE_S)
                raise serial.SerialTimeoutException("write timeout")
            self._from_host += data
            if not self._hung:
                self._turn()

    def release(self, port: "EmulatedPort") -> None:
        """Forget a port that its host has closed."""
        with self.lock:
            if self._port is port:
                self._port = None
                self._outbox.clear()

    def _take(self) -> bytes:
        data, self._from_host = self._from_host, b""
        return data

    def _send(self, data: bytes) -> int:
        if self._port is not None:
            self._port.received += data
        return len(data)


class EmulatedPort:
    """The host's end, with the part of `serial.Serial` that drivers use."""

    def __init__(self, wire: SerialWire, clock: Clock) -> None:
        self.clock = clock
        self.received = bytearray()
        self._wire = wire
        self._end, self._far_end = os.pipe()

    @property
    def in_waiting(self) -> int:
        self._wire.exchange(self)
        return len(self.received)

    def read(self, size: int) -> bytes:
        """At most `size` bytes; none if nothing comes within one slice of waiting. For 0 bytes it does not wait."""
        ends_ns = self.clock.now_ns() + round(_SLICE_S * NS_PER_S) * bool(size)
        while not self.in_waiting and self.clock.now_ns() < ends_ns:
            self.clock.sleep(_TURN_S)
        with self._wire.lock:
            data = bytes(self.received[:size])
            del self.received[:size]
        return data

    def write(self, data: bytes) -> None:
        self._wire.exchange(self, data)

    def fileno(self) -> int:
        """Tells of a hang-up when the cable is pulled."""
        return self._end

    def hang_up(self) -> None:
        if self._far_end >= 0:
            os.close(self._far_end)
            self._far_end = -1

    def close(self) -> None:
        self._wire.release(self)
        self.hang_up()
        if self._end >= 0:
            os.close(self._end)
            self._end = -1


STANDSTILL_S = 5.0


def hold_up(port: SerialPort, clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the host stand still, as on a busy machine, each time it begins to wait for bytes; they come meanwhile."""
    emulated = port._port
    read = emulated.read

    def late(size: int) -> bytes:
        if size and not emulated.in_waiting:
            clock.sleep(STANDSTILL_S)
            return b""
        data: bytes = read(size)
        return data

    monkeypatch.setattr(emulated, "read", late)
