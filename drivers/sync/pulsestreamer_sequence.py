"""Sequences of a Pulse Streamer: the sequence for a program of the sync source, and the count of the sweeps played so
far.

The box cannot wait within a sequence, nor look at the scan marker while it plays: see `pulsestreamer`.
"""

import base64
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from drivers.errors import LimitExceeded
from drivers.interfaces import Pulse
from drivers.interfaces.sync import HOLD_S
from drivers.sync.board import OutputPins

RESOLUTION_S = 1e-9
"""Unit of durations, and the sampling period of the digital outputs."""
MIN_TICKS = 3
"""Shortest step in ns: the shortest pulse of older boxes; newer ones can do 2 ns."""
MAX_TICKS = 2**32 - 1
"""Longest step in ns. Longer words become several steps."""
MAX_STEPS = 100_000
"""Most steps of a sequence. The box holds 2 000 000; only this many surely arrive within the deadline of a call."""
STEP = np.dtype([("ticks", ">u4"), ("levels", "u1"), ("analog", ">i2", 2)])
"""Nine bytes, as `stream` takes them in base64."""
POLL_S = 0.001
"""Pause between two questions whether the box plays, when a sweep may begin or end."""
IDLE_POLL_S = 0.05
"""The same when nothing is due."""
_CLOCK_TOLERANCE = 1e-3


@dataclass(frozen=True, slots=True)
class GateSequence:
    """Steps that the box plays again and again. steps: `STEP` (n,). sweeps: how often they are played.

    waits: whether the box waits for the scan marker each time before it plays them. rest: levels of the channels during
    the wait, one bit for each.
    """

    steps: NDArray[np.void]
    sweeps: int
    waits: bool
    rest: int = 0

    @property
    def duration_s(self) -> float:
        """Duration of one sweep, in seconds."""
        return float(self.steps["ticks"].sum(dtype=np.int64)) * RESOLUTION_S

    @property
    def encoded(self) -> str:
        """The steps in base64."""
        return base64.b64encode(self.steps.tobytes()).decode()


def compile_sequence(
    name: str, pulses: Sequence[Pulse], repeats: int, pins: OutputPins, *, external_hold: bool
) -> GateSequence:
    """The sequence for a program. name: the box's name in messages. external_hold: whether hardware ANDs the gate with
    the scan marker.

    Raises `LimitExceeded` for waits that the box cannot play, held pulses that nothing holds, and words that are too
    short or too many.
    """
    waits = [index for index, pulse in enumerate(pulses) if pulse.duration_s is None]
    if waits and waits[0] != 0:
        raise LimitExceeded(
            f"{name}: word {waits[0]} waits for the scan marker and word 0 does not; a Pulse Streamer waits only "
            "before a sequence: let the program begin with the wait"
        )
    bounds = [*waits, len(pulses)] if waits else [-1, len(pulses)]
    sweeps = [_steps(name, pulses, first + 1, end, pins) for first, end in pairwise(bounds)]
    rests = {pins.levels(pulses[index].outputs) for index in waits} or {0}
    if any(not np.array_equal(sweep, sweeps[0]) for sweep in sweeps[1:]) or len(rests) > 1:
        raise LimitExceeded(
            f"{name}: its {len(sweeps)} waits are followed by different words, and a Pulse Streamer plays one sequence "
            "after each scan marker: scan in one direction and with markers, or use a PrawnDO"
        )
    if not external_hold:
        _require_short_holds(name, pulses)
    return GateSequence(sweeps[0], repeats * len(sweeps), bool(waits), rests.pop())


def _steps(name: str, pulses: Sequence[Pulse], first: int, end: int, pins: OutputPins) -> NDArray[np.void]:
    """Steps of the words from `first` up to, but not including, `end`: `STEP` (n,)."""
    steps: list[tuple[int, int, tuple[int, int]]] = []
    for index in range(first, end):
        duration_s, levels = pulses[index].duration_s or 0.0, pins.levels(pulses[index].outputs)
        ticks = round(duration_s / RESOLUTION_S)
        if ticks < MIN_TICKS:
            raise LimitExceeded(f"{name}: word {index} lasts {duration_s:g} s, under {MIN_TICKS} ns; lengthen it")
        n = -(-ticks // MAX_TICKS)
        if len(steps) + n > MAX_STEPS:
            raise LimitExceeded(f"{name}: more than {MAX_STEPS} steps; make the program shorter")
        edges = [ticks * part // n for part in range(n + 1)]
        steps += [(after - before, levels, (0, 0)) for before, after in pairwise(edges)]
    if not steps:
        raise LimitExceeded(f"{name}: no words follow the wait before word {first}; give at least 1")
    return np.array(steps, STEP)


def _require_short_holds(name: str, pulses: Sequence[Pulse]) -> None:
    """Raise `LimitExceeded` for a held pulse that may last longer than the scan marker by more than `HOLD_S`."""
    since_marker_s = float("inf")
    for index, pulse in enumerate(pulses):
        since_marker_s = 0.0 if pulse.duration_s is None else since_marker_s + pulse.duration_s
        if pulse.held and since_marker_s > HOLD_S * (1 + 1e-9):
            raise LimitExceeded(
                f"{name}: word {index} is held by the scan marker but may outlast it by {since_marker_s:g} s (limit "
                f"{HOLD_S:g} s), as this box looks only at the marker's edge: AND its gate with the scan marker in "
                "hardware (docs/how-to/devices.md), then set hold: external"
            )


@dataclass(slots=True)
class SweepCount:
    """Counts the sweeps that a box has played, from its answers to the question whether it plays. Thread-safe.

    Times are seconds of the device's clock. An answer tells what the box did at some moment between question and
    answer. A box that plays has begun a new sweep if it did not play before, or if the last sweep must be over. So no
    sweep is counted twice.
    """

    sweeps: int
    duration_s: float
    heard_s: float
    """Time of the last answer; at first, a time before the sequence was armed."""
    done: int = 0
    plays: bool = False
    idle_s: float = 0.0
    """Time of the first of the last answers in a row that said 'does not play'."""
    _began_after_s: float = 0.0
    _ends_s: float = 0.0
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def __post_init__(self) -> None:
        self.idle_s = self._began_after_s = self.heard_s

    def take(self, asked_s: float, answered_s: float, plays: bool) -> bool:
        """Take an answer in; returns whether the last sweep is over. asked_s, answered_s: times of question and answer.
        If the question was asked before the last answer came, it is not known which answer is newer: this one is
        dropped, and False returned."""
        with self._lock:
            if asked_s < self.heard_s:
                return False
            if plays and (not self.plays or asked_s > self._ends_s):
                if self.plays:
                    self._began_after_s += self.duration_s  # no pause was seen: at the earliest when the last one ended
                self.done += 1
                self._ends_s = answered_s + self.duration_s * (1 + _CLOCK_TOLERANCE)
            if not plays:
                self._began_after_s = asked_s
                self.idle_s = answered_s if self.plays else self.idle_s
            self.heard_s, self.plays = answered_s, plays
            return self.done > self.sweeps or (self.done == self.sweeps and not plays)

    def pause_s(self, now_s: float) -> float:
        """Seconds until the next question: short when a sweep may begin or end."""
        with self._lock:
            if self.plays:
                due_s = self._began_after_s + self.duration_s - now_s
            else:
                due_s = min((self.heard_s - self.idle_s) / 4, self.duration_s / 3)
            return max(POLL_S, min(due_s, IDLE_POLL_S))
