"""Compiled sums of the pixel view: how often each pixel fired while the search windows passed over it."""

import numba
import numpy as np
from numpy.typing import NDArray


@numba.njit(cache=True, nogil=True)
def window_sums(
    counts: NDArray[np.unsignedinteger],
    n_frames: NDArray[np.int32],
    x0: NDArray[np.int32],
    x_lo: NDArray[np.int32],
    x_hi: NDArray[np.int32],
    rows: int,
    width: int,
) -> NDArray[np.uint32]:
    """Ones and exposures (2, rows, width) of every pixel over the columns in whose search window it lies."""
    out = np.zeros((2, rows, width), np.uint32)
    for c in range(counts.shape[0]):
        for y in range(rows):
            for x in range(max(x_lo[y, c], x0[c]), min(x_hi[y, c], x0[c] + counts.shape[2] - 1, width - 1) + 1):
                out[0, y, x] += counts[c, y, x - x0[c]]
                out[1, y, x] += n_frames[c]
    return out
