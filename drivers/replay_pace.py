"""The clock of a replay: when the frames of a recording come due, in the time of the clock that is passed in.

`realtime` holds the frame clock of the recording, `x4` and `x0.1` multiples of it, `max` waits for nothing, `step` for
somebody's word. Time that a full ring cost moves the clock on, and is counted: behind it frames come at their pace
again and not all at once.
"""

import math
import re
import threading
from dataclasses import dataclass
from fractions import Fraction

from drivers.clock import NS_PER_S, Clock

SLOWEST, FASTEST = 1e-4, 1e4
"""Speeds of `xN`."""
_PIECE_S = 0.2
"""Longest time between two blocks at a slow clock: they are cut so that none is longer."""
_SLICE_S = 0.02
"""One wait: how late a stop is noticed."""
_TIMES = re.compile(r"x(\d+(?:\.\d*)?|\.\d+)")


@dataclass(frozen=True, slots=True)
class ReplayClock:
    """What `--clock` says. speed: recorded seconds per second; None: as fast as they are taken, or step by step."""

    speed: float | None = None
    steps: bool = False

    @classmethod
    def parse(cls, text: str) -> "ReplayClock":
        """realtime, max, step or xN. ValueError for anything else."""
        named = {"realtime": cls(1.0), "max": cls(), "step": cls(steps=True)}
        if text in named:
            return named[text]
        times = _TIMES.fullmatch(text)
        speed = float(times[1]) if times else math.nan
        if not SLOWEST <= speed <= FASTEST:
            raise ValueError(
                f"clock is {text!r}; write realtime, max, step, or x with a number from {SLOWEST:g} to {FASTEST:g} "
                "like x4 or x0.1"
            )
        return cls(speed)


@dataclass(frozen=True, slots=True)
class PaceReport:
    """How the pace was held: lateness of `blocks` against their own times. held_s: how long a full ring held it up."""

    blocks: int = 0
    late_mean_s: float = 0.0
    late_sd_s: float = 0.0
    late_max_s: float = 0.0
    held_s: float = 0.0


class Pace:
    """Lets blocks pass when they are due. `wait` belongs to the source thread, `step`, `run_on` and `halt` to any."""

    def __init__(self, what: ReplayClock, clock: Clock) -> None:
        self._what = what
        self._clock = clock
        self._changed = threading.Condition()
        self._steps = 0
        self._run_on = not what.steps
        self._halted = False
        self.closed = False
        """Whether nothing will ever wait again."""
        self._origin_s = 0.0
        self._sums = [0, 0.0, 0.0, 0.0]
        self._held_s = 0.0

    @property
    def report(self) -> PaceReport:
        """Of all runs so far."""
        n, total, squares, most = self._sums
        if not n:
            return PaceReport(held_s=self._held_s)
        mean = total / n
        return PaceReport(int(n), mean, math.sqrt(max(0.0, squares / n - mean * mean)), most, self._held_s)

    @property
    def speed(self) -> float | None:
        """Recorded seconds per second; None: as fast as frames are taken."""
        return self._what.speed

    @property
    def stepping(self) -> bool:
        """Whether frames wait for somebody's word."""
        return not self._run_on

    @property
    def halted(self) -> bool:
        """Whether the run was stopped."""
        return self._halted

    def most_frames(self, period_s: Fraction) -> float:
        """Frames that a block may have at most, so that one comes every now and then at a slow clock too."""
        return math.inf if self._what.speed is None else max(1.0, _PIECE_S * self._what.speed / float(period_s))

    def start(self) -> None:
        """A run begins now."""
        self._halted = False
        self._origin_s = self._now_s()

    def step(self) -> None:
        """One step more."""
        with self._changed:
            self._steps += 1
            self._changed.notify_all()

    def run_on(self) -> None:
        """No more steps: as fast as frames are taken."""
        with self._changed:
            self._run_on = True
            self._changed.notify_all()

    def halt(self) -> None:
        """End the run: `wait` returns."""
        with self._changed:
            self._halted = True
            self._changed.notify_all()

    def wait_for_step(self, timeout_s: float) -> bool:
        """Take a step; False where none came in time or the run was stopped."""
        with self._changed:
            self._changed.wait_for(lambda: self._steps > 0 or self._run_on or self._halted, timeout_s)
            if self._halted or not (self._run_on or self._steps):
                return False
            self._steps -= not self._run_on
            return True

    def hold(self, due_s: float, waited_s: float) -> None:
        """A full ring held a block up for `waited_s`, which was due `due_s` after the run's start."""
        if self._what.speed is None:
            return
        late_s = self._now_s() - self._origin_s - due_s / self._what.speed
        held_s = max(0.0, min(waited_s, late_s))
        self._origin_s += held_s
        self._held_s += held_s

    def wait(self, due_s: float, timeout_s: float) -> bool:
        """Wait until what is due `due_s` (recorded time) after the run's start; False where that is not in time."""
        if self._what.speed is None:
            return not self._halted
        at_s = self._origin_s + due_s / self._what.speed
        ends_s = self._now_s() + timeout_s
        while not self._halted and (left_s := at_s - self._now_s()) > 0:
            if self._now_s() >= ends_s:
                return False
            self._clock.sleep(min(left_s, _SLICE_S))
        if self._halted:
            return False
        self._note(max(0.0, self._now_s() - at_s))
        return True

    def _note(self, late_s: float) -> None:
        n, total, squares, most = self._sums
        self._sums = [n + 1, total + late_s, squares + late_s * late_s, max(most, late_s)]

    def _now_s(self) -> float:
        return self._clock.now_ns() / NS_PER_S
