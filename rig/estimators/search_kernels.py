"""Compiled search along a row: every position scored at once, sixteen to a vector, then the best one looked at closely.

A row of 128 pixels is eight vectors of counts (`rig.lane_order`). Prefix sums run over the steps within a lane and then
once over the lanes. Scores are saturating 16-bit numbers (`screen_tables`).
"""

from typing import Final, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rig.estimators.powers import nothing_below, power, powers
from rig.estimators.screen_tables import OUTSIDE, SCREENS, SLOPE
from rig.lane_order import PAD, STEPS
from rig.lanes import (
    LANES,
    add_saturated,
    address_of,
    equal_mask,
    larger,
    largest,
    last_lane,
    load_int16,
    lowest_bit,
    read_float32,
    read_int16,
    running_sum,
    smaller,
    store_float32,
    store_int16,
    up_1,
    write_int16,
    zero_float32,
    zero_int16,
)

BATCH: Final = 8
"""Rows that go through each part of the search together: what one row waits for, the others fill."""
START: Final = -12000
"""Score of 'everything is as right of the stripe': most of the range lies above it."""
MOST_OCTAVES: Final = 60
"""A hypothesis without a stripe counts no more than 2^60 times the best position."""


class Search(NamedTuple):
    """Addresses of a thread's buffers for BATCH rows of `lanes` lanes, and the bytes from row to row of each.

    n: counts, see `rig.lane_order`. In lane order without padding, int16: score (STEPS * lanes,); start (lanes,),
    score of a change at the lane's first pixel; best (lanes,), best score of each lane. For all rows of a batch
    together: constant (SCREENS * STEPS * lanes,) and lane (lanes,), the tables' parts per exposure times the
    exposures; none (3,) as in `Tables`. all_left (BATCH,), score of all pixels lying left. What was found in each row,
    32 bits each: x, the close-up's levels, and float32 confidence (BATCH,). mass: float32 (BATCH, LANES), sums to be
    taken across.
    """

    lanes: int
    n: int
    n_bytes: int
    score: int
    score_bytes: int
    start: int
    best: int
    constant: int
    lane: int
    none: int
    all_left: int
    x: int
    levels: int
    confidence: int
    mass: int


@numba.njit(cache=True, nogil=True)
def search_memory(lanes: int) -> NDArray[np.int16]:
    """Memory for the buffers of a `Search`."""
    of_row = STEPS * (lanes + 2 * PAD) + STEPS * lanes + 2 * lanes
    # What is of 32 bits comes last, behind an even number of 16-bit ones.
    return np.zeros(BATCH * of_row + SCREENS * STEPS * lanes + lanes + 4 + BATCH + (6 + 2 * LANES) * BATCH, np.int16)


@numba.njit(cache=True, nogil=True)
def search_in(memory: NDArray[np.int16], lanes: int) -> Search:
    """The buffers in that memory, which the caller keeps."""
    n = address_of(memory)
    n_bytes, score_bytes = 2 * STEPS * (lanes + 2 * PAD), 2 * STEPS * lanes
    score = n + BATCH * n_bytes
    start = score + BATCH * score_bytes
    best = start + BATCH * 2 * lanes
    constant = best + BATCH * 2 * lanes
    lane = constant + 2 * SCREENS * STEPS * lanes
    none = lane + 2 * lanes
    all_left = none + 2 * 4
    x = all_left + 2 * BATCH
    return Search(
        lanes, n, n_bytes, score, score_bytes, start, best, constant, lane, none, all_left, x, x + 4 * BATCH,
        x + 8 * BATCH, x + 12 * BATCH,
    )  # fmt: skip


