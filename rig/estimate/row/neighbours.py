"""Copies of maps with a margin: compiled code can compare each answer with those around it without checking bounds.

Answers are compared by their distance in px from the position of their column's line at a fixed depth: neighbours whose
distances differ by at most SAME_PX count as lying on one surface. Arrays are float32 (rows, columns).
"""

from typing import Final

import numba
import numpy as np

from rig.simd import Float32
from rig.simd.memory import address_of, copy_floats, load_float32
from rig.simd.vectors import LANES, where_small, zero_float32

SAME_PX: Final = np.float32(1.0)
"""Neighbours whose distances differ by at most this lie on the same surface."""
MARGIN: Final = 6
"""Extra rows above and below in a copy: the farthest distance over which answers are pooled."""
COPIED_ROWS: Final = 32
"""Rows that are copied at a time where the copies should stay in the cache."""


@numba.njit(cache=True, nogil=True)
def with_margin(array: Float32, first_row: int, last_row: int) -> Float32:
    """Copy of rows first_row..last_row-1 with MARGIN rows and LANES or more columns around, NaN outside the array."""
    rows, columns = array.shape
    top, end = max(first_row - MARGIN, 0), min(last_row + MARGIN, rows)
    width = (-(-columns // LANES) + 2) * LANES
    copy, nowhere = np.empty((last_row - first_row + 2 * MARGIN, width), np.float32), np.float32(np.nan)
    source, to = address_of(array), address_of(copy)
    for y in range(first_row - MARGIN, last_row + MARGIN):
        line = copy[y - first_row + MARGIN]
        if top <= y < end:
            line[:LANES], line[LANES + columns :] = nowhere, nowhere
            copy_floats(source + 4 * columns * y, to + 4 * (width * (y - first_row + MARGIN) + LANES), columns)
        else:
            line[:] = nowhere
    return copy


@numba.njit(forceinline=True)
def on_surface(distance, light, here, width, reach):  # type: ignore[no-untyped-def]
    """For each of LANES answers, the number of answers on its surface up to `reach` rows and columns away, and the sum
    of their light.

    distance, light: addresses of copies from `with_margin`, `width` wide; here: index of the first answer. An answer
    counts itself; if its distance is NaN, the number is 0.
    """
    own, number, lit, one = load_float32(distance, here), zero_float32(), zero_float32(), zero_float32() + 1.0
    for line in range(here - reach * width, here + reach * width + 1, width):
        for near in range(line - reach, line + reach + 1):
            off = load_float32(distance, near) - own
            number = number + where_small(one, off, SAME_PX)
            lit = lit + where_small(load_float32(light, near), off, SAME_PX)
    return number, lit
