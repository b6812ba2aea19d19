"""Compiled search along a row: every position scored at once, sixteen to a vector, then the best one looked at closely.

A row of 128 pixels is eight vectors of counts (`rig.lane_order`). Prefix sums run over the steps within a lane and then
once over the lanes. Scores are saturating 16-bit numbers (`screen_tables`); the probability
of a place is summed with 2^x read off the bits of a bfloat16, exact to 6 % a term and unbiased.
"""

from typing import Final, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rig.estimators.screen_tables import SCREENS, Tables
from rig.lane_order import PAD, STEPS, new_counts
from rig.lanes import (
    LANES,
    add_saturated,
    equal_mask,
    from_bfloat16,
    larger,
    largest,
    last_lane,
    load_int16,
    lowest_bit,
    running_sum,
    smaller,
    store,
    sub_saturated,
    total,
    up_1,
    zero_float32,
)

START: Final = -20000
"""Score of 'everything is as right of the stripe': most of the range lies above it."""
BIAS: Final = np.int16(127 << 7)
"""Exponent of 1.0 as a bfloat16."""
MEAN_EXCESS: Final = np.float32(1.040684)
"""Mean of (1 + f) / 2^f over f in 0..1: by so much a term is too large on average."""
MOST_OCTAVES: Final = 60
"""A hypothesis without a stripe counts no more than 2^60 times the best position."""


class Search(NamedTuple):
    """Buffers of the search, one per thread; in lane order, see `search_buffers`.

    n: int16 ((STEPS * stride,)), counts; score: int16 (STEPS * lanes,); start: int16 (lanes,), score of a change at
    the lane's first pixel; best: int16 (lanes,), best score of each lane; constant: int16 (SCREENS * STEPS * lanes,)
    and lane: int16 (lanes,), the tables' parts per exposure times the exposures.
    """

    n: NDArray[np.int16]
    score: NDArray[np.int16]
    start: NDArray[np.int16]
    best: NDArray[np.int16]
    constant: NDArray[np.int16]
    lane: NDArray[np.int16]


@numba.njit(cache=True, nogil=True)
def search_buffers(lanes: int) -> Search:
    """Buffers for rows of `lanes` lanes."""
    pixels = STEPS * lanes
    return Search(
        new_counts(lanes), np.zeros(pixels, np.int16), np.zeros(lanes, np.int16),
        np.zeros(lanes, np.int16), np.zeros(SCREENS * pixels, np.int16), np.zeros(lanes, np.int16),
    )  # fmt: skip


@numba.njit(cache=True, nogil=True)
def set_exposures(tables: Tables, c: int, b: int, exposures: float, search: Search) -> None:
    """Make the constants of one table for columns of so many exposures."""
    pixels = search.score.shape[0]
    exposures = np.float32(exposures)
    for m in range(SCREENS):
        position, prior = tables.position[c, b, m], tables.prior[c, b, m]
        constant = search.constant[m * pixels : (m + 1) * pixels]
        for i in range(pixels):
            constant[i] = np.int16(min(max(exposures * position[i] + prior[i], np.float32(-32000)), np.float32(32000)))
    lane = tables.lane[c, b]
    for i in range(lane.shape[0]):
        search.lane[i] = np.int16(min(max(exposures * lane[i], np.float32(-32000)), np.float32(32000)))


@numba.njit(inline="always")
def _edge(n, at, edge, s, lanes, v):  # type: ignore[no-untyped-def]
    return load_int16(n, at) * load_int16(edge, s * lanes + v)


