"""Compiled: how far a map's answers agree with those around them, which is what tells a surface from nothing at all.

Where a stripe is, answers lie on a surface. Where there is none, in a shadow or behind the end of the haze, every row
finds what its noise looks most like; four paths tie those answers into streaks, but not into surfaces. So each answer
is asked how many of its 5 x 5 neighbours are on the same surface (`count_neighbours`), and a place how many of all
such pairs there are among the 7 x 7 answers around it (`agreement_row`). Only the former are stored, 16 bits each.
Thin things have few such neighbours, slanted ones fewer; but an answer that is wrong is mostly not where those opposite
each other put it, whatever the slope (`apart_row`).

Speed: 0.5 ms for 512 x 500 answers, with all that `joint_confidence` does 2.1 (Zen 3, AVX2, one thread).
"""

from typing import Final, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rig.estimators.label_volume_buffers import signed_address
from rig.estimators.placing_pools import COPIED_ROWS, MARGIN, SAME_PX, with_margin
from rig.lane_memory import load_float32, load_int16, store_float32, store_int16
from rig.lanes import LANES, to_float32, to_int16, where_small, zero_float32, zero_int16

NEIGHBOURS: Final = 2
"""Rows and columns to either side in which neighbours are counted."""
AROUND: Final = 3
"""The same of the answers whose neighbours are counted."""
OPPOSITE: Final = 2, 4
"""Rows and columns to the neighbours that lie opposite each other."""
ASKED: Final = 4 * len(OPPOSITE)
"""Pairs of them: along rows, columns and both diagonals."""
_ANYWHERE: Final = np.float32(1e6)


class Neighbours(NamedTuple):
    """How many neighbours of each answer lie on its surface, and how many there are to ask.

    number: int16 (rows, columns) with AROUND rows and LANES columns around, 0 there. pairs: of `pairs_to_ask`.
    """

    number: NDArray[np.int16]
    pairs: NDArray[np.float32]


def new_neighbours(pairs: NDArray[np.float32]) -> Neighbours:
    """Room for a map with so many pairs to ask."""
    rows, columns = pairs.shape
    return Neighbours(np.zeros((rows + 2 * AROUND, (-(-columns // LANES) + 2) * LANES), np.int16), pairs)


def pairs_to_ask(there: NDArray[np.bool_]) -> NDArray[np.float32]:
    """How many pairs of neighbours there are around each place (rows, columns), both of them there; at least 1.

    there: whether a place is searched and has frames; others have no say.
    """
    weight = there.astype(np.int16)
    return np.maximum(_around(weight * _around(weight, NEIGHBOURS), AROUND), 1).astype(np.float32)


def _around(number: NDArray[np.int16], reach: int) -> NDArray[np.int16]:
    """Sums over so many rows and columns to either side."""
    (rows, columns), wide = number.shape, np.pad(number, reach)
    tall = wide[:rows].copy()
    for i in range(1, 2 * reach + 1):
        tall += wide[i : i + rows]
    total = tall[:, :columns].copy()
    for i in range(1, 2 * reach + 1):
        total += tall[:, i : i + columns]
    return total


@numba.njit(cache=True, nogil=True)
def count_neighbours(distance: NDArray[np.float32], first_row: int, last_row: int, out: Neighbours) -> None:
    """Fill number of rows first_row..last_row-1; distance: (rows, columns) of answers from the far end, NaN: none."""
    for band in range(first_row, last_row, COPIED_ROWS):
        end = min(band + COPIED_ROWS, last_row)
        copy = with_margin(distance, band, end)
        at, to, width = signed_address(copy), signed_address(out.number), copy.shape[1]
        for y in range(band, end):
            _count_row(at, (y - band + MARGIN) * width + LANES, width, to, (y + AROUND) * width + LANES)
        copy[:1] = 0.0  # it lives until here


@numba.njit(cache=True, nogil=True)
def _count_row(distance: int, here: int, width: int, number: int, there: int) -> None:
    """A row's numbers, from element `there` on, of the distances from element `here` on; both of addresses."""
    one = zero_float32() + np.float32(1.0)
    for c in range(0, width - 2 * LANES, LANES):
        own, same = load_float32(distance, here + c), zero_float32()
        for away in range(-NEIGHBOURS, NEIGHBOURS + 1):
            line = here + c + away * width
            for i in range(line - NEIGHBOURS, line + NEIGHBOURS + 1):
                same = same + where_small(one, load_float32(distance, i) - own, SAME_PX)
        store_int16(number, there + c, to_int16(same))


@numba.njit(cache=True, nogil=True)
def agreement_row(number: int, width: int, y: int, line: int, out: int) -> None:
    """Pairs that agree around each answer of row y, float32 to `out`.

    All but numbers addresses: number and its width as in `Neighbours`; line: int16 (width,), whose margins are 0.
    """
    for c in range(0, width - 2 * LANES, LANES):
        pairs = zero_int16()
        for row in range(y, y + 2 * AROUND + 1):
            pairs = pairs + load_int16(number, row * width + LANES + c)
        store_int16(line, LANES + c, pairs)
    for c in range(0, width - 2 * LANES, LANES):
        pairs = zero_int16()
        for i in range(c - AROUND, c + AROUND + 1):
            pairs = pairs + load_int16(line, LANES + i)
        store_float32(out, c, to_float32(pairs))


@numba.njit(cache=True, nogil=True)
def apart_row(placed: int, width: int, here: int, out: int) -> None:
    """Pairs of opposite neighbours whose mean is not within SAME_PX of the answer between them, float32 to `out`.

    placed: address of a copy `with_margin` of final distances, width wide; here: the row's first answer in it.
    """
    one, half = zero_float32() + np.float32(1.0), np.float32(0.5)
    for c in range(0, width - 2 * LANES, LANES):
        own, apart = load_float32(placed, here + c), zero_float32()
        for step in OPPOSITE:
            for away in (1, width - 1, width, width + 1):
                before, behind = here + c - step * away, here + c + step * away
                off = (load_float32(placed, before) + load_float32(placed, behind)) * half - own
                apart = apart + where_small(one, off, _ANYWHERE) - where_small(one, off, SAME_PX)
        store_float32(out, c, apart)


@numba.njit(cache=True, nogil=True)
def light_row(at: tuple[int, int], width: int, here: int, out: int, apart: int) -> None:
    """Numbers of 3 x 3 neighbours on the surface of each answer of a row, and `apart` further on their light.

    at: addresses of distances and light, copies `with_margin`, width wide; here: the row's first answer in them.
    """
    one = zero_float32() + np.float32(1.0)
    for c in range(0, width - 2 * LANES, LANES):
        own, number, total = load_float32(at[0], here + c), zero_float32(), zero_float32()
        for line in range(here + c - width, here + c + width + 1, width):
            for i in range(line - 1, line + 2):
                off = load_float32(at[0], i) - own
                number = number + where_small(one, off, SAME_PX)
                total = total + where_small(load_float32(at[1], i), off, SAME_PX)
        store_float32(out, c, number)
        store_float32(out, apart + c, total)
