"""What is read off the total cost of all labels of a pixel: the best one to a fraction of a label, and its rivals."""

from typing import Final, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

REACH: Final = 4
"""Labels to each side of the winner that its sub-label position is the mean of."""
RIVAL_REACH: Final = 2
"""The same of the rival, which the winner is not far from."""
MARGIN_FROM: Final = 3
"""Labels from the winner at which the margin's rivals begin: 1.5 pixels."""
RIVAL_FROM: Final = 6
"""Labels from the winner at which a second return may lie."""
NOTHING: Final = 255
"""Cost of a label that is excluded, and the largest total."""


class AnswerSettings(NamedTuple):
    """Which labels there are: stripes at 0..stripes-1, 'no stripe' at `none`; weights (256,): of a total's excess."""

    stripes: int
    none: int
    weights: NDArray[np.float32]


class Answer(NamedTuple):
    """Per (row, column). Labels are counted in labels, costs in eighths of a nat.

    label, spread: float32, mean and standard deviation of the labels around the winner, the stripe of the least total
    (ties: the smaller label). margin: uint8, the least total at least MARGIN_FROM labels away less the winner's. none:
    int16, total of 'no stripe' less the winner's. data: uint8, the winner's own cost. rival: float32, the best label at
    least RIVAL_FROM labels away, NaN where all of those have total 255; rival_data: its own cost.
    """

    label: NDArray[np.float32]
    spread: NDArray[np.float32]
    margin: NDArray[np.uint8]
    none: NDArray[np.int16]
    data: NDArray[np.uint8]
    rival: NDArray[np.float32]
    rival_data: NDArray[np.uint8]


def new_answer(rows: int, columns: int) -> Answer:
    """Room for the answers of a map."""
    shape = rows, columns
    real, byte = np.float32, np.uint8
    return Answer(*(np.zeros(shape, dtype) for dtype in (real, real, byte, np.int16, byte, real, byte)))


def answer_settings(stripes: int, none: int, beta: float = 0.5) -> AnswerSettings:
    """Settings for so many stripe labels; beta: weight exp(-beta excess), excess of a total in nats."""
    return AnswerSettings(stripes, none, np.exp(-beta * np.arange(256) / 8).astype(np.float32))


@numba.njit(cache=True, nogil=True)
def _around(cost, total, settings, winner, reach):  # type: ignore[no-untyped-def]
    """Mean and standard deviation of the labels around the winner.

    Only as far as both sides have labels: one side alone would draw every answer to it.
    """
    one, first, second = np.float32(1.0), np.float32(0.0), np.float32(0.0)
    for k in range(1, reach + 1):
        low, high = winner - k, winner + k
        if low < 0 or high >= settings.stripes or cost[low] == NOTHING or cost[high] == NOTHING:
            break
        a, b = settings.weights[total[low] - total[winner]], settings.weights[total[high] - total[winner]]
        one += a + b
        first += np.float32(k) * (b - a)
        second += np.float32(k * k) * (a + b)
    mean = first / one
    return winner + mean, np.sqrt(max(second / one - mean * mean, np.float32(0.0)))


@numba.njit(cache=True, nogil=True)
def _least(total, settings, winner, away):  # type: ignore[no-untyped-def]
    """Label of the least total at least `away` labels from the winner; -1 where there is none below 255."""
    best, least = -1, NOTHING
    for label in range(settings.stripes):
        if abs(label - winner) >= away and total[label] < least:
            best, least = label, total[label]
    return best, least


@numba.njit(cache=True, nogil=True)
def answer_pixel(cost, total, settings, row, column, out):  # type: ignore[no-untyped-def]
    """Write the answers of one pixel; cost, total: (labels,)."""
    winner = max(_least(total, settings, -NOTHING, 0)[0], 0)
    least = np.int64(total[winner])
    out.label[row, column], out.spread[row, column] = _around(cost, total, settings, winner, REACH)
    out.margin[row, column] = _least(total, settings, winner, MARGIN_FROM)[1] - least
    out.none[row, column] = np.int64(total[settings.none]) - least
    out.data[row, column] = cost[winner]
    rival = _least(total, settings, winner, RIVAL_FROM)[0]
    out.rival[row, column] = _around(cost, total, settings, rival, RIVAL_REACH)[0] if rival >= 0 else np.nan
    out.rival_data[row, column] = cost[rival] if rival >= 0 else NOTHING