@numba.njit(cache=True, nogil=True)
def score_row(edge: NDArray[np.int16], tap: NDArray[np.int16], search: Search) -> tuple[int, int]:
    """Score every position of the row in search.n; returns the best score and the sum of all pixels lying left.

    edge: (P,) and tap: (SCREENS, 2T + 1, P) of the row's table.
    """
    lanes = search.start.shape[0]
    stride = lanes + 2 * PAD
    n = search.n
    pixels = STEPS * lanes
    constant, score = search.constant, search.score
    taps = tap.shape[1]
    flat = tap.ravel()
    reach = (taps - 1) // 2
    carry = np.int16(START)
    best = np.int16(-32768)
    for v in range(0, lanes, LANES):
        at = PAD + v
        sums = _edge(n, at, edge, 0, lanes, v) + _edge(n, at + stride, edge, 1, lanes, v)
        sums = sums + (_edge(n, at + 2 * stride, edge, 2, lanes, v) + _edge(n, at + 3 * stride, edge, 3, lanes, v))
        sums = sums + (_edge(n, at + 4 * stride, edge, 4, lanes, v) + _edge(n, at + 5 * stride, edge, 5, lanes, v))
        sums = sums + (_edge(n, at + 6 * stride, edge, 6, lanes, v) + _edge(n, at + 7 * stride, edge, 7, lanes, v))
        through = running_sum(sums + load_int16(search.lane, v))
        level = add_saturated(up_1(through), carry)
        carry = last_lane(add_saturated(through, carry))
        store(search.start, v, level)
        if reach == 1:
            top = _score_narrow(n, at, stride, edge, flat, constant, score, level, lanes, pixels, v)
        else:
            top = _score_wide(n, at, stride, edge, flat, constant, score, level, lanes, pixels, v, reach)
        store(search.best, v, top)
        best = max(best, largest(top))
    return best, carry


@numba.njit(inline="always")
def _narrow(before, here, after, flat, constant, level, place, pixels):  # type: ignore[no-untyped-def]
    """Scores of one step of a line that lights one pixel on either side, at the likelier of two amplitudes."""
    dim = before * load_int16(flat, place) + here * load_int16(flat, place + pixels)
    dim = dim + after * load_int16(flat, place + 2 * pixels)
    bright = before * load_int16(flat, place + 3 * pixels) + here * load_int16(flat, place + 4 * pixels)
    bright = bright + after * load_int16(flat, place + 5 * pixels)
    dim = add_saturated(dim, load_int16(constant, place))
    bright = add_saturated(bright, load_int16(constant, place + pixels))
    return add_saturated(level, larger(dim, bright))


@numba.njit(inline="always")
def _score_narrow(n, at, stride, edge, flat, constant, score, level, lanes, pixels, v):  # type: ignore[no-untyped-def]
    n0, n1 = load_int16(n, at), load_int16(n, at + stride)
    n2, n3 = load_int16(n, at + 2 * stride), load_int16(n, at + 3 * stride)
    n4, n5 = load_int16(n, at + 4 * stride), load_int16(n, at + 5 * stride)
    n6, n7 = load_int16(n, at + 6 * stride), load_int16(n, at + 7 * stride)
    # Step 7 of the lane before, step 0 of the lane behind.
    n_before, n_after = load_int16(n, at + 7 * stride - 1), load_int16(n, at + 1)
    s0 = _narrow(n_before, n0, n1, flat, constant, level, v, pixels)
    level = add_saturated(level, n0 * load_int16(edge, v))
    s1 = _narrow(n0, n1, n2, flat, constant, level, lanes + v, pixels)
    level = add_saturated(level, n1 * load_int16(edge, lanes + v))
    s2 = _narrow(n1, n2, n3, flat, constant, level, 2 * lanes + v, pixels)
    level = add_saturated(level, n2 * load_int16(edge, 2 * lanes + v))
    s3 = _narrow(n2, n3, n4, flat, constant, level, 3 * lanes + v, pixels)
    level = add_saturated(level, n3 * load_int16(edge, 3 * lanes + v))
    s4 = _narrow(n3, n4, n5, flat, constant, level, 4 * lanes + v, pixels)
    level = add_saturated(level, n4 * load_int16(edge, 4 * lanes + v))
    s5 = _narrow(n4, n5, n6, flat, constant, level, 5 * lanes + v, pixels)
    level = add_saturated(level, n5 * load_int16(edge, 5 * lanes + v))
    s6 = _narrow(n5, n6, n7, flat, constant, level, 6 * lanes + v, pixels)
    level = add_saturated(level, n6 * load_int16(edge, 6 * lanes + v))
    s7 = _narrow(n6, n7, n_after, flat, constant, level, 7 * lanes + v, pixels)
    store(score, v, s0)
    store(score, lanes + v, s1)
    store(score, 2 * lanes + v, s2)
    store(score, 3 * lanes + v, s3)
    store(score, 4 * lanes + v, s4)
    store(score, 5 * lanes + v, s5)
    store(score, 6 * lanes + v, s6)
    store(score, 7 * lanes + v, s7)
    return larger(larger(larger(s0, s1), larger(s2, s3)), larger(larger(s4, s5), larger(s6, s7)))


