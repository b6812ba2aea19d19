"""Sums of light over blocks of rows and columns at equal distances from the far end, compiled, for second returns.

A block is BLOCK x BLOCK lines; a line is one row of one column. Lines are added at equal distances from the far end of
the depth range, in whole pixels (pixel 0 of distance is the leftmost), without the pixels near their stripes. Both the
ones counted and those expected from haze and ambient light are added. With K frames of a line, and q and c the
probabilities that a pixel stays dark under ambient light alone and under haze alone,

    ones expected = sum over lines K (1 - q c) = sum over columns K (number of lines - c sum q)

so only the q of the lines are summed, left and right of the stripe, and these sums are multiplied with the block's c.
Sums are float32 (block rows, block columns, pixels of distance), sixteen pixels to a vector.
"""

from typing import Final, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rig.count.volume import Counts
from rig.estimate.row.inputs import RowState, Sweep, flux_between, line_light, others_at, profile_place
from rig.estimate.row.likelihood import FLUX_MAX
from rig.geometry.kernels import with_rays
from rig.simd import Float32, Float64, Int16, Int32
from rig.simd.memory import (
    CACHE_LINE,
    address_of,
    keep_alive,
    load_counts,
    load_float32,
    prefetch,
    read_float32,
    read_int16,
    read_int32,
    read_int64,
    store_float32,
    write_float32,
    write_int64,
)
from rig.simd.vectors import LANES, where_below, zero_float32

BLOCK: Final = 4
"""Rows and columns of a block; it is judged together with its eight neighbours."""
LEFT_OUT: Final = np.float32(0.0)
"""Value in `still` (of `SecondLight`) of pixels that are left out: hot ones, and those that must not be used."""
PLACE_X, PLACE_BEGIN, PLACE_END, PLACES = 0, 1, 2, 4
NOWHERE: Final = -(1 << 15)
"""PLACE_X of a line where nothing is searched, see `line_places`."""
SEEN, STILL, HERE, FIELDS = range(4)
"""Fields of a line: addresses of its counts and `still` at pixel 0 of distance, its index in the map; their number."""
BEGIN, LEFT_END, RIGHT, END, LIMITS = range(5)
"""Limits of a line, in pixels of distance: its begin, the end of its part left of the stripe, the begin of its part
right of the stripe, its end; their number."""


class LineTable(NamedTuple):
    """Addresses of the lines of a block, column by column, and of their limits and frames.

    lines: int64 (BLOCK^2, FIELDS); limits: float32 (BLOCK^2, LIMITS); ends, frames: int64 and float32 (BLOCK,), number
    of lines up to the end of each column, and its frames; order: 0, 1, ... as float32.
    """

    lines: int
    limits: int
    ends: int
    frames: int
    order: int


@numba.njit(cache=True, nogil=True)
def line_places(sweep: Sweep, x_far: Float64, side: int, pixels: int) -> Int16:
    """Places of the lines of all rows and columns, int16 (rows, columns, PLACES); made once per model.

    PLACE_X: x of pixel 0 of distance, the leftmost of all `pixels`; NOWHERE if nothing is searched. PLACE_BEGIN,
    PLACE_END: first pixel of distance that is searched and was stored, and the one after the last; both 0 if none is.
    """
    rows, columns = x_far.shape
    out, width = np.zeros((rows, columns, PLACES), np.int16), sweep.u.shape[1]
    for y in range(rows):
        for c in range(columns):
            out[y, c, PLACE_X] = NOWHERE
            if np.isnan(x_far[y, c]):
                continue
            x0, start = sweep.x0[c], int(np.rint(x_far[y, c])) - (pixels - 1 if side > 0 else 0)
            begin = max(sweep.x_lo[y, c], x0, 0, start)
            end = min(sweep.x_hi[y, c] + 1, x0 + sweep.window, width, start + pixels)
            out[y, c, PLACE_X] = min(max(start, NOWHERE + 1), -NOWHERE - 1)
            if begin < end and out[y, c, PLACE_X] == start:
                out[y, c, PLACE_BEGIN], out[y, c, PLACE_END] = begin - start, end - start
    return out


