"""The SPAD's crystal against the time of the bench: off by a constant, and wandering.

    dt/dtick = 1 / (tick_hz (1 + y)),    y = error + W,    W a random walk: var W(t) = wander^2 t

(random walk of frequency, of which the Allan deviation is wander sqrt(t/3): D. Allan, IEEE Trans. UFFC 34, 647, 1987.)
W makes a step every millisecond of the counter, the same for any blocks. An ordinary crystal is off by up to 50 ppm,
and by 1 ppm more per K; a wander of 0.1 ppm per root second is much.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

STEP_S = 1e-3


class TickClock:
    """Counts from 0 at `start_s` of the bench. error: relative, positive is fast. wander: per root second."""

    def __init__(self, tick_s: float, start_s: float, error: float, wander: float, seed: list[int]) -> None:
        """tick_s: nominal."""
        self._tick_s = tick_s
        self._step_ticks = max(1, round(STEP_S / tick_s)) if wander else np.iinfo(np.int64).max
        self._sd = wander * np.sqrt(self._step_ticks * tick_s)
        self._random = np.random.default_rng(seed)
        self._step = 0
        """Of the first one in the lists: steps that nobody will ask for any more are forgotten."""
        self._start_s = [start_s]
        self._error = [error]

    def times_s(self, first_tick: int, period_ticks: int, n: int) -> Array:
        """When the counter is at n ticks, one period apart, float64 (n,). Not before the first of the last call."""
        ticks = first_tick + period_ticks * np.arange(n)
        step = ticks // self._step_ticks
        while self._step + len(self._error) <= step[-1]:
            self._start_s.append(self._start_s[-1] + self._step_ticks * self._tick_s / (1 + self._error[-1]))
            self._error.append(self._error[-1] + self._sd * self._random.standard_normal())
        gone = int(step[0]) - self._step
        del self._start_s[:gone], self._error[:gone]
        self._step += gone
        at = step - self._step
        since_s = (ticks - step * self._step_ticks) * self._tick_s
        times: Array = np.array(self._start_s)[at] + since_s / (1 + np.array(self._error)[at])
        return times
