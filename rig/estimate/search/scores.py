"""Scores of all positions of a row, compiled: a fast form of `rig.estimate.row.likelihood`, tested against it.

Computes the log-likelihood of each position, with its prior, relative to 'everything is right of the stripe' (START);
the best of these scores; and how probable its position is:

    score_m(x) = START + K constant_m(x) + prior_m(x) + sum of n edge left of x + sum over t around x of n_t tap_m,t(x)

n: uint8, at most COUNT_LIMIT + 1, in K exposures. Scores: saturating int16 with 128 >> shift units an octave (factor of
2) of likelihood, shift as in `SearchTables`. Tables: `rig.estimate.search.tables`. A row of 128 pixels is four vectors
of counts in lane order (`rig.count.lane_order`) and eight of scores: prefix sums run over the steps within a lane and
then once over the lanes. For the probability of the best position scores become likelihoods (`rig.simd.functions`),
which are summed over the row.
"""

from typing import Final

import numba
import numpy as np

from rig.count.lane_order import PAD, STEPS, pair_bytes
from rig.estimate.search.tables import OUTSIDE, SLOPE, ScreenTable, Search, first_pair
from rig.simd.functions import MEAN_EXCESS, lift_to_powers, powers, powers_in_order
from rig.simd.memory import load_bytes, load_int16, read_float32, read_int16, store_int16, write_int16
from rig.simd.shuffles import (
    equal_bits,
    equal_mask,
    largest_of_rows,
    last_lane,
    lowest_bit,
    running_sum,
    store_folded,
    totals_of_rows,
    up_1,
)
from rig.simd.vectors import (
    LANES,
    add_saturated,
    dot_pairs,
    larger,
    larger_float,
    smaller,
    smaller_float,
    zero_float32,
    zero_int16,
)

START: Final = -12000
"""Score of 'everything is right of the stripe': low, since most scores lie above it."""


@numba.njit(cache=True, nogil=True)
def fit_positions(position: int, slope: int, places: int, more: float, to: int) -> None:
    """Write the constants of a table's positions for columns with the nominal number of exposures plus `more`.

    position, slope, to: addresses of `places` int16 each.
    """
    for i in range(places):
        constant = np.float32(read_int16(position, i)) + more / np.float32(SLOPE) * np.float32(read_int16(slope, i))
        inside = read_int16(position, i) > OUTSIDE
        constant = min(max(constant, np.float32(OUTSIDE)), np.float32(-OUTSIDE))
        write_int16(to, i, np.int16(constant) if inside else np.int16(OUTSIDE))


@numba.njit(forceinline=True)
def fit_lanes(per_exposure: int, exposures: float, change: float, first: int, last: int, search: Search) -> None:
    """Write the constants of the lanes. per_exposure: address of the table's constants, which are sums up to each lane.

    change: score of a change without a stripe, in the lanes first..last that hold pixels of the column.
    """
    before = np.float32(0.0)
    for i in range(search.lanes):
        # Differences of rounded sums: rounding each lane would drift along the row.
        through = np.floor(read_float32(per_exposure, i) * np.float32(exposures) + np.float32(0.5))
        write_int16(search.lane, i, np.int16(min(max(through - before, np.float32(-32000)), np.float32(32000))))
        before = through
        write_int16(search.change, i, np.int16(change) if first <= i <= last else np.int16(OUTSIDE))


@numba.njit(forceinline=True)
def score_rows(table: ScreenTable, reach: int, search: Search, rows: int) -> None:
    """Score every position of the batch's first `rows` rows. reach: T of the table's taps."""
    for r in range(rows):
        _sum_edges(table, search, r)
    # Separate loops: one row's sums wait for one another, so those of several rows should be under way at once.
    if reach == 1:
        for r in range(rows):
            _score_narrow(table, search, r)
    else:
        for r in range(rows):
            _score_wide(table, reach, search, r)


@numba.njit(forceinline=True)
def _rise(table, search, r, q, v):  # type: ignore[no-untyped-def]
    """Score that the counts of pair q in the lanes from v on of row r add to all positions right of the pair."""
    n = search.n + r * search.n_bytes + 2 * (PAD + v) + q * pair_bytes(search.lanes)
    return dot_pairs(load_bytes(n, 0), load_bytes(table.edge, 2 * (q * search.lanes + v)))


