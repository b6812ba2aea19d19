"""The rows of a trade-off: error and time of a setting, their confidence interval, and whether another one is better.

`score_map` makes the row of one map, `over_repeats` that of several, `with_fronts` marks the Pareto fronts.

95 % confidence intervals of a mean are over repeats by Student's t, or over one map by a bootstrap over blocks of it.
The two answer different questions. Repeats of a scan differ only in their photons, so the interval is for this scene.
Blocks of a map also differ in what they show, so the interval is for scenes like it, and wider. Errors of neighbours
are correlated, since filters and coupled estimators spread them; so whole blocks are drawn and not single answers.
"""

import math
import statistics
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from drivers.interfaces import SweepTruth
from rig.depth.reconstruct import MapResult
from rig.errors import UsageError
from rig.geometry.stripe_table import MISSING_PX, depth_errors

Interval = tuple[float, float]
Place = tuple[str, str | None]
"""Scene and fog."""

MOST_MISSING = 0.05
"""Largest share of true stripes without an answer with which a row's error is meaningful."""

LOCAL_PX = 1.0
"""Largest error, in px, of an answer that has found the stripe; what remains is the error of its position."""
_SD_OF_MEDIAN = 1.4826
"""Standard deviation of a Gaussian, divided by the median of its absolute values."""

Clock = Literal["sensor", "compute"]
"""The time that an error is traded for: the sensor's or the computer's."""


@dataclass(frozen=True, slots=True)
class TrialSetting:
    """A setting that can be chosen: estimator, filter, exposures per column, and number of lines at once."""

    estimator: str
    filter: str
    exposures: int
    lines: int = 1

    def __str__(self) -> str:
        """Say the setting in words."""
        filtered = "" if self.filter == "none" else f" + {self.filter}"
        lines = "" if self.lines == 1 else f", {self.lines} lines"
        return f"{self.estimator}{filtered}, {self.exposures} exposure{'s' * (self.exposures != 1)}{lines}"


@dataclass(frozen=True, slots=True)
class TradeoffRow:
    """A setting in one scene and fog, over all repeats: errors relative to the world's truth, and times.

    fog: a visibility or 'clear'; None for the scene's own fog.
    sensor_ms: time of the sensor for a map, with dark frames and fly-back.
    compute_ms: computing time of a map after the first, with counting and everything else.
    mean_abs_px: mean |error| of stripes over every (row, column) with a true stripe; a missing answer counts as
    `MISSING_PX`.
    within_1px, missing: shares of the true stripes with an answer within 1 px, and without an answer.
    depth_mm: mean depth error; None if no pixel has a depth.
    ci95: confidence interval of mean_abs_px, over repeats or else over blocks of the map.
    local_sd_px: standard deviation of the errors of answers within LOCAL_PX, from the median |error|; None without any.
    pareto, pareto_compute: whether the row is on the Pareto front, where no other setting in the same scene and fog is
    at least as good in error and in time (of sensor or computer) and better in one of them; False with too many answers
    missing.

    The other fields compare the row with the statistical limit (`rig.tradeoff.limits`); each is None if not known.
    times_limit: mean_abs_px divided by the statistical limit.
    exponent_nats: Chernoff's exponent per exposure, of all rows that are seen together. times_wrong_limit: share of
      answers more than 1 px off, divided by that of the ideal estimator.
    position_sd_px: Cramer-Rao's bound. times_position_limit: local_sd_px divided by this bound.
    """

    scene: str
    fog: str | None
    estimator: str
    filter: str
    exposures: int
    lines: int
    sensor_ms: float
    compute_ms: float
    mean_abs_px: float
    within_1px: float
    missing: float
    depth_mm: float | None
    ci95: Interval
    times_limit: float | None = None
    exponent_nats: float | None = None
    times_wrong_limit: float | None = None
    local_sd_px: float | None = None
    position_sd_px: float | None = None
    times_position_limit: float | None = None
    pareto: bool = False
    pareto_compute: bool = False

    @property
    def counts(self) -> bool:
        """Whether few enough answers are missing for the error to be meaningful."""
        return self.missing <= MOST_MISSING

    @property
    def place(self) -> Place:
        """Scene and fog of this row."""
        return self.scene, self.fog

    @property
    def setting(self) -> TrialSetting:
        """The setting of this row."""
        return TrialSetting(self.estimator, self.filter, self.exposures, self.lines)

    def time_ms(self, of: Clock) -> float:
        """Time of a map on the sensor or on the computer."""
        return self.sensor_ms if of == "sensor" else self.compute_ms


