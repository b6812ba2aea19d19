"""Compiled four-path aggregation: the cost of each label, tied to the labels of the neighbours on rows and columns.

Along a path, L(p, l) = C(p, l) + m(p, l) with the message m(p, l) = min(L(q, l), L(q, l +- 1) + P1, L(q, l +- 2) + P2,
L(q, l +- 3) + P3, min L(q) + J) - min L(q) from the pixel q before p (Hirschmueller, PAMI 30, 2008, with steps of up to
three labels). All numbers are unsigned bytes that stop at 255.
"""

from typing import Final, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rig.estimators.aggregation_answer import Answer, AnswerSettings, answer_columns, desk_memory, desk_of
from rig.lane_memory import address_of, load_bytes, prefetch, read_byte, store_bytes, write_byte
from rig.lanes import (
    BYTES,
    add_saturated_unsigned,
    smaller_unsigned,
    smallest_byte,
    sub_saturated_unsigned,
    zero_bytes,
)

VECTOR: Final = BYTES.count
"""Labels that are worked on at once."""
LARGEST: Final = 255
_SIDE: Final = 2 * VECTOR
"""Bytes before and behind the labels of a path, whole cache lines: labels beyond the ends, and its least L."""
_LEAST_AT: Final = -VECTOR
_CHUNK: Final = 8
"""Columns that go down and up together: enough that none waits for its own last step, few enough for the caches."""
_AHEAD: Final = 3
"""Rows ahead of which memory is asked for: each lies on a page of its own, which the processor does not foresee."""
_SET, _ADD, _TOTAL = 0, 1, 2


class Penalties(NamedTuple):
    """What a change of label between neighbours costs, eighths of a nat: a step of 1, 2 or 3 labels, or any other."""

    one: int = 16
    two: int = 24
    three: int = 30
    jump: int = 52


