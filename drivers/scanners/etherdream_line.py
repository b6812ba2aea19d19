"""The connection to an Ether Dream laser DAC: commands, replies and its broadcast (docs/reference/hardware.md).

Commands go one at a time over TCP, and each gets a reply of 22 bytes with the board's whole status; only `v` gets 32
bytes of text. Once a second a board broadcasts a datagram with its MAC address, revisions, buffer and highest rate.

A connection that was interrupted in the middle of a command, or that gave no proper reply, is closed: the firmware
would take the next command for the rest of the last one. A new connection begins with a fresh parser.

Sources: ether-dream.com/protocol.html; `j4cbo/j4cDAC` 12ecbe5, common/protocol.h and firmware/net/point-stream.c (read
for facts; no code taken); captures of an Ether Dream 2 in `ModulaserApp/laser-dac-rs` 01321db,
tests/fixtures/ether_dream. Unknown commands are never sent: they close the connection or stop the board. A rate above
the board's highest is refused after one byte, and the rest of the command is then read as further commands.
"""

import logging
import socket
import struct
import threading
import time
from dataclasses import dataclass

from drivers.errors import (
    CommandRefused,
    DeviceBusy,
    DeviceDisconnected,
    DeviceError,
    DeviceNotFound,
    DeviceTimeout,
    ProtocolError,
)
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
_STATUS = struct.Struct("<4B4H2I")
_BROADCAST = struct.Struct("<6s3HI")
_VERSION_BYTES = 32
_CONNECT_S = 2.0
_REPLY_S = 1.0
"""Deadline for a reply. An Ether Dream 2 usually takes 0.5 ms and sometimes 35 ms."""
_LISTENS_S = 1.0
"""Longest time until a board whose only client has left takes another one."""
BROADCAST_S = 1.5
"""Time within which a board has broadcast at least once."""


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
class BoardStatus:
    """The board's report on itself. Its 'light engine flags' are left out: firmware puts the state there."""

    light_engine: int
    playback: int
    source: int
    """0: the network; 1: files from its SD card; 2: its own patterns."""
    flags: int
    fullness: int
    """Points in the buffer. After a stop this stays as it was, until the next `PREPARE`."""
    rate_hz: int
    count: int
    """Points played since playback began, modulo 2^32; 0 if it does not play."""

    @classmethod
    def read(cls, bytes_20: bytes) -> "BoardStatus":
        """The status in 20 bytes of a reply or broadcast."""
        _, light_engine, playback, source, _, flags, _, fullness, rate_hz, count = _STATUS.unpack(bytes_20)
        return cls(light_engine, playback, source, flags, fullness, rate_hz, count)


@dataclass(frozen=True, slots=True)
class Reply:
    """The reply to a command."""

    code: bytes
    """`ACCEPTED`, `STILL_STOPPED`, b"F" (full) or b"I" (invalid)."""
    status: BoardStatus


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
        """The content of a datagram; None if it is none of an Ether Dream."""
        if len(datagram) != _BROADCAST.size + _STATUS.size:
            return None
        mac, *numbers = _BROADCAST.unpack_from(datagram)
        return cls(mac.hex(":"), *numbers)


def listen(host: str, wait_s: float = BROADCAST_S, port: int = BROADCAST_PORT) -> Broadcast | None:
    """The next broadcast that comes from the numeric address `host`; None if none does within `wait_s`, or if another
    program keeps the port to itself.
    """
    ends_at = time.monotonic() + wait_s
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ear:
            ear.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            ear.bind(("", port))
            while (left_s := ends_at - time.monotonic()) > 0:
                ear.settimeout(left_s)
                datagram, sender = ear.recvfrom(2048)
                heard = Broadcast.read(datagram) if sender[0] == host else None
                if heard is not None:
                    return heard
    except OSError as error:
        _log.debug("no broadcast of %s on UDP port %d: %s", host, port, error)
    return None


