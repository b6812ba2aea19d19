"""Compiled placing by pairs of neighbours opposite each other, sixteen stripes to a vector.

The mean of two places that lie opposite each other on a plane is the place between them, whatever the plane's slope. So
a stripe is joined by its opposite neighbours some stripes away, each placed with its own neighbourhood before, where
their mean m agrees with its own place d: within SAME_PX, and within SIGMAS of what the standard deviations of both let
expect,

    d' = (d / s^2 + sum m / v) / (1 / s^2 + sum 1 / v),    v = (s1^2 + s2^2) / 4

Where a surface ends or bends they do not agree, and the stripe stays where it is. Two such rounds reach as far as 25 x
25 neighbours for the work of 16: with as many summed one by one (`placing_pools`) slopes have to be less than SAME_PX
over the whole reach, and half a neighbourhood at an edge is off by its slope.

Neighbourhoods overlap, so that pairs know less than the sum of what each knows: `share` of it, which is what makes the
standard deviation right where all agree.
"""

from typing import Final

import numba
import numpy as np
from numpy.typing import NDArray

from rig.estimators.label_volume_buffers import signed_address
from rig.estimators.placing_pools import COPIED_ROWS, MARGIN, SAME_PX, with_margin
from rig.lane_memory import copy_floats, load_float32, store_float32
from rig.lanes import (
    LANES,
    larger_float,
    largest_float,
    square_root,
    where_below,
    where_small,
    zero_float32,
)

Float32 = NDArray[np.float32]

SIGMAS: Final = 2.0
"""Standard deviations by which a pair may differ from the stripe between it: what belongs together nearly always does,
and a surface that bends by more than its noise is left as it is."""


@numba.njit(cache=True, nogil=True)
def join_pairs(
    distance: Float32,
    sd_px: Float32,
    step: int,
    share: float,
    enough: float,
    first_row: int,
    last_row: int,
    out_distance: Float32,
    out_sd_px: Float32,
) -> None:
    """Fill the outputs, (rows, columns) as the inputs, of rows first_row..last_row-1.

    distance: from the far end in px, NaN where there is no stripe; sd_px: at most 1, which is to know nothing. step:
    rows and columns to the neighbours, at most MARGIN. enough: 1/px^2, from which on a stripe stays where it is.
    """
    columns = distance.shape[1]
    to_distance, to_sd = signed_address(out_distance), signed_address(out_sd_px)
    lines = np.empty((2, (-(-columns // LANES) + 2) * LANES), np.float32)
    at = signed_address(lines)
    for band in range(first_row, last_row, COPIED_ROWS):
        end = min(band + COPIED_ROWS, last_row)
        places, sds = with_margin(distance, band, end), with_margin(sd_px, band, end)
        around, width = (signed_address(places), signed_address(sds)), places.shape[1]
        for y in range(band, end):
            _join_row(around, width, (y - band + MARGIN) * width + LANES, step, share, 1.0 / enough, at)
            copy_floats(at, to_distance + 4 * columns * y, columns)
            copy_floats(at + 4 * width, to_sd + 4 * columns * y, columns)
        # They live until here: what is known by its address alone would be freed.
        places[:1] = sds[:1] = 0.0
    lines[:1] = 0.0


@numba.njit(cache=True, nogil=True)
def _join_row(at: tuple[int, int], width: int, here: int, step: int, share: float, known: float, out: int) -> None:
    """One row, whose first stripe is element `here` of the copies; known: variance from which on stripes stay."""
    one, none = zero_float32() + np.float32(1.0), zero_float32()
    quarter, sigmas, shared = np.float32(0.25), np.float32(SIGMAS * SIGMAS), np.float32(share)
    enough = np.float32(known)
    for c in range(0, width - 2 * LANES, LANES):
        own, sd = load_float32(at[0], here + c), load_float32(at[1], here + c)
        variance = sd * sd
        if largest_float(variance) <= enough:
            store_float32(out, c, own)
            store_float32(out, width + c, sd)
            continue
        information = one / variance
        pull, joined = none, none
        for away in (1, width - 1, width, width + 1):
            a, b = here + c - step * away, here + c + step * away
            first, second = load_float32(at[1], a), load_float32(at[1], b)
            first, second = first * first, second * second
            both = (first + second) * quarter
            off = (load_float32(at[0], a) + load_float32(at[0], b)) * np.float32(0.5) - own
            weight = where_below(one / both, none, off * off, (both + variance) * sigmas)
            weight = where_below(where_small(weight, off, SAME_PX), none, larger_float(first, second), one)
            pull = pull + where_small(off, off, SAME_PX) * weight
            joined = joined + weight
        moved = own + pull / (information + joined)
        store_float32(out, c, where_below(moved, own, none + enough, variance))
        told = one / square_root(information + joined * shared)
        store_float32(out, width + c, where_below(told, sd, none + enough, variance))
