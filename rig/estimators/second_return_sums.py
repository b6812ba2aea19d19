"""Compiled sums of light over blocks of rows and columns, sixteen pixels of a line at a time.

Rows of a block are added at equal distances from the far end, without what lies near their stripes: the ones counted,
and those that haze and ambient light bring. A vector of pixels is weighed with 0 where they are left out, so that no
line is cut into pieces.
"""

from typing import Final, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rig.aligned import CACHE_LINE
from rig.estimators.label_volume_buffers import signed_address
from rig.estimators.row_input import (
    State,
    Sweep,
    flux_between,
    line_light,
    others_at,
    profile_place,
    with_rays,
)
from rig.estimators.row_kernels import FLUX_MAX
from rig.lane_memory import load_counts, load_float32, prefetch, store_float32
from rig.lanes import LANES, where_below, where_small, zero_float32

Float32 = NDArray[np.float32]

BLOCK: Final = 4
"""Rows, and columns, whose light is summed at once; a block is judged together with its eight neighbours."""
HAZE_BLOCKS: Final = 4
"""Blocks above one another that haze is worked out for at once: it changes slowly from row to row."""
HAZE_STEP: Final = 8
"""Pixels from one place where haze is worked out to the next."""
LEFT_OUT: Final = np.float32(2.0)
"""Marks pixels that show nothing, among probabilities."""
_IN_ORDER: Final = np.arange(LANES, dtype=np.float32)


class Blocks(NamedTuple):
    """Sums per block: float32 (block rows, block columns, pixels of distance): ones, and those that were expected.

    Pixels: a multiple of LANES.
    """

    ones: Float32
    expected: Float32


