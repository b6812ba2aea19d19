"""Serial lines to a model of a device: `SerialWire` within this process, `SerialServer` on a pseudo terminal.

Replies leave at 10 bits a character, as through a UART (a virtual COM port is faster, and no driver may depend on
that). A `SerialWire` replaces pyserial and runs on the model's clock, so a test on virtual time gives the same result
on any machine, however busy it is. A pseudo terminal is opened by the real pyserial, from any process, and runs in the
host's time; it ignores the baud rate. Its path is a link that survives unplugging and plugging in again.
"""

import errno
import os
import select
import tempfile
import threading
import tty
from abc import abstractmethod
from pathlib import Path
from typing import Protocol

import serial

from drivers.clock import NS_PER_S, Clock
from drivers.transports.endpoints import Endpoint
from sim_backend.wire.serve.wire_server import FaultSchedule, Wire, WireServer

BITS_PER_CHARACTER = 10
"""8N1: a start bit, eight data bits, a stop bit."""
MOST_UNHEARD_BYTES = 4096
"""Bytes that a port keeps for a device that hangs, as a pseudo terminal does."""
_WRITE_S, _SLICE_S = 1.0, 0.02
"""Time after which an emulated port gives up a write, and longest wait of one read."""
_TURN_S = 0.001
"""One turn of the serving thread while bytes are on their way."""
_IDLE_S = 0.01
"""One turn while nothing happens: how late a model's own events come at most."""


class SerialModel(Protocol):
    """The firmware of a serial device: a pure state machine that is given bytes and a time. No threads, no waiting."""

    def receive(self, data: bytes, now_s: float) -> bytes:
        """Take bytes from the host, in pieces of any size; returns what the device answers."""

    def tick(self, now_s: float) -> bytes:
        """Let time pass; returns what the device sends unasked."""


class _SerialLine(Wire[SerialModel]):
    """The serial line itself: it passes received bytes to the model and sends the replies when they are due."""

    def __init__(
        self,
        model: SerialModel,
        *,
        clock: Clock | None = None,
        baud: int = 115_200,
        faults: FaultSchedule | None = None,
    ) -> None:
        super().__init__(model, clock, faults)
        self._characters_per_s = baud / BITS_PER_CHARACTER

    def _turn(self) -> None:
        """Take what came, let the model answer, send what is due."""
        now_s = self._now_s()
        self._reply(self.model.tick(now_s))
        data = self._take()
        if data:
            self._reply(self.model.receive(data, now_s))
        self._send_due()

    def _queue(self, at: float, data: bytes) -> None:
        """No faster than the line carries them."""
        super()._queue(at, data)
        self._free_at += len(data) / self._characters_per_s

    def _send_due(self) -> None:
        now = self._wire_s()
        while self._outbox and self._outbox[0][0] <= now:
            starts_at, data = self._outbox.popleft()
            n_due = max(1, int((now - starts_at) * self._characters_per_s))
            sent = self._send(data[:n_due])
            if sent < len(data):
                self._outbox.appendleft((starts_at + sent / self._characters_per_s, data[sent:]))
                return

    @abstractmethod
    def _take(self) -> bytes:
        """The bytes that the host has sent."""

    @abstractmethod
    def _send(self, data: bytes) -> int:
        """Give bytes to the host; returns how many it took."""


