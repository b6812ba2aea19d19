"""Pixels that cannot be used, filled in from their neighbours so that a picture can be searched."""

import numpy as np
from numpy.typing import NDArray

_REACHES = (1, 2, 4)
"""Half width of the neighbourhood, in pixels; the next one where all of it is unusable."""


def repaired(picture: NDArray[np.generic], defects: NDArray[np.bool_] | None = None) -> NDArray[np.float32]:
    """The picture with defects (True = unusable) and values that are no number replaced by their neighbours' median."""
    values: NDArray[np.float32] = np.array(picture, dtype=np.float32)
    bad = ~np.isfinite(values)
    if defects is not None:
        bad |= defects
    values[bad] = np.nan
    for reach in _REACHES:
        rows, columns = np.nonzero(np.isnan(values))
        if len(rows) == 0:
            return values
        padded = np.pad(values, reach, constant_values=np.nan)
        step = np.arange(2 * reach + 1)
        around = padded[rows[:, None, None] + step[:, None], columns[:, None, None] + step].reshape(len(rows), -1)
        known = ~np.isnan(around).all(axis=1)
        values[rows[known], columns[known]] = np.nanmedian(around[known], axis=1)
    return np.nan_to_num(values)