@numba.njit(forceinline=True)
def _sum_edges(table, search, r):  # type: ignore[no-untyped-def]
    """Fill start and all_left of row r."""
    carry = np.int16(START)
    for v in range(0, search.lanes, LANES):
        lane = add_saturated(_rise(table, search, r, 0, v), _rise(table, search, r, 1, v))
        lane = add_saturated(lane, add_saturated(_rise(table, search, r, 2, v), _rise(table, search, r, 3, v)))
        through = running_sum(add_saturated(lane, load_int16(search.lane, v)))
        store_int16(search.start, r * search.lanes + v, add_saturated(up_1(through), carry))
        carry = last_lane(add_saturated(through, carry))
    write_int16(search.all_left, r, carry)


@numba.njit(forceinline=True)
def _position_score(first, second, tap, constant, s, v, lanes, level):  # type: ignore[no-untyped-def]
    """Score of the positions of step s at the likelier of two amplitudes. first, second: counts of pairs with taps."""
    at, screen = 4 * s * lanes + 2 * v, 4 * STEPS * lanes
    dim = dot_pairs(first, load_bytes(tap, at)) + dot_pairs(second, load_bytes(tap, at + 2 * lanes))
    dim = add_saturated(dim, load_int16(constant, s * lanes + v))
    bright = dot_pairs(first, load_bytes(tap, screen + at)) + dot_pairs(
        second, load_bytes(tap, screen + at + 2 * lanes)
    )
    bright = add_saturated(bright, load_int16(constant, (STEPS + s) * lanes + v))
    return add_saturated(level, larger(dim, bright))


@numba.njit(forceinline=True)
def _score_narrow(table, search, r):  # type: ignore[no-untyped-def]
    """Score row r of a line that lights one pixel on either side: its taps lie in two pairs."""
    lanes, tap, constant = search.lanes, table.tap, table.constant
    pair = pair_bytes(lanes)
    n, score = search.n + r * search.n_bytes, search.score + r * search.score_bytes
    top = zero_int16() - 32768
    for v in range(0, lanes, LANES):
        level = load_int16(search.start, r * lanes + v)
        at = 2 * (PAD + v)
        # The first step also reads the last pair of the lane before, the last step the first pair of the lane behind.
        before, p0, p1 = load_bytes(n, at + 3 * pair - 2), load_bytes(n, at), load_bytes(n, at + pair)
        p2, p3, behind = load_bytes(n, at + 2 * pair), load_bytes(n, at + 3 * pair), load_bytes(n, at + 2)
        s0 = _position_score(before, p0, tap, constant, 0, v, lanes, level)
        s1 = _position_score(p0, p1, tap, constant, 1, v, lanes, level)
        level = add_saturated(level, _rise(table, search, r, 0, v))
        s2 = _position_score(p0, p1, tap, constant, 2, v, lanes, level)
        s3 = _position_score(p1, p2, tap, constant, 3, v, lanes, level)
        level = add_saturated(level, _rise(table, search, r, 1, v))
        s4 = _position_score(p1, p2, tap, constant, 4, v, lanes, level)
        s5 = _position_score(p2, p3, tap, constant, 5, v, lanes, level)
        level = add_saturated(level, _rise(table, search, r, 2, v))
        s6 = _position_score(p2, p3, tap, constant, 6, v, lanes, level)
        s7 = _position_score(p3, behind, tap, constant, 7, v, lanes, level)
        store_int16(score, v, s0)
        store_int16(score, lanes + v, s1)
        store_int16(score, 2 * lanes + v, s2)
        store_int16(score, 3 * lanes + v, s3)
        store_int16(score, 4 * lanes + v, s4)
        store_int16(score, 5 * lanes + v, s5)
        store_int16(score, 6 * lanes + v, s6)
        store_int16(score, 7 * lanes + v, s7)
        top = larger(top, larger(larger(larger(s0, s1), larger(s2, s3)), larger(larger(s4, s5), larger(s6, s7))))
    store_int16(search.tops, r * LANES, top)


