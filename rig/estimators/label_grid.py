"""Positions as labels that neighbours on one surface share: steps of disparity from the far end of the depth range.

On a surface of even depth the stripe of the next column stands one column spacing further on, so that positions in
pixels tell nothing about neighbours; distances from where the stripe would stand at the far end do.
"""

from dataclasses import dataclass
from typing import Final

import numba
import numpy as np
from numpy.typing import NDArray

from rig.geometry import SweepGeometry

PER_PX: Final = 2
"""Labels a pixel: at whole pixels the stripe's place between two of them costs 0.05 px of error at 10 exposures."""
SPARE: Final = 1
"""Labels beyond the searched pixels at either end, for the mean of a peak there."""
VECTOR: Final = 32
_ROWS_APART: Final = 8
"""Rows that are looked at for the distance of columns."""


@dataclass(frozen=True, slots=True, eq=False)
class LabelGrid:
    """Label l of a row and column is at x_far - side * l / PER_PX, for l from 0 to stripes - 1.

    x_far: float64 (rows, columns), NaN where nothing is searched; x may lie outside the picture there. side: 1 where
    near is left, else -1. labels: a multiple of VECTOR; those from stripes on mean nothing. column_px: from a column to
    the next, as a rule.
    """

    x_far: NDArray[np.float64]
    side: int
    stripes: int
    labels: int
    column_px: float


def label_grid(geometry: SweepGeometry) -> LabelGrid:
    """The labels of a sweep: as many as the widest row needs."""
    x_far = far_ends(
        geometry.u, geometry.v, geometry.plane, geometry.x_lo, geometry.x_hi, 1 / geometry.depth_range_m[1]
    )
    side = 1 if geometry.near_is_left else -1
    nearest = geometry.x_lo if geometry.near_is_left else geometry.x_hi
    seen = np.isfinite(x_far)
    span = (side * (x_far - nearest))[seen].max(initial=1.0)
    stripes = int(np.ceil(PER_PX * span)) + 1 + SPARE
    steps = np.abs(np.diff(x_far[::_ROWS_APART], axis=1))
    steps = steps[np.isfinite(steps)]
    column_px = float(np.median(steps)) if steps.size else 1.0
    return LabelGrid(x_far, side, stripes, -(-stripes // VECTOR) * VECTOR, column_px)


@numba.njit(cache=True, nogil=True)
def far_ends(
    u: NDArray[np.float32],
    v: NDArray[np.float32],
    plane: NDArray[np.float64],
    x_lo: NDArray[np.int32],
    x_hi: NDArray[np.int32],
    w_far: float,
) -> NDArray[np.float64]:
    """Where each column's line would stand on each row at inverse depth w_far: (rows, columns) pixels.

    Between pixels by straight lines, outside the picture by that through the last two; NaN where x_lo > x_hi.
    """
    rows, columns = x_lo.shape
    width = u.shape[1]
    out = np.full((rows, columns), np.nan)
    for y in range(rows):
        for c in range(columns):
            lo, hi = x_lo[y, c], x_hi[y, c]
            if lo > hi:
                continue
            px, py, pz = plane[c, 0], plane[c, 1], plane[c, 2]
            w_lo = px * u[y, lo] + py * v[y, lo] + pz
            w_hi = px * u[y, hi] + py * v[y, hi] + pz
            # From the searched pixel that is farthest towards the far end, one pixel beyond it where there is one.
            at = hi if w_hi < w_lo else lo
            beyond = at + 1 if w_hi < w_lo else at - 1
            if lo == hi:
                beyond = at + 1 if px * (u[y, min(at + 1, width - 1)] - u[y, max(at - 1, 0)]) < 0 else at - 1
            if beyond < 0 or beyond >= width or np.isnan(u[y, beyond]):
                beyond = 2 * at - beyond
            if beyond < 0 or beyond >= width or np.isnan(u[y, beyond]):
                out[y, c] = at
                continue
            w_at = px * u[y, at] + py * v[y, at] + pz
            w_beyond = px * u[y, beyond] + py * v[y, beyond] + pz
            out[y, c] = at + (w_at - w_far) / (w_at - w_beyond) * (beyond - at)
    return out