@numba.njit(cache=True, nogil=True, error_model="numpy")
def sum_blocks(
    counts: NDArray[np.unsignedinteger],
    n_frames: NDArray[np.int32],
    sweep: Sweep,
    state: State,
    still: Float32,
    x_far: NDArray[np.float64],
    side: int,
    apart: float,
    x_px: Float32,
    first_block: int,
    last_block: int,
    out: Blocks,
) -> None:
    """Fill the sums of rows of blocks first_block..last_block-1, without what lies within `apart` px of stripes x_px.

    Haze is that in the middle of HAZE_BLOCKS blocks, or of the block where there is nothing to search there. state,
    still: see `SecondLight`.
    """
    rows, columns = x_px.shape
    width, pixels, window = sweep.u.shape[1], out.ones.shape[2], counts.shape[2]
    # Named apart: every use of a tuple with arrays in the loop would count references to all of them.
    x_lo, x_hi, all_x0, across = sweep.x_lo, sweep.x_hi, sweep.x0, out.ones.shape[1]
    clear = np.zeros((across, 2, pixels + 1), np.float32)
    line, order, group = np.zeros(pixels, np.float32), _IN_ORDER, -1
    line_at, clear_at, order_at = signed_address(line), signed_address(clear), signed_address(order)
    to_ones, to_expected, still_at = signed_address(out.ones), signed_address(out.expected), signed_address(still)
    counts_at, in_bytes, row_bytes = signed_address(counts), counts.itemsize == 1, window * counts.itemsize
    for by in range(first_block, last_block):
        out.ones[by] = 0.0
        out.expected[by] = 0.0
        known, group = group == by // HAZE_BLOCKS, by // HAZE_BLOCKS
        together = min(group * HAZE_BLOCKS * BLOCK + HAZE_BLOCKS * BLOCK // 2, rows - 1)
        for bx in range(across):
            my, mc = min(by * BLOCK + BLOCK // 2, rows - 1), min(bx * BLOCK + BLOCK // 2, columns - 1)
            # Asked for one block early: counts of one column after the other are not what a processor foresees.
            for c in range((bx + 1) * BLOCK, min((bx + 2) * BLOCK, columns)):
                for ahead in range(0, BLOCK * row_bytes, CACHE_LINE):
                    prefetch(counts_at + (c * rows + by * BLOCK) * row_bytes + ahead)
            alone = np.isnan(x_far[together, mc])
            if alone and np.isnan(x_far[my, mc]):
                continue
            if alone or not known:
                y = my if alone else together
                _clear_beside(sweep, state, y, mc, leftmost(x_far[y, mc], side, pixels), side, clear[bx])
            block, left = 4 * pixels * (by * across + bx), clear_at + 4 * clear[0].size * bx
            at = left, left + 4 * (pixels + 1), order_at
            for y in range(by * BLOCK, min(by * BLOCK + BLOCK, rows)):
                for c in range(bx * BLOCK, min(bx * BLOCK + BLOCK, columns)):
                    if np.isnan(x_px[y, c]) or np.isnan(x_far[y, c]):
                        continue
                    start, x0 = leftmost(x_far[y, c], side, pixels), int(all_x0[c])
                    begin = max(int(x_lo[y, c]), x0, 0, start)
                    end = min(int(x_hi[y, c]) + 1, x0 + window, width, start + pixels)
                    if begin >= end:
                        continue
                    first, last = (begin - start) // LANES * LANES, end - start
                    stored = (c * rows + y) * window + start - x0
                    seen, as_bytes = counts_at + stored, True
                    if not in_bytes or stored + first < 0 or stored + last + LANES > counts.size:
                        seen, as_bytes = line_at, False
                        for i in range(first, last):
                            line[i] = counts[c, y, max(start + i - x0, 0)]
                    _add_line(
                        at, seen, as_bytes, still_at + 4 * (LANES + y * width + start), to_ones + block,
                        to_expected + block, first, last, start, begin, end, x_px[y, c], np.float32(apart),
                        np.float32(n_frames[c]),
                    )  # fmt: skip


@numba.njit(inline="always")
def leftmost(x_far, side, pixels):  # type: ignore[no-untyped-def]
    """Pixel that the first of so many pixels of distance is at: they run from left to right."""
    return int(np.rint(x_far)) - (pixels - 1 if side > 0 else 0)


@numba.njit(cache=True, nogil=True)
def _clear_beside(sweep: Sweep, state: State, y: int, c: int, start: int, side: int, clear: Float32) -> None:
    """Probability of no one by haze left and right of a stripe, (2, pixels + 1), in pixels from `start` on.

    Straight lines between every HAZE_STEP pixels. Pixels without a ray have that of the nearest one with a ray.
    """
    # Named apart: every use of a tuple with arrays in the loop would count references to all of them.
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


@numba.njit(cache=True, nogil=True)
def _add_line(
    at: tuple[int, int, int], seen: int, as_bytes: bool, still: int, ones: int, expected: int, first: int, last: int,
    start: int, begin: int, end: int, x: np.float32, apart: np.float32, frames: np.float32,
) -> None:  # fmt: skip
    """Add pixels begin..end-1 of a line to sums; at: addresses of `clear` left and right, and 0, 1, ...

    seen: address of its counts, bytes or float32.
    """
    middle, half = np.float32(0.5) * np.float32(begin + end - 1), np.float32(0.5) * np.float32(end - begin - 1)
    none, order = zero_float32(), load_float32(at[2], 0)
    one, all_frames, beside = none + np.float32(1.0), none + frames, apart * apart
    low, high = int(np.floor(x - apart)), int(np.ceil(x + apart))
    for i in range(first, last, LANES):
        t, alone = start + i, load_float32(still, i)
        weight, here = where_small(all_frames, alone, np.float32(1.0)), order + np.float32(t)
        # Most vectors lie on one side of the stripe, and not at an end of the line.
        if t < begin or t + LANES > end:
            weight = where_small(weight, here - middle, half)
        if t + LANES <= low or t > high:
            clear = load_float32(at[0] if t < low else at[1], i)
        else:
            away = here - x
            clear = where_below(load_float32(at[0], i), load_float32(at[1], i), away, none)
            weight = where_below(none, weight, away * away, beside)
        counted = load_counts(seen, i) if as_bytes else load_float32(seen, i)
        store_float32(ones, i, load_float32(ones, i) + where_below(counted, none, none, weight))
        store_float32(expected, i, load_float32(expected, i) + weight * (one - alone * clear))
