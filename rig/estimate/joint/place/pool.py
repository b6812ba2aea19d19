"""Sums over neighbours on one surface, and places combined with pairs of opposite neighbours, compiled.

Pooling: sums over those neighbours whose distance from the far end of the depth range differs by at most SAME_PX. Each
stripe has its own set of them, so running sums cannot be used. Rows are processed LANES stripes to a vector, in copies
with a margin of NaN (`with_margin`), so that no bounds need checking. All arrays are float32 (rows, columns).

Joining: on a plane of any slope, the mean of two places opposite each other is the place between them. So a stripe is
joined with pairs of opposite neighbours; all of them have been pooled before. A pair counts if its mean m agrees with
the stripe's place d: within SAME_PX, and within SIGMAS times the standard deviation expected for the difference,

    d' = (d / s^2 + sum m / v) / (1 / s^2 + sum 1 / v),    v = (s1^2 + s2^2) / 4

with standard deviations s of the stripe, and s1 and s2 of the pair. Where a surface ends or bends, pairs do not agree,
and the stripe stays where it is. After pooling over 5 x 5, two such rounds reach as far as 25 x 25 neighbours,
with 8 neighbours each. Neighbourhoods overlap, so pairs add less information than 1 / v. In the standard deviation of
d', 1 / v is multiplied by `share`, which is right where all pairs agree.
"""

from typing import Final

import numba
import numpy as np

from rig.estimate.joint.place.places import Places
from rig.estimate.row.neighbours import COPIED_ROWS, MARGIN, SAME_PX, with_margin
from rig.simd import Float32
from rig.simd.memory import address_of, copy_floats, keep_alive, load_float32, store_float32
from rig.simd.vectors import (
    LANES,
    larger_float,
    largest_float,
    smaller_float,
    smallest_float,
    square_root,
    where_below,
    where_small,
    zero_float32,
)

_LEAST: Final = np.float32(1e-12)


@numba.njit(cache=True, nogil=True)
def pool_row(distance: Float32, first: Float32, second: Float32, y: int, reach: int, sums: Float32) -> None:
    """Fill sums of `first` and `second` over the neighbours of each stripe of row y on its surface, itself included.

    distance, first, second: of `with_margin`; y: counted from their first row after the margin. reach: rows and columns
    to either side. sums: (2, columns), where the number of columns is a multiple of LANES.
    """
    sums[:] = 0.0
    at = address_of(distance), address_of(first), address_of(second)
    widen_row(at, distance.shape[1], y, -1, reach, np.inf, address_of(sums))


@numba.njit(cache=True, nogil=True)
def widen_row(at: tuple[int, int, int], width: int, y: int, inner: int, reach: int, enough: float, sums: int) -> None:
    """Add to the sums of `pool_row` those neighbours that are more than `inner` rows or columns away, up to `reach`.

    Stripes whose second sum already reaches `enough` may be left as they are. at, sums: addresses; width: of copies.
    """
    columns = width - 2 * LANES
    for c in range(0, columns, LANES):
        if smallest_float(load_float32(sums, columns + c)) < enough:
            _widen_block(at, sums, width, (y + MARGIN) * width + LANES + c, c, inner, reach)


@numba.njit(cache=True, nogil=True)
def _widen_block(at: tuple[int, int, int], to: int, width: int, here: int, c: int, inner: int, reach: int) -> None:
    """Do what `widen_row` does for LANES stripes, from index `here` of the copies and index c of the sums on."""
    own, columns = load_float32(at[0], here), width - 2 * LANES
    a, b = load_float32(to, c), load_float32(to, columns + c)
    for away in range(-reach, reach + 1):
        line = here + away * width
        nearest = inner if abs(away) <= inner else -1
        for i in range(line - reach, line - max(nearest, 0)):
            off = load_float32(at[0], i) - own
            a = a + where_small(load_float32(at[1], i), off, SAME_PX)
            b = b + where_small(load_float32(at[2], i), off, SAME_PX)
        for i in range(line + nearest + 1, line + reach + 1):
            off = load_float32(at[0], i) - own
            a = a + where_small(load_float32(at[1], i), off, SAME_PX)
            b = b + where_small(load_float32(at[2], i), off, SAME_PX)
    store_float32(to, c, a)
    store_float32(to, columns + c, b)


