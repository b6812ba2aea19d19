"""The motion of the simulated mirror and the levels of the scanner's marker outputs, at any time.

The command has the value of point i at the start of point i and goes linearly to the next one. The mirror lags
behind the command by a time that depends on its direction of motion. Marker outputs have no lag. The mirror can also
shake (`Jitter`). Times are those of `Bench.now_s`.
"""

import math
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from drivers.interfaces import LEVEL_BACKWARD, ScanWaveform
from sim_backend.random_numbers import GOLDEN, mixed

Array = NDArray[np.float64]

JITTER_HOLD_S = 1e-4
"""Time for which the mirror's error stays the same: a small galvo answers within 100 us."""


@dataclass(frozen=True, slots=True)
class Jitter:
    """The mirror's random error: Gaussian with standard deviation `rms` (in units of the command), drawn anew every
    `JITTER_HOLD_S`. The error depends on seed and time alone.
    """

    rms: float
    seed: int

    def error(self, time_s: Array) -> Array:
        """Errors at the given times, of the same shape."""
        if self.rms == 0:
            return np.zeros(time_s.shape)
        step = np.floor(time_s / JITTER_HOLD_S).astype(np.int64).view(np.uint64)
        with np.errstate(over="ignore"):
            start = mixed(np.uint64((self.seed + int(GOLDEN)) % 2**64)) + np.uint64(2) * step * GOLDEN
            uniform = [
                (mixed(start + which * GOLDEN) >> np.uint64(11)) + 0.5 for which in np.arange(2, dtype=np.uint64)
            ]
        radius = np.sqrt(-2 * np.log(uniform[0] / 2.0**53))
        result: Array = self.rms * radius * np.cos(2 * np.pi * uniform[1] / 2.0**53)
        return result


@dataclass(frozen=True, slots=True, eq=False)
class Playing:
    """A waveform that is played `repeats` times from `start_s` on, at `rate_hz` (the true rate, clock error included).
    The command is that of the first point before, and that of the last point afterwards."""

    waveform: ScanWaveform
    repeats: int
    start_s: float
    rate_hz: float
    lag_forward_s: float
    lag_backward_s: float

    @property
    def end_s(self) -> float:
        """Time at which the last point of the last repetition ends."""
        return self.start_s + self.repeats * len(self.waveform.command) / self.rate_hz

    def mirror(self, time_s: Array) -> Array:
        """Mirror position as a command, lag included, float64 of the same shape as the times."""
        forward = self._command(time_s - self.lag_forward_s)
        if self.lag_forward_s == self.lag_backward_s:
            return forward
        turned = self.backward(time_s - self.lag_backward_s)
        return np.where(turned, self._command(time_s - self.lag_backward_s), forward)

    def backward(self, time_s: Array) -> NDArray[np.bool_]:
        """Level of the direction output at the times; low before the start and after the end."""
        return self._high(LEVEL_BACKWARD, time_s)

    def first_high(self, bit: int, from_s: float, until_s: float) -> float | None:
        """First time in [from_s, until_s) at which a marker output is high, which is from_s if it is high then. None if
        it stays low.
        """
        if from_s < until_s and self._high(bit, np.array([from_s]))[0]:
            return from_s
        edges = self.edges(bit, from_s, until_s)
        return float(edges[0]) if len(edges) else None

    def _high(self, bit: int, time_s: Array) -> NDArray[np.bool_]:
        points = len(self.waveform.command)
        at = np.floor((time_s - self.start_s) * self.rate_hz).astype(np.int64)
        inside = (at >= 0) & (at < self.repeats * points)
        level: NDArray[np.bool_] = inside & ((self.waveform.markers[at % points] & bit) != 0)
        return level

    def edges(self, bit: int, from_s: float, until_s: float) -> Array:
        """Times of the rising edges of a marker output in [from_s, until_s), ascending.

        A bit that stays high over several points, or over the seam between repeats, makes one edge.
        """
        points = len(self.waveform.command)
        high = (self.waveform.markers & bit) != 0
        rising = np.flatnonzero(high & ~np.roll(high, 1))
        first = (from_s - self.start_s) * self.rate_hz / points
        last = (until_s - self.start_s) * self.rate_hz / points
        repeats = np.arange(max(0, math.floor(first)), min(self.repeats, math.floor(last) + 1))
        at = (repeats[:, None] * points + rising).ravel()
        if high[0] and high[-1] and len(repeats) and repeats[0] == 0:
            at = np.concatenate([[0], at])  # high from the very first point, with nothing before it
        times = self.start_s + at / self.rate_hz
        return times[(times >= from_s) & (times < until_s)]

    def moving(self, time_s: float) -> bool:
        """Whether the last point has not ended yet. A waveform counts as under way even before its start."""
        return time_s < self.end_s

    def _command(self, time_s: Array) -> Array:
        command = self.waveform.command
        points = len(command)
        at = np.clip((time_s - self.start_s) * self.rate_hz, 0, self.repeats * points - 1)
        index = np.floor(at).astype(np.int64)
        here, following = command[index % points], command[(index + 1) % points]
        result: Array = here + (at - index) * (following - here)
        return result


def resting(command: float) -> Playing:
    """A mirror that stands still: a waveform of one point with no repeats."""
    waveform = ScanWaveform(np.array([command]), np.zeros(1, np.uint8), Fraction(1))
    return Playing(waveform, 0, start_s=0.0, rate_hz=1.0, lag_forward_s=0.0, lag_backward_s=0.0)
