"""A Helios laser DAC as its firmware behaves, traps included (docs/reference/devices/helios.md; vendor's firmware v6,
0952a2a).

There are two buffers, one playing and one pending, and a status polled with 03. A frame whose length is a multiple of
the packet size never completes. Invalid frames are dropped silently, and so are frames within 100 ms after STOP. A
frame without SINGLE repeats for ever, and one that follows another begins with a longer point. `DacModel` is the part
that emulated scanner boards have in common; emulated worlds and tests read its record of the outputs.
"""

import struct
import threading
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sim_backend.wire.serve.usb_model import STALL, AlternateSpec, Answer, DeviceSpec, EndpointSpec, Stall, UsbModel

Array = NDArray[np.float64]

JOINED_S = 0.1
"""Duration from which on a piece of the history is not lengthened any more."""
KEEP_S = 20.0
"""Age at which the output's history is dropped."""


@dataclass(frozen=True, slots=True, eq=False)
class Played:
    """Points played from start_s on, one every period_s, cut off at end_s. The first one lasts longer by longer_s.

    command: float64 (n,), normalised drive, -1 to 1. levels: uint8 (n, lines), colour outputs.
    """

    start_s: float
    end_s: float
    period_s: float
    command: Array
    levels: NDArray[np.uint8]
    longer_s: float = 0.0

    def points_at(self, time_s: Array) -> NDArray[np.int64]:
        """Indices of the points at times within the piece."""
        at = np.floor((time_s - self.start_s - self.longer_s) / self.period_s + 1e-9).astype(np.int64)
        return np.clip(at, 0, len(self.command) - 1)

    def starts_s(self, points: NDArray[np.int64]) -> Array:
        """Times at which points begin."""
        at_s: Array = self.start_s + points * self.period_s + self.longer_s * (points > 0).astype(np.float64)
        return at_s


class DacHistory:
    """Output over time: the pieces that were played, and rests between them during which the colour outputs are 0.

    Pieces that ended more than `KEEP_S` before the newest piece begins are dropped, and the output at their times then
    reads as a rest. Thread-safe."""

    def __init__(self, command: float, lines: int) -> None:
        self._lock = threading.Lock()
        self._lines = lines
        self._played: deque[Played] = deque()
        self._rests: deque[tuple[float, float]] = deque([(-np.inf, command)])
        """(from, command): where the mirror command stands when nothing is played, ascending."""

    def play(self, played: Played) -> None:
        """Append what is played. It must start at the end of the previous piece or later."""
        with self._lock:
            if self._played and _joins(self._played[-1], played):
                last = self._played.pop()
                self._rests.pop()
                command = np.concatenate([last.command, played.command])
                levels = np.concatenate([last.levels, played.levels])
                played = replace(last, end_s=played.end_s, command=command, levels=levels)
            self._played.append(played)
            self._rests.append((played.end_s, float(played.command[-1])))
            while self._played[0].end_s < played.start_s - KEEP_S:
                self._played.popleft()
            while len(self._rests) > 1 and self._rests[1][0] < played.start_s - KEEP_S:
                self._rests.popleft()

    def cut(self, time_s: float, command: float | None = None) -> None:
        """Play nothing from `time_s` on. The drive keeps its value, or jumps to `command` if that is given."""
        here = float(self.command(np.array([time_s]))[0])
        with self._lock:
            while self._played and self._played[-1].start_s >= time_s:
                self._played.pop()
            if self._played and self._played[-1].end_s > time_s:
                self._played[-1] = replace(self._played[-1], end_s=time_s)
            while len(self._rests) > 1 and self._rests[-1][0] >= time_s:
                self._rests.pop()
            self._rests.append((time_s, here if command is None else command))

    def command(self, time_s: Array) -> Array:
        """Normalised drive at the given times, in the steps of the DAC and without the mirror's lag."""
        with self._lock:
            starts, values = np.array(self._rests).T
            result: Array = values[np.maximum(np.searchsorted(starts, time_s, side="right") - 1, 0)]
            for one, inside, at in self._at(time_s):
                result[inside] = one.command[at]
            return result

    def level(self, line: int, time_s: Array) -> NDArray[np.uint8]:
        """Level of an output at the given times; 0 when nothing is played."""
        result = np.zeros(time_s.shape, np.uint8)
        with self._lock:
            for one, inside, at in self._at(time_s):
                result[inside] = one.levels[at, line]
        return result

    def rising(self, line: int, from_s: float, until_s: float) -> Array:
        """Times of an output's rising edges in [from_s, until_s), ascending. An output that stays high over a seam has
        one edge.
        """
        edges: list[Array] = []
        with self._lock:
            high_until = -np.inf
            # A piece that ended shortly before is used too: it shows whether an output high at from_s rose earlier.
            for one in self._between(from_s - KEEP_S / 100, until_s):
                high = one.levels[:, line] > 0
                before = np.concatenate([[one.start_s - high_until < one.period_s / 2], high[:-1]])
                at = one.starts_s(np.flatnonzero(high & ~before))
                edges.append(at[(at >= from_s) & (at < min(until_s, one.end_s))].astype(np.float64))
                high_until = one.end_s if high[-1] else -np.inf
        return np.concatenate(edges) if edges else np.empty(0)

    def _at(self, time_s: Array) -> Iterator[tuple[Played, NDArray[np.bool_], NDArray[np.int64]]]:
        """Each piece played at the times: the piece, a mask of its times, and the indices of its points at them."""
        for one in self._between(time_s.min(initial=np.inf), time_s.max(initial=-np.inf)):
            inside = (time_s >= one.start_s) & (time_s < one.end_s)
            yield one, inside, one.points_at(time_s[inside])

    def _between(self, from_s: float, until_s: float) -> list[Played]:
        """The pieces that were played in [from_s, until_s], ascending."""
        return [one for one in self._played if one.end_s > from_s and one.start_s <= until_s]


