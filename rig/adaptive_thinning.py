"""Counts as they would be of fewer frames: three quarters of those of each column, or one less, drawn at random.

Half of them would tell less of what further frames will change: where few answers are wrong at four exposures, many are
at two.
"""

from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from rig.counting import CountVolume

Array = NDArray[np.float64]
Numbers = TypeVar("Numbers", bound=NDArray[Any])


def thinned(volume: CountVolume, seed: int = 0) -> CountVolume:
    """The counts of `frames_left` of the frames of each column, drawn at random: ones without replacement.

    Of a single frame nothing is left.
    """
    rng = np.random.default_rng(seed)
    counts = np.empty_like(volume.counts)
    tables: dict[int, NDArray[np.unsignedinteger]] = {}
    for c, n in enumerate(volume.n_frames.tolist()):
        if n not in tables:
            tables[n] = _thinning(n).astype(counts.dtype)
        draw = rng.integers(0, _DRAWS, counts[c].shape, np.uint8)
        counts[c] = tables[n][volume.counts[c], draw]
    return replace(volume, counts=counts, n_frames=frames_left(volume.n_frames), exposures=None)


_DRAWS = 256


def frames_left(n: Numbers) -> Numbers:
    """Frames that are left of n, whole numbers of any type: a quarter is left out, rounded down, and one at least.

    Of 1, 2 and 3 frames 0, 1 and 2 are left, of 10 eight.
    """
    left: Numbers = np.maximum(n - np.maximum(n // 4, 1), 0)
    return left


def _thinning(n: int) -> NDArray[np.int64]:
    """How many of k ones among n frames are among those that are drawn, (n + 1, 256): its quantiles.

    Hypergeometric: P(j) = C(k, j) C(n - k, m - j) / C(n, m), m the frames that are drawn.
    """
    m = int(frames_left(np.array(n)))
    level = (np.arange(_DRAWS) + 0.5) / _DRAWS
    log_factorial: Array = np.concatenate([[0.0], np.cumsum(np.log(np.arange(1, n + 1)))])
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
