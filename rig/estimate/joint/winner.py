"""Answers read from the totals of all labels, compiled: sub-label position and margin of each row and column.

With S(l) the totals of a row and column (uint8, LARGEST if a label is excluded) and l* the label with the least total,

    label  = sum of l w(l) / sum of w(l) over |l - l*| <= r,     w(l) = exp(-BETA (S(l) - S(l*)) / UNITS)
    margin = min of S(l) over |l - l*| >= MARGIN_FROM  -  S(l*)

r is REACH, or the largest distance up to which no label on either side is excluded. label is float32, margin uint8,
(rows, columns). Several columns of a row are read at a time, in short steps for all: while one waits, others go on.
"""

from typing import Final, NamedTuple

import numba
import numpy as np

from rig.simd import Float32, Int32, Uint8
from rig.simd.memory import (
    aligned_zeros,
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
from rig.simd.shuffles import equal_bytes, first_equal
from rig.simd.vectors import BLOCK, smaller_unsigned, smallest_byte, zero_four

REACH: Final = 4
"""Labels on each side of the winner over which the mean for its sub-label position is taken."""
MARGIN_FROM: Final = 3
"""Least distance of the margin's rivals from the winner, in labels: 1.5 pixels."""
LARGEST: Final = 255
"""Largest cost and total, those of a label that is excluded."""
TAPS: Final = 2 * REACH + 1
POWERS: Final = 4
"""Numbers that are summed at once: powers 0 and 1 of the distance in labels, and two zeros."""
VECTOR: Final = 32
"""Labels that are processed at once."""
MIDDLE: Final = VECTOR // 2
UNITS: Final = 8.0
"""Units of cost per nat with very few exposures; with K exposures there are UNITS / (1 + K / SHARP) or less, see
`rig.estimate.joint.labels.costs`."""


BETA: Final = 0.5
"""Steepness of the weights w(l) of the module."""


class AnswerSettings(NamedTuple):
    """Tables of `answer_settings`. For r and w see the module's docstring.

    stripes: number of labels that are positions; labels from there on are padding. weights: w by the difference of a
    total from the least one, float32 (256,). powers: for each r, powers of the distance from the winner, 0 for labels
    farther away than r, float32 (REACH + 1, TAPS, POWERS). reach: r for each set of excluded labels around the winner,
    a number of TAPS bits with those of excluded labels set, uint8 (2^TAPS,). near: for a winner at MIDDLE, LARGEST for
    labels that are too near to be its rivals, else 0, uint8 (VECTOR,).
    """

    stripes: int
    weights: Float32
    powers: Float32
    reach: Uint8
    near: Uint8


class LabelAnswers(NamedTuple):
    """Answers of a map, (rows, columns) each. Positions are counted in labels, costs in units (`UNITS`).

    label: float32, weighted mean of the labels around the winner, which is the label with the least total (of equal
    ones the smallest). The mean extends only as far as both sides have labels, since a single side would draw every
    answer to it. margin: uint8, the least total at least MARGIN_FROM labels away minus the winner's.
    """

    label: Float32
    margin: Uint8


def new_answer(rows: int, columns: int) -> LabelAnswers:
    """Memory for the answers of a map."""
    return LabelAnswers(np.zeros((rows, columns), np.float32), np.zeros((rows, columns), np.uint8))


def answer_settings(stripes: int) -> AnswerSettings:
    """Settings for this number of stripe labels."""
    weights = np.exp(-BETA / UNITS * np.arange(LARGEST + 1)).astype(np.float32)
    distance = np.arange(-REACH, REACH + 1)
    powers = np.zeros((REACH + 1, TAPS, POWERS), np.float32)
    for reach in range(REACH + 1):
        powers[reach, :, :2] = (np.abs(distance) <= reach)[:, None] * distance[:, None] ** np.arange(2.0)
    excluded = np.arange(1 << TAPS)[:, None] >> np.arange(TAPS) & 1
    pairs = excluded[:, REACH + 1 :] | excluded[:, REACH - 1 :: -1]
    reach_of = np.where(pairs.any(axis=1), pairs.argmax(axis=1), REACH).astype(np.uint8)
    away = np.abs(np.arange(VECTOR) - MIDDLE)
    near = np.where(away < MARGIN_FROM, LARGEST, 0).astype(np.uint8)
    return AnswerSettings(stripes, weights, powers, reach_of, near)


_BLOCK: Final = BLOCK.count


class Readout(NamedTuple):
    """Arrays and sizes with which a thread finds the answers of some columns; kernels get `pointers` to them.

    end: labels up to the end of the last block with stripes; size: bytes from the totals of a column to the next.
    around: uint8, totals of the columns, with at least a vector of LARGEST before and after each; totals: address of
    the first column's. hidden: uint8 (labels,), LARGEST for padding. Per column: least_label: int32, label of the least
    total; least: uint8, that total; moments: float32 (columns, POWERS), sums of weight times power.
    """

    settings: AnswerSettings
    answer: LabelAnswers
    labels: int
    end: int
    size: int
    totals: int
    around: Uint8
    hidden: Uint8
    least_label: Int32
    least: Uint8
    moments: Float32


def new_readout(settings: AnswerSettings, answer: LabelAnswers, columns: int, labels: int) -> Readout:
    """Working memory for answering this number of columns at a time."""
    size = -(-labels // _BLOCK) * _BLOCK + 2 * VECTOR
    around = aligned_zeros((columns * size + VECTOR,), np.uint8)
    around[:] = LARGEST
    hidden = aligned_zeros((labels,), np.uint8)
    hidden[settings.stripes :] = LARGEST
    return Readout(
        settings=settings, answer=answer, labels=labels, end=-(-settings.stripes // _BLOCK) * _BLOCK, size=size,
        totals=around.ctypes.data + VECTOR, around=around, hidden=hidden,
        least_label=aligned_zeros((columns,), np.int32), least=aligned_zeros((columns,), np.uint8),
        moments=aligned_zeros((columns, POWERS), np.float32),
    )  # fmt: skip


@numba.njit(forceinline=True)
def _least_of(totals, desk):  # type: ignore[no-untyped-def]
    """The least total of a column."""
    low = load_block(totals, 0)
    for block in range(_BLOCK, desk.end, _BLOCK):
        low = smaller_unsigned(low, load_block(totals, block))
    return smallest_byte(low)


@numba.njit(forceinline=True)
def _find_winners(columns, desk):  # type: ignore[no-untyped-def]
    """Find the least total of each column and its label, the smallest of equal ones."""
    for c in range(columns):
        totals = desk.totals + c * desk.size
        least, label = _least_of(totals, desk), 0
        for block in range(desk.end - _BLOCK, -1, -_BLOCK):
            place = first_equal(load_block(totals, block), least)
            label = block + place if place < _BLOCK else label
        write_int32(desk.least_label, c, np.int32(label))
        write_byte(desk.least, c, least)


@numba.njit(forceinline=True)
def _weigh(columns, desk):  # type: ignore[no-untyped-def]
    """Sum weight times each power over the labels around the winners, as far as both sides have labels."""
    settings = desk.settings
    for c in range(columns):
        around = desk.totals + c * desk.size + read_int32(desk.least_label, c)
        excluded = np.int64(equal_bytes(load_bytes(around, -MIDDLE), LARGEST)) >> (MIDDLE - REACH)
        reach = np.int64(read_byte(settings.reach, excluded & ((1 << TAPS) - 1)))
        powers = settings.powers + 4 * POWERS * (TAPS * reach + REACH)
        weights = settings.weights - 4 * np.int64(read_byte(desk.least, c))
        below, above = load_four(powers, 0) * read_float32(weights, np.int64(read_byte(around, 0))), zero_four()
        for k in range(1, REACH + 1):
            below = below + load_four(powers, -POWERS * k) * read_float32(weights, np.int64(read_byte(around, -k)))
            above = above + load_four(powers, POWERS * k) * read_float32(weights, np.int64(read_byte(around, k)))
        store_four(desk.moments, POWERS * c, below + above)


@numba.njit(forceinline=True)
def _hide_winners(columns, desk):  # type: ignore[no-untyped-def]
    """Set the totals of the winners, and of labels too close to count for the margin, to LARGEST."""
    near = load_bytes(desk.settings.near, 0)
    for c in range(columns):
        around = desk.totals + c * desk.size + read_int32(desk.least_label, c)
        store_bytes(around, -MIDDLE, load_bytes(around, -MIDDLE) | near)


@numba.njit(forceinline=True)
def _write_answers(pixel, columns, desk):  # type: ignore[no-untyped-def]
    answer = desk.answer
    for c in range(columns):
        mean = read_float32(desk.moments, POWERS * c + 1) / read_float32(desk.moments, POWERS * c)
        write_float32(answer.label, pixel + c, np.float32(read_int32(desk.least_label, c)) + mean)
        rival = _least_of(desk.totals + c * desk.size, desk)
        write_byte(answer.margin, pixel + c, np.uint8(rival - read_byte(desk.least, c)))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def answer_columns(pixel: int, columns: int, desk: Readout) -> None:
    """Write the answers of columns from their totals, which are overwritten. pixel: index of the first answer."""
    _find_winners(columns, desk)
    _weigh(columns, desk)
    _hide_winners(columns, desk)
    _write_answers(pixel, columns, desk)


@numba.njit(forceinline=True)
def fetch_answers(pixel, columns, desk):  # type: ignore[no-untyped-def]
    """Prefetch the memory of some columns' answers."""
    answer = desk.answer
    for at in (pixel, pixel + columns - 1):
        prefetch(answer.label + 4 * at)
        prefetch(answer.margin + at)