def _joins(last: Played, played: Played) -> bool:
    """Whether two pieces can be kept as one: small ones of a long stream would be thousands to look through."""
    whole_s = last.longer_s + len(last.command) * last.period_s
    seamless = max(abs(last.start_s + whole_s - at_s) for at_s in (last.end_s, played.start_s)) < 1e-3 * last.period_s
    return seamless and last.period_s == played.period_s and not played.longer_s and whole_s < JOINED_S


DAC_STEPS = 4095
CENTRE = 0x800 / DAC_STEPS * 2 - 1
"""Normalised drive of an output at 0 V, as without power."""


class DacModel(UsbModel):
    """Base of the scanner boards. `history` records what the outputs did; times are the transport's."""

    centre = CENTRE
    """Drive at which the board itself puts the mirror."""

    def __init__(self, spec: DeviceSpec, *, commands: int, replies: int, points: int) -> None:
        """commands, replies, points: addresses of the endpoints that carry them."""
        self.spec = spec
        self.history = DacHistory(self.centre, lines=4)
        self.deaf = False
        """Test knob: whether the firmware hangs, while its outputs play on."""
        self.points_endpoint = points
        self._commands_endpoint, self._replies_endpoint = commands, replies
        self._replies: deque[bytes] = deque()

    def out(self, endpoint: int, data: bytes, now_s: float) -> int | Stall | None:
        """Take commands and points from the host."""
        self.advance(now_s)
        if self.deaf:
            return None
        if endpoint == self._commands_endpoint:
            self._command(data, now_s)
            return len(data)
        return self._take_points(data, now_s) if endpoint == self.points_endpoint else STALL

    def inp(self, endpoint: int, length: int, now_s: float) -> Answer:
        """Give replies to the host, one per transfer."""
        self.advance(now_s)
        ready = endpoint == self._replies_endpoint and self._replies and not self.deaf
        return self._replies.popleft() if ready else None

    def unplugged(self, now_s: float) -> None:
        """Let the outputs fall to 0 V, which is the centre, since the power is gone."""
        self.advance(now_s)
        self._halt(now_s)
        self.history.cut(now_s, self.centre)

    def moving(self, now_s: float) -> bool:
        """Whether points are being played."""
        raise NotImplementedError

    def advance(self, now_s: float) -> None:
        """Play on until now."""
        raise NotImplementedError

    def _command(self, data: bytes, now_s: float) -> None:
        raise NotImplementedError

    def _take_points(self, data: bytes, now_s: float) -> int | None:
        """Take points; returns the number of bytes taken, None while not ready."""
        raise NotImplementedError

    def _halt(self, now_s: float) -> None:
        """End playing: nothing is left to play."""
        raise NotImplementedError