@numba.njit(cache=True, nogil=True)
def _new_paths(paths: int, labels: int) -> tuple[NDArray[np.uint8], int]:
    """Memory for two turns of L of so many paths, and the address of the first one's labels."""
    memory = np.full(2 * paths * (labels + 2 * _SIDE) + _SIDE, LARGEST, np.uint8)
    return memory, -(-address_of(memory) // _SIDE) * _SIDE + _SIDE


@numba.njit(cache=True, nogil=True)
def _begin(path: int, paths: int, labels: int) -> None:
    """Make so many paths begin: no message to their first pixel."""
    for _ in range(paths):
        for v in range(0, labels, VECTOR):
            store_bytes(path, v, zero_bytes())
        write_byte(path, _LEAST_AT, np.uint8(0))
        path += labels + 2 * _SIDE


@numba.njit(forceinline=True)
def _step(before, after, cost, message, total, labels, ahead, penalties, use):  # type: ignore[no-untyped-def]
    """One pixel of a path: L of its last pixel at `before` to that of this one at `after`; all of these addresses.

    use: whether the message is written to `message`, added to it, or all of them and the cost make up `total`.
    ahead: bytes to the cost and message that are to be fetched into the cache; 0: none.
    """
    one, two, three, jump = penalties
    least = zero_bytes() + read_byte(before, _LEAST_AT)
    most = add_saturated_unsigned(least, jump)
    next_least = zero_bytes() + LARGEST
    for v in range(0, labels, VECTOR):
        if ahead != 0:
            prefetch(cost + ahead + v)
            prefetch(message + ahead + v)
        # Both sides at once; what lies beyond the ends is as large as can be.
        by_one = smaller_unsigned(load_bytes(before, v - 1), load_bytes(before, v + 1))
        by_two = smaller_unsigned(load_bytes(before, v - 2), load_bytes(before, v + 2))
        by_three = smaller_unsigned(load_bytes(before, v - 3), load_bytes(before, v + 3))
        by_one = add_saturated_unsigned(by_one, one)
        by_two = add_saturated_unsigned(by_two, two)
        by_three = add_saturated_unsigned(by_three, three)
        best = smaller_unsigned(smaller_unsigned(by_one, by_two), smaller_unsigned(by_three, load_bytes(before, v)))
        sent = sub_saturated_unsigned(smaller_unsigned(best, most), least)
        here = add_saturated_unsigned(load_bytes(cost, v), sent)
        next_least = smaller_unsigned(next_least, here)
        store_bytes(after, v, here)
        if use == _SET:
            store_bytes(message, v, sent)
        elif use == _ADD:
            store_bytes(message, v, add_saturated_unsigned(load_bytes(message, v), sent))
        else:
            store_bytes(total, v, add_saturated_unsigned(load_bytes(message, v), here))
    write_byte(after, _LEAST_AT, smallest_byte(next_least))


@numba.njit(forceinline=True)
def _spread(penalties):  # type: ignore[no-untyped-def]
    """Each penalty as a vector."""
    none = zero_bytes()
    return none + penalties.one, none + penalties.two, none + penalties.three, none + penalties.jump


@numba.njit(forceinline=True)
def _both_ways(cost, message, paths, columns, labels, first, last, penalties, use):  # type: ignore[no-untyped-def]
    """Steps first..last-1 from both ends of a row; cost, message, paths: addresses."""
    size = labels + 2 * _SIDE
    to_right, to_left = first * labels, (columns - 1 - first) * labels
    before, after = paths + 2 * size * (first & 1), paths + 2 * size * (1 - (first & 1))
    for _ in range(first, last):
        _step(before, after, cost + to_right, message + to_right, 0, labels, 0, penalties, use)
        _step(before + size, after + size, cost + to_left, message + to_left, 0, labels, 0, penalties, use)
        to_right += labels
        to_left -= labels
        before, after = after, before


@numba.njit(cache=True, nogil=True)
def along_rows(
    cost: NDArray[np.uint8], message: NDArray[np.uint8], penalties: Penalties, first_row: int, last_row: int
) -> None:
    """Sums of the messages from the left and from the right, for rows first_row..last_row-1.

    cost, message: (rows, columns, labels), C-contiguous; labels: a multiple of VECTOR.
    """
    columns, labels = cost.shape[1], cost.shape[2]
    memory, paths = _new_paths(2, labels)
    vectors = _spread(penalties)
    half = columns // 2
    for row in range(first_row, last_row):
        _begin(paths, 4, labels)
        costs, messages = address_of(cost) + row * columns * labels, address_of(message) + row * columns * labels
        # From both ends at once, two paths that do not wait for each other: to the middle nothing is there to add to.
        _both_ways(costs, messages, paths, columns, labels, 0, half, vectors, _SET)
        if columns % 2:
            message[row, half] = 0
        _both_ways(costs, messages, paths, columns, labels, half, columns, vectors, _ADD)
    memory[0] = 0  # alive until here


@numba.njit(cache=True, nogil=True)
def along_columns(
    cost: NDArray[np.uint8],
    message: NDArray[np.uint8],
    penalties: Penalties,
    settings: AnswerSettings,
    first_column: int,
    last_column: int,
    out: Answer,
) -> None:
    """The answers of columns first_column..last_column-1, from what `along_rows` left in all rows of message.

    Adds the messages from above to message.
    """
    rows, columns, labels = cost.shape
    memory, paths = _new_paths(_CHUNK, labels)
    totals = desk_memory(_CHUNK, labels)
    desk = desk_of(settings, out, totals, _CHUNK, labels)
    vectors = _spread(penalties)
    size, row_bytes = labels + 2 * _SIDE, columns * labels
    for column in range(first_column, last_column, _CHUNK):
        count = min(_CHUNK, last_column - column)
        _begin(paths, 2 * _CHUNK, labels)
        for row in range(rows):
            at = row * row_bytes + column * labels
            before, after = paths + (row & 1) * _CHUNK * size, paths + (1 - (row & 1)) * _CHUNK * size
            costs, messages = address_of(cost) + at, address_of(message) + at
            ahead = _AHEAD * row_bytes
            for _ in range(count):
                _step(before, after, costs, messages, 0, labels, ahead, vectors, _ADD)
                before, after = before + size, after + size
                costs, messages = costs + labels, messages + labels
        _begin(paths, 2 * _CHUNK, labels)
        for row in range(rows - 1, -1, -1):
            at = row * row_bytes + column * labels
            before, after = paths + (row & 1) * _CHUNK * size, paths + (1 - (row & 1)) * _CHUNK * size
            costs, messages = address_of(cost) + at, address_of(message) + at
            ahead, total = -_AHEAD * row_bytes, desk.totals
            for _ in range(count):
                _step(before, after, costs, messages, total, labels, ahead, vectors, _TOTAL)
                before, after = before + size, after + size
                costs, messages = costs + labels, messages + labels
                total += desk.size
            answer_columns(address_of(cost) + at, row * columns + column, count, desk)
    memory[0] = totals[0] = 0  # alive until here
