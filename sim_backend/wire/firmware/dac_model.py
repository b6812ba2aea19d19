"""The common part of emulated scanner boards: commands and replies, points, and a record of the outputs.

Emulated worlds and tests read that record.
"""

import threading
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sim_backend.wire.serve.usb_model import STALL, Answer, DeviceSpec, Stall, UsbModel

Array = NDArray[np.float64]

KEEP_S = 20.0
"""Age at which output is forgotten."""


@dataclass(frozen=True, slots=True, eq=False)
class Played:
    """Points played from start_s on, one every period_s, cut off at end_s.

    command: float64 (n,), normalised drive. levels: uint8 (n, lines), colour outputs.
    """

    start_s: float
    end_s: float
    period_s: float
    command: Array
    levels: NDArray[np.uint8]


class DacHistory:
    """Output over time: what was played, with rests in between during which the colours are low. Thread-safe."""

    def __init__(self, command: float, lines: int) -> None:
        self._lock = threading.Lock()
        self._lines = lines
        self._played: deque[Played] = deque()
        self._rests: deque[tuple[float, float]] = deque([(-np.inf, command)])
        """(from, command): where the mirror command stands when nothing is played, ascending."""

    def play(self, played: Played) -> None:
        """Append what is played. It must start at the end of the previous piece or later."""
        with self._lock:
            self._played.append(played)
            self._rests.append((played.end_s, float(played.command[-1])))
            while self._played[0].end_s < played.start_s - KEEP_S:
                self._played.popleft()
            while len(self._rests) > 1 and self._rests[1][0] < played.start_s - KEEP_S:
                self._rests.popleft()

    def cut(self, time_s: float, command: float | None = None) -> None:
        """Play nothing from that time on. The command holds, or jumps to `command` if given."""
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
            # One point further back: its level tells whether what is high at from_s rose before.
            for one in self._between(from_s - KEEP_S / 100, until_s):
                high = one.levels[:, line] > 0
                before = np.concatenate([[one.start_s - high_until < one.period_s / 2], high[:-1]])
                at = one.start_s + np.flatnonzero(high & ~before) * one.period_s
                edges.append(at[(at >= from_s) & (at < min(until_s, one.end_s))].astype(np.float64))
                high_until = one.end_s if high[-1] else -np.inf
        return np.concatenate(edges) if edges else np.empty(0)

    def _at(self, time_s: Array) -> Iterator[tuple[Played, NDArray[np.bool_], NDArray[np.int64]]]:
        """All that was played at the times: at which of them, and its points then."""
        for one in self._between(time_s.min(initial=np.inf), time_s.max(initial=-np.inf)):
            inside = (time_s >= one.start_s) & (time_s < one.end_s)
            at = np.floor((time_s[inside] - one.start_s) / one.period_s + 1e-9).astype(np.int64)
            yield one, inside, np.clip(at, 0, len(one.command) - 1)

    def _between(self, from_s: float, until_s: float) -> list[Played]:
        """The points that were played in [from_s, until_s], ascending."""
        return [one for one in self._played if one.end_s > from_s and one.start_s <= until_s]


DAC_STEPS = 4095
CENTRE = 0x800 / DAC_STEPS * 2 - 1
"""Normalised drive without power."""


class DacModel(UsbModel):
    """Base of the boards. `history` records what its outputs did; times are the transport's."""

    def __init__(self, spec: DeviceSpec, *, commands: int, replies: int, points: int) -> None:
        """commands, replies, points: its endpoints."""
        self.spec = spec
        self.history = DacHistory(CENTRE, lines=4)
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
        self.history.cut(now_s, CENTRE)

    def moving(self, now_s: float) -> bool:
        """Whether points are being played."""
        raise NotImplementedError

    def advance(self, now_s: float) -> None:
        """Play on until now."""
        raise NotImplementedError

    def _command(self, data: bytes, now_s: float) -> None:
        raise NotImplementedError

    def _take_points(self, data: bytes, now_s: float) -> int | None:
        """Bytes taken; None: not now."""
        raise NotImplementedError

    def _halt(self, now_s: float) -> None:
        """End playing: nothing is left to play."""
        raise NotImplementedError
