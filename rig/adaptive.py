"""Which columns of a map deserve more exposures: the passes that are expected to decide most rows in the time left.

A line lights all rows at once, so what can be chosen is columns, by all their rows together. What is asked of the data
is how many rows a column's light still moves: those whose answer from all n frames lies more than 1 px from that of m,
three quarters of them drawn at random (`thinned`). Wrong answers fall about as 1/n, u(n) = u m / n from m frames on, so
that moved = u(n) (n - m) / m, and e further exposures decide u(n) e / (n + e) of them. Nothing has to be known of the
scene. Where all columns wait for photons alike the best pass is a plain one over all.

Where there is no stripe, as in shadows, answers move for ever: up to five of six rows that moved. They have next to no
confidence, so those below LEAST_SURE are left out. Without that, and with half of the frames in place of three
quarters, passes went where no light comes back. In dense fog at 4 exposures moved rows then foretold the errors
that 4 more would mend, column by column, with a correlation of 0.14 (aloe) and 0.61 (cones); now 0.83 and 0.75.

Tried besides, on counts of the yardstick: 1 - confidence in place of `moved`, with the power of n from half and all
frames; what confidence gains from half to all; both together; rows that moved weighted by confidence; the pass of most
gain per time, one by one, in place of a plan for all the time that is left.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import groupby
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.adaptive_thinning import frames_left
from rig.config import ScanConfig
from rig.scan_plan import column_command
from rig.stripes import StripeTable

Array = NDArray[np.float64]
PassTime = Callable[[int, int], float | None]
"""Sensor time of a pass over so many columns at so many exposures, in seconds; None where the mirror cannot do it."""

EXPOSURES = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
"""Of a further pass; between two of them a pass is hardly better than either."""
BLOCKS = 64
"""Of columns, where passes may begin and end: finer than what is learned of them."""
PRICES = 1.0, 1e7
"""Rows per second that are worth a plan's time, least and most; tried by halving their logarithm."""
HALVINGS = 20
TRAVEL_FACTORS = (1.0, 2.0, 4.0, 8.0, 16.0)
"""The more travel counts, the fewer passes a plan has."""
ALIKE = 1.0 / 3.0
"""Share of a column's rows that is taken from the mean column: wrong answers that do not move lie anywhere."""
SMOOTH_COLUMNS = 15
"""Columns over which moved rows are averaged: of one column they are known to a tenth."""
MOVED_PX = 1.0
"""An answer that is further from another is another one."""
LEAST_SURE = 0.1
"""Confidence below which an answer that moves hardly ever has a stripe: of stripes that moved it leaves out a tenth, of
other rows it leaves in a tenth (random scenes and prepared ones, dense fog, 4 exposures)."""


@dataclass(frozen=True, slots=True)
class Pass:
    """Part of a map: `columns` columns from `first_column` on, `exposures` frames each."""

    first_column: int
    columns: int
    exposures: int

    @property
    def end_column(self) -> int:
        """One behind the last."""
        return self.first_column + self.columns

    @property
    def part(self) -> slice:
        """Its columns."""
        return slice(self.first_column, self.end_column)

    def scan(self, whole: ScanConfig) -> ScanConfig:
        """The scan of this pass alone, over the mirror commands that these columns have in the whole one."""
        edges = column_command([self.first_column - 0.5, self.end_column - 0.5], whole.command_range, whole.columns)
        first, last = whole.command_range if self.columns == whole.columns else (float(edges[0]), float(edges[1]))
        settings = {"columns": self.columns, "exposures": self.exposures, "command_range": (first, last)}
        return whole.model_copy(update={**settings, "bidirectional": False, "adaptive": None})


@dataclass(frozen=True, slots=True)
class Unsettled:
    """Rows of each column that `moved` (columns,) from `thinned` counts to those of all its n_frames (columns,)."""

    moved: Array
    n_frames: NDArray[np.int32]

    def gain(self, exposures: int) -> Array:
        """Rows that so many further exposures are expected to decide in each column, (columns,)."""
        n = np.maximum(self.n_frames, 2).astype(np.float64)
        fewer = frames_left(n)
        moved = (1.0 - ALIKE) * _smooth(self.moved) + ALIKE * self.moved.mean()
        return np.asarray(moved * fewer / (n - fewer) * exposures / (n + exposures))


