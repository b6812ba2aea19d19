"""The connection to an Ether Dream laser DAC: commands, replies and its broadcast.

Commands go one at a time over TCP, and each gets a reply of 22 bytes with the board's whole status; only `v` gets 32
bytes of text. Once a second a board broadcasts a datagram with its MAC address, revisions, buffer and highest rate.

A connection that was interrupted in the middle of a command, or that gave no proper reply, is closed for good.
Otherwise the firmware might take the next command for the rest of the interrupted one, or the driver might take a late
reply for the reply to the next command. Unknown commands are never sent: they close the connection or stop the board. A
rate above the board's highest is refused after one byte, and the rest of the command is then read as further commands.
Facts and sources: docs/reference/devices/etherdream.md.
"""

import logging
import socket
import struct
import threading
import time
from collections.abc import Generator
from contextlib import closing, suppress
from dataclasses import dataclass

from drivers.errors import CommandRefused, DeviceBusy, DeviceDisconnected, DeviceError, DeviceTimeout, ProtocolError
from drivers.transports.endpoints import Endpoint, printable
from drivers.transports.tap import IN, OUT, Tap
from drivers.transports.tcp_line import TcpStream

_log = logging.getLogger(__name__)

TCP_PORT, BROADCAST_PORT = 7765, 7654
IDLE, PREPARED, PLAYING = 0, 1, 2
"""States of playback. Idle and prepared: all colours are dark, the mirror is at the centre."""
READY, STOPPED = 0, 3
"""States of the 'light engine': normal, and emergency stop. 1 and 2, warm-up and cool-down, are not used."""
UNDERFLOW, BY_EMERGENCY = 2, 4
"""Bits of `flags` that say why playback ended. An Ether Dream 2 sets other bits too, without a meaning."""
PREPARE, STOP, EMERGENCY, CLEAR, PING, VERSION = b"p", b"s", b"\x00", b"c", b"?", b"v"
ACCEPTED, STILL_STOPPED = b"a", b"!"
_REPLY = struct.Struct("<cxx3B2xH2xH2I")
_BROADCAST = struct.Struct("<6s3HI20x")
_VERSION_BYTES = 32
_CONNECT_S = 2.0
REPLY_S = 1.0
"""Deadline for a reply while nothing plays. An Ether Dream 2 usually takes 0.5 ms and sometimes 35 ms."""
BROADCAST_S = 1.5
"""Time within which a board broadcasts at least once."""


def begin(rate_hz: int) -> bytes:
    """The command that starts playback. Its other number, a low-water mark, is not used by any firmware."""
    return struct.pack("<cHI", b"b", 0, rate_hz)


def queue_rate(rate_hz: int) -> bytes:
    """The command that queues a rate for the next point whose control word asks for one."""
    return struct.pack("<cI", b"q", rate_hz)


def data(points: bytes, n: int) -> bytes:
    """The command that appends n points, of 18 bytes each, to the board's buffer."""
    return struct.pack("<cH", b"d", n) + points


@dataclass(frozen=True, slots=True)
class Reply:
    """The reply to a command, with the board's report on itself."""

    code: bytes
    """`ACCEPTED`, `STILL_STOPPED`, b"F" (full) or b"I" (invalid)."""
    light_engine: int
    playback: int
    source: int
    """0: the network; 1: files from the board's SD card; 2: its own patterns."""
    flags: int
    fullness: int
    """Points in the buffer. After a stop this stays as it was, until the next `PREPARE`."""
    rate_hz: int
    count: int
    """Points played since playback began, modulo 2^32; 0 if it does not play."""

    @classmethod
    def read(cls, bytes_22: bytes) -> "Reply":
        """The content of a reply of 22 bytes."""
        return cls(*_REPLY.unpack(bytes_22))


@dataclass(frozen=True, slots=True)
class Broadcast:
    """The board's broadcast, without the status in it."""

    mac: str
    hardware: int
    software: int
    capacity: int
    """Most points that the buffer holds."""
    highest_rate_hz: int

    @classmethod
    def read(cls, datagram: bytes) -> "Broadcast | None":
        """The content of a datagram; None if it does not have the length of an Ether Dream's broadcast."""
        if len(datagram) != _BROADCAST.size:
            return None
        mac, *numbers = _BROADCAST.unpack(datagram)
        return cls(mac.hex(":"), *numbers)


