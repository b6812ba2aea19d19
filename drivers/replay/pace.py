"""The clock of a replay: when each recorded frame is due, in the time of the clock that is passed in.

`realtime` plays at the frame clock of the recording, `x4` and `x0.1` at multiples of it, `max` never waits, and `step`
waits for a call of `Pace.step` before each sweep, or, if there are no scan markers, before each block. Time lost to a
full ring shifts all later frames and is counted, so that frames then come at their normal pace again and not all at
once. A run in this module is one start of the SPAD.
"""

import math
import re
import threading
from dataclasses import dataclass
from fractions import Fraction

from drivers.clock import NS_PER_S, Clock

SLOWEST, FASTEST = 1e-4, 1e4
"""Smallest and largest N of `xN`."""
_PIECE_S = 0.2
"""Longest time between two blocks: at a slow clock, blocks are cut to this duration."""
_SLICE_S = 0.02
"""Length of one wait: a stop is noticed at most this late."""
_TIMES = re.compile(r"x(\d+(?:\.\d*)?|\.\d+)")


@dataclass(frozen=True, slots=True)
class ReplayClock:
    """The clock named by the option `--clock`. speed: recorded seconds per second; None: as fast as frames are taken,
    or in steps.
    """

    speed: float | None = None
    steps: bool = False
    """Whether frames wait for a call of `Pace.step`."""

    @classmethod
    def parse(cls, text: str) -> "ReplayClock":
        """The clock named by a text: realtime, max, step or xN. Raises ValueError for anything else."""
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
    """Lateness of blocks against the times at which they were due. held_s: time for which a full ring held them up."""

    blocks: int = 0
    late_mean_s: float = 0.0
    late_sd_s: float = 0.0
    late_max_s: float = 0.0
    held_s: float = 0.0


class Pace:
    """Lets blocks pass when they are due.

    `step`, `run_on` and `halt` may be called from any thread. `start` is called by the thread that starts the SPAD;
    `wait`, `wait_for_step` and `hold` by the source thread, which calls the SPAD's `fill`. The other members may be
    used from any thread; `report` is exact once the run has ended."""

    def __init__(self, what: ReplayClock, clock: Clock) -> None:
        self.speed = what.speed
        """Recorded seconds per second; None: as fast as frames are taken, or in steps."""
        self._clock = clock
        self._changed = threading.Condition()
        self._steps = 0
        self._run_on = not what.steps
        self.halted = False
        """Whether the run was stopped."""
        self.closed = False
        """Whether the replay is closed, so that it waits for no more steps."""
        self._origin_ns = 0
        self._late_s = _Lateness()
        self._held_ns = 0

    @property
    def report(self) -> PaceReport:
        """Lateness over all runs so far."""
        late = self._late_s
        sd_s = math.sqrt(late.squares / late.blocks) if late.blocks else 0.0
        return PaceReport(late.blocks, late.mean, sd_s, late.most, self._held_ns / NS_PER_S)

    @property
    def stepping(self) -> bool:
        """Whether frames wait for calls of `step`."""
        return not self._run_on

    def most_frames(self, period_s: Fraction) -> float:
        """Most frames of a block, so that blocks come regularly even at a slow clock; infinite without a speed.
        period_s: frame period as recorded."""
        return math.inf if self.speed is None else max(1.0, _PIECE_S * self.speed / float(period_s))

    def start(self) -> None:
        """Begin a run: recorded time 0 is due now."""
        self.halted = False
        self._origin_ns = self._clock.now_ns()

    def step(self) -> None:
        """Allow one more step: a sweep, or a block if there are no scan markers."""
        with self._changed:
            self._steps += 1
            self._changed.notify_all()

    def run_on(self) -> None:
        """End stepping: the other frames come as fast as they are taken."""
        with self._changed:
            self._run_on = True
            self._changed.notify_all()

    def halt(self) -> None:
        """End the run: `wait` and `wait_for_step` return False until the next `start`."""
        with self._changed:
            self.halted = True
            self._changed.notify_all()

    def wait_for_step(self, timeout_s: float) -> bool:
        """Wait up to `timeout_s` for an allowed step and take it. Returns True at once if frames do not wait for steps,
        as after `run_on`, and False if no step was allowed in time or the run was stopped."""
        with self._changed:
            self._changed.wait_for(lambda: self._steps > 0 or self._run_on or self.halted, timeout_s)
            if self.halted or not (self._run_on or self._steps):
                return False
            self._steps -= not self._run_on
            return True

    def hold(self, due_s: float, waited_s: float) -> None:
        """Note that a block due at `due_s` of recorded time was held up by a full ring for `waited_s`. The part of that
        time by which the block became late shifts all later blocks."""
        if self.speed is None:
            return
        late_ns = self._clock.now_ns() - self._due_ns(due_s, self.speed)
        held_ns = max(0, min(round(waited_s * NS_PER_S), late_ns))
        self._origin_ns += held_ns
        self._held_ns += held_ns

    def wait(self, due_s: float, timeout_s: float) -> bool:
        """Wait until `due_s` of recorded time after the run's start; without a speed, do not wait. Returns False if the
        timeout or `halt` comes first."""
        if self.speed is None:
            return not self.halted
        at_ns = self._due_ns(due_s, self.speed)
        ends_ns = self._clock.now_ns() + round(timeout_s * NS_PER_S)
        # Whole nanoseconds: in seconds a clock that has long been running would never quite get there.
        while not self.halted and (left_ns := at_ns - self._clock.now_ns()) > 0:
            if self._clock.now_ns() >= ends_ns:
                return False
            self._clock.sleep(min(left_ns / NS_PER_S, _SLICE_S))
        if self.halted:
            return False
        self._late_s.note(max(0, self._clock.now_ns() - at_ns) / NS_PER_S)
        return True

    def _due_ns(self, due_s: float, speed: float) -> int:
        return self._origin_ns + round(due_s / speed * NS_PER_S)


@dataclass(slots=True)
class _Lateness:
    """Mean, sum of squares about the mean, and maximum of the values noted (Welford 1962: no difference of
    large sums)."""

    blocks: int = 0
    mean: float = 0.0
    squares: float = 0.0
    most: float = 0.0

    def note(self, late_s: float) -> None:
        """Add one more value."""
        self.blocks += 1
        off = late_s - self.mean
        self.mean += off / self.blocks
        self.squares += off * (late_s - self.mean)
        self.most = max(self.most, late_s)
