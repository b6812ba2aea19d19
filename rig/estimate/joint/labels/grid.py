"""Positions as labels that neighbours on one surface share: steps of disparity from the far end of the depth range.

On a surface of constant depth the stripe of the next column is one column spacing further on. So neighbours are not
compared by positions in pixels, but by distances from where the stripe would be at the far end. Label l of a row and
column is at

    x = x_far - side l / PER_PX,     x_far: float64 (rows, columns), side: 1 where near is left, else -1

A table says where labels lie in the pixels of each row (`places_of`, int16 (columns, rows, PLACES)). Pixels are
numbered from far to near: pixel p of a row is at x = START - side p, and FAR_PX pixels come before the one that
contains label 0, so that neighbouring rows of a leaning line have the same depth at the same p. A pixel holds two
labels, half a pixel apart, of phase 0 (its far half) and 1 (its near half). The variant, 0 to 3, says how many eighths
of a pixel each label lies from the far end of its half.
"""

from dataclasses import dataclass
from typing import Final

import numba
import numpy as np

from rig.estimate.row.inputs import Sweep
from rig.geometry.kernels import with_rays
from rig.geometry.windows import MARGIN_PX, SweepGeometry
from rig.simd import Float32, Float64, Int16, Int32

PER_PX: Final = 2
"""Labels per pixel. With one, a stripe between two of them would have 0.05 px more error at 10 exposures."""
SPARE: Final = 1
"""Labels beyond the searched pixels at the near end, so that the mean of a peak there has labels on both sides."""
VECTOR: Final = 32
BAND_ROWS: Final = 64
"""Rows that share tables of costs."""
_ROWS_APART: Final = 8
"""One row in so many is used to find the usual distance of columns."""


@dataclass(frozen=True, slots=True, eq=False)
class LabelGrid:
    """Label l of a row and column is at x_far - side * l / PER_PX, for l from 0 to stripes - 1.

    x_far: float64 (rows, columns), NaN where nothing is searched. side: 1 if near is left, else -1. stripes: number of
    labels in use; labels: the same, rounded up to a multiple of VECTOR. column_px: usual distance from one column to
    the next.
    """

    x_far: Float64
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
def far_ends(u: Float32, v: Float32, plane: Float64, x_lo: Int32, x_hi: Int32, w_far: float) -> Float64:
    """Position of each column's line on each row at inverse depth w_far: (rows, columns) pixels.

    Interpolated between pixels; outside the picture extrapolated from the last two, or the searched pixel itself if
    those beside it have no ray. NaN where x_lo > x_hi.
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


FRACTIONS: Final = 8
"""Positions within a pixel to which the centre of a line is rounded."""
VARIANTS: Final = FRACTIONS // 2
PHASES: Final = 2
FAR_PX: Final = MARGIN_PX
SLACK_PX: Final = 1
"""Pixels by which a label may lie outside a search window: the mean of a peak at the window's end needs both sides."""
START, VARIANT, ODD, LABEL, LABEL_END, VALID, VALID_END, MEND = range(8)
"""START: x of pixel 0; VARIANT: -1 where nothing is searched; ODD: 1 where label 0 is of phase 1; LABEL, LABEL_END:
first possible label, and one after the last; VALID, VALID_END: first pixel p that was stored and is read, and one after
the last; MEND: 1 where some pixel with a weight in the row's table is not among those, or is hot
(`rig.estimate.joint.labels.tables`)."""
PLACES: Final = 8


def label_pixels(grid: LabelGrid) -> int:
    """Number of pixels in which labels lie."""
    return grid.stripes // PHASES + 1


def places_of(sweep: Sweep, grid: LabelGrid) -> Int16:
    """The numbers that place labels in each row of each column, int16 (columns, rows, PLACES)."""
    out = np.zeros((*grid.x_far.T.shape, PLACES), np.int16)
    _fill_places(sweep, grid.x_far, grid.side, grid.stripes, label_pixels(grid), out)
    return out


@numba.njit(cache=True, nogil=True)
def _fill_places(sweep: Sweep, x_far: Float64, side: int, stripes: int, pixels: int, out: Int16) -> None:
    rows, columns = x_far.shape
    width = sweep.u.shape[1]
    for c in range(columns):
        for y in range(rows):
            place = out[c, y]
            place[VARIANT] = -1
            lo, hi, x0 = sweep.x_lo[y, c], sweep.x_hi[y, c], sweep.x0[c]
            first, last = with_rays(
                sweep.u, y, max(lo - MARGIN_PX, x0, 0), min(hi + MARGIN_PX, x0 + sweep.window - 1, width - 1)
            )
            if lo > hi or max(lo, first) > min(hi, last):
                continue
            # In eighths of a pixel towards near: the position of label 0. Then the pixel that holds it.
            at = -int(np.floor(FRACTIONS * side * x_far[y, c] + 0.5))
            pixel = (at + FRACTIONS // 2) // FRACTIONS
            place[VARIANT] = at % VARIANTS
            place[ODD] = 1 if at >= FRACTIONS * pixel else 0
            start = -side * (pixel - FAR_PX)
            place[START] = start
            far, near = (last, first) if side > 0 else (first, last)
            place[VALID] = max(side * (start - far), 0)
            place[VALID_END] = side * (start - near) + 1
            far, near = (min(hi, last), max(lo, first)) if side > 0 else (max(lo, first), min(hi, last))
            step = FRACTIONS // PHASES
            # Limited to the eighths that are nearest to a stored pixel.
            low = max(-side * far - SLACK_PX, -side * (last if side > 0 else first) - 4 / FRACTIONS)
            high = min(-side * near + SLACK_PX, -side * (first if side > 0 else last) + 3 / FRACTIONS)
            place[LABEL] = min(max(int(np.ceil((FRACTIONS * low - at) / step)), 0), stripes)
            # The last label's pixel must be in the tables.
            high_label = int(np.floor((FRACTIONS * high - at) / step))
            place[LABEL_END] = min(max(high_label + 1, place[LABEL]), stripes, PHASES * pixels - place[ODD])
