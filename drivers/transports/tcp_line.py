"""A TCP connection to a device or to the program that serves it.

Every call has a deadline in the host's time, and each way in which a connection can fail has an error class of its own.
Only looking up a host name takes as long as the resolver allows, so give numeric addresses if that matters.
"""

import errno
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from drivers.errors import DeviceDisconnected, DeviceError, DeviceNotFound, DevicePermission, DeviceTimeout
from drivers.transports.endpoints import one_line

_FORBIDDEN = (errno.EACCES, errno.EPERM)
_NEXT = "check cable and power, end its other clients, then open it again"
_CHUNK_BYTES = 65_536
"""Largest number of bytes that `receive` takes at a time."""
_CONNECT_S = 5.0
"""Longest wait for a connection."""


class TcpStream:
    """An open connection. `close` may be called more than once and from any thread, all other methods from one
    thread."""

    def __init__(self, name: str, address: str, connect_s: float = _CONNECT_S) -> None:
        """Connect within `connect_s`. name: the device's name in messages; address: "host:port".

        Raises `DeviceNotFound` (refused, unreachable, silent or no such host) or `DevicePermission`.
        """
        self._name = name
        self._address = address
        self._connect_s = connect_s
        host, port = _split(name, address)
        try:
            self._socket = socket.create_connection((host, port), connect_s)
        except OSError as error:
            raise self._refused(error) from None
        with suppress(OSError):  # a hint: commands are single small packets
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    @property
    def peer(self) -> str:
        """The other side's numeric address, without the port. May raise `DeviceDisconnected`."""
        with self._translated():
            return str(self._socket.getpeername()[0])

    def send(self, data: bytes, deadline_s: float) -> None:
        """Send all of `data`. Raises `DeviceTimeout` if the other side has not taken it within `deadline_s`, or
        `DeviceDisconnected`.
        """
        with self._translated():
            self._socket.settimeout(deadline_s)
            try:
                self._socket.sendall(data)
            except TimeoutError as error:
                if error.errno == errno.ETIMEDOUT:
                    raise  # of the connection: the other side is lost
                raise DeviceTimeout(
                    f"{self._name} took no data for {deadline_s:g} s on {self._address}; it hangs"
                ) from None

    def receive(self, deadline_s: float) -> bytes:
        """The bytes that have arrived; b"" if none arrived within the deadline. May raise `DeviceDisconnected`."""
        buffer = bytearray(_CHUNK_BYTES)
        return bytes(buffer[: self.receive_into(memoryview(buffer), deadline_s)])

    def receive_into(self, view: memoryview, deadline_s: float) -> int:
        """Receive bytes into `view`; returns their number, 0 after the deadline. May raise `DeviceDisconnected`."""
        with self._translated():
            self._socket.settimeout(deadline_s)
            try:
                n = self._socket.recv_into(view)
            except (TimeoutError, BlockingIOError) as error:  # the second if the deadline is 0
                if error.errno == errno.ETIMEDOUT:
                    raise  # of the connection: the other side is lost
                return 0
        if n == 0:
            raise DeviceDisconnected(f"{self._name}: {self._address} closed the connection; {_NEXT}")
        return n

    def receive_exactly(self, n: int, deadline_s: float) -> bytes:
        """The next n bytes; fewer if they have not all come within the deadline. May raise `DeviceDisconnected`."""
        ends_at = time.monotonic() + deadline_s
        buffer = memoryview(bytearray(n))
        came = 0
        while came < n and (left_s := ends_at - time.monotonic()) > 0:
            came += self.receive_into(buffer[came:], left_s)
        return bytes(buffer[:came])

    def drain(self, quiet_s: float, deadline_s: float) -> bytes:
        """Read and drop until nothing comes for `quiet_s`, at most for `deadline_s`; returns the last 64 KiB that
        came."""
        ends_at = time.monotonic() + deadline_s
        dropped = bytearray()
        while (left_s := ends_at - time.monotonic()) > 0 and (data := self.receive(min(quiet_s, left_s))):
            dropped += data
            del dropped[:-_CHUNK_BYTES]  # the last bytes say why the run ended; a burst of gigabytes is not kept
        return bytes(dropped)

    def close(self) -> None:
        """Close the connection; a second call does nothing. Never raises."""
        with suppress(OSError):
            self._socket.close()

    def _refused(self, error: OSError) -> DeviceError:
        where = f"{self._name}: {self._address}"
        if isinstance(error, ConnectionRefusedError):
            return DeviceNotFound(
                f"{where} refuses the connection; start the program that serves it, end its other clients, or correct "
                "'port'"
            )
        if error.errno in _FORBIDDEN:
            return DevicePermission(f"{where} may not be connected to by this user; ask for a firewall rule")
        if isinstance(error, TimeoutError):
            return DeviceNotFound(f"{where} did not answer within {self._connect_s:g} s; check cable and address")
        return DeviceNotFound(f"{where} cannot be reached ({one_line(error)}); correct 'port'")

    @contextmanager
    def _translated(self) -> Iterator[None]:
        """Raise `DeviceDisconnected` for any error of the socket: all of them mean that the connection is gone."""
        try:
            yield
        except OSError as error:
            raise DeviceDisconnected(
                f"{self._name}: the connection to {self._address} is lost ({one_line(error)}); {_NEXT}"
            ) from None


def _split(name: str, address: str) -> tuple[str, int]:
    """Host and port number of "host:port"."""
    host, colon, port = address.rpartition(":")
    if not colon or not host or not port.isascii() or not port.isdigit() or not 0 < int(port) < 65_536:
        raise DeviceNotFound(f"{name}: {address!r} is no address; write 'port' as host:port, like 127.0.0.1:9999")
    return host.strip("[]"), int(port)