def broadcasts(wait_s: float = BROADCAST_S, port: int = BROADCAST_PORT) -> Generator[tuple[str, Broadcast], None, None]:
    """The broadcasts that come within `wait_s`, each with its sender's numeric address. Ends early, without an error,
    if the socket fails, for example if another program keeps the port to itself."""
    ends_at = time.monotonic() + wait_s
    with suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ear:
        ear.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        ear.bind(("", port))
        while (left_s := ends_at - time.monotonic()) > 0:
            ear.settimeout(left_s)
            datagram, sender = ear.recvfrom(2048)
            heard = Broadcast.read(datagram)
            if heard is not None:
                yield str(sender[0]), heard


def listen(host: str) -> Broadcast | None:
    """The next broadcast that comes from the numeric address `host`; None if none does within `BROADCAST_S`."""
    with closing(broadcasts()) as all_heard:
        return next((heard for sender, heard in all_heard if sender == host), None)


class EtherDreamLine:
    """The connection to a board, open from its creation until `close` or an error. Any thread may call its methods;
    they take turns."""

    def __init__(self, name: str, endpoint: Endpoint, tap: Tap | None = None) -> None:
        """Connect to "host" or "host:port", and read the status that a board sends to each new client. Raises what
        `TcpStream` raises, `DeviceBusy` if the board closes the connection at once, `DeviceTimeout` or
        `ProtocolError`."""
        self._name, self._tap = name, tap
        self.lock = threading.RLock()
        """Held during each command. Hold it to keep other threads' commands away for longer."""
        self._lost: DeviceError | None = None
        """The error that closed the connection; None: it is open, or was closed on purpose."""
        address = endpoint.address if ":" in endpoint.address else f"{endpoint.address}:{TCP_PORT}"
        self._stream: TcpStream = (
            TcpStream(name, address, _CONNECT_S) if endpoint.tcp_stream is None else endpoint.tcp_stream()
        )
        try:
            self._read(PING, _REPLY.size)
        except BaseException as error:
            self._stream.close()
            if isinstance(error, DeviceDisconnected):
                raise DeviceBusy(
                    f"{name}: {address} took the connection and closed it at once; end its other client"
                ) from None
            raise

    @property
    def peer(self) -> str:
        """The board's numeric address."""
        return self._stream.peer

    def ask(self, command: bytes, within_s: float = REPLY_S) -> Reply:
        """Send one command, not `VERSION`, and return its reply. Raises `DeviceTimeout`, `DeviceDisconnected` or
        `ProtocolError`; each of them closes the connection, and every later command raises the same error.
        """
        return Reply.read(self._exchange(command, _REPLY.size, within_s))

    def tell(self, command: bytes) -> Reply:
        """Send one command and return its reply. Raises `CommandRefused` if the board refuses it, and what `ask`
        raises."""
        reply = self.ask(command)
        if reply.code != ACCEPTED:
            raise CommandRefused(
                f"{self._name}: refuses command {_shown(command)} with {_shown(reply.code)} in state "
                f"{reply.light_engine}/{reply.playback}; end its other clients"
            )
        return reply

    def version(self) -> str:
        """The firmware's name for itself. The oldest firmware does not know the command and closes the connection.
        Raises as `ask`."""
        return printable(self._exchange(VERSION, _VERSION_BYTES).split(b"\0")[0].decode("ascii", "replace"))

    def close(self) -> None:
        """Close the connection; a second call does nothing."""
        self._stream.close()

    def _exchange(self, command: bytes, n: int, within_s: float = REPLY_S) -> bytes:
        with self.lock:
            if self._lost is not None:
                raise self._lost
            try:
                if self._tap is not None:
                    self._tap.note("tcp", OUT, command)
                self._stream.send(command, within_s)
                return self._read(command[:1], n, within_s)
            except BaseException as error:
                interrupted = DeviceDisconnected(f"{self._name}: a command was interrupted; open it again")
                self._lost = error if isinstance(error, DeviceError) else interrupted
                self._stream.close()
                raise

    def _read(self, command: bytes, n: int, within_s: float = REPLY_S) -> bytes:
        reply = self._stream.receive_exactly(n, within_s)
        if self._tap is not None:
            self._tap.note("tcp", IN, reply)
        if len(reply) < n:
            raise DeviceTimeout(
                f"{self._name}: {len(reply)} of {n} B in reply to command {_shown(command)} within {within_s:.2g} s; "
                "check its cable and power-cycle it"
            )
        if command != VERSION and reply[1:2] != command:
            raise ProtocolError(
                f"{self._name}: replied {reply[:2].hex(' ')} to command {_shown(command)}; is 'port' an Ether Dream?"
            )
        return reply


def _shown(command: bytes) -> str:
    return command[:1].decode("ascii") if command[:1].isalpha() else command[:1].hex()