def next_pass(unsettled: Unsettled, pass_time: PassTime, left_s: float, passes: int) -> Pass | None:
    """The first pass of the best plan for the time that is left, with at most so many passes; None where none gains.

    The plan gives every block of columns a further number of exposures. Neighbours that have the same make a pass, and
    each pass costs its travel. Of its passes that comes first which decides most rows per time: behind it, columns are
    looked at again.
    """
    columns = len(unsettled.moved)
    edges = np.unique(np.linspace(0, columns, min(columns, BLOCKS) + 1).round().astype(int))
    levels = _levels(unsettled, pass_time, edges)
    best: list[tuple[Pass, float]] = []
    for travel in TRAVEL_FACTORS:
        low, high = PRICES
        for _ in range(HALVINGS):
            price = math.sqrt(low * high)
            plan = _plan(levels, edges, price, travel)
            times = [pass_time(one.columns, one.exposures) for one, _ in plan]
            total_s = sum(math.inf if time_s is None else time_s for time_s in times)
            if len(plan) > passes or total_s > left_s:
                low = price
                continue
            high = price
            if sum(gain for _, gain in plan) > sum(gain for _, gain in best):
                best = plan
    if not best:
        return None
    return max(best, key=lambda each: each[1] / (pass_time(each[0].columns, each[0].exposures) or math.inf))[0]


class _Levels(NamedTuple):
    """Numbers of further exposures (levels,), the first 0; rows decided and time (blocks, levels); travel (levels,)."""

    exposures: list[int]
    gain: Array
    time_s: Array
    travel_s: Array


def _levels(unsettled: Unsettled, pass_time: PassTime, edges: NDArray[np.int_]) -> _Levels:
    """What further exposures bring to each block and cost: time goes linearly with columns, but for the travel."""
    columns, widths = int(edges[-1]), np.diff(edges)
    part = max(1, columns // 8)
    exposures, gains, times, travels = [0], [np.zeros(len(widths))], [np.zeros(len(widths))], [0.0]
    for k in EXPOSURES:
        short_s, long_s = pass_time(part, k), pass_time(columns, k)
        if short_s is None or long_s is None:
            continue
        per_column_s = (long_s - short_s) / (columns - part) if columns > part else long_s / columns
        exposures.append(k)
        gains.append(np.add.reduceat(unsettled.gain(k), edges[:-1]))
        times.append(widths * per_column_s)
        travels.append(max(0.0, short_s - part * per_column_s))
    return _Levels(exposures, np.stack(gains, axis=1), np.stack(times, axis=1), np.array(travels))


def _plan(levels: _Levels, edges: NDArray[np.int_], price: float, travel: float) -> list[tuple[Pass, float]]:
    """Passes, and rows they decide, with the largest sum of rows - price * time, travel counted so many times.

    The best level of the blocks up to each one, by dynamic programming.
    """
    worth = levels.gain - price * levels.time_s
    begin = -price * travel * levels.travel_s
    stay = np.arange(len(levels.exposures))
    total = worth[0] + begin
    came_from = []
    for block in worth[1:]:
        other = int(total.argmax())
        begins = total[other] + begin
        came_from.append(np.where(begins > total, other, stay))
        total = np.maximum(begins, total) + block
    level = [int(total.argmax())]
    for source in reversed(came_from):
        level.append(int(source[level[-1]]))
    found: list[tuple[Pass, float]] = []
    at = 0
    for same, blocks in groupby(reversed(level)):
        first, at = at, at + sum(1 for _ in blocks)
        if same:
            one = Pass(int(edges[first]), int(edges[at] - edges[first]), levels.exposures[same])
            found.append((one, float(levels.gain[first:at, same].sum())))
    return found


def moved_rows(before: StripeTable, now: StripeTable, searched: NDArray[np.bool_]) -> Array:
    """Rows of each column (columns,) whose answer moved and may be a stripe, of those searched (rows, columns).

    before: of `thinned` counts.
    """
    with np.errstate(invalid="ignore"):
        moved = np.abs(now.x_px - before.x_px) > MOVED_PX
    return np.asarray((moved & searched & (now.confidence > LEAST_SURE)).sum(axis=0), np.float64)


def _smooth(values: Array) -> Array:
    """Means over neighbouring columns, fewer at the ends."""
    kernel = np.ones(min(SMOOTH_COLUMNS, len(values)))
    return np.convolve(values, kernel, "same") / np.convolve(np.ones(len(values)), kernel, "same")