@numba.njit(cache=True, nogil=True)
def set_exposures(
    position: int, slope: int, lane: int, none: int, exposures: float, nominal: float, search: Search
) -> None:
    """Make the constants of one table, given by addresses, for columns of so many exposures."""
    for i in range(3):
        write_int16(search.none, i, np.int16(max(read_float32(none, i), np.float32(-32000))))
    more = np.float32(exposures) - np.float32(nominal)
    places = SCREENS * STEPS * search.lanes
    if more == 0:
        for i in range(0, places, LANES):
            store_int16(search.constant, i, load_int16(position, i))
    else:
        for i in range(places):
            constant = np.float32(read_int16(position, i)) + more / np.float32(SLOPE) * np.float32(read_int16(slope, i))
            inside = read_int16(position, i) > OUTSIDE
            constant = min(max(constant, np.float32(OUTSIDE)), np.float32(-OUTSIDE))
            write_int16(search.constant, i, np.int16(constant) if inside else np.int16(OUTSIDE))
    for i in range(search.lanes):
        constant = np.float32(exposures) * read_float32(lane, i)
        write_int16(search.lane, i, np.int16(min(max(constant, np.float32(-32000)), np.float32(32000))))


@numba.njit(cache=True, nogil=True)
def sum_edges(edge: int, search: Search, rows: int) -> None:
    """Fill start and all_left of the batch's first rows; edge: address of their table's."""
    # With the usual number of lanes as a constant all offsets are, and no register is spent on them.
    if search.lanes == LANES:
        for r in range(rows):
            _sum_row(edge, search, r, LANES)
    else:
        for r in range(rows):
            _sum_row(edge, search, r, search.lanes)


@numba.njit(inline="always")
def _sum_row(edge, search, r, lanes):  # type: ignore[no-untyped-def]
    stride = lanes + 2 * PAD
    n = search.n + r * search.n_bytes
    carry = np.int16(START)
    for v in range(0, lanes, LANES):
        at = PAD + v
        a = load_int16(n, at) * load_int16(edge, v)
        a = a + load_int16(n, at + stride) * load_int16(edge, lanes + v)
        b = load_int16(n, at + 2 * stride) * load_int16(edge, 2 * lanes + v)
        b = b + load_int16(n, at + 3 * stride) * load_int16(edge, 3 * lanes + v)
        c = load_int16(n, at + 4 * stride) * load_int16(edge, 4 * lanes + v)
        c = c + load_int16(n, at + 5 * stride) * load_int16(edge, 5 * lanes + v)
        d = load_int16(n, at + 6 * stride) * load_int16(edge, 6 * lanes + v)
        d = d + load_int16(n, at + 7 * stride) * load_int16(edge, 7 * lanes + v)
        through = running_sum(((a + b) + (c + d)) + load_int16(search.lane, v))
        store_int16(search.start, r * lanes + v, add_saturated(up_1(through), carry))
        carry = last_lane(add_saturated(through, carry))
    write_int16(search.all_left, r, carry)


@numba.njit(cache=True, nogil=True)
def score_rows(edge: int, tap: int, reach: int, search: Search, rows: int) -> None:
    """Score every position of the batch's first rows, after `sum_edges`.

    edge, tap: addresses of the rows' table, see `Tables`; reach: T of its taps.
    """
    if reach == 1:
        # In pairs: what bounds the speed is reading the table, which serves both. An odd last row has a stale partner.
        if search.lanes == LANES:
            for r in range(0, rows, 2):
                _score_pair(edge, tap, search, r, LANES)
        else:
            for r in range(0, rows, 2):
                _score_pair(edge, tap, search, r, search.lanes)
    else:
        for r in range(rows):
            _score_wide(edge, tap, reach, search, r)


