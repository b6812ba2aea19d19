"""Messages and heartbeat between the application and the guard.

Each message, errors included, is one line of JSON over a socket pair. The end of the stream is a message too: the
kernel sends it as soon as the other process is gone.

The heartbeat is a page of memory that both processes share. The application's source thread, which reads the SPAD,
writes to it. A beat only stores numbers, without a lock or a system call, so that a full pipe, a stopped guard or a
slow disk cannot delay it.
"""

import json
import mmap
import os
import select
import socket
import struct
import threading
import time
from collections.abc import Mapping
from typing import Any

import drivers.errors
from drivers.errors import DeviceError, ProtocolError

Message = dict[str, Any]
_READ_BYTES = 65_536


class Channel:
    """One end of the connection. Any thread may send; only one thread may receive."""

    def __init__(self, end: socket.socket) -> None:
        end.setblocking(False)
        self._end = end
        self._lock = threading.Lock()
        self._unsent = bytearray()
        self._received = bytearray()

    def fileno(self) -> int:
        """The socket's file descriptor, for select."""
        return self._end.fileno()

    def send(self, message: Message, within_s: float = 0.0) -> None:
        """Queue a message and send what the socket accepts within `within_s`; the rest waits for the next `send` or
        `flush`. If the other process is gone, the message is dropped without an error."""
        line = json.dumps(message, separators=(",", ":")).encode() + b"\n"
        with self._lock:
            self._unsent += line
        self.flush(within_s)

    def flush(self, within_s: float = 0.0) -> None:
        """Send what is still queued, or as much of it as the socket accepts within `within_s`."""
        ends_at = time.monotonic() + within_s
        with self._lock:
            while self._unsent:
                try:
                    del self._unsent[: self._end.send(self._unsent)]
                except BlockingIOError:
                    left_s = ends_at - time.monotonic()
                    if left_s <= 0:
                        return
                    select.select([], [self._end], [], left_s)
                except OSError:
                    self._unsent.clear()

    def receive(self) -> list[Message] | None:
        """The messages that have arrived since the last call. None once the other process is gone and all were
        returned.
        """
        ended = False
        while not ended:
            try:
                data = self._end.recv(_READ_BYTES)
            except BlockingIOError:
                break
            except OSError:
                data = b""
            ended = not data
            self._received += data
        *lines, rest = self._received.split(b"\n")
        self._received = bytearray(rest)
        if ended and not lines:
            return None
        return [json.loads(line) for line in lines]

    def close(self) -> None:
        """Close the connection; a second call does nothing."""
        self._end.close()


def error_message(error: BaseException) -> list[str]:
    """The content of a message that carries an error: the name of its class and its text."""
    return [type(error).__name__, str(error)]


def error_from(message: list[str]) -> DeviceError:
    """The error that a message from `error_message` carries. If its class is not in `drivers.errors`, a `ProtocolError`
    that says that the guard failed."""
    name, text = message
    kind = getattr(drivers.errors, name, None)
    if isinstance(kind, type) and issubclass(kind, DeviceError):
        return kind(text)
    return ProtocolError(f"the guard failed with {name}: {text}; report it")


def plain_ports(ports: Mapping[str, Any]) -> dict[str, str]:
    """Addresses of the emulated ports, by name. USB and serial ports that exist only in this process's memory are left
    out: the guard cannot open them."""
    return {name: port.address for name, port in ports.items() if port.usb_backend is None and port.serial_port is None}


_FRAME, _WAITED = struct.Struct("<q"), struct.Struct("<d")
_NO_FRAME = -1


def require_linux() -> None:
    """Raise `DeviceError` where no guard can run: it needs memory that two processes share without a file, and /proc,
    by which it sees whether the application still runs. Only Linux has both."""
    if not hasattr(os, "memfd_create") or not os.path.exists("/proc/self/stat"):
        raise DeviceError(
            "light is guarded by a process that takes it away if the program dies or hangs, which needs Linux; use a "
            "simulated laser and sync source here, or scan from a Linux PC"
        )


class Heartbeat:
    """The shared page of memory. Each of the two processes has an object of this class for it."""

    def __init__(self, handle: int) -> None:
        """handle: file descriptor of an anonymous file of at least one memory page; `close` closes it."""
        self.handle = handle
        self._page = mmap.mmap(handle, mmap.PAGESIZE)

    @classmethod
    def create(cls) -> "Heartbeat":
        """A new page in memory, not in a file on a disk, which could block. Its frame number is -1. Raises
        `DeviceError` outside Linux."""
        require_linux()
        handle = os.memfd_create("spadrig-heartbeat")
        os.ftruncate(handle, mmap.PAGESIZE)
        beat = cls(handle)
        beat.frame = _NO_FRAME
        return beat

    @property
    def frame(self) -> int:
        """The last frame number that was reported; -1 before the first one."""
        return int(_FRAME.unpack_from(self._page)[0])

    @frame.setter
    def frame(self, number: int) -> None:
        _FRAME.pack_into(self._page, 0, number)

    @property
    def waited_s(self) -> float:
        """Seconds for which the source thread has been asking the SPAD for frames without getting any."""
        return float(_WAITED.unpack_from(self._page, _FRAME.size)[0])

    @waited_s.setter
    def waited_s(self, seconds: float) -> None:
        _WAITED.pack_into(self._page, _FRAME.size, seconds)

    def close(self) -> None:
        """Give the page back; a second call does nothing."""
        if self.handle >= 0:
            self._page.close()
            os.close(self.handle)
            self.handle = -1
