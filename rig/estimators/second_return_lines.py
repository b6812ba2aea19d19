"""Lines of a block of rows and columns: where they lie, once per model, and the sums of their light.

Of frames K, a pixel's share q of no one by ambient light and c by haze,

    ones expected = sum over lines K (1 - q c) = sum over columns K (number of lines - c sum q)

so that lines only add up what is theirs, left and right of the stripe; the block's haze is multiplied with the sums.
"""

from typing import Final, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rig.estimators.row_input import Sweep
from rig.lane_memory import load_counts, load_float32, read_float32, read_int64, store_float32
from rig.lanes import LANES, where_below, zero_float32

BLOCK: Final = 4
"""Rows, and columns, whose light is summed at once; a block is judged together with its eight neighbours."""
LEFT_OUT: Final = np.float32(0.0)
"""Marks pixels that show nothing, among probabilities of no one: those that always fire."""
PLACE_X, PLACE_BEGIN, PLACE_END, PLACES = 0, 1, 2, 4
NOWHERE: Final = -(1 << 15)
"""See `line_places`."""
SEEN, STILL, HERE, FIELDS = range(4)
"""Of a line: addresses of its counts and of `still` at pixel 0 of distance, and its number in the map."""
BEGIN, LEFT_END, RIGHT, END, LIMITS = range(5)
"""Pixels of distance: it begins there, is left of the stripe up to there, right of it from there on, and ends there."""


class Table(NamedTuple):
    """Lines of a block, addresses: int64 (BLOCK^2, FIELDS) and float32 (BLOCK^2, LIMITS), column by column.

    ends, frames: int64 and float32 (BLOCK,), the number of lines up to the end of each column, and its frames. order:
    0, 1, ... as float32.
    """

    lines: int
    limits: int
    ends: int
    frames: int
    order: int


@numba.njit(cache=True, nogil=True)
def line_places(sweep: Sweep, x_far: NDArray[np.float64], side: int, pixels: int) -> NDArray[np.int16]:
    """Where the lines of all rows and columns lie: int16 (rows, columns, PLACES), made once per model.

    PLACE_X: x of pixel 0 of distance, the leftmost of `pixels`, NOWHERE where nothing is searched; PLACE_BEGIN,
    PLACE_END: pixels of distance that are searched and were stored, from and up to.
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
    table: Table, inner: tuple[np.float32, np.float32, np.float32, np.float32], as_bytes: bool, clear: int, pixels: int,
    to_ones: int, to_expected: int,
) -> None:  # fmt: skip
    """The sums of a block.

    inner: pixels from which on, and up to which, all lines are left of their stripes, and right of them; as_bytes:
    counts are bytes, or else float32. clear: address.
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
