"""Compiled reading of answers off the totals of all labels, some columns of a row at a time.

In rounds over the columns, each short: what one column waits for, others fill. All arrays come by their addresses, see
`rig.lane_memory`.
"""

from typing import Final, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rig.estimators.aggregation_answer import (
    LARGEST,
    MIDDLE,
    POWERS,
    REACH,
    RIVAL_REACH,
    TAPS,
    VECTOR,
    Answer,
    AnswerSettings,
)
from rig.lane_memory import (
    address_of,
    load_block,
    load_bytes,
    load_four,
    prefetch,
    read_byte,
    read_float32,
    read_int32,
    store_bytes,
    store_four,
    write_byte,
    write_float32,
    write_int32,
)
from rig.lane_shuffles import equal_bytes, first_equal
from rig.lanes import BLOCK, smaller_unsigned, smallest_byte, zero_four

_BLOCK: Final = BLOCK.count


class Fields(NamedTuple):
    """Addresses of what `Answer` has."""

    label: int
    spread: int
    margin: int
    data: int
    rival: int
    rival_data: int


class Found(NamedTuple):
    """Addresses of what was found in each column: label, int32; its total, uint8; moments, float32 (POWERS,)."""

    label: int
    total: int
    moments: int


class Desk(NamedTuple):
    """What columns are answered with: numbers (labels, end, size) and addresses.

    totals: uint8, `size` bytes from column to column, at least a vector of LARGEST before and behind each. end: labels
    up to the end of the last block with stripes. ring: uint8 of each column, the least total of labels that count for
    the margin, but may be no rival. hidden: uint8 (labels,), LARGEST where there is no stripe. The tables are those of
    `AnswerSettings`.
    """

    labels: int
    end: int
    size: int
    totals: int
    hidden: int
    weights: int
    powers: int
    reach: int
    off_ring: int
    near: int
    winner: Found
    rival: Found
    ring: int
    answer: Fields


@numba.njit(cache=True, nogil=True)
def desk_memory(settings: AnswerSettings, columns: int, labels: int) -> NDArray[np.uint8]:
    """Memory of a desk for so many columns; must live as long as the desk."""
    memory = np.full(labels + columns * (labels + 2 * _BLOCK) + 2 * VECTOR, LARGEST, np.uint8)
    memory[: settings.stripes] = 0
    return memory


