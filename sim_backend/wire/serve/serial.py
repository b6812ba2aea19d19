"""A serial line to a model of a device, on a pseudo terminal.

Replies leave at 10 bits a character, as through a UART of the server's baud rate. (A virtual COM port is faster.) The
terminal is opened by the real pyserial, from any process, and runs in the host's time; the baud rate that the host sets
is ignored. Its path is a link that exists while the device is plugged in, and is the same when it is plugged in again.
"""

import os
import select
import tempfile
import threading
from pathlib import Path
from typing import Protocol

from drivers.clock import Clock
from drivers.errors import DeviceError
from sim_backend.wire.serve.wire_server import WireServer

BITS_PER_CHARACTER = 10
"""8N1: a start bit, eight data bits, a stop bit."""
_TURN_S = 0.001
"""Length of one turn of the serving thread while bytes are on their way."""
_IDLE_S = 0.01
"""Length of one turn while nothing happens: a model's own events come at most this late."""


class SerialModel(Protocol):
    """The firmware of a serial device: a pure state machine that is given bytes and a time. No threads, no waiting."""

    def receive(self, data: bytes, now_s: float) -> bytes:
        """Take bytes from the host, in pieces of any size; returns what the device answers."""

    def tick(self, now_s: float) -> bytes:
        """Let time pass; returns what the device sends unasked."""


class SerialServer(WireServer[SerialModel]):
    """A serial device on a pseudo terminal."""

    def __init__(self, model: SerialModel, *, clock: Clock | None = None, baud: int = 115_200) -> None:
        super().__init__(model, clock)
        self._characters_per_s = baud / BITS_PER_CHARACTER
        self._folder = tempfile.TemporaryDirectory(prefix="spadrig-tty-")
        self._master: int | None = None
        self._slave: int | None = None
        self._waiting = threading.Lock()

    @property
    def path(self) -> str:
        """Path at which pyserial finds the device while it is plugged in."""
        return str(Path(self._folder.name) / "tty")

    @property
    def address(self) -> str:
        """The port's path, which is the address that a config names."""
        return self.path

    def close(self) -> None:
        """Unplug the device for good; a second call does nothing."""
        super().close()
        self._folder.cleanup()

    def plug(self) -> None:
        """Plug the cable in. Raises DeviceError on Windows, which has no pseudo terminals."""
        with self.lock:
            if self._master is not None:
                return
            if not hasattr(os, "openpty"):
                raise DeviceError("an emulated serial port is a pseudo terminal, which Windows has not; use Linux")
            import tty

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

    def _turn(self) -> None:
        """Take what came, let the model answer, send what is due."""
        now_s = self._now_s()
        self._reply(self.model.tick(now_s))
        data = self._take()
        if data:
            self._reply(self.model.receive(data, now_s))
        self._send_due()

    def _queue(self, at: float, data: bytes) -> None:
        """Queue bytes, to leave no faster than the line carries them."""
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

    def _take(self) -> bytes:
        """The bytes that the host has sent."""
        try:
            return b"" if self._master is None else os.read(self._master, 4096)
        except OSError:
            return b""  # nothing there, or nobody has the port open

    def _send(self, data: bytes) -> int:
        """Give bytes to the host; returns how many it took."""
        assert self._master is not None, "nothing is on its way of what is not plugged in"
        try:
            return os.write(self._master, data)
        except BlockingIOError:
            return 0  # nobody reads: the terminal's buffer is full
        except OSError:
            return len(data)  # nobody has the port open: the bytes go nowhere
