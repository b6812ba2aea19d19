"""Which columns of a map deserve more exposures: the pass that is expected to decide most rows for its time.

A line lights all rows at once, so what can be chosen is columns, by all their rows together. A row is undecided by
1 - confidence, its posterior probability of being wrong; of a column that share falls about as a power of the frames,

    u(n) = u (n / n0)^-gamma,    gamma = log2(u(n0 / 2) / u(n0)),

with u(n0 / 2) from the same counts thinned to half the frames (`thinned`): nothing has to be known of the scene. Rows
that no light will ever decide (no stripe, a shadow) leave gamma near 0 and draw no exposures; where all rows wait for
photons alike, gamma / n is the same everywhere and the best pass is a plain one over all columns.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rig.config import ScanConfig
from rig.counting import CountVolume
from rig.scan_plan import column_command

Array = NDArray[np.float64]
PassTime = Callable[[int, int], float | None]
"""Sensor time of a pass over so many columns at so many exposures, in seconds; None where the mirror cannot do it."""

EXPOSURES = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
"""Of a further pass; between two of them a pass is hardly better than either."""
STEPS = 64
"""A pass begins and ends at a multiple of a share of the columns: finer than what is learned of them."""
SMOOTH_COLUMNS = 15
"""Columns over which undecided rows are averaged: of one column they are known to a tenth."""
MOST_GAMMA = 2.0


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
class Undecided:
    """Undecided rows of each column (columns,) float64, by all n_frames (columns,) and by half of them; of `rows`."""

    now: Array
    halved: Array
    n_frames: NDArray[np.int32]
    rows: int

    @property
    def share(self) -> float:
        """Of all rows and columns."""
        return float(self.now.mean()) / self.rows

    def gain(self, exposures: int) -> Array:
        """Rows that so many further exposures are expected to decide in each column, (columns,)."""
        now, halved = _smooth(self.now), _smooth(self.halved)
        gamma = np.clip(np.log2(np.maximum(halved, 1e-9) / np.maximum(now, 1e-9)), 0.0, MOST_GAMMA)
        n = np.maximum(self.n_frames, 1)
        return now * (1 - (n / (n + exposures)) ** gamma)


def next_pass(undecided: Undecided, pass_time: PassTime, left_s: float, passes: int) -> Pass | None:
    """The pass that decides most rows per time, of those that leave the time that is left used up in `passes` passes.

    None where no pass fits or none decides anything.
    """
    columns = len(undecided.now)
    edges = np.unique(np.linspace(0, columns, min(columns, STEPS) + 1).round().astype(int))
    lengths = np.unique(edges[None, :] - edges[:, None])
    best: tuple[float, Pass] | None = None
    for exposures in EXPOSURES:
        gained = np.concatenate([[0.0], np.cumsum(undecided.gain(exposures))])
        for length in lengths[lengths > 0].tolist():
            time_s = pass_time(length, exposures)
            if time_s is None or time_s > left_s:
                continue
            first = edges[edges + length <= columns]
            gain = gained[first + length] - gained[first]
            at = int(gain.argmax())
            enough = time_s >= left_s / passes
            rate = float(gain[at]) / (time_s if enough else left_s / passes)
            if gain[at] > 0 and (best is None or rate > best[0]):
                best = rate, Pass(int(first[at]), length, exposures)
    return None if best is None else best[1]


def undecided_rows(confidence: NDArray[np.float32], searched: NDArray[np.bool_]) -> Array:
    """Rows of each column that are expected to be wrong, (columns,), out of (rows, columns) that were searched."""
    return np.where(searched, 1.0 - confidence.astype(np.float64), 0.0).sum(axis=0)


def thinned(volume: CountVolume, seed: int = 0) -> CountVolume:
    """The counts of half the frames of each column, drawn at random out of all of them: ones without replacement.

    Columns need at least 2 frames.
    """
    rng = np.random.default_rng(seed)
    counts = np.empty_like(volume.counts)
    tables: dict[int, NDArray[np.unsignedinteger]] = {}
    for c, n in enumerate(volume.n_frames.tolist()):
        if n not in tables:
            tables[n] = _thinning(n).astype(counts.dtype)
        draw = rng.integers(0, _DRAWS, counts[c].shape, np.uint8)
        counts[c] = tables[n][volume.counts[c], draw]
    return replace(volume, counts=counts, n_frames=volume.n_frames // 2, exposures=None)


_DRAWS = 256


def _thinning(n: int) -> NDArray[np.int64]:
    """How many of k ones among n frames are among the half that is drawn, (n + 1, 256): its quantiles.

    Hypergeometric: P(j) = C(k, j) C(n - k, m - j) / C(n, m) with m = n // 2.
    """
    m = n // 2
    level = (np.arange(_DRAWS) + 0.5) / _DRAWS
    log_factorial = np.concatenate([[0.0], np.cumsum(np.log(np.arange(1, n + 1)))])
    table = np.zeros((n + 1, _DRAWS), np.int64)
    for k in range(n + 1):
        j = np.arange(max(0, m - (n - k)), min(k, m) + 1)
        log_p = (
            log_factorial[k] - log_factorial[j] - log_factorial[k - j]
            + log_factorial[n - k] - log_factorial[m - j] - log_factorial[n - k - m + j]
        )  # fmt: skip
        p = np.exp(log_p - log_p.max())
        below = np.cumsum(p / p.sum())
        table[k] = j[np.minimum(np.searchsorted(below, level), len(j) - 1)]
    return table


def _smooth(values: Array) -> Array:
    """Means over neighbouring columns, fewer at the ends."""
    kernel = np.ones(min(SMOOTH_COLUMNS, len(values)))
    return np.convolve(values, kernel, "same") / np.convolve(np.ones(len(values)), kernel, "same")


def share_of(passes: Sequence[Pass], columns: int) -> Array:
    """Exposures that each column got in all passes, (columns,)."""
    total = np.zeros(columns)
    for one in passes:
        total[one.part] += one.exposures
    return total
