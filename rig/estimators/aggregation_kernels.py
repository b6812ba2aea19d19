"""Compiled four-path aggregation: the cost of each label, tied to the labels of the neighbours on rows and columns.

Along a path, L(p, l) = C(p, l) + m(p, l) with the message m(p, l) = min(L(q, l), L(q, l +- 1) + P1, L(q, l +- 2) + P2,
L(q, l +- 3) + P3, min L(q) + J) - min L(q) from the pixel q before p (Hirschmueller, PAMI 30, 2008, with steps of up to
three labels). All numbers are unsigned bytes that stop at 255.
"""

from typing import Final, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rig.estimators.aggregation_answer import Answer, AnswerSettings, answer_pixel
from rig.lane_memory import address_of, load_bytes, store_bytes
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
NOTHING: Final = 255


class Penalties(NamedTuple):
    """What a change of label between neighbours costs, eighths of a nat: a step of 1, 2 or 3 labels, or any other."""

    one: int = 16
    two: int = 24
    three: int = 30
    jump: int = 52


@numba.njit(cache=True, nogil=True)
def _new_paths(paths: int, labels: int) -> NDArray[np.uint8]:
    """Two turns of L for so many paths, a vector of NOTHING on both sides of each."""
    return np.full((2, paths, labels + 2 * VECTOR), NOTHING, np.uint8)


@numba.njit(forceinline=True)
def _step(before, after, cost, message, into, lowest, labels, penalties):  # type: ignore[no-untyped-def]
    """One pixel of a path: writes L to `after`, message + m to `into`, gives min L; all but `lowest` are addresses."""
    jump = add_saturated_unsigned(zero_bytes() + lowest, penalties.jump)
    least = zero_bytes() + NOTHING
    for v in range(VECTOR, VECTOR + labels, VECTOR):
        one = smaller_unsigned(load_bytes(before, v - 1), load_bytes(before, v + 1))
        two = smaller_unsigned(load_bytes(before, v - 2), load_bytes(before, v + 2))
        three = smaller_unsigned(load_bytes(before, v - 3), load_bytes(before, v + 3))
        one = add_saturated_unsigned(one, penalties.one)
        two = add_saturated_unsigned(two, penalties.two)
        three = add_saturated_unsigned(three, penalties.three)
        best = smaller_unsigned(smaller_unsigned(one, two), smaller_unsigned(three, load_bytes(before, v)))
        m = sub_saturated_unsigned(smaller_unsigned(best, jump), lowest)
        here = add_saturated_unsigned(load_bytes(cost, v - VECTOR), m)
        least = smaller_unsigned(least, here)
        store_bytes(after, v, here)
        store_bytes(into, v - VECTOR, add_saturated_unsigned(load_bytes(message, v - VECTOR), m))
    return smallest_byte(least)


@numba.njit(cache=True, nogil=True)
def along_rows(
    cost: NDArray[np.uint8], message: NDArray[np.uint8], penalties: Penalties, first_row: int, last_row: int
) -> None:
    """Sums of the messages from the left and from the right, for rows first_row..last_row-1.

    cost, message: (rows, columns, labels), C-contiguous; labels: a multiple of VECTOR.
    """
    columns, labels = cost.shape[1], cost.shape[2]
    message[first_row:last_row] = 0
    for row in range(first_row, last_row):
        for way in range(2):
            paths = _new_paths(1, labels)
            paths[:, :, VECTOR : VECTOR + labels] = 0
            lowest = np.uint8(0)
            for i in range(columns):
                column = i if way == 0 else columns - 1 - i
                at = (row * columns + column) * labels
                into = address_of(message) + at
                before, after = address_of(paths[i & 1, 0]), address_of(paths[~i & 1, 0])
                lowest = _step(before, after, address_of(cost) + at, into, into, lowest, labels, penalties)


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
    """The answers of columns first_column..last_column-1, from what `along_rows` left in cost and message.

    Changes message.
    """
    rows, columns, labels = cost.shape
    total = np.empty(labels, np.uint8)
    for column in range(first_column, last_column):
        for way in range(2):
            paths = _new_paths(1, labels)
            paths[:, :, VECTOR : VECTOR + labels] = 0
            lowest = np.uint8(0)
            for i in range(rows):
                row = i if way == 0 else rows - 1 - i
                at = (row * columns + column) * labels
                into = address_of(message) + at
                before, after = address_of(paths[i & 1, 0]), address_of(paths[~i & 1, 0])
                lowest = _step(before, after, address_of(cost) + at, into, into, lowest, labels, penalties)
                if way == 1:
                    for label in range(labels):
                        total[label] = min(
                            np.int64(cost[row, column, label]) + message[row, column, label], NOTHING
                        )
                    answer_pixel(cost[row, column], total, settings, row, column, out)
