"""Compiled counting for several lines at once: frames of a place are added once, each line's window is read from that.

As `counting_kernels.add_runs`, whose parts it is made of. With four lines it takes a quarter of the additions that one
count for each line would take.
"""

import numba
import numpy as np
from numpy.typing import NDArray

from rig.counting_kernels import (
    CHUNK,
    MOST_FRAMES,
    PLANES,
    WORD_BYTES,
    add_frames,
    planes_for,
    rows_of_chunk,
)
from rig.geometry import WORD_PX
from rig.lane_memory import address_of
from rig.lane_order import new_counts, padded_lanes, read_planes, write_counts


@numba.njit(cache=True, nogil=True)
def add_line_runs(
    words: NDArray[np.uint64],
    row_words: int,
    bins: NDArray[np.int32],
    columns_at: NDArray[np.int32],
    x0: NDArray[np.int32],
    counts: NDArray[np.unsignedinteger],
    first_row: int,
    last_row: int,
) -> None:
    """Add lit frames of whole rows to `counts` (columns, rows, window), each to the columns (places, lines) of its bin.

    words: (all words,), `row_words` a row; bins: (n,) place, below 0 to skip; x0: (columns,). Only rows
    first_row..last_row-1 are touched, so that threads may share the output.
    """
    rows, window = counts.shape[1], counts.shape[2]
    planes = np.zeros((PLANES + 1) * CHUNK + 2, np.uint64)
    as_bytes = planes.view(np.uint8)
    n_row = new_counts(2, padded_lanes(window))
    chunk_rows, row_bytes = rows_of_chunk(row_words), row_words * WORD_BYTES
    for y0 in range(first_row, last_row, chunk_rows):
        y1 = min(y0 + chunk_rows, last_row)
        f = 0
        while f < bins.shape[0]:
            place, g = bins[f], f + 1
            while g < bins.shape[0] and bins[g] == place and g - f < MOST_FRAMES:
                g += 1
            if place >= 0:
                add_frames(words, rows * row_words, y0 * row_words, f, g, (y1 - y0) * row_words, 0, planes)
                for line in range(columns_at.shape[1]):
                    c = columns_at[place, line]
                    for y in range(y0, y1, 2):
                        at = (y - y0) * row_bytes + x0[c] // WORD_PX * WORD_BYTES
                        read_planes(
                            address_of(as_bytes), at, at + row_bytes if y + 1 < y1 else at, CHUNK * WORD_BYTES,
                            planes_for(g - f), window, address_of(n_row), padded_lanes(window),
                        )  # fmt: skip
                        for r in range(min(2, y1 - y)):
                            write_counts(n_row[r], counts[c, y + r])
            f = g
