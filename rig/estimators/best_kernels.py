"""The best position of each row once all are scored, and how sure it is: likelihoods from scores, and their sums."""

from typing import Final

import numba
import numpy as np

from rig.estimators.powers import MEAN_EXCESS, lift_to_powers, powers, powers_in_order
from rig.estimators.search_buffers import Search, Table
from rig.lane_memory import load_int16, read_int16, store_int16, write_int16
from rig.lane_order import STEPS
from rig.lane_reductions import largest_of_rows, store_folded, totals_of_rows
from rig.lane_shuffles import equal_bits, equal_mask, lowest_bit
from rig.lanes import LANES, add_saturated, larger_float, smaller, smaller_float, zero_float32, zero_int16

NOTHING: Final = np.float32(1.2e-38)
"""The smallest likelihood that counts."""
MOST_OCTAVES: Final = 60
"""A hypothesis without a stripe counts no more than 2^60 times the best position."""


@numba.njit(forceinline=True)
def find_best(search: Search, rows: int, shift: int) -> None:
    """Fill best, lift, ceiling and x of the batch's first rows.

    Of pixels that share the best score the one of the lowest lane counts, of its steps the first.
    """
    lanes = search.lanes
    best = largest_of_rows(search.tops)
    store_int16(search.best, 0, best)
    store_int16(search.lift, 0, lift_to_powers(best, shift))
    store_int16(search.ceiling, 0, add_saturated(best, np.int16(min(np.int64(MOST_OCTAVES * 128) >> shift, 32767))))
    for r in range(rows):
        score, wanted, lane = search.score + r * search.score_bytes, read_int16(search.best, r), 0
        if lanes == LANES:
            lane = np.int64(lowest_bit(equal_mask(load_int16(search.tops, r * LANES), wanted)))
        else:
            lane = _lane_with(score, lanes, wanted)
        # Which step it is cannot be foreseen: all are compared at once.
        step = np.int64(lowest_bit(equal_bits(score, lane, lanes, wanted)))
        write_int16(search.x, r, np.int16(STEPS * lane + step))


@numba.njit(cache=True, nogil=True)
def _lane_with(score: int, lanes: int, wanted: np.int16) -> int:
    """The lowest lane that has that score."""
    for v in range(0, lanes, LANES):
        mask = np.uint32(0)
        for s in range(STEPS):
            mask |= equal_mask(load_int16(score, s * lanes + v), wanted)
        if mask:
            return v + np.int64(lowest_bit(mask))
    return 0


@numba.njit(forceinline=True)
def add_likelihoods(table: Table, search: Search, rows: int, window: int, shift: int) -> None:
    """Fill mass, left and right of the batch's first rows, after `find_best`.

    mass: likelihoods of all positions, and of a change without a stripe at each lane, up to a factor for each row.
    """
    lanes = search.lanes
    for r in range(rows):
        score = search.score + r * search.score_bytes
        lift, ceiling = read_int16(search.lift, r), read_int16(search.ceiling, r)
        lot = zero_float32()
        for v in range(0, lanes, LANES):
            a = powers(load_int16(score, v), lift, shift) + powers(load_int16(score, lanes + v), lift, shift)
            b = powers(load_int16(score, 2 * lanes + v), lift, shift)
            b = b + powers(load_int16(score, 3 * lanes + v), lift, shift)
            c = powers(load_int16(score, 4 * lanes + v), lift, shift)
            c = c + powers(load_int16(score, 5 * lanes + v), lift, shift)
            d = powers(load_int16(score, 6 * lanes + v), lift, shift)
            d = d + powers(load_int16(score, 7 * lanes + v), lift, shift)
            nowhere = smaller(
                add_saturated(load_int16(search.start, r * lanes + v), load_int16(search.change, v)), ceiling
            )
            lot = lot + (((a + b) + (c + d)) + powers(nowhere, lift, shift))
        store_folded(search.mass, r, lot)
        x = np.int64(read_int16(search.x, r))
        before, behind = max(x - 1, 0), min(x + 1, window - 1)
        left = read_int16(score, (before & 7) * lanes + (before >> 3))
        right = read_int16(score, (behind & 7) * lanes + (behind >> 3))
        write_int16(search.left, r, left if x > 0 else np.int16(-32768))
        write_int16(search.right, r, right if x + 1 < window else np.int16(-32768))


@numba.njit(forceinline=True)
def certainties(table: Table, search: Search, shift: int):  # type: ignore[no-untyped-def]
    """Probability of each row of the batch to have its stripe within 1 px of x, float32 lanes; the model's."""
    lift, ceiling = load_int16(search.lift, 0), load_int16(search.ceiling, 0)
    all_left = add_saturated(load_int16(search.all_left, 0), table.all_left)
    all_right = zero_int16() + table.all_right
    ends = powers_in_order(smaller(all_left, ceiling), lift, shift)
    ends = ends + powers_in_order(smaller(all_right, ceiling), lift, shift)
    own = powers_in_order(load_int16(search.best, 0), lift, shift)
    near = powers_in_order(load_int16(search.left, 0), lift, shift)
    near = near + powers_in_order(load_int16(search.right, 0), lift, shift)
    # The best position's own term is exact, the others are too large by the same share on average.
    others = totals_of_rows(search.mass) + ends - own
    own = own * MEAN_EXCESS
    # Where even the best score is the lowest there is, nothing is known.
    return smaller_float((own + near) / larger_float(own + others, NOTHING), np.float32(1.0))