def score_map(
    place: Place, setting: TrialSetting, result: MapResult, truth: SweepTruth, sensor_ms: float, compute_ms: float
) -> TradeoffRow:
    """Make the row of one map, with an interval over its blocks. Raises UsageError if the truth has no stripe."""
    true_px = truth.x_px.astype(np.float64)
    if not np.isfinite(true_px).any():
        raise UsageError("the line is nowhere seen in this scene; check the scene and scan.command_range")
    errors = np.abs(result.stripe.x_px - true_px)
    missing = np.isfinite(true_px) & ~np.isfinite(result.stripe.x_px)
    errors[missing] = MISSING_PX
    near = (errors <= LOCAL_PX) & ~missing
    sums, numbers = blocks_of(errors)
    total = int(numbers.sum())
    depth_m = depth_errors(result.depth_m, truth.depth_m)["mean_abs"]
    return TradeoffRow(
        *place,
        **asdict(setting),
        mean_abs_px=float(sums.sum() / total),
        within_1px=float(np.count_nonzero(near) / total),
        missing=float(np.count_nonzero(missing) / total),
        depth_mm=None if depth_m is None else 1e3 * depth_m,
        sensor_ms=sensor_ms,
        compute_ms=compute_ms,
        ci95=blocks_interval(sums, numbers),
        local_sd_px=float(_SD_OF_MEDIAN * np.median(errors[near])) if near.any() else None,
    )


def over_repeats(rows: Sequence[TradeoffRow]) -> TradeoffRow:
    """Make the row of a setting from those of its repeats: their means, and the median of compute_ms."""
    averaged: dict[str, float | None] = {}
    for name in ("sensor_ms", "mean_abs_px", "within_1px", "missing", "depth_mm", "local_sd_px"):
        known = [value for row in rows if (value := getattr(row, name)) is not None]
        averaged[name] = statistics.fmean(known) if known else None
    compute_ms = statistics.median(row.compute_ms for row in rows)
    interval = repeats_interval([row.mean_abs_px for row in rows]) if len(rows) > 1 else rows[0].ci95
    return replace(rows[0], **averaged, compute_ms=compute_ms, ci95=interval)  # type: ignore[arg-type]


def with_fronts(rows: Sequence[TradeoffRow]) -> tuple[TradeoffRow, ...]:
    """Mark the rows that lie on the Pareto front of their scene and fog."""
    sensor, compute = _fronts(rows, "sensor"), _fronts(rows, "compute")
    return tuple(replace(row, pareto=i in sensor, pareto_compute=i in compute) for i, row in enumerate(rows))


def _fronts(rows: Sequence[TradeoffRow], of: Clock) -> set[int]:
    """Indices of the rows that no other row in their scene and fog beats."""
    found: set[int] = set()
    best: dict[Place, float] = {}
    counting = [(row.time_ms(of), row.mean_abs_px, i) for i, row in enumerate(rows) if row.counts]
    for _, error_px, i in sorted(counting):
        if error_px < best.get(rows[i].place, math.inf):
            found.add(i)
            best[rows[i].place] = error_px
    return found


BLOCK_ROWS, BLOCK_COLUMNS = 32, 25
"""Rows and columns of a block: more than the reach of filters and of the coupling of neighbours."""
RESAMPLES = 1000
_Z = 1.959964
"""97.5 % quantile of the normal distribution."""
_T = {1: 12.7062, 2: 4.3027, 3: 3.1824, 4: 2.7764, 5: 2.5706}
"""97.5 % quantiles of Student's t by degrees of freedom, where the series of `t_quantile` is off by more than 0.1 %."""


def repeats_interval(means: Sequence[float]) -> Interval:
    """95 % interval of the mean of two or more independent means of absolute errors. It is cut off at 0."""
    half = t_quantile(len(means) - 1) * statistics.stdev(means) / math.sqrt(len(means))
    middle = statistics.fmean(means)
    return max(0.0, middle - half), middle + half


def blocks_interval(sums: NDArray[np.float64], numbers: NDArray[np.int64], seed: int = 0) -> Interval:
    """95 % interval of the mean error sum(sums) / sum(numbers).

    sums, numbers: (blocks,), sum and number of the errors in each block. The interval is between percentiles of the
    means of randomly drawn blocks (Efron and Tibshirani, 'An introduction to the bootstrap', 1993, chapters 8 and 13).
    """
    some = numbers > 0
    sums, numbers = sums[some], numbers[some]
    drawn = np.random.default_rng(seed).integers(0, len(sums), (RESAMPLES, len(sums)))
    means = sums[drawn].sum(axis=1) / numbers[drawn].sum(axis=1)
    low, high = np.percentile(means, [2.5, 97.5])
    return float(low), float(high)


def blocks_of(errors: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Sum and number of the errors (rows, columns) in each block, arrays (blocks,); NaN means no error value."""
    rows, columns = errors.shape
    down, across = np.arange(0, rows, BLOCK_ROWS), np.arange(0, columns, BLOCK_COLUMNS)
    known = np.isfinite(errors)

    def added(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.add.reduceat(np.add.reduceat(values, down, axis=0), across, axis=1).ravel()

    return added(np.where(known, errors, 0.0)), added(known.astype(np.float64)).astype(np.int64)


def t_quantile(freedom: int) -> float:
    """97.5 % quantile of Student's t (Abramowitz and Stegun 26.7.5), within 0.1 %."""
    if freedom in _T:
        return _T[freedom]
    z, n = _Z, float(freedom)
    return (
        z
        + (z**3 + z) / (4 * n)
        + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * n**2)
        + (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / (384 * n**3)
    )
