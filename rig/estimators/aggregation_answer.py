"""What is read off the total cost of all labels of a pixel: the best one to a fraction of a label, and its rivals."""

from typing import Final, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rig.lane_memory import (
    address_of,
    load_block,
    load_bytes,
    load_four,
    read_byte,
    read_float32,
    read_int16,
    read_int32,
    store_bytes,
    store_four,
    write_byte,
    write_float32,
    write_int16,
    write_int32,
)
from rig.lane_shuffles import equal_bytes, first_equal
from rig.lanes import BLOCK, BYTES, smaller_unsigned, smallest_byte, zero_four

REACH: Final = 4
"""Labels to each side of the winner that its sub-label position is the mean of."""
RIVAL_REACH: Final = 2
"""The same of the rival, which lies on the winner's slope more often than not."""
MARGIN_FROM: Final = 3
"""Labels from the winner at which the margin's rivals begin: 1.5 pixels."""
RIVAL_FROM: Final = 6
"""Labels from the winner at which a second return may lie."""
LARGEST: Final = 255
"""Largest total, and that of a label that is excluded."""
_VECTOR: Final = BYTES.count
_BLOCK: Final = BLOCK.count
_TAPS: Final = 2 * REACH + 1
_POWERS: Final = 4
_MIDDLE: Final = _VECTOR // 2


class AnswerSettings(NamedTuple):
    """Which labels there are: stripes at 0..stripes-1, 'no stripe' at `none`; and tables of `answer_settings`.

    Every other label must cost LARGEST. weights: float32 (256,), of a total's excess over the least. powers: float32
    (REACH + 1, taps, 4), for each reach the powers 0, 1, 2 of the distance of the taps within it. reach: uint8
    (2^taps,), how far labels reach to both sides where those of the set bits are excluded. ring, near: uint8 (vector,),
    around the winner: LARGEST but where a label counts for the margin, yet may be no rival; and where it may be none.
    """

    stripes: int
    none: int
    weights: NDArray[np.float32]
    powers: NDArray[np.float32]
    reach: NDArray[np.uint8]
    ring: NDArray[np.uint8]
    near: NDArray[np.uint8]


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
    real, byte = np.float32, np.uint8
    return Answer(*(np.zeros((rows, columns), dtype) for dtype in (real, real, byte, np.int16, byte, real, byte)))


def answer_settings(stripes: int, none: int, beta: float = 0.5) -> AnswerSettings:
    """Settings for so many stripe labels; a label weighs exp(-beta * excess of its total in nats)."""
    weights = np.exp(-beta * np.arange(LARGEST + 1) / 8).astype(np.float32)
    distance = np.arange(-REACH, REACH + 1)
    powers = np.zeros((REACH + 1, _TAPS, _POWERS), np.float32)
    for reach in range(REACH + 1):
        powers[reach, :, :3] = (np.abs(distance) <= reach)[:, None] * distance[:, None] ** np.arange(3.0)
    excluded = (np.arange(1 << _TAPS)[:, None] >> np.arange(_TAPS)) & 1
    # Only as far as both sides have labels: one side alone would draw every answer to it.
    pairs = excluded[:, REACH + 1 :] | excluded[:, REACH - 1 :: -1]
    reach_of = np.where(pairs.any(axis=1), pairs.argmax(axis=1), REACH).astype(np.uint8)
    away = np.abs(np.arange(_VECTOR) - _MIDDLE)
    near = np.where(away < RIVAL_FROM, LARGEST, 0).astype(np.uint8)
    ring = np.where((away < RIVAL_FROM) & (away >= MARGIN_FROM), 0, LARGEST).astype(np.uint8)
    return AnswerSettings(stripes, none, weights, powers, reach_of, ring, near)


class Fields(NamedTuple):
    """Addresses of what `Answer` has."""

    label: int
    spread: int
    margin: int
    none: int
    data: int
    rival: int
    rival_data: int


class Desk(NamedTuple):
    """What columns are answered with: numbers (labels, size, end, none) and addresses.

    totals: uint8, `size` bytes from column to column, at least a vector of LARGEST before and behind each. end: labels
    up to the end of the last vector with stripes. The tables are those of `AnswerSettings`, answer the fields of
    `Answer`. Of each column: winner, int32, its label; least, ring_least: bytes, its total and the least in the ring.
    moments: 4 float32, sums of the weights times each power.
    """

    labels: int
    size: int
    end: int
    none: int
    totals: int
    weights: int
    powers: int
    reach: int
    ring: int
    near: int
    winner: int
    least: int
    ring_least: int
    moments: int
    answer: Fields


@numba.njit(cache=True, nogil=True)
def desk_memory(columns: int, labels: int) -> NDArray[np.uint8]:
    """Memory of a desk for so many columns; must live as long as the desk."""
    return np.full((columns + 1) * (labels + 2 * _BLOCK), LARGEST, np.uint8)