class EtherDreamLine:
    """The connection, open from the start. Any thread may call its methods; they take turns."""

    def __init__(self, name: str, address: str, tap: Tap | None = None) -> None:
        """Connect. address: "host" or "host:port". Raises what `TcpStream` raises, `DeviceBusy` or `DeviceTimeout`."""
        self._name = name
        self.address = address if ":" in address else f"{address}:{TCP_PORT}"
        self._tap = tap
        self.lock = threading.RLock()
        """Held during each command. Hold it to keep other threads' commands away for longer."""
        self.lost: DeviceError | None = None
        """The error that closed the connection; None: it is open, or was closed on purpose."""
        self._stream = TcpStream(name, self.address, _CONNECT_S)
        self._greet()

    @property
    def peer(self) -> str:
        """The board's numeric address."""
        return self._stream.peer

    def connect_again(self) -> None:
        """Connect again if the connection was lost. Raises `DeviceDisconnected` if that is not possible."""
        with self.lock:
            ends_at = time.monotonic() + _LISTENS_S
            while self.lost is not None:
                try:
                    self._stream = TcpStream(self._name, self.address, _CONNECT_S)
                    self._greet()
                    self.lost = None
                except DeviceError as error:
                    if not isinstance(error, DeviceNotFound) or time.monotonic() > ends_at:
                        raise DeviceDisconnected(
                            f"{self._name}: the connection is lost and there is no new one ({error}); check cable and "
                            "power"
                        ) from None
                    time.sleep(0.02)

    def ask(self, command: bytes) -> Reply:
        """Send one command, not `VERSION`, and return its reply. Raises `DeviceTimeout`, `DeviceDisconnected` or
        `ProtocolError`, and each of them closes the connection.
        """
        reply = self._exchange(command, 2 + _STATUS.size)
        return Reply(reply[:1], BoardStatus.read(reply[2:]))

    def tell(self, command: bytes) -> BoardStatus:
        """Send one command that must be accepted. Raises `CommandRefused` if it is not, else as `ask`."""
        reply = self.ask(command)
        if reply.code != ACCEPTED:
            raise CommandRefused(
                f"{self._name}: refuses command {_shown(command)} with {_shown(reply.code)} in state "
                f"{reply.status.light_engine}/{reply.status.playback}; end its other clients"
            )
        return reply.status

    def version(self) -> str:
        """The firmware's name for itself. The oldest firmware does not know the command and closes the connection."""
        return self._exchange(VERSION, _VERSION_BYTES).split(b"\0")[0].decode("ascii", "replace")

    def close(self) -> None:
        """Close the connection; a second call does nothing."""
        self._stream.close()

    def _greet(self) -> None:
        """Read the status that a board sends to each new client."""
        try:
            self._read(PING, 2 + _STATUS.size)
        except DeviceDisconnected:
            self._stream.close()
            raise DeviceBusy(
                f"{self._name}: {self.address} took the connection and closed it at once; end its other client"
            ) from None
        except BaseException:
            self._stream.close()
            raise

    def _exchange(self, command: bytes, n: int) -> bytes:
        with self.lock:
            if self.lost is not None:
                raise self.lost
            try:
                if self._tap is not None:
                    self._tap.note("tcp", OUT, command)
                self._stream.send(command, _REPLY_S)
                return self._read(command[:1], n)
            except BaseException as error:
                interrupted = DeviceDisconnected(f"{self._name}: a command was interrupted; start again")
                self.lost = error if isinstance(error, DeviceError) else interrupted
                self._stream.close()
                raise

    def _read(self, command: bytes, n: int) -> bytes:
        reply = self._stream.receive_exactly(n, _REPLY_S)
        if self._tap is not None:
            self._tap.note("tcp", IN, reply)
        if len(reply) < n:
            raise DeviceTimeout(
                f"{self._name}: {len(reply)} of {n} B in reply to command {_shown(command)} within {_REPLY_S:g} s; "
                "power-cycle it"
            )
        if command != VERSION and reply[1:2] != command:
            raise ProtocolError(
                f"{self._name}: replied {reply[:2].hex(' ')} to command {_shown(command)}; is 'port' an Ether Dream?"
            )
        return reply


def _shown(command: bytes) -> str:
    return command[:1].decode("ascii") if command[:1].isalpha() else command[:1].hex()
