"""Where the labels of each row and column lie in its pixels: a table of small numbers, made once per geometry.

Pixels are numbered from far to near: pixel p of a row is at x = START - side * p, and FAR_PX of them come before the
one that label 0 is in, so that neighbouring rows of a leaning line have the same depth at the same p. A pixel holds two
labels, half a pixel apart, of phase 0 (its far half) and 1 (its near half); where between the pixels they lie is the
variant, in eighths of a pixel: 0 to 3.
"""

from typing import Final

import numba
import numpy as np
from numpy.typing import NDArray

from rig.estimators.label_grid import LabelGrid
from rig.estimators.row_input import Sweep, with_rays
from rig.geometry import MARGIN_PX

FRACTIONS: Final = 8
"""Parts of a pixel that the centre of a line is told apart in."""
VARIANTS: Final = FRACTIONS // 2
PHASES: Final = 2
FAR_PX: Final = MARGIN_PX
SLACK_PX: Final = 1
"""How far outside the row's search window a label may lie: the mean of a peak at its end needs both sides."""
START, VARIANT, ODD, LABEL, LABEL_END, VALID, VALID_END, MEND = range(8)
"""START: x of pixel 0; VARIANT: -1 where nothing is searched; ODD: 1 where label 0 is of phase 1; LABEL, LABEL_END:
labels that can be, from and up to; VALID, VALID_END: pixels p that were stored and are looked at; MEND: 1 where some
pixel that the row's table weighs is not among those, or is hot (`label_tables`)."""
PLACES: Final = 8


def label_pixels(grid: LabelGrid) -> int:
    """Pixels that labels lie in."""
    return grid.stripes // PHASES + 1


def places_of(sweep: Sweep, grid: LabelGrid) -> NDArray[np.int16]:
    """The numbers of each row of each column, int16 (columns, rows, PLACES)."""
    out = np.zeros((*grid.x_far.T.shape, PLACES), np.int16)
    _fill_places(sweep, grid.x_far, grid.side, grid.stripes, label_pixels(grid), out)
    return out


@numba.njit(cache=True, nogil=True)
def _fill_places(
    sweep: Sweep, x_far: NDArray[np.float64], side: int, stripes: int, pixels: int, out: NDArray[np.int16]
) -> None:
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
            # In eighths of a pixel towards near: label 0, and from there to the pixel that holds it.
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
            # Of the pixels that were stored, all eighths that are nearest to them.
            low = max(-side * far - SLACK_PX, -side * (last if side > 0 else first) - 4 / FRACTIONS)
            high = min(-side * near + SLACK_PX, -side * (first if side > 0 else last) + 3 / FRACTIONS)
            place[LABEL] = min(max(int(np.ceil((FRACTIONS * low - at) / step)), 0), stripes)
            # The pixel of the last label is one that tables have.
            high_label = int(np.floor((FRACTIONS * high - at) / step))
            place[LABEL_END] = min(max(high_label + 1, place[LABEL]), stripes, PHASES * pixels - place[ODD])
