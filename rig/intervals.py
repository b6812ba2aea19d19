"""95 % confidence intervals of a mean: over repeats by Student's t, over one map by a bootstrap over blocks of it.

The two answer different questions. Repeats of a scan differ in their photons: the interval is of this scene. Blocks of
a map differ in what they look at too: the interval is of scenes like it, and wider. Errors of neighbours hang together,
since filters and coupled estimators share them out, so that whole blocks are drawn and not single answers.
"""

import math
import statistics
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

BLOCK_ROWS, BLOCK_COLUMNS = 32, 25
"""Size of a block: more than the reach of filters and of what couples neighbours."""
RESAMPLES = 1000
_Z = 1.959964
"""97.5 % quantile of the normal distribution."""
_T = {1: 12.7062, 2: 4.3027, 3: 3.1824, 4: 2.7764, 5: 2.5706}
"""The same of Student's t by degrees of freedom, where the series of `t_quantile` is off by more than 0.1 %."""

Interval = tuple[float, float]


def repeats_interval(means: Sequence[float]) -> Interval:
    """Of the mean of at least two independent means; never below zero, since they are of absolute errors."""
    half = t_quantile(len(means) - 1) * statistics.stdev(means) / math.sqrt(len(means))
    middle = statistics.fmean(means)
    return max(0.0, middle - half), middle + half


def blocks_interval(sums: NDArray[np.float64], numbers: NDArray[np.int64], seed: int = 0) -> Interval:
    """Of sum(sums) / sum(numbers), both (blocks,): what the errors of each block add up to, and how many there are.

    Percentiles of the means of drawn blocks (Efron and Tibshirani, 'An introduction to the bootstrap', 1993, chapters 8
    and 13).
    """
    some = numbers > 0
    sums, numbers = sums[some], numbers[some]
    drawn = np.random.default_rng(seed).integers(0, len(sums), (RESAMPLES, len(sums)))
    means = sums[drawn].sum(axis=1) / numbers[drawn].sum(axis=1)
    low, high = np.percentile(means, [2.5, 97.5])
    return float(low), float(high)


def blocks_of(errors: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Sum and number of the errors (rows, columns) in each block; NaN is no error. Arrays (blocks,)."""
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
