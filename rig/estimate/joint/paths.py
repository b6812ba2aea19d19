"""Four-path aggregation, compiled: the cost of each label, tied to the labels of the neighbours on rows and columns.

A pixel, in this module, is one row and column of the map. With the cost C of a label, along a path from pixel q to p,

    L(p, l) = C(p, l) + m(p, l)
    m(p, l) = min(L(q, l), L(q, l +- 1) + P1, L(q, l +- 2) + P2, L(q, l +- 3) + P3, min L(q) + J) - min L(q)

and the total of a label is C plus the messages m of the four paths, left, right, up and down (Hirschmueller, PAMI 30,
2008, with steps of up to three labels). C and the sum of messages are uint8 (rows, columns, labels); all sums saturate
at 255. `along_rows` sums the messages of two paths; `along_columns` adds the other two and reads the answers from the
totals (`rig.estimate.joint.winner`).

Labels stay in order in memory. Neighbouring labels are read by unaligned loads from the first-level cache, since
shuffling them in registers gains nothing. Several paths are processed at once, because each step of a path waits for
the one before.
"""

from typing import Final

import numba
import numpy as np

from rig.estimate.joint.winner import LARGEST, VECTOR, Readout, answer_columns, fetch_answers
from rig.simd import Uint8
from rig.simd.memory import address_of, keep_alive, load_bytes, prefetch, read_byte, store_bytes, write_byte
from rig.simd.vectors import add_saturated_unsigned, smaller_unsigned, smallest_byte, sub_saturated_unsigned, zero_bytes

_SIDE: Final = 2 * VECTOR
"""Bytes before and behind the labels of a path, a cache line each: all LARGEST, but at _LEAST_AT lies the least L."""
_LEAST_AT: Final = -VECTOR
CHUNK: Final = 16
"""Columns that are stepped through together: enough that none waits for its last step, few enough for the caches."""
_AHEAD: Final = 3
"""Memory is prefetched this many rows ahead: each row lies on another page, so the processor does not prefetch it."""
_SET, _ADD, _TOTAL = 0, 1, 2


ONE: Final = 16
TWO: Final = 24
THREE: Final = 30
JUMP: Final = 40
"""Costs of a change of label between neighbours, P1, P2, P3 and J of the module, in units of
`rig.estimate.joint.labels.costs`. With more exposures a unit stands for more nats, so a change costs more nats."""


@numba.njit(cache=True, nogil=True)
def _path_memory(paths: int, labels: int) -> Uint8:
    """Memory for L of the previous and of the present pixel on `paths` paths; keep it while its address is used."""
    return np.full(2 * paths * (labels + 2 * _SIDE) + _SIDE, LARGEST, np.uint8)