@numba.njit(cache=True, nogil=True)
def sum_lines(
    table: LineTable, inner: tuple[np.float32, np.float32, np.float32, np.float32], as_bytes: bool, clear: int,
    pixels: int, to_ones: int, to_expected: int,
) -> None:  # fmt: skip
    """Write the sums of a block to the addresses to_ones and to_expected.

    inner: begin and end of the pixels that lie left of the stripe in all lines, and of those that lie right of it in
    all. as_bytes: whether counts are bytes, else float32. clear: address of the probabilities that a pixel stays
    dark under haze alone, left and right of the stripe.
    """
    none, order, one = zero_float32(), load_float32(table.order, 0), zero_float32() + np.float32(1.0)
    for v in range(0, pixels, LANES):
        ones, expected, here, i = none, none, order + np.float32(v), 0
        clear_left, clear_right = load_float32(clear, v), load_float32(clear, pixels + 1 + v)
        # Most vectors lie on one side of all stripes, and not at an end of a line.
        first, last = np.float32(v), np.float32(v + LANES - 1)
        whole = first >= inner[0] and last < inner[3]
        all_left, all_right = whole and last < inner[1], whole and first >= inner[2]
        for k in range(BLOCK):
            weight, left, right, end = none, none, none, read_int64(table.ends, k)
            if all_left or all_right:
                while i < end:
                    alone = load_float32(read_int64(table.lines, FIELDS * i + STILL), v)
                    seen = read_int64(table.lines, FIELDS * i + SEEN)
                    there, left = where_below(one, none, none, alone), left + alone
                    weight = weight + there
                    ones = ones + there * (load_counts(seen, v) if as_bytes else load_float32(seen, v))
                    i += 1
                left = left * (clear_left if all_left else clear_right)
            else:
                while i < end:
                    alone = load_float32(read_int64(table.lines, FIELDS * i + STILL), v)
                    seen = read_int64(table.lines, FIELDS * i + SEEN)
                    if not whole:
                        alone = where_below(none, alone, here, read_float32(table.limits, LIMITS * i + BEGIN))
                        alone = where_below(alone, none, here, read_float32(table.limits, LIMITS * i + END))
                    before = where_below(alone, none, here, read_float32(table.limits, LIMITS * i + LEFT_END))
                    behind = where_below(none, alone, here, read_float32(table.limits, LIMITS * i + RIGHT))
                    left, right = left + before, right + behind
                    there = where_below(one, none, none, before + behind)
                    weight = weight + there
                    ones = ones + there * (load_counts(seen, v) if as_bytes else load_float32(seen, v))
                    i += 1
                left = left * clear_left + right * clear_right
            expected = expected + (weight - left) * read_float32(table.frames, k)
        store_float32(to_ones, v, ones)
        store_float32(to_expected, v, expected)


HAZE_BLOCKS: Final = 4
"""Blocks above one another for which haze is computed together: it changes slowly from row to row."""
HAZE_STEP: Final = 8
"""Spacing, in px, of the places at which haze is computed."""
_IN_ORDER: Final = np.arange(LANES, dtype=np.float32)


class Blocks(NamedTuple):
    """Sums of ones and of expected ones in each block, float32 (block rows, block columns, pixels of distance).

    The number of pixels is a multiple of LANES.
    """

    ones: Float32
    expected: Float32


class _Map(NamedTuple):
    """The arrays in which lines are looked up, and their sizes.

    x_px, place, x0, n_frames, counts: addresses of the first elements; still: address of pixel 0 of the first row.
    """

    x_px: int
    place: int
    x0: int
    n_frames: int
    counts: int
    still: int
    rows: int
    columns: int
    window: int
    width: int
    count_bytes: int
    pixels: int


