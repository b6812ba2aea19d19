"""Finds points of a depth map that float between two surfaces: wrong points at the edges of near objects.

Points are compared by disparity, in px along the row. A point floats if of the 9 x 9 points around it

- at least one is nearer by more than CLEARLY_PX, and at least one farther by more than that;
- fewer than one in LEAST_SHARE lie on its own surface (within SAME_PX);
- there are at least LEAST_POINTS, more than two rows or columns have.

A straight wire one pixel wide crosses the 9 x 9: one point in ten lies on it, and one in twenty at its end. So wires,
twigs and bars stay, even where some of their rows are missing. So do planes of up to 2.5 px of disparity per pixel, or
1.75 px at the border of the map. A map of one or two rows or columns has too few points to tell.
"""

from typing import Final

import numba
import numpy as np

from rig.estimate.row.neighbours import COPIED_ROWS, MARGIN, SAME_PX, with_margin
from rig.simd import Bools, Float32
from rig.simd.vectors import LANES
from rig.threads import RowWorkers

CLEARLY_PX: Final = np.float32(6.0)
"""Surfaces clearly before or behind a point differ from it by more than this. In 32 maps of four test scenes the filter
took 109 floating or wrong points and 13 right ones at 5 px, 97 and 5 at 6 px."""
AROUND: Final = 4
LEAST_SHARE: Final = 20
LEAST_POINTS: Final = 18
_ENOUGH: Final = ((2 * AROUND + 1) ** 2 - 1) // LEAST_SHARE
"""Points on its surface with which a point does not float, however many there are around."""


def floating_points(depth_m: Float32, px_per_inverse_depth: float, workers: RowWorkers | None = None) -> Bools:
    """The points of a depth map that float between two surfaces, bool (rows, width).

    depth_m: (rows, width), NaN where there is none. px_per_inverse_depth: px of disparity per 1/m of inverse depth.
    """
    disparity = np.float32(px_per_inverse_depth) / depth_m
    floats = np.zeros(depth_m.shape, np.bool_)
    (workers or RowWorkers(1)).over(len(depth_m), lambda first, last: mark_floating(disparity, first, last, floats))
    return floats


@numba.njit(cache=True, nogil=True)
def mark_floating(disparity: Float32, first_row: int, last_row: int, floats: Bools) -> None:
    """Write which points of rows first_row..last_row-1 float; disparity (rows, width) in px, NaN for no point."""
    width = disparity.shape[1]
    same = np.empty(width, np.int8)
    for band in range(first_row, last_row, COPIED_ROWS):
        end = min(band + COPIED_ROWS, last_row)
        copy = with_margin(disparity, band, end)
        for y in range(band, end):
            row = y - band + MARGIN
            own = copy[row, LANES : LANES + width]
            same[:] = 0
            for away in range(row - 1, row + 2):
                for left in range(LANES - 1, LANES + 2):
                    near = copy[away, left : left + width]
                    for x in range(width):
                        same[x] += np.int8(abs(near[x] - own[x]) <= SAME_PX)
            for x in range(width):
                # Most points have enough neighbours on their surface next to them, or there is no point at all.
                floats[y, x] = 0 < same[x] <= _ENOUGH and _floats(copy, row, LANES + x)


@numba.njit(cache=True, nogil=True)
def _floats(disparity: Float32, row: int, column: int) -> bool:
    """Whether a point of a copy `with_margin` floats."""
    own = disparity[row, column]
    points, same, before, behind = -1, -1, False, False  # it counts itself
    for reach in range(AROUND + 1):
        for y in range(row - reach, row + reach + 1, max(2 * reach, 1)):
            for x in range(column - AROUND, column + AROUND + 1):
                off = disparity[y, x] - own
                points += not np.isnan(off)
                same += abs(off) <= SAME_PX
                before |= off > CLEARLY_PX
                behind |= off < -CLEARLY_PX
        if same >= _ENOUGH:
            return False
    return before and behind and points >= LEAST_POINTS and same * LEAST_SHARE < points
