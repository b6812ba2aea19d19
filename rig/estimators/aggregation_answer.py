"""What the aggregation answers for each pixel, and the tables that its answers are read off with."""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

REACH: Final = 4
"""Labels to each side of the winner that its sub-label position is the mean of."""
MARGIN_FROM: Final = 3
"""Labels from the winner at which the margin's rivals begin: 1.5 pixels."""
LARGEST: Final = 255
"""Largest cost and total: of a label that is excluded."""
TAPS: Final = 2 * REACH + 1
POWERS: Final = 4
"""Numbers that are summed at once: powers 0 and 1 of the distance, and nothing."""
VECTOR: Final = 32
"""Labels that are worked on at once."""
MIDDLE: Final = VECTOR // 2
UNITS: Final = 8.0
"""Units of cost per nat of very few exposures; of K exposures UNITS / (1 + K / SHARP), see `label_volume`."""


class AnswerSettings(NamedTuple):
    """Which labels there are, stripes at 0..stripes-1, and tables of `answer_settings`.

    weights: float32 (256,), of a total's excess over the least. powers: float32 (REACH + 1, TAPS, POWERS), for each
    reach those of the taps within it. reach: uint8 (2^TAPS,), how far labels reach to both sides where the taps of the
    set bits are excluded. near: uint8 (VECTOR,) with the winner at MIDDLE, LARGEST at labels that do not count for the
    margin.
    """

    stripes: int
    weights: NDArray[np.float32]
    powers: NDArray[np.float32]
    reach: NDArray[np.uint8]
    near: NDArray[np.uint8]


class Answer(NamedTuple):
    """Per (row, column). Labels are counted in labels, costs in units (`UNITS`).

    label: float32, mean of the labels around the winner, the stripe of the least total (ties: the smaller label), only
    as far as both sides have labels: one side alone would draw every answer to it. margin: uint8, the least total at
    least MARGIN_FROM labels away less the winner's.
    """

    label: NDArray[np.float32]
    margin: NDArray[np.uint8]


def new_answer(rows: int, columns: int) -> Answer:
    """Room for the answers of a map."""
    return Answer(np.zeros((rows, columns), np.float32), np.zeros((rows, columns), np.uint8))


def answer_settings(stripes: int, beta: float = 0.5) -> AnswerSettings:
    """Settings for so many stripe labels; a label weighs exp(-beta * excess of its total / UNITS)."""
    weights = np.exp(-beta / UNITS * np.arange(LARGEST + 1)).astype(np.float32)
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