@numba.njit(inline="always")
def _score_step(n, before, here, after, tap, constant, edge, place, pixels, levels, tops, score, other):  # type: ignore[no-untyped-def]
    """One step of two rows: scores at the likelier of two amplitudes, then the levels behind it.

    before, here, after: places of the neighbours' counts in n; the second row's lie `other` numbers behind.
    """
    weight = load_int16(tap, place)
    dim, other_dim = load_int16(n, before) * weight, load_int16(n, before + other) * weight
    weight = load_int16(tap, place + pixels)
    dim = dim + load_int16(n, here) * weight
    other_dim = other_dim + load_int16(n, here + other) * weight
    weight = load_int16(tap, place + 2 * pixels)
    dim = dim + load_int16(n, after) * weight
    other_dim = other_dim + load_int16(n, after + other) * weight
    weight = load_int16(constant, place)
    dim, other_dim = add_saturated(dim, weight), add_saturated(other_dim, weight)
    weight = load_int16(tap, place + 3 * pixels)
    bright, other_bright = load_int16(n, before) * weight, load_int16(n, before + other) * weight
    weight = load_int16(tap, place + 4 * pixels)
    bright = bright + load_int16(n, here) * weight
    other_bright = other_bright + load_int16(n, here + other) * weight
    weight = load_int16(tap, place + 5 * pixels)
    bright = bright + load_int16(n, after) * weight
    other_bright = other_bright + load_int16(n, after + other) * weight
    weight = load_int16(constant, place + pixels)
    bright, other_bright = add_saturated(bright, weight), add_saturated(other_bright, weight)
    dim = add_saturated(levels[0], larger(dim, bright))
    other_dim = add_saturated(levels[1], larger(other_dim, other_bright))
    store_int16(score, place, dim)
    store_int16(score, place + pixels, other_dim)
    weight = load_int16(edge, place)
    level = add_saturated(levels[0], load_int16(n, here) * weight)
    other_level = add_saturated(levels[1], load_int16(n, here + other) * weight)
    return (level, other_level), (larger(tops[0], dim), larger(tops[1], other_dim))


@numba.njit(inline="always")
def _score_pair(edge, tap, search, r, lanes):  # type: ignore[no-untyped-def]
    """Score rows r and r + 1 of a line that lights one pixel on either side."""
    stride = lanes + 2 * PAD
    n, score, constant = search.n + r * search.n_bytes, search.score + r * search.score_bytes, search.constant
    pixels, other = STEPS * lanes, STEPS * stride
    for v in range(0, lanes, LANES):
        at, end = PAD + v, PAD + v + 7 * stride
        levels = load_int16(search.start, r * lanes + v), load_int16(search.start, (r + 1) * lanes + v)
        lowest = zero_int16() - 32768
        tops = lowest, lowest
        # The first step's neighbour is step 7 of the lane before, the last one's step 0 of the lane behind.
        levels, tops = _score_step(
            n, end - 1, at, at + stride, tap, constant, edge, v, pixels, levels, tops, score, other
        )  # fmt: skip
        levels, tops = _score_step(
            n, at, at + stride, at + 2 * stride, tap, constant, edge, lanes + v, pixels, levels, tops, score, other
        )  # fmt: skip
        levels, tops = _score_step(
            n, at + stride, at + 2 * stride, at + 3 * stride, tap, constant, edge, 2 * lanes + v, pixels, levels, tops,
            score, other
        )  # fmt: skip
        levels, tops = _score_step(
            n, at + 2 * stride, at + 3 * stride, at + 4 * stride, tap, constant, edge, 3 * lanes + v, pixels, levels,
            tops, score, other
        )  # fmt: skip
        levels, tops = _score_step(
            n, at + 3 * stride, at + 4 * stride, at + 5 * stride, tap, constant, edge, 4 * lanes + v, pixels, levels,
            tops, score, other
        )  # fmt: skip
        levels, tops = _score_step(
            n, at + 4 * stride, at + 5 * stride, at + 6 * stride, tap, constant, edge, 5 * lanes + v, pixels, levels,
            tops, score, other
        )  # fmt: skip
        levels, tops = _score_step(
            n, at + 5 * stride, at + 6 * stride, end, tap, constant, edge, 6 * lanes + v, pixels, levels, tops, score,
            other
        )  # fmt: skip
        levels, tops = _score_step(
            n, at + 6 * stride, end, at + 1, tap, constant, edge, 7 * lanes + v, pixels, levels, tops, score, other
        )  # fmt: skip
        store_int16(search.best, r * lanes + v, tops[0])
        store_int16(search.best, (r + 1) * lanes + v, tops[1])


