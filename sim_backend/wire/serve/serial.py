"""Serves a model of a serial device on a pseudo terminal: the real driver opens it with the real pyserial.

Replies leave at 10 bits a character, in the host's time, as through a UART (a virtual COM port is faster, and no driver
may depend on that). A pseudo terminal ignores the baud rate. The path is a link that survives unplugging and plugging
in again.
"""

import os
import select
import tempfile
import threading
import time
import tty
from pathlib import Path
from typing import Protocol

from drivers.clock import Clock
from drivers.transports.endpoints import Endpoint
from sim_backend.wire.serve.wire_server import FaultSchedule, WireServer

BITS_PER_CHARACTER = 10
"""8N1: a start bit, eight data bits, a stop bit."""
_TURN_S = 0.001
"""One turn of the serving thread while bytes are on their way."""
_IDLE_S = 0.01
"""One turn while nothing happens: how late a model's own events come at most."""


class SerialModel(Protocol):
    """The firmware of a serial device: a pure state machine fed with bytes and a time. No threads, no waiting."""

    def receive(self, data: bytes, now_s: float) -> bytes:
        """Take bytes from the host, in pieces of any size; returns what the device answers."""
        ...

    def tick(self, now_s: float) -> bytes:
        """Let time pass; returns what the device sends unasked."""
        ...


class SerialServer(WireServer[SerialModel]):
    """A serial device."""

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
        self._folder = tempfile.TemporaryDirectory(prefix="spadrig-tty-")
        self._master: int | None = None
        self._slave: int | None = None
        self._waiting = threading.Lock()
        self._wake_in, self._wake_out = os.pipe()

    @property
    def path(self) -> str:
        """Path at which pyserial finds the device while it is plugged in."""
        return str(Path(self._folder.name) / "tty")

    @property
    def endpoint(self) -> Endpoint:
        """The endpoint of that path for `Surroundings.ports`."""
        return Endpoint(self.path)

    def close(self) -> None:
        """Unplug it for good; again: nothing happens."""
        super().close()
        if self._wake_in >= 0:
            os.close(self._wake_in)
            os.close(self._wake_out)
            self._wake_in = self._wake_out = -1
        self._folder.cleanup()

    def plug(self) -> None:
        """Put the cable in."""
        with self.lock:
            if self._master is not None:
                return
            self._master, self._slave = os.openpty()
            tty.setraw(self._slave)  # without it the terminal would echo what the device says before anybody opened it
            os.set_blocking(self._master, False)
            os.symlink(os.ttyname(self._slave), self.path)

    def unplug(self) -> None:
        """Pull the cable: the open port is lost, bytes on their way with it."""
        with self.lock:
            if self._master is None or self._slave is None:
                return
            os.unlink(self.path)
            self._outbox.clear()
            os.write(self._wake_out, b"w")
            with self._waiting:  # a terminal that somebody waits on stays open, and the cable would still be in
                os.close(self._slave)
                os.close(self._master)
                self._master = self._slave = None

    def _serve(self) -> None:
        while not self._ending.is_set():
            with self.lock:
                master = None if self._hung else self._master
                if master is not None:
                    self._turn(master)
                wait_s = _TURN_S if self._outbox else _IDLE_S
            if master is None:
                self._rest()
            else:
                self._await_input(master, wait_s)

    def _rest(self) -> None:
        """One turn of a device that hangs or is not plugged in: what comes stays where it is."""
        self._ending.wait(_IDLE_S)

    def _await_input(self, master: int, wait_s: float) -> None:
        with self._waiting:
            if self._master != master:
                return  # unplugged
            readable, _, _ = select.select([master, self._wake_in], [], [], wait_s)
            if self._wake_in in readable:
                os.read(self._wake_in, 64)

    def _turn(self, master: int) -> None:
        """Take what came, let the model answer, send what is due."""
        now_s = self._now_s()
        self._reply(self.model.tick(now_s))
        try:
            data = os.read(master, 4096)
        except OSError:
            data = b""  # nothing there, or nobody has the port open
        if data:
            self._reply(self.model.receive(data, now_s))
        if self._master is not None:  # a fault may just have unplugged it
            self._send_due(self._master)

    def _queue(self, at: float, data: bytes) -> None:
        """No faster than the line carries them."""
        super()._queue(at, data)
        self._free_at += len(data) / self._characters_per_s

    def _send_due(self, master: int) -> None:
        now = time.monotonic()
        while self._outbox and self._outbox[0][0] <= now:
            starts_at, data = self._outbox.popleft()
            n_due = max(1, int((now - starts_at) * self._characters_per_s))
            sent = self._send(master, data[:n_due])
            if sent < len(data):
                self._outbox.appendleft((starts_at + sent / self._characters_per_s, data[sent:]))
                return

    def _send(self, master: int, data: bytes) -> int:
        try:
            return os.write(master, data)
        except BlockingIOError:
            return 0  # nobody reads: the terminal's buffer is full
        except OSError:
            return len(data)  # nobody has the port open: the bytes go nowhere
