"""Messages between application and guard: one JSON object a line over a socket pair, and errors on their way.

The end of the stream is a message too: the kernel sends it the moment the other process is gone.
"""

import json
import select
import socket
import threading
import time
from collections.abc import Mapping
from typing import Any

import drivers.errors
from drivers.errors import DeviceError, ProtocolError

Message = dict[str, Any]
_READ_BYTES = 65_536


class Channel:
    """One end. Sending is safe from any thread, receiving belongs to one."""

    def __init__(self, end: socket.socket) -> None:
        end.setblocking(False)
        self._end = end
        self._lock = threading.Lock()
        self._unsent = bytearray()
        self._received = bytearray()

    def fileno(self) -> int:
        """For select."""
        return self._end.fileno()

    def send(self, message: Message, within_s: float = 0.0) -> None:
        """Queue a message and pass on what the socket takes within that time; the rest goes with later calls.

        A peer that is gone is no error here: `receive` tells.
        """
        line = json.dumps(message, separators=(",", ":")).encode() + b"\n"
        with self._lock:
            self._unsent += line
        self.flush(within_s)

    def flush(self, within_s: float = 0.0) -> None:
        """Pass on what is still unsent, as far as the socket takes it within that time."""
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
        """The messages that have come; None after the last one, when the other process is gone."""
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
        """Hang up; again: nothing happens."""
        self._end.close()


def error_message(error: BaseException) -> list[str]:
    """An error on its way: its class and its text."""
    return [type(error).__name__, str(error)]


def error_from(message: list[str]) -> DeviceError:
    """The error that arrived. One that is not of our tree is a fault of the guard itself."""
    name, text = message
    kind = getattr(drivers.errors, name, None)
    if isinstance(kind, type) and issubclass(kind, DeviceError):
        return kind(text)
    return ProtocolError(f"the guard failed with {name}: {text}; report it")


def plain_ports(ports: Mapping[str, Any]) -> dict[str, str]:
    """Emulated ports by name, without those that exist in this process's memory only."""
    return {name: port.address for name, port in ports.items() if port.usb_backend is None}