@numba.njit(cache=True, nogil=True, inline="always")
def _score_wide(n, at, stride, edge, flat, constant, score, level, lanes, pixels, v, reach):  # type: ignore[no-untyped-def]
    """As `_score_narrow` for a line that lights `reach` pixels on either side."""
    taps = 2 * reach + 1
    top = load_int16(constant, v) * 0 - 32768
    for s in range(STEPS):
        place = s * lanes + v
        dim, bright = load_int16(constant, place), load_int16(constant, place + pixels)
        for d in range(taps):
            x = s + d - reach
            lane, step = x // STEPS, x % STEPS
            count = load_int16(n, at + step * stride + lane)
            dim = add_saturated(dim, count * load_int16(flat, place + d * pixels))
            bright = add_saturated(bright, count * load_int16(flat, place + (taps + d) * pixels))
        scored = add_saturated(level, larger(dim, bright))
        store(score, place, scored)
        top = larger(top, scored)
        level = add_saturated(level, load_int16(n, at + s * stride) * load_int16(edge, place))
    return top


@numba.njit(cache=True, nogil=True)
def best_position(search: Search, best: int) -> int:
    """Stored pixel of the best score, one of the lowest lane that has it."""
    lanes = search.start.shape[0]
    lane = 0
    for v in range(0, lanes, LANES):
        mask = equal_mask(load_int16(search.best, v), np.int16(best))
        if mask != 0:
            lane = v + lowest_bit(mask)
            break
    for s in range(STEPS - 1):
        if search.score[s * lanes + lane] == best:
            return STEPS * lane + s
    return STEPS * lane + STEPS - 1


@numba.njit(inline="always")
def _power(scores, best, low, shift):  # type: ignore[no-untyped-def]
    """2^((scores - best) / units), 0 below the range."""
    down = larger(sub_saturated(scores, best), low)
    return from_bfloat16((down << shift) + BIAS)


@numba.njit(inline="always")
def power(difference, shift):  # type: ignore[no-untyped-def]
    """The same of one whole number, at most 0."""
    bits = max((np.int64(difference) << shift) + BIAS, 0)
    return np.uint32(bits << 16).view(np.float32)


@numba.njit(cache=True, nogil=True)
def mass_of(search: Search, best: int, shift: int) -> float:
    """Sum of 2^((score - best) / units) over all positions; units = 128 >> shift."""
    lanes = search.start.shape[0]
    score = search.score
    low = np.int16(-(np.int64(BIAS) >> shift))
    best = np.int16(best)
    lot = zero_float32()
    for v in range(0, lanes, LANES):
        a = _power(load_int16(score, v), best, low, shift) + _power(load_int16(score, lanes + v), best, low, shift)
        b = _power(load_int16(score, 2 * lanes + v), best, low, shift)
        b = b + _power(load_int16(score, 3 * lanes + v), best, low, shift)
        c = _power(load_int16(score, 4 * lanes + v), best, low, shift)
        c = c + _power(load_int16(score, 5 * lanes + v), best, low, shift)
        d = _power(load_int16(score, 6 * lanes + v), best, low, shift)
        d = d + _power(load_int16(score, 7 * lanes + v), best, low, shift)
        lot = lot + ((a + b) + (c + d))
    return total(lot)


@numba.njit(cache=True, nogil=True)
def none_mass(search: Search, none: NDArray[np.float32], all_left: int, best: int, shift: int) -> float:
    """The same sum over the hypotheses without a stripe; none: (3,) of the row's table."""
    lanes = search.start.shape[0]
    low = np.int16(-(np.int64(BIAS) >> shift))
    most = (MOST_OCTAVES * 128) >> shift
    highest = np.int16(min(best + most, 32767))
    lot = zero_float32()
    change = np.int16(max(none[2], np.float32(-32000.0)))
    for v in range(0, lanes, LANES):
        level = smaller(add_saturated(load_int16(search.start, v), change), highest)
        lot = lot + _power(level, np.int16(best), low, shift)
    ends = power(min(START + np.int64(max(none[0], np.float32(-32000.0))) - best, most), shift)
    ends += power(min(all_left + np.int64(max(none[1], np.float32(-32000.0))) - best, most), shift)
    return total(lot) + ends