SYSTICK_HZ = 112_000_000
BUFFER_POINTS = 4096
STOP_DEAD_S = 0.1
SEAM_S = 2.5e-6
"""Time by which the first point of a frame that follows another lasts longer: 2 to 3 us, inferred. The firmware starts
its timer anew only after it has sent that point's four colours (main.c:80-82, 251-254), 16 bits each at 22.4 MHz
(main.c:378-379)."""
BUS_BYTES_PER_S = 1.0e6
"""Approximate rate of full-speed USB: 4095 points take 28 ms."""

COMMANDS, REPLIES, FRAMES = 0x06, 0x83, 0x02
RED, GREEN, BLUE, INTENSITY = 0, 1, 2, 3
"""Colour outputs: numbers of their lines in `DacHistory`."""

_SPEC = DeviceSpec(
    vendor=0x1209,
    product=0xE500,
    manufacturer="Gitle Mikkelsen",
    product_name="Helios Laser DAC",
    serial=None,
    speed="full",
    release=0x0200,
    max_power_ma=150,
    alternates=(
        AlternateSpec(0, 0),
        AlternateSpec(
            0,
            1,
            (
                EndpointSpec(REPLIES, "interrupt", 32, 1),
                EndpointSpec(COMMANDS, "interrupt", 32, 1),
                EndpointSpec(0x81, "bulk", 64),
                EndpointSpec(FRAMES, "bulk", 64),
            ),
        ),
    ),
)


@dataclass(frozen=True, slots=True, eq=False)
class _Frame:
    x: Array
    levels: NDArray[np.uint8]
    period_s: float
    single: bool

    @property
    def duration_s(self) -> float:
        """Time that its points take, without a seam."""
        return len(self.x) * self.period_s