class SerialWire(_SerialLine):
    """A serial device within this process. Its ports wait on the clock of the model, whose time may be virtual."""

    _plugged = False
    _port: "EmulatedPort | None" = None
    _from_host = b""

    @property
    def endpoint(self) -> Endpoint:
        """The endpoint that opens such ports. Its address only serves for messages."""
        return Endpoint(f"/dev/emulated-{id(self):x}", serial_port=self._open)

    def plug(self) -> None:
        """Plug the cable in."""
        self._plugged = True

    def unplug(self) -> None:
        """Pull the cable."""
        with self.lock:
            self._plugged = False
            self._outbox.clear()
            self._from_host = b""
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
        """Let the device act, at the present time and on the host's data. Raises SerialException if the port is
        lost."""
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
    """The host's end of a `SerialWire`, with the part of `serial.Serial` that drivers use."""

    def __init__(self, wire: SerialWire, clock: Clock) -> None:
        self.clock = clock
        self.received = bytearray()
        """Bytes that came and were not read yet."""
        self._wire = wire
        self._end, self._far_end = os.pipe()

    @property
    def in_waiting(self) -> int:
        """Number of bytes that can be read now."""
        self._wire.exchange(self)
        return len(self.received)

    def read(self, size: int) -> bytes:
        """At most `size` bytes; none if nothing comes within one slice of waiting."""
        ends_ns = self.clock.now_ns() + round(_SLICE_S * NS_PER_S)
        while not self.in_waiting and self.clock.now_ns() < ends_ns:
            self.clock.sleep(_TURN_S)
        with self._wire.lock:
            data = bytes(self.received[:size])
            del self.received[:size]
        return data

    def write(self, data: bytes) -> None:
        """Send all of `data`."""
        self._wire.exchange(self, data)

    def fileno(self) -> int:
        """A file descriptor that reports a hang-up when the cable is pulled."""
        return self._end

    def hang_up(self) -> None:
        """Behave as a port whose cable is pulled. A second call does nothing."""
        if self._far_end >= 0:
            os.close(self._far_end)
            self._far_end = -1

    def close(self) -> None:
        """Close the port; a second call does nothing."""
        self._wire.release(self)
        self.hang_up()
        if self._end >= 0:
            os.close(self._end)
            self._end = -1


class SerialServer(_SerialLine, WireServer[SerialModel]):
    """A serial device on a pseudo terminal."""

    def __init__(
        self,
        model: SerialModel,
        *,
        clock: Clock | None = None,
        baud: int = 115_200,
        faults: FaultSchedule | None = None,
    ) -> None:
        super().__init__(model, clock=clock, baud=baud, faults=faults)
        self._folder = tempfile.TemporaryDirectory(prefix="spadrig-tty-")
        self._master: int | None = None
        self._slave: int | None = None
        self._waiting = threading.Lock()

    @property
    def path(self) -> str:
        """Path at which pyserial finds the device while it is plugged in."""
        return str(Path(self._folder.name) / "tty")

    @property
    def endpoint(self) -> Endpoint:
        """The endpoint of that path for `Surroundings.ports`."""
        return Endpoint(self.path)

    def close(self) -> None:
        """Unplug the device for good; a second call does nothing."""
        super().close()
        self._folder.cleanup()

    def plug(self) -> None:
        """Plug the cable in."""
        with self.lock:
            if self._master is not None:
                return
            self._master, self._slave = os.openpty()
            tty.setraw(self._slave)  # without it the terminal would echo what the device says before anybody opened it
            os.set_blocking(self._master, False)
            os.symlink(os.ttyname(self._slave), self.path)

    def unplug(self) -> None:
        """Pull the cable. The open port is lost, and so are bytes on their way."""
        with self.lock:
            if self._master is None or self._slave is None:
                return
            os.unlink(self.path)
            self._outbox.clear()
            with self._waiting:  # a terminal that somebody waits on stays open, and the cable would still be in
                os.close(self._slave)
                os.close(self._master)
                self._master = self._slave = None

    def _serve(self) -> None:
        while not self._ending.is_set():
            with self.lock:
                master = None if self._hung else self._master
                if master is not None:
                    self._turn()
                wait_s = _TURN_S if self._outbox else _IDLE_S
            if master is None:  # it hangs or is not plugged in: what comes stays where it is
                self._ending.wait(_IDLE_S)
                continue
            with self._waiting:
                if self._master == master:  # else it was unplugged
                    select.select([master], [], [], wait_s)

    def _take(self) -> bytes:
        try:
            return b"" if self._master is None else os.read(self._master, 4096)
        except OSError:
            return b""  # nothing there, or nobody has the port open

    def _send(self, data: bytes) -> int:
        assert self._master is not None, "nothing is on its way of what is not plugged in"
        try:
            return os.write(self._master, data)
        except BlockingIOError:
            return 0  # nobody reads: the terminal's buffer is full
        except OSError:
            return len(data)  # nobody has the port open: the bytes go nowhere
