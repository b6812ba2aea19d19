"""The waves of one sweep's planes against those of another: the sign of exposures that are not locked to the mirror.

While the sweeps of a view were taken nothing moved, so their residuals, binned over the mirror's command, may differ by
noise and by one constant for each direction (what is left of the lag). The rest are waves that each sweep has on its
own. A view with a single sweep shows them against its own straight line. Medians in bins keep bad passages out. Where
few passages are left, as in bright room light, a mean square of so few bins is noise: how large it may be is told too.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.arrays import Array
from calibration.views import robust_sd

BINS = 24
"""Bins of the command range: wide enough for tens of passages each, narrow enough for a wave of several turns."""
_FEWEST_IN_BIN = 5
_LEAST_SHARE_IN_BIN = 0.25
"""Share of a sweep's usual bin contents that a bin must hold: where a sweep only reaches into a bin, noise has chosen
the passages that are in it."""
_FEWEST_BINS = 4
_MEDIAN_VARIANCE = np.pi / 2
"""Variance of a median in units of the mean's, normal distribution."""
_MEDIAN_TAKES = 0.8
"""The robust scatter of n values around their own median is (n - 0.8) / n of the true (Croux, Rousseeuw, 1992)."""
NOISE_SIGMAS = 4.0
"""Standard deviations of a mean square up to which it may be noise."""


@dataclass(frozen=True, slots=True, eq=False)
class SweepResidual:
    """Residuals of one sweep of a view. command, residual: (m,) float64, both in command units."""

    view: str
    direction: int
    command: Array
    residual: Array


@dataclass(frozen=True, slots=True, eq=False)
class SweepWaves:
    """rms: of the waves in command units, noise taken off; NaN where there are too few passages to tell. noise: up to
    here that may be noise.

    command: (BINS,) middles of bins; sweeps: (sweeps, BINS) medians, NaN where there are too few passages.
    """

    rms: float
    noise: float
    command: Array
    sweeps: Array


def sweep_waves(sweeps: Sequence[SweepResidual]) -> SweepWaves:
    """Compare the sweeps of each view."""
    edges = _edges(sweeps)
    middle, variance = _binned(sweeps, edges)
    left = middle.copy()
    for direction in (-1, 1):
        mine = np.array([sweep.direction == direction for sweep in sweeps], dtype=bool)
        if np.isfinite(middle[mine]).any():
            left[mine] -= np.nanmedian(middle[mine])
    views = [
        [i for i, sweep in enumerate(sweeps) if sweep.view == name]
        for name in dict.fromkeys(sweep.view for sweep in sweeps)
    ]
    square, sd = _between(left, variance, views)
    if np.isnan(square):
        square, sd = _off_lines(left, variance)
    return SweepWaves(
        rms=float(np.sqrt(max(square, 0.0))) if np.isfinite(square) else np.nan,
        noise=float(np.sqrt(NOISE_SIGMAS * sd)),
        command=(edges[1:] + edges[:-1]) / 2,
        sweeps=middle,
    )


def _edges(sweeps: Sequence[SweepResidual]) -> Array:
    commands = [sweep.command for sweep in sweeps if sweep.command.size]
    low, high = (min(map(np.min, commands)), max(map(np.max, commands))) if commands else (-1.0, 1.0)
    return np.linspace(low, high if high > low else low + 1, BINS + 1)


def _binned(sweeps: Sequence[SweepResidual], edges: Array) -> tuple[Array, Array]:
    """Medians of the residuals (sweeps, BINS) and their variances."""
    middle, variance = np.full((len(sweeps), BINS), np.nan), np.full((len(sweeps), BINS), np.nan)
    for i, sweep in enumerate(sweeps):
        at = np.clip(np.searchsorted(edges, sweep.command, side="right") - 1, 0, BINS - 1)
        count = np.bincount(at, minlength=BINS)
        usual = float(np.median(count[count > 0])) if count.any() else 0.0
        for k in np.flatnonzero(count >= max(_FEWEST_IN_BIN, _LEAST_SHARE_IN_BIN * usual)):
            inside = sweep.residual[at == k]
            middle[i, k] = np.median(inside)
            sd = robust_sd(inside - middle[i, k]) * inside.size / (inside.size - _MEDIAN_TAKES)
            variance[i, k] = _MEDIAN_VARIANCE * sd**2 / inside.size
    return middle, variance


def _between(left: Array, variance: Array, views: Sequence[Sequence[int]]) -> tuple[float, float]:
    """Mean square of what tells the sweeps of a view apart, NaN where no view has two; and its sd, were all noise."""
    found = weight = chance = 0.0
    for rows in views:
        if len(rows) > 1:
            noise = np.mean(variance[rows], axis=0)
            spread = np.var(left[rows], axis=0, ddof=1) - noise
            known, free = np.isfinite(spread), len(rows) - 1
            found += float(spread[known].sum()) * free
            weight += np.count_nonzero(known) * free
            chance += 2 * free * float(np.sum(noise[known] ** 2))
    return (found / weight, float(np.sqrt(chance)) / weight) if weight else (np.nan, np.nan)


def _off_lines(left: Array, variance: Array) -> tuple[float, float]:
    """Mean square of single sweeps off their straight lines, NaN where none is long enough; and its sd, as above."""
    found = weight = chance = 0.0
    bins = np.arange(BINS)
    for values, noise in zip(left, variance, strict=True):
        known = np.isfinite(values)
        count = int(np.count_nonzero(known))
        if count < _FEWEST_BINS:
            continue
        line = np.polynomial.Polynomial.fit(bins[known], values[known], 1)
        free = count - 2
        found += float(np.sum((values[known] - line(bins[known])) ** 2)) - free * float(noise[known].mean())
        weight += free
        chance += 2 * free * float(noise[known].mean()) ** 2
    return (found / weight, float(np.sqrt(chance)) / weight) if weight else (np.nan, np.nan)