@numba.njit(cache=True, nogil=True, error_model="numpy")
def sum_blocks(
    counts: Counts, n_frames: Int32, sweep: Sweep, state: RowState, still: Float32, place: Int16, side: int,
    apart: float, x_px: Float32, first_block: int, last_block: int, out: Blocks,
) -> None:  # fmt: skip
    """Fill the sums of rows of blocks first_block..last_block-1, without pixels within `apart` px of stripes x_px.

    Haze is taken in the middle of HAZE_BLOCKS blocks, or of the block itself if nothing is searched there; if nothing
    is searched there either, the sums are 0. state, still: see `SecondLight`; place: of `line_places`.
    """
    rows, columns = x_px.shape
    pixels, across, aside, x0 = out.ones.shape[2], out.ones.shape[1], np.float32(apart), sweep.x0
    clear, spare = np.zeros((across, 2, pixels + 1), np.float32), np.zeros((2, BLOCK**2, pixels), np.float32)
    lines, limits = np.zeros((BLOCK**2, FIELDS), np.int64), np.zeros((BLOCK**2, LIMITS), np.float32)
    ends, frames, order = np.zeros(BLOCK, np.int64), np.zeros(BLOCK, np.float32), _IN_ORDER
    seen = _Map(
        address_of(x_px), address_of(place), address_of(x0), address_of(n_frames),
        address_of(counts), address_of(still) + 4 * LANES, rows, columns, counts.shape[2], sweep.u.shape[1],
        counts.itemsize, pixels,
    )  # fmt: skip
    table = LineTable(address_of(lines), address_of(limits), address_of(ends), address_of(frames),
                  address_of(order))  # fmt: skip
    clear_at, to_ones, to_expected = address_of(clear), address_of(out.ones), address_of(out.expected)
    group = -1
    for by in range(first_block, last_block):
        known, group = group == by // HAZE_BLOCKS, by // HAZE_BLOCKS
        together = min(group * HAZE_BLOCKS * BLOCK + HAZE_BLOCKS * BLOCK // 2, rows - 1)
        for bx in range(across):
            my, mc = min(by * BLOCK + BLOCK // 2, rows - 1), min(bx * BLOCK + BLOCK // 2, columns - 1)
            _ask_for_block(seen, by, bx)
            alone = place[together, mc, PLACE_X] == NOWHERE
            if alone and place[my, mc, PLACE_X] == NOWHERE:
                out.ones[by, bx] = 0.0
                out.expected[by, bx] = 0.0
                continue
            if alone or not known:
                y = my if alone else together
                _clear_beside(sweep, state, y, mc, int(place[y, mc, PLACE_X]), side, clear[bx])
            number, readable, inner = _list_lines(seen, table, by, bx, aside, counts.size, still.size - LANES)
            if not readable:
                _copy_lines(counts, still, place, x0, sweep.u.shape[1], number, lines, spare)
            at = 4 * pixels * (by * across + bx)
            sum_lines(table, inner, readable, clear_at + 4 * clear[0].size * bx, pixels, to_ones + at, to_expected + at)
    keep_alive(lines, limits, ends, frames, clear, spare)


@numba.njit(forceinline=True)
def _ask_for_block(seen: _Map, by: int, before: int) -> None:
    """Prefetch the counts of the block after `before`, and places and stripes of the fourth one after `before`."""
    row_bytes, top = seen.window * seen.count_bytes, by * BLOCK
    for y in range(top, min(top + BLOCK, seen.rows)):
        there = y * seen.columns + (before + 4) * BLOCK
        prefetch(seen.place + 2 * PLACES * there)
        prefetch(seen.x_px + 4 * there)
    for c in range((before + 1) * BLOCK, min((before + 2) * BLOCK, seen.columns)):
        for ahead in range(0, BLOCK * row_bytes, CACHE_LINE):
            prefetch(seen.counts + (c * seen.rows + top) * row_bytes + ahead)


@numba.njit(forceinline=True)
def _list_lines(
    seen: _Map, table: LineTable, by: int, bx: int, aside: np.float32, counts_size: int, still_size: int
) -> tuple[int, bool, tuple[np.float32, np.float32, np.float32, np.float32]]:
    """Write the lines of a block that have a stripe and pixels to add into the table.

    Returns their number, whether all their vectors can be read in place, and `inner` of `sum_lines`. counts_size,
    still_size: number of counts, and of values in `still` from pixel 0 of the first row on.
    """
    number, readable, all_pixels = 0, seen.count_bytes == 1, np.float32(seen.pixels)
    inner = np.float32(0.0), all_pixels, np.float32(0.0), all_pixels
    top, bottom = by * BLOCK, min(by * BLOCK + BLOCK, seen.rows)
    for k in range(BLOCK):
        c = min(bx * BLOCK + k, seen.columns - 1)
        column = c * seen.rows * seen.window - read_int32(seen.x0, c)
        for y in range(top, bottom if bx * BLOCK + k < seen.columns else top):
            here = y * seen.columns + c
            x, begin = read_float32(seen.x_px, here), read_int16(seen.place, PLACES * here + PLACE_BEGIN)
            end = read_int16(seen.place, PLACES * here + PLACE_END)
            if np.isnan(x) or begin == end:
                continue
            start = int(read_int16(seen.place, PLACES * here + PLACE_X))
            stored, level = column + y * seen.window + start, y * seen.width + start
            readable &= stored >= 0 and stored + seen.pixels <= counts_size
            readable &= level >= -LANES and level + seen.pixels <= still_size
            write_int64(table.lines, FIELDS * number + SEEN, seen.counts + stored)
            write_int64(table.lines, FIELDS * number + STILL, seen.still + 4 * level)
            write_int64(table.lines, FIELDS * number + HERE, here)
            low, high, off = np.float32(begin), np.float32(end), x - np.float32(start)
            left_end, right = off - aside, off + aside
            write_float32(table.limits, LIMITS * number + BEGIN, low)
            write_float32(table.limits, LIMITS * number + LEFT_END, left_end)
            write_float32(table.limits, LIMITS * number + RIGHT, right)
            write_float32(table.limits, LIMITS * number + END, high)
            inner = max(inner[0], low), min(inner[1], left_end), max(inner[2], right), min(inner[3], high)
            number += 1
        write_int64(table.ends, k, number)
        write_float32(table.frames, k, np.float32(read_int32(seen.n_frames, c)))
    return number, readable, inner


@numba.njit(cache=True, nogil=True)
def _copy_lines(
    counts: Counts, still: Float32, place: Int16, x0: Int32, width: int, number: int, lines: NDArray[np.int64],
    spare: Float32,
) -> None:  # fmt: skip
    """Copy counts, as float32, and `still` of lines to `spare`, and let `lines` point there.

    At the ends of an array, and if counts are not bytes, vectors cannot be read in place.
    """
    columns = place.shape[1]
    for i in range(number):
        y, c = lines[i, HERE] // columns, lines[i, HERE] % columns
        start = place[y, c, PLACE_X]
        for p in range(place[y, c, PLACE_BEGIN], place[y, c, PLACE_END]):
            spare[0, i, p] = counts[c, y, start + p - x0[c]]
            spare[1, i, p] = still[LANES + y * width + start + p]
        lines[i, SEEN], lines[i, STILL] = address_of(spare[0, i]), address_of(spare[1, i])


@numba.njit(cache=True, nogil=True)
def _clear_beside(sweep: Sweep, state: RowState, y: int, c: int, start: int, side: int, clear: Float32) -> None:
    """Fill clear (2, pixels + 1): the probability, left and right of a stripe, that pixels from `start` on stay dark
    under haze alone.

    It is computed every HAZE_STEP pixels and interpolated linearly. A pixel without a ray has the value of the nearest
    pixel with a ray.
    """
    # Local names: each use of the tuple itself in the loop would count references to all of its arrays.
    u, v, profile, w_lo, per_w = sweep.u, sweep.v, state.profile, state.w_lo, state.per_w
    px, py, pz = sweep.plane[c, 0], sweep.plane[c, 1], sweep.plane[c, 2]
    first, last = with_rays(u, y, 0, u.shape[1] - 1)
    path_p, strength = line_light(sweep, state, y, c, min(max(start, sweep.x_lo[y, c]), sweep.x_hi[y, c]))
    left, right = clear[0 if side > 0 else 1], clear[1 if side > 0 else 0]
    several, none = sweep.others.shape[1] > 0, np.float32(0.0)
    for k in range(0, clear.shape[1], HAZE_STEP):
        x = min(max(start + k, first), last)
        path_c, _, b = profile_place(px, py, pz, u[y, x], v[y, x], path_p, w_lo, per_w, profile.shape[0])
        i = int(b)
        part, gain = np.float32(b - i), strength * path_c
        before = flux_between(none, gain, profile[i, 0], profile[i + 1, 0], part)
        behind = flux_between(none, gain, profile[i, 1], profile[i + 1, 1], part)
        if several:
            others = others_at(sweep, state, y, c, x)
            before, behind = min(before + others, FLUX_MAX), min(behind + others, FLUX_MAX)
        left[k], right[k] = np.exp(-np.float32(before)), np.exp(-np.float32(behind))
    step = np.float32(1 / HAZE_STEP)
    for k in range(0, clear.shape[1] - 1, HAZE_STEP):
        for line in range(2):
            begin = clear[line, k]
            rise = step * (clear[line, k + HAZE_STEP] - begin)
            for m in range(1, HAZE_STEP):
                clear[line, k + m] = begin + np.float32(m) * rise