@numba.njit(cache=True, nogil=True)
def desk_of(settings: AnswerSettings, out: Answer, memory: NDArray[np.uint8], columns: int, labels: int) -> Desk:
    """A desk; its totals begin at a multiple of their vectors."""
    size = -(-labels // _BLOCK) * _BLOCK + 2 * _VECTOR
    totals = -(-address_of(memory) // _VECTOR) * _VECTOR + _VECTOR
    numbers = totals + columns * size
    answer = Fields(
        address_of(out.label), address_of(out.spread), address_of(out.margin), address_of(out.none),
        address_of(out.data), address_of(out.rival), address_of(out.rival_data),
    )  # fmt: skip
    return Desk(
        labels, size, -(-settings.stripes // _BLOCK) * _BLOCK, settings.none, totals, address_of(settings.weights),
        address_of(settings.powers), address_of(settings.reach), address_of(settings.ring), address_of(settings.near),
        numbers, numbers + 4 * columns, numbers + 5 * columns, numbers + 8 * columns, answer,
    )  # fmt: skip


@numba.njit(forceinline=True)
def _least(totals, end):  # type: ignore[no-untyped-def]
    """The least total and its label, the smallest such one."""
    low = load_block(totals, 0)
    for block in range(_BLOCK, end, _BLOCK):
        low = smaller_unsigned(low, load_block(totals, block))
    least, label = smallest_byte(low), 0
    for block in range(end - _BLOCK, -1, -_BLOCK):
        place = first_equal(load_block(totals, block), least)
        label = block + place if place < _BLOCK else label
    return least, label


@numba.njit(forceinline=True)
def _moments(around, least, reach, taps, desk):  # type: ignore[no-untyped-def]
    """Sums over the labels around the one whose total is at address `around`, up to `taps` to both sides."""
    sums = zero_four()
    weights, powers = desk.weights - 4 * np.int64(least), desk.powers + 4 * _POWERS * (_TAPS * reach + REACH)
    for k in range(-taps, taps + 1):
        weight = read_float32(weights, np.int64(read_byte(around, k)))
        sums = sums + load_four(powers, _POWERS * k) * weight
    return sums


@numba.njit(forceinline=True)
def _reach(window, desk):  # type: ignore[no-untyped-def]
    """Labels to both sides of the middle one of a vector of totals that are not excluded."""
    excluded = np.int64(equal_bytes(window, LARGEST)) >> (_MIDDLE - REACH)
    return np.int64(read_byte(desk.reach, excluded & ((1 << _TAPS) - 1)))


@numba.njit(cache=True, nogil=True)
def _find_winners(pixel: int, columns: int, desk: Desk) -> None:
    """Winner and least total of each column; none is no longer among its totals."""
    for c in range(columns):
        totals = desk.totals + c * desk.size
        write_int16(desk.answer.none, pixel + c, np.int16(read_byte(totals, desk.none)))
        write_byte(totals, desk.none, np.uint8(LARGEST))
    for c in range(columns):
        least, winner = _least(desk.totals + c * desk.size, desk.end)
        write_int32(desk.winner, c, np.int32(winner))
        write_byte(desk.least, c, least)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _look_around(cost: int, pixel: int, columns: int, desk: Desk) -> None:
    """What the winners' surroundings tell; those are no longer among the totals."""
    answer = desk.answer
    ring, near = load_bytes(desk.ring, 0), load_bytes(desk.near, 0)
    for c in range(columns):
        winner, least = np.int64(read_int32(desk.winner, c)), read_byte(desk.least, c)
        around = desk.totals + c * desk.size + winner
        window = load_bytes(around, -_MIDDLE)
        write_byte(desk.ring_least, c, smallest_byte(window | ring))
        store_four(desk.moments, 0, _moments(around, least, _reach(window, desk), REACH, desk))
        store_bytes(around, -_MIDDLE, window | near)
        share = np.float32(1.0) / read_float32(desk.moments, 0)
        mean, square = read_float32(desk.moments, 1) * share, read_float32(desk.moments, 2) * share
        write_float32(answer.label, pixel + c, np.float32(winner) + mean)
        write_float32(answer.spread, pixel + c, np.sqrt(max(square - mean * mean, np.float32(0.0))))
        write_int16(answer.none, pixel + c, np.int16(read_int16(answer.none, pixel + c) - np.int16(least)))
        write_byte(answer.data, pixel + c, read_byte(cost, c * desk.labels + winner))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _find_rivals(cost: int, pixel: int, columns: int, desk: Desk) -> None:
    """The best one of what is left of each column's totals."""
    answer = desk.answer
    for c in range(columns):
        totals = desk.totals + c * desk.size
        least, rival = _least(totals, desk.end)
        reach = min(_reach(load_bytes(totals, rival - _MIDDLE), desk), RIVAL_REACH)
        store_four(desk.moments, 0, _moments(totals + rival, least, reach, RIVAL_REACH, desk))
        mean = read_float32(desk.moments, 1) / read_float32(desk.moments, 0)
        found = least < LARGEST
        write_float32(answer.rival, pixel + c, np.float32(rival) + mean if found else np.float32(np.nan))
        write_byte(answer.rival_data, pixel + c, read_byte(cost, c * desk.labels + rival) if found else np.uint8(LARGEST))
        margin = min(least, read_byte(desk.ring_least, c)) - read_byte(desk.least, c)
        write_byte(answer.margin, pixel + c, np.uint8(margin))


@numba.njit(cache=True, nogil=True)
def answer_columns(cost: int, pixel: int, columns: int, desk: Desk) -> None:
    """Answer columns from the desk's totals, which are not the same afterwards.

    cost: address of the first one's costs; pixel: its place among the answers.
    """
    # In rounds over the columns: what one waits for, others fill, above all for bytes that were just written to be
    # read back as parts of other vectors.
    _find_winners(pixel, columns, desk)
    _look_around(cost, pixel, columns, desk)
    _find_rivals(cost, pixel, columns, desk)