@numba.njit(forceinline=True)
def _paths_in(memory):  # type: ignore[no-untyped-def]
    """Address of the first path's labels, at a whole cache line."""
    return -(-address_of(memory) // _SIDE) * _SIDE + _SIDE


@numba.njit(forceinline=True)
def _begin(path, paths, labels):  # type: ignore[no-untyped-def]
    """Begin this number of paths: L is 0 before their first pixel, so that their first message is 0."""
    for _ in range(2 * paths):
        for v in range(0, labels, VECTOR):
            store_bytes(path, v, zero_bytes())
        write_byte(path, _LEAST_AT, np.uint8(0))
        path += labels + 2 * _SIDE


@numba.njit(forceinline=True)
def _step(before, after, cost, message, total, hidden, labels, ahead, use):  # type: ignore[no-untyped-def]
    """Step along a path: from L of the previous pixel, at `before`, to L of this one, at `after`.

    before to hidden: addresses. use: _SET writes the message to `message`, _ADD adds it there; _TOTAL writes the sum of
    it, `message` and cost to `total`, LARGEST for `hidden` labels. ahead: bytes to what is prefetched, 0 for nothing.
    """
    least = zero_bytes() + read_byte(before, _LEAST_AT)
    most = add_saturated_unsigned(least, JUMP)
    next_least = zero_bytes() + LARGEST
    for v in range(0, labels, VECTOR):
        if ahead != 0 and v & VECTOR == 0:
            prefetch(cost + ahead + v)
            prefetch(message + ahead + v)
        # Both sides at once; beyond the ends of the labels lies LARGEST.
        by_one = smaller_unsigned(load_bytes(before, v - 1), load_bytes(before, v + 1))
        by_two = smaller_unsigned(load_bytes(before, v - 2), load_bytes(before, v + 2))
        by_three = smaller_unsigned(load_bytes(before, v - 3), load_bytes(before, v + 3))
        by_one = add_saturated_unsigned(by_one, ONE)
        by_two = add_saturated_unsigned(by_two, TWO)
        by_three = add_saturated_unsigned(by_three, THREE)
        best = smaller_unsigned(smaller_unsigned(by_one, by_two), smaller_unsigned(by_three, load_bytes(before, v)))
        # The least is subtracted only here, from the message, so that the step before need not wait for it.
        sent = sub_saturated_unsigned(smaller_unsigned(best, most), least)
        here = add_saturated_unsigned(load_bytes(cost, v), sent)
        next_least = smaller_unsigned(next_least, here)
        store_bytes(after, v, here)
        if use == _SET:
            store_bytes(message, v, sent)
        elif use == _ADD:
            store_bytes(message, v, add_saturated_unsigned(load_bytes(message, v), sent))
        else:
            whole = add_saturated_unsigned(load_bytes(message, v), here)
            store_bytes(total, v, whole | load_bytes(hidden, v))
    write_byte(after, _LEAST_AT, smallest_byte(next_least))


@numba.njit(forceinline=True)
def _both_ways(cost, message, paths, columns, labels, first, last, use):  # type: ignore[no-untyped-def]
    """Do steps first..last-1 from both ends of a row; cost, message, paths: addresses."""
    size = labels + 2 * _SIDE
    to_right, to_left = first * labels, (columns - 1 - first) * labels
    before, after = paths + 2 * size * (first & 1), paths + 2 * size * (1 - (first & 1))
    for _ in range(first, last):
        _step(before, after, cost + to_right, message + to_right, 0, 0, labels, 0, use)
        _step(before + size, after + size, cost + to_left, message + to_left, 0, 0, labels, 0, use)
        to_right += labels
        to_left -= labels
        before, after = after, before


@numba.njit(cache=True, nogil=True)
def _along_row(cost: int, message: int, columns: int, labels: int, paths: int) -> None:
    """Write the sums of the messages of both ways along one row; cost, message, paths: addresses."""
    _begin(paths, 2, labels)
    half = columns // 2
    # Two paths from both ends at once, which do not wait for each other. Up to the middle they set, then they add.
    _both_ways(cost, message, paths, columns, labels, 0, half, _SET)
    for v in range(half * labels, (columns - half) * labels, VECTOR):
        store_bytes(message, v, zero_bytes())
    _both_ways(cost, message, paths, columns, labels, half, columns, _ADD)


@numba.njit(cache=True, nogil=True)
def along_rows(cost: Uint8, message: Uint8, first_row: int, last_row: int) -> None:
    """Write the sums of the messages from the left and from the right, for rows first_row..last_row-1.

    cost, message: (rows, columns, labels), C-contiguous; labels: a multiple of VECTOR.
    """
    columns, labels = cost.shape[1], cost.shape[2]
    memory = _path_memory(2, labels)
    for row in range(first_row, last_row):
        at = row * columns * labels
        _along_row(address_of(cost) + at, address_of(message) + at, columns, labels, _paths_in(memory))
    keep_alive(memory)


@numba.njit(cache=True, nogil=True)
def _step_down(before: int, after: int, cost: int, message: int, labels: int, columns: int, ahead: int) -> None:
    """Step some columns of a row on their way down; before, after, cost, message: addresses."""
    # A function of its own, so that everything in the loop fits into the registers.
    for _ in range(columns):
        _step(before, after, cost, message, 0, 0, labels, ahead, _ADD)
        before, after = before + labels + 2 * _SIDE, after + labels + 2 * _SIDE
        cost, message = cost + labels, message + labels


@numba.njit(cache=True, nogil=True)
def _step_up(
    before: int, after: int, cost: int, message: int, labels: int, columns: int, ahead: int,
    total: int, total_bytes: int, hidden: int,
) -> None:  # fmt: skip
    """Step some columns of a row on their way up and write their totals, total_bytes from column to column."""
    for _ in range(columns):
        _step(before, after, cost, message, total, hidden, labels, ahead, _TOTAL)
        before, after = before + labels + 2 * _SIDE, after + labels + 2 * _SIDE
        cost, message, total = cost + labels, message + labels, total + total_bytes


@numba.njit(cache=True, nogil=True)
def _go_down(cost: int, message: int, rows: int, row_bytes: int, labels: int, columns: int, paths: int) -> None:
    """Add the messages from above to those of some columns; cost, message, paths: addresses."""
    before, after = paths, paths + CHUNK * (labels + 2 * _SIDE)
    _begin(paths, CHUNK, labels)
    for _ in range(rows):
        _step_down(before, after, cost, message, labels, columns, _AHEAD * row_bytes)
        before, after = after, before
        cost, message = cost + row_bytes, message + row_bytes


@numba.njit(cache=True, nogil=True)
def _go_up(
    cost: int, message: int, rows: int, row_bytes: int, columns: int, paths: int, pixel: int,
    desk: Readout,
) -> None:  # fmt: skip
    """Find totals and answers of some columns, from the last row up. pixel: index of the first answer in row 0."""
    labels = desk.labels
    width = row_bytes // labels
    before, after = paths, paths + CHUNK * (labels + 2 * _SIDE)
    _begin(paths, CHUNK, labels)
    for row in range(rows - 1, -1, -1):
        costs, messages, here = cost + row * row_bytes, message + row * row_bytes, pixel + row * width
        fetch_answers(here - _AHEAD * width, columns, desk)
        _step_up(before, after, costs, messages, labels, columns, -_AHEAD * row_bytes, desk.totals,
                 desk.size, desk.hidden)  # fmt: skip
        answer_columns(here, columns, desk)
        before, after = after, before


@numba.njit(cache=True, nogil=True)
def along_columns(cost: Uint8, message: Uint8, first_column: int, last_column: int, desk: Readout) -> None:
    """Find the answers of columns first_column..last_column-1, from what `along_rows` wrote to `message` for all rows.

    Messages from above are added to `message`. desk: pointers to the `Readout` of CHUNK columns.
    """
    rows, columns, labels = cost.shape
    memory = _path_memory(CHUNK, labels)
    paths, row_bytes = _paths_in(memory), columns * labels
    for column in range(first_column, last_column, CHUNK):
        count, at = min(CHUNK, last_column - column), column * labels
        costs, messages = address_of(cost) + at, address_of(message) + at
        _go_down(costs, messages, rows, row_bytes, labels, count, paths)
        _go_up(costs, messages, rows, row_bytes, count, paths, column, desk)
    keep_alive(memory)