@numba.njit(cache=True, nogil=True)
def desk_of(settings: AnswerSettings, out: Answer, memory: NDArray[np.uint8], columns: int, labels: int) -> Desk:
    """A desk for so many columns; its totals begin at a multiple of their vectors."""
    hidden = address_of(memory)
    totals = -(-(hidden + labels) // VECTOR) * VECTOR + VECTOR
    size = -(-labels // _BLOCK) * _BLOCK + 2 * VECTOR
    moments = totals + columns * size - VECTOR
    rest = moments + 2 * 4 * POWERS * columns
    answer = Fields(
        address_of(out.label), address_of(out.spread), address_of(out.margin),
        address_of(out.data), address_of(out.rival), address_of(out.rival_data),
    )  # fmt: skip
    return Desk(
        labels, -(-settings.stripes // _BLOCK) * _BLOCK, size, totals, hidden,
        address_of(settings.weights), address_of(settings.powers), address_of(settings.reach),
        address_of(settings.off_ring), address_of(settings.near),
        Found(rest, rest + 8 * columns, moments),
        Found(rest + 4 * columns, rest + 9 * columns, moments + 4 * POWERS * columns),
        rest + 10 * columns, answer,
    )  # fmt: skip


@numba.njit(forceinline=True)
def _find_least(columns, desk, found):  # type: ignore[no-untyped-def]
    """The least total of each column and its label, the smallest such one."""
    for c in range(columns):
        totals = desk.totals + c * desk.size
        low = load_block(totals, 0)
        for block in range(_BLOCK, desk.end, _BLOCK):
            low = smaller_unsigned(low, load_block(totals, block))
        least, label = smallest_byte(low), 0
        for block in range(desk.end - _BLOCK, -1, -_BLOCK):
            place = first_equal(load_block(totals, block), least)
            label = block + place if place < _BLOCK else label
        write_int32(found.label, c, np.int32(label))
        write_byte(found.total, c, least)


@numba.njit(forceinline=True)
def _weigh(columns, desk, found, farthest):  # type: ignore[no-untyped-def]
    """Sums of weight times each power over the labels around those found, as far as both sides have some."""
    for c in range(columns):
        around = desk.totals + c * desk.size + read_int32(found.label, c)
        excluded = np.int64(equal_bytes(load_bytes(around, -MIDDLE), LARGEST)) >> (MIDDLE - REACH)
        reach = min(np.int64(read_byte(desk.reach, excluded & ((1 << TAPS) - 1))), farthest)
        powers = desk.powers + 4 * POWERS * (TAPS * reach + REACH)
        weights = desk.weights - 4 * np.int64(read_byte(found.total, c))
        below, above = load_four(powers, 0) * read_float32(weights, np.int64(read_byte(around, 0))), zero_four()
        for k in range(1, farthest + 1):
            below = below + load_four(powers, -POWERS * k) * read_float32(weights, np.int64(read_byte(around, -k)))
            above = above + load_four(powers, POWERS * k) * read_float32(weights, np.int64(read_byte(around, k)))
        store_four(found.moments, POWERS * c, below + above)


@numba.njit(forceinline=True)
def _hide_winners(columns, desk):  # type: ignore[no-untyped-def]
    """Take the winners, and what is too near for a rival, out of the totals."""
    off_ring, near = load_bytes(desk.off_ring, 0), load_bytes(desk.near, 0)
    for c in range(columns):
        around = desk.totals + c * desk.size + read_int32(desk.winner.label, c)
        window = load_bytes(around, -MIDDLE)
        write_byte(desk.ring, c, smallest_byte(window | off_ring))
        store_bytes(around, -MIDDLE, window | near)


@numba.njit(forceinline=True)
def _answer_winners(cost, pixel, columns, desk):  # type: ignore[no-untyped-def]
    answer, found = desk.answer, desk.winner
    for c in range(columns):
        label = read_int32(found.label, c)
        share = np.float32(1.0) / read_float32(found.moments, POWERS * c)
        mean = read_float32(found.moments, POWERS * c + 1) * share
        square = read_float32(found.moments, POWERS * c + 2) * share
        write_float32(answer.label, pixel + c, np.float32(label) + mean)
        write_float32(answer.spread, pixel + c, np.sqrt(max(square - mean * mean, np.float32(0.0))))
        write_byte(answer.data, pixel + c, read_byte(cost, c * desk.labels + label))


@numba.njit(forceinline=True)
def _answer_rivals(cost, pixel, columns, desk):  # type: ignore[no-untyped-def]
    answer, found = desk.answer, desk.rival
    for c in range(columns):
        label, total = read_int32(found.label, c), read_byte(found.total, c)
        mean = read_float32(found.moments, POWERS * c + 1) / read_float32(found.moments, POWERS * c)
        own = read_byte(cost, c * desk.labels + label)
        margin = np.uint8(min(total, read_byte(desk.ring, c)) - read_byte(desk.winner.total, c))
        there = total < LARGEST
        write_float32(answer.rival, pixel + c, np.float32(label) + mean if there else np.float32(np.nan))
        write_byte(answer.rival_data, pixel + c, own if there else np.uint8(LARGEST))
        write_byte(answer.margin, pixel + c, margin)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def answer_columns(cost: int, pixel: int, columns: int, desk: Desk) -> None:
    """Answer columns from the desk's totals, which are not the same afterwards.

    cost: address of the first one's costs; pixel: its place among the answers.
    """
    _find_least(columns, desk, desk.winner)
    _weigh(columns, desk, desk.winner, REACH)
    _hide_winners(columns, desk)
    _find_least(columns, desk, desk.rival)
    _weigh(columns, desk, desk.rival, RIVAL_REACH)
    _answer_winners(cost, pixel, columns, desk)
    _answer_rivals(cost, pixel, columns, desk)


@numba.njit(forceinline=True)
def fetch_answers(pixel, columns, desk):  # type: ignore[no-untyped-def]
    """Have the places of answers brought into the cache."""
    answer = desk.answer
    for at in (pixel, pixel + columns - 1):
        prefetch(answer.label + 4 * at)
        prefetch(answer.spread + 4 * at)
        prefetch(answer.margin + at)
        prefetch(answer.data + at)
        prefetch(answer.rival + 4 * at)
        prefetch(answer.rival_data + at)
