"""A TCP connection with a deadline on every call, and one typed error for each way in which it can fail.

Wraps the standard library's sockets. Only looking up a host name has no deadline of ours. The resolver has its own, so
give numeric addresses if that matters.
"""

import errno
import select
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from drivers.errors import DeviceDisconnected, DeviceError, DeviceNotFound, DevicePermission, DeviceTimeout
from drivers.transports.endpoints import one_line

_FORBIDDEN = (errno.EACCES, errno.EPERM)
_CHUNK_BYTES = 65_536
"""Largest number of bytes that `receive` takes at a time."""


class TcpStream:
    """An open connection. `close` is idempotent and may be called from any thread; all else from one thread."""

    def __init__(self, name: str, address: str, *, connect_s: float = 5.0) -> None:
        """Connect. name: the device's name in messages; address: "host:port".

        Raises `DeviceNotFound` (refused, unreachable, silent or no such host) or `DevicePermission`.
        """
        self._name = name
        self._address = address
        host, port = _split(name, address)
        try:
            self._socket = socket.create_connection((host, port), connect_s)
        except OSError as error:
            raise self._refused(error, connect_s) from None
        self._socket.setblocking(False)
        with suppress(OSError):  # a hint: commands are single small packets
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def send(self, data: bytes, deadline_s: float) -> None:
        """Send all of `data`. Raises `DeviceTimeout` if the other side takes none for `deadline_s`, or
        `DeviceDisconnected`.
        """
        ends_at = time.monotonic() + deadline_s
        rest = memoryview(data)
        while rest:
            with self._translated():
                if not select.select([], [self._socket], [], max(0.0, ends_at - time.monotonic()))[1]:
                    raise DeviceTimeout(f"{self._name} took no data for {deadline_s:g} s on {self._address}; it hangs")
                with suppress(BlockingIOError):
                    rest = rest[self._socket.send(rest) :]

    def receive(self, deadline_s: float, limit: int = _CHUNK_BYTES) -> bytes:
        """The bytes that have come, at least one; b"" if nothing came within the deadline. May raise
        `DeviceDisconnected`.
        """
        buffer = bytearray(limit)
        return bytes(buffer[: self.receive_into(memoryview(buffer), deadline_s)])

    def receive_into(self, view: memoryview, deadline_s: float) -> int:
        """Receive bytes into `view`; returns their number, 0 after the deadline. May raise `DeviceDisconnected`."""
        ends_at = time.monotonic() + deadline_s
        while True:
            with self._translated():
                if not select.select([self._socket], [], [], max(0.0, ends_at - time.monotonic()))[0]:
                    return 0
                try:
                    n = self._socket.recv_into(view)
                except BlockingIOError:
                    continue
            if n == 0:
                raise DeviceDisconnected(f"{self._name}: {self._address} closed the connection")
            return n

    def drain(self, quiet_s: float, deadline_s: float) -> bytes:
        """Read all that comes until the line is quiet for `quiet_s`, at most for `deadline_s`; returns it."""
        ends_at = time.monotonic() + deadline_s
        dropped = bytearray()
        while (left_s := ends_at - time.monotonic()) > 0 and (data := self.receive(min(quiet_s, left_s))):
            dropped += data
            del dropped[:-_CHUNK_BYTES]  # the end says why it ended; a burst of gigabytes is not kept
        return bytes(dropped)

    def close(self) -> None:
        """Close the connection; a second call does nothing. Never raises."""
        with suppress(OSError):
            self._socket.close()

    def _refused(self, error: OSError, connect_s: float) -> DeviceError:
        where = f"{self._name}: {self._address}"
        if isinstance(error, ConnectionRefusedError):
            return DeviceNotFound(
                f"{where} refuses the connection; start the program that serves it, end its other clients, or correct "
                "'port'"
            )
        if error.errno in _FORBIDDEN:
            return DevicePermission(f"{where} may not be connected to by this user; ask for a firewall rule")
        if isinstance(error, TimeoutError):
            return DeviceNotFound(f"{where} did not answer within {connect_s:g} s; check cable and address")
        return DeviceNotFound(f"{where} cannot be reached ({one_line(error)}); correct 'port'")

    @contextmanager
    def _translated(self) -> Iterator[None]:
        """Raise our error for all that a socket raises about an open connection: it means that this is gone."""
        try:
            yield
        except (OSError, ValueError) as error:
            # ValueError: what select makes of a socket that was closed by another thread.
            raise DeviceDisconnected(
                f"{self._name}: the connection to {self._address} is lost ({one_line(error)})"
            ) from None


def _split(name: str, address: str) -> tuple[str, int]:
    """Host and port number of "host:port"."""
    host, colon, port = address.rpartition(":")
    if not colon or not host or not port.isascii() or not port.isdigit() or not 0 < int(port) < 65_536:
        raise DeviceNotFound(f"{name}: {address!r} is no address; write 'port' as host:port, like 127.0.0.1:9999")
    return host.strip("[]"), int(port)