@numba.njit(cache=True, nogil=True)
def _score_wide(table: ScreenTable, reach: int, search: Search, r: int) -> None:
    """Score row r of a line that lights `reach` pixels on either side."""
    lanes, pairs = search.lanes, reach + 1
    pair = pair_bytes(lanes)
    n, score = search.n + r * search.n_bytes, search.score + r * search.score_bytes
    top = zero_int16() - 32768
    for v in range(0, lanes, LANES):
        level = load_int16(search.start, r * lanes + v)
        for s in range(STEPS):
            dim = load_int16(table.constant, s * lanes + v)
            bright = load_int16(table.constant, (STEPS + s) * lanes + v)
            first = (s >> 1) + first_pair(s, reach)
            for d in range(pairs):
                p = first + d
                counts = load_bytes(n, (p & 3) * pair + 2 * (PAD + v + (p >> 2)))
                at = 2 * ((s * pairs + d) * lanes + v)
                dim = add_saturated(dim, dot_pairs(counts, load_bytes(table.tap, at)))
                at += 2 * STEPS * pairs * lanes
                bright = add_saturated(bright, dot_pairs(counts, load_bytes(table.tap, at)))
            scored = add_saturated(level, larger(dim, bright))
            store_int16(score, s * lanes + v, scored)
            top = larger(top, scored)
            if s & 1:
                level = add_saturated(level, _rise(table, search, r, s >> 1, v))
    store_int16(search.tops, r * LANES, top)


NOTHING: Final = np.float32(1.2e-38)
"""Least divisor, the smallest normal float32: a sum of likelihoods may be 0."""
MOST_OCTAVES: Final = 60
"""A hypothesis without a stripe counts no more than 2^60 times the best position."""


@numba.njit(forceinline=True)
def find_best(search: Search, rows: int, shift: int) -> None:
    """Fill best, lift, ceiling and x of the batch's first `rows` rows.

    Among pixels with the same best score, the one of the lowest lane and there of the first step is taken.
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
        # Branches on the step would be mispredicted: all steps are compared at once.
        step = np.int64(lowest_bit(equal_bits(score, lane, lanes, wanted)))
        write_int16(search.x, r, np.int16(STEPS * lane + step))


@numba.njit(cache=True, nogil=True)
def _lane_with(score: int, lanes: int, wanted: np.int16) -> int:
    """The lowest lane that has the score `wanted`; 0 if none has."""
    for v in range(0, lanes, LANES):
        mask = np.uint32(0)
        for s in range(STEPS):
            mask |= equal_mask(load_int16(score, s * lanes + v), wanted)
        if mask:
            return v + np.int64(lowest_bit(mask))
    return 0


@numba.njit(forceinline=True)
def add_likelihoods(table: ScreenTable, search: Search, rows: int, window: int, shift: int) -> None:
    """Fill mass, left and right of the batch's first `rows` rows. Call it after `find_best`.

    mass: sum of the likelihoods of all positions, and of a change without a stripe at each lane, up to a factor for
    each row. left, right: scores beside the best position.
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
def certainties(table: ScreenTable, search: Search, shift: int):  # type: ignore[no-untyped-def]
    """Probability that each row of the batch has its stripe within 1 px of x, float32 lanes."""
    lift, ceiling = load_int16(search.lift, 0), load_int16(search.ceiling, 0)
    all_left = add_saturated(load_int16(search.all_left, 0), table.all_left)
    all_right = zero_int16() + table.all_right
    ends = powers_in_order(smaller(all_left, ceiling), lift, shift)
    ends = ends + powers_in_order(smaller(all_right, ceiling), lift, shift)
    own = powers_in_order(load_int16(search.best, 0), lift, shift)
    near = powers_in_order(load_int16(search.left, 0), lift, shift)
    near = near + powers_in_order(load_int16(search.right, 0), lift, shift)
    # `powers` is exact for the best position and too large by the factor MEAN_EXCESS, on average, for all others.
    others = totals_of_rows(search.mass) + ends - own
    own = own * MEAN_EXCESS
    # Where even the best score is the lowest possible, the likelihoods are 0, and so is the result.
    return smaller_float((own + near) / larger_float(own + others, NOTHING), np.float32(1.0))
