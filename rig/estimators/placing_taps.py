"""Compiled fetching of what lies around stripes: counts and ambient light of the pixels to both sides.

Counts lie column by column, answers are worked on row by row, sixteen columns to a vector: in tiles of rows and columns
the counts around all stripes are brought into the order of the answers once, for all that asks for them afterwards.
"""

from typing import Any, Final

import numba
import numpy as np
from numpy.typing import NDArray

from rig.estimators.label_volume_buffers import signed_address
from rig.estimators.placing_kernels import REACH_PX
from rig.lane_eights import EIGHT, spread_eights
from rig.lane_memory import prefetch, read_float32, read_int64, write_float32, write_int64
from rig.lanes import LANES

Float32 = NDArray[np.float32]
Counts = NDArray[np.unsignedinteger[Any]]

TAPS: Final = 2 * REACH_PX + 1
"""Pixels around a stripe that are looked at; EIGHT are fetched."""
MOST_FLUX: Final = np.float32(20.0)
"""In more light no pixel stays dark in a thousand million exposures; ambient light of pixels that there are not."""
_TILE: Final = 16


@numba.njit(cache=True, nogil=True)
def fetch_counts(
    counts: Counts, x0: NDArray[np.int32], x_px: Float32, first_row: int, last_row: int, around: Counts
) -> None:
    """Fill around (rows, columns, EIGHT) of rows first_row..last_row-1: counts from REACH_PX before each stripe on.

    counts: (columns, rows, window), C-contiguous; around: of the same type. 0 where no pixel was stored, of any value
    where there is no stripe.
    """
    columns, rows, window = counts.shape
    size, column = counts.itemsize, rows * window * counts.itemsize
    source, to = signed_address(counts), signed_address(around)
    for top in range(first_row, last_row, _TILE):
        for left in range(0, columns, _TILE):
            for c in range(left, min(left + _TILE, columns)):
                for y in range(top, min(top + _TILE, last_row)):
                    if np.isnan(x_px[y, c]):
                        continue
                    first = nearest_pixel(x_px[y, c]) - REACH_PX - int(x0[c])
                    if 0 <= first <= window - EIGHT:
                        at = source + ((c * rows + y) * window + first) * size
                        # Counts of one column after the other are not what a processor foresees.
                        prefetch(at + column)
                        for i in range(size):
                            write_int64(to + (y * columns + c) * EIGHT * size, i, read_int64(at, i))
                    else:
                        for d in range(EIGHT):
                            stored = 0 <= first + d < window
                            around[y, c, d] = counts[c, y, first + d] if stored else 0


@numba.njit(inline="always")
def nearest_pixel(x):  # type: ignore[no-untyped-def]
    """The pixel that holds x."""
    return int(np.floor(x + np.float32(0.5)))


@numba.njit(forceinline=True)
def ambient_place(ambient, width, y, x, x0, window, spare):  # type: ignore[no-untyped-def]
    """Address of the ambient light from REACH_PX before pixel x on; it is written to `spare` where it is not all there.

    ambient: address of rows of `width` pixels; spare: that of EIGHT numbers, given MOST_FLUX at pixels that were not
    stored or that the picture does not have.
    """
    first, low, high = x - REACH_PX, max(x0, 0), min(x0 + window, width)
    if low <= first <= high - EIGHT:
        return ambient + 4 * (y * width + first)
    for d in range(EIGHT):
        there = low <= first + d < high
        write_float32(spare, d, read_float32(ambient, y * width + first + d) if there else MOST_FLUX)
    return spare


@numba.njit(forceinline=True)
def counts_of(around, at, y, c, to):  # type: ignore[no-untyped-def]
    """Write EIGHT vectors of the counts of stripes c..c+LANES-1, see `fetch_counts`, to address `to`; at: of around."""
    if around.itemsize == 1 and c + LANES <= around.shape[1]:
        spread_eights(at + (y * around.shape[1] + c) * EIGHT, to)
        return
    for i in range(LANES):
        for d in range(EIGHT):
            count = np.float32(around[y, c + i, d]) if c + i < around.shape[1] else np.float32(0.0)
            write_float32(to, d * LANES + i, count)