class HeliosModel(DacModel):
    """The firmware. `history` also covers future times, as far as the buffers reach."""

    def __init__(self, *, name: str = "Helios 1", version: int = 6, clock_error: float = 0.0, axis: str = "x") -> None:
        """clock_error: relative error of its crystal, positive if it runs fast. axis: the one whose mirror the history
        follows."""
        super().__init__(_SPEC, commands=COMMANDS, replies=REPLIES, points=FRAMES)
        self.shutter = False
        self.bootloader = False
        self.refused = 0
        """Frames dropped in silence."""
        self.played = 0
        """Frames whose playing began."""
        self.drop_next = 0
        """Test knob: number of next frames that are dropped in silence, sound or not."""
        self._name, self._version, self._axis = name, version, axis
        self._clock_error = clock_error
        self._playing: _Frame | None = None
        self._ends_s = 0.0
        self._pending: _Frame | None = None
        self._armed = False
        self._received = b""
        self._arriving: tuple[int, float] | None = None
        self._dead_until_s: float | None = None
        self._alternate = 0

    def set_interface(self, interface: int, alternate: int, now_s: float) -> None:
        """Alternate 1 enables the DAC: colours low, and the mirror stays where it is. To leave it, or to choose it
        again, does what STOP does: colours low, and the mirror at the centre 100 ms later. Transfers that are under way
        end."""
        self.advance(now_s)
        if self._alternate == 1:
            self._stop(now_s)
        self._alternate = alternate
        self._armed = alternate == 1
        self._received, self._arriving = b"", None
        self._replies.clear()

    def advance(self, now_s: float) -> None:
        """Play on until now. When a frame ends, the pending one follows, with a longer first point. If none is pending,
        a frame with the flag SINGLE ends with the colours low, and any other frame is played again.

        Frames are accepted again from 100 ms after STOP on.
        """
        if self._dead_until_s is not None and now_s >= self._dead_until_s:
            self._dead_until_s = None
            self._armed = True
        while self._playing is not None and now_s >= self._ends_s:
            following, start_s = self._pending, self._ends_s + SEAM_S
            if following is None and not self._playing.single:
                following, start_s = self._playing, self._ends_s
                self._record(following, start_s)
            self._playing = self._pending = None
            self._armed = True  # a frame that begins or ends makes the endpoint ready for the next one
            if following is not None:
                self._play(following, start_s)

    def moving(self, now_s: float) -> bool:
        """Whether points are being played."""
        self.advance(now_s)
        return self._playing is not None

    def _command(self, data: bytes, now_s: float) -> None:
        match data[0]:
            case 0x01:
                self._stop(now_s)
                self._armed = True
            case 0x02:
                self.shutter = bool(data[1])
            case 0x03:
                free = self._pending is None
                self._armed = self._armed or free
                self._reply(bytes((0x83, free)))
            case 0x04:
                self._reply(b"\x84" + struct.pack("<I", self._version))
            case 0x05:
                self._reply(b"\x85" + self._name.encode()[:31].ljust(31, b"\0"))
            case 0x06:
                self._name = data[1:].split(b"\0")[0].decode("ascii", "replace")
            case 0xDE:
                self._halt(now_s)
                self.bootloader = self.gone = True

    def _reply(self, data: bytes) -> None:
        """Offer a reply. It is lost if the host has not yet fetched the one before."""
        if not self._replies:
            self._replies.append(data)

    def _take_points(self, data: bytes, now_s: float) -> int | None:
        if not self._armed:
            return None
        if self._arriving is None or self._arriving[0] != len(data):
            self._arriving = (len(data), now_s + len(data) / BUS_BYTES_PER_S)
        if now_s < self._arriving[1]:
            return None
        self._arriving = None
        self._received += data
        if len(data) % 64 == 0:
            return len(data)  # no short packet: the firmware goes on waiting for the end
        frame, self._received = self._received, b""
        self._armed = False
        self._take(frame, now_s)
        return len(data)

    def _take(self, data: bytes, now_s: float) -> None:
        pps, points, flags = struct.unpack("<HHB", data[-5:]) if len(data) >= 5 else (0, 0, 0)
        sound = 0 < points <= BUFFER_POINTS and len(data) == 7 * points + 5
        if not sound or self._dead_until_s is not None or self.drop_next > 0:
            self.drop_next = max(0, self.drop_next - 1)
            self.refused += 1
            return
        frame = self._decode(data[:-5], max(pps, 7), flags)
        if self._playing is None or flags & 1:
            start_s = now_s + frame.period_s  # the timer starts, and its first tick brings the first point
            self._halt(start_s)
            self._record(frame, start_s)
            self._play(frame, start_s)
        else:
            self._pending = frame
            self._record(frame, self._ends_s, SEAM_S)

    def _decode(self, data: bytes, pps: int, flags: int) -> _Frame:
        raw = np.frombuffer(data, np.uint8).reshape(-1, 7).astype(np.uint16)
        x = raw[:, 0] << 4 | raw[:, 1] >> 4
        y = (raw[:, 1] & 0xF) << 8 | raw[:, 2]
        period_s = (SYSTICK_HZ // pps + 1) / SYSTICK_HZ / (1 + self._clock_error)
        command = (x if self._axis == "x" else y) / DAC_STEPS * 2 - 1
        return _Frame(command, raw[:, 3:].astype(np.uint8), period_s, bool(flags & 2))

    def _play(self, frame: _Frame, start_s: float) -> None:
        self._playing, self._ends_s = frame, start_s + frame.duration_s
        self._armed = True
        self.played += 1

    def _stop(self, now_s: float) -> None:
        """Blank at once, refuse frames for 100 ms, and centre the mirror then. A second STOP begins the 100 ms anew."""
        self._halt(now_s)
        self.history.cut(now_s)
        self._dead_until_s = now_s + STOP_DEAD_S
        self.history.cut(self._dead_until_s, CENTRE)

    def _record(self, frame: _Frame, start_s: float, longer_s: float = 0.0) -> None:
        end_s = start_s + longer_s + frame.duration_s
        self.history.play(Played(start_s, end_s, frame.period_s, frame.x, frame.levels, longer_s))

    def _halt(self, now_s: float) -> None:
        if self._playing is not None:
            self.history.cut(now_s)
        self._playing = self._pending = None