@numba.njit(cache=True, nogil=True)
def pool_amplitude(
    reach: int, faintest: float, brightest: float, first_row: int, last_row: int, places: Places
) -> None:
    """Fill amplitude: light / scale, each summed over a stripe's neighbours, kept between faintest and brightest."""
    amplitude, columns = address_of(places.amplitude), places.amplitude.shape[1]
    sums = np.empty((2, -(-columns // LANES) * LANES), np.float32)
    at, width = address_of(sums), sums.shape[1]
    for band in range(first_row, last_row, COPIED_ROWS):
        end = min(band + COPIED_ROWS, last_row)
        distance = with_margin(places.distance, band, end)
        light, scale = with_margin(places.light, band, end), with_margin(places.scale, band, end)
        for y in range(band, end):
            pool_row(distance, light, scale, y - band, reach, sums)
            for c in range(0, width, LANES):
                own = load_float32(at, c) / larger_float(load_float32(at, width + c), _LEAST)
                store_float32(at, c, smaller_float(larger_float(own, faintest), brightest))
            copy_floats(at, amplitude + 4 * columns * y, columns)
    keep_alive(sums)


@numba.njit(cache=True, nogil=True)
def pool_places(
    places: Places, reaches: tuple[int, ...], enough: float, first_row: int, last_row: int, moved: Float32, sd: Float32
) -> None:
    """Fill moved, the shift of each stripe in x, and sd, the standard deviation of its new place, both at most 1 px in
    size.

    reaches: of neighbourhoods, smallest first; the first with `enough` information (1/px^2) is taken, else the last.
    """
    columns = moved.shape[1]
    # The two sums, the shift, and the standard deviation, which is negative while not known.
    lines = np.empty((4, -(-columns // LANES) * LANES), np.float32)
    to, to_moved, to_sd = address_of(lines), address_of(moved), address_of(sd)
    for band in range(first_row, last_row, COPIED_ROWS):
        end = min(band + COPIED_ROWS, last_row)
        distance = with_margin(places.distance, band, end)
        score, known = with_margin(places.score, band, end), with_margin(places.known, band, end)
        at, width = (address_of(distance), address_of(score), address_of(known)), distance.shape[1]
        for y in range(band, end):
            lines[:3], lines[3] = 0.0, -1.0
            lines[1, columns:] = np.inf  # nothing to pool beyond the last column
            own = at[0] + 4 * ((y - band + MARGIN) * width + LANES)
            for i in range(len(reaches)):
                inner, last = reaches[i - 1] if i > 0 else -1, i == len(reaches) - 1
                widen_row(at, width, y - band, inner, reaches[i], enough, to)
                if not _settle(to, width - 2 * LANES, own, -np.inf if last else enough):
                    break
            copy_floats(to + 8 * (width - 2 * LANES), to_moved + 4 * columns * y, columns)
            copy_floats(to + 12 * (width - 2 * LANES), to_sd + 4 * columns * y, columns)
        keep_alive(distance, score, known)
    keep_alive(lines)


@numba.njit(cache=True, nogil=True)
def _settle(lines: int, columns: int, distance: int, enough: float) -> bool:
    """Place the stripes that are not placed yet and have enough information; returns whether any is left unplaced."""
    one, none, least = zero_float32() + np.float32(1.0), zero_float32(), zero_float32()
    for c in range(0, columns, LANES):
        known, before = load_float32(lines, columns + c), load_float32(lines, 3 * columns + c)
        information = larger_float(known, _LEAST)
        step = load_float32(lines, c) / information - load_float32(distance, c)
        step = smaller_float(larger_float(step, np.float32(-1.0)), np.float32(1.0))
        step = where_below(step, none, none, known)
        sd = smaller_float(one / square_root(information), np.float32(1.0))
        sd = where_below(none - one, sd, known, enough)
        store_float32(lines, 2 * columns + c, where_below(step, load_float32(lines, 2 * columns + c), before, none))
        sd = where_below(sd, before, before, none)
        least = smaller_float(least, sd)
        store_float32(lines, 3 * columns + c, sd)
    return bool(smallest_float(least) < 0.0)


SIGMAS: Final = 2.0
"""Standard deviations by which the mean of a pair may differ from the stripe between them: on a plane nearly all pairs
differ by less, and a surface that bends by more than its noise is left as it is."""


@numba.njit(cache=True, nogil=True)
def join_pairs(
    distance: Float32, sd_px: Float32, step: int, share: float, enough: float, first_row: int, last_row: int,
    out_distance: Float32, out_sd_px: Float32,
) -> None:  # fmt: skip
    """Join the stripes of rows first_row..last_row-1 with pairs, see the module; all arrays are (rows, columns).

    distance: from the far end in px, NaN where there is no stripe; sd_px: at most 1, which means no information. step:
    number of rows and columns to the neighbours, at most MARGIN. share: factor on the information of pairs.
    enough: information, 1/px^2, above which a stripe stays where it is.
    """
    columns = distance.shape[1]
    to_distance, to_sd = address_of(out_distance), address_of(out_sd_px)
    lines = np.empty((2, (-(-columns // LANES) + 2) * LANES), np.float32)
    at = address_of(lines)
    for band in range(first_row, last_row, COPIED_ROWS):
        end = min(band + COPIED_ROWS, last_row)
        places, sds = with_margin(distance, band, end), with_margin(sd_px, band, end)
        around, width = (address_of(places), address_of(sds)), places.shape[1]
        for y in range(band, end):
            _join_row(around, width, (y - band + MARGIN) * width + LANES, step, share, 1.0 / enough, at)
            copy_floats(at, to_distance + 4 * columns * y, columns)
            copy_floats(at + 4 * width, to_sd + 4 * columns * y, columns)
        keep_alive(places, sds)
    keep_alive(lines)


@numba.njit(cache=True, nogil=True)
def _join_row(at: tuple[int, int], width: int, here: int, step: int, share: float, known: float, out: int) -> None:
    """Join one row, whose first stripe has index `here` in the copies; known: variance up to which stripes stay."""
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