@numba.njit(cache=True, nogil=True)
def _score_wide(edge: int, tap: int, reach: int, search: Search, r: int) -> None:
    """Score row r of a line that lights `reach` pixels on either side."""
    lanes = search.lanes
    stride = lanes + 2 * PAD
    n, score, constant = search.n + r * search.n_bytes, search.score + r * search.score_bytes, search.constant
    pixels = STEPS * lanes
    taps = 2 * reach + 1
    for v in range(0, lanes, LANES):
        at = PAD + v
        level = load_int16(search.start, r * lanes + v)
        top = zero_int16() - 32768
        for s in range(STEPS):
            place = s * lanes + v
            dim, bright = load_int16(constant, place), load_int16(constant, place + pixels)
            for d in range(taps):
                x = s + d - reach
                count = load_int16(n, at + (x & 7) * stride + (x >> 3))
                dim = add_saturated(dim, count * load_int16(tap, place + d * pixels))
                bright = add_saturated(bright, count * load_int16(tap, place + (taps + d) * pixels))
            scored = add_saturated(level, larger(dim, bright))
            store_int16(score, place, scored)
            top = larger(top, scored)
            level = add_saturated(level, load_int16(n, at + s * stride) * load_int16(edge, place))
        store_int16(search.best, r * lanes + v, top)


@numba.njit(cache=True, nogil=True)
def best_score(search: Search, r: int) -> int:
    """The best score of row r."""
    best = np.int16(-32768)
    for v in range(0, search.lanes, LANES):
        best = max(best, largest(load_int16(search.best, r * search.lanes + v)))
    return best


@numba.njit(cache=True, nogil=True)
def best_position(search: Search, r: int, best: int) -> int:
    """Stored pixel of row r with the best score, the first of the lowest lane that has it."""
    lanes = search.lanes
    score = search.score + r * search.score_bytes
    lane = 0
    for v in range(0, lanes, LANES):
        mask = equal_mask(load_int16(search.best, r * lanes + v), np.int16(best))
        if mask != 0:
            lane = v + lowest_bit(mask)
            break
    # One bit a step, without a branch: which step it is cannot be foreseen.
    found = 0
    for s in range(STEPS):
        found |= np.int64(read_int16(score, s * lanes + lane) == best) << s
    return STEPS * lane + lowest_bit(np.uint32(found))


@numba.njit(cache=True, nogil=True)
def add_likelihoods(search: Search, r: int, best: int, shift: int) -> None:
    """Fill row r of search.mass: likelihoods of all positions, and of a change without a stripe at each lane."""
    lanes = search.lanes
    score = search.score + r * search.score_bytes
    most = np.int64(best) + ((MOST_OCTAVES * 128) >> shift)
    change, ceiling, none = read_int16(search.none, 2), np.int16(min(most, 32767)), nothing_below(best, shift)
    lot = zero_float32()
    for v in range(0, lanes, LANES):
        a = powers(load_int16(score, v), none, shift) + powers(load_int16(score, lanes + v), none, shift)
        b = powers(load_int16(score, 2 * lanes + v), none, shift)
        b = b + powers(load_int16(score, 3 * lanes + v), none, shift)
        c = powers(load_int16(score, 4 * lanes + v), none, shift)
        c = c + powers(load_int16(score, 5 * lanes + v), none, shift)
        d = powers(load_int16(score, 6 * lanes + v), none, shift)
        d = d + powers(load_int16(score, 7 * lanes + v), none, shift)
        nowhere = smaller(add_saturated(load_int16(search.start, r * lanes + v), change), ceiling)
        lot = lot + (((a + b) + (c + d)) + powers(nowhere, none, shift))
    store_float32(search.mass, r * LANES, lot)


@numba.njit(cache=True, nogil=True)
def end_likelihoods(search: Search, r: int, best: int, shift: int) -> float:
    """Likelihoods of the two hypotheses that the row holds no change at all."""
    most, nothing = np.int64(best) + ((MOST_OCTAVES * 128) >> shift), nothing_below(best, shift)
    ends = power(min(START + np.int64(read_int16(search.none, 0)), most), nothing, shift)
    all_left = np.int64(read_int16(search.all_left, r)) + read_int16(search.none, 1)
    return ends + power(min(all_left, most), nothing, shift)
