"""Vote on weak answers of `rig.estimate.joint.paths`, compiled: all neighbours decide together.

Four paths carry evidence along rows and columns only. If few photons come back, single rows or columns are wrong as a
whole and form streaks. So an answer is put to the vote if its margin, by which the next best position costs more, is
below WEAK. Candidates are its own label and those of the four nearest neighbours; the winner is the one with the least

    sum over 5 x 5 neighbours n of margin_n min(|label - label_n|, FAR)

But the old label stays if the winner's cost, without the messages of neighbours, exceeds that of the old label by more
than OBJECTION. The new margin is the sum of the margins of neighbours within SAME of the label, less that of all
others, divided by the number of neighbours (the answer included) and at least 0. So where streaks disagree, margins are
small. The vote rounds labels to int16 and divides margins (uint8, in units of cost) by SHARE, so that sums fit 16 bits.
"""

from typing import Final, NamedTuple

import numba
import numpy as np

from rig.estimate.joint.winner import LabelAnswers
from rig.simd import Float32, Int16, Uint8
from rig.simd.memory import (
    load_float32,
    load_int16,
    pointers,
    prefetch,
    read_byte,
    read_float32,
    read_int16,
    store_int16,
    write_byte,
    write_float32,
    write_int16,
)
from rig.simd.shuffles import equal_mask, lowest_bit
from rig.simd.vectors import LANES, larger, smaller, to_float32, to_int16, zero_int16

REACH: Final = 2
"""Rows and columns to either side that vote."""
SHARE_BITS: Final = 2
SHARE: Final = 1 << SHARE_BITS
"""Units of margin that make one vote, so that 16 bits hold the votes of all neighbours."""
NOWHERE: Final = 30000
"""Label outside the picture: farther than FAR from all others, so that it is never elected."""


class Ballots(NamedTuple):
    """Labels and votes of a map, with a border of at least REACH rows and columns without votes on every side.

    label: float32 as answered; whole: int16, the nearest integer; votes: int16, the margin divided by SHARE.
    """

    label: Float32
    whole: Int16
    votes: Int16


def new_ballots(rows: int, columns: int) -> Ballots:
    """Memory for the ballots of a map."""
    shape = rows + 2 * REACH, -(-columns // LANES) * LANES + LANES
    return Ballots(np.zeros(shape, np.float32), np.full(shape, NOWHERE, np.int16), np.zeros(shape, np.int16))


@numba.njit(cache=True, nogil=True)
def collect(answer: LabelAnswers, first_column: int, last_column: int, out: Ballots) -> None:
    """Fill the ballots of columns first_column..last_column-1."""
    # Local names: each use of the tuple itself in the loop would count references to all of its arrays.
    labels, margins, label, whole, votes = answer.label, answer.margin, out.label, out.whole, out.votes
    to = slice(first_column + REACH, last_column + REACH)
    for y in range(labels.shape[0]):
        own, margin = labels[y, first_column:last_column], margins[y, first_column:last_column]
        to_label, to_whole, to_votes = label[y + REACH, to], whole[y + REACH, to], votes[y + REACH, to]
        for c in range(own.shape[0]):
            to_label[c] = own[c]
            to_whole[c] = np.int16(own[c] + np.float32(0.5))
            to_votes[c] = margin[c] >> SHARE_BITS


NEIGHBOURS_PX: Final = 3.0
"""Largest distance of columns at which there is a vote: in dense fog, columns farther apart do not help each other."""
WEAK: Final = 48
"""Margin, in units of cost, from which on there is no vote on an answer."""
OBJECTION: Final = 8
"""Most units by which the elected label may cost more than the old one, by the row's own counts."""
FAR: Final = 16
"""Limit to distances between labels in a vote."""
SAME: Final = 2
"""Largest difference of labels that support one another: one pixel."""
_CANDIDATES: Final = 5


class _Hall(NamedTuple):
    """Arrays that a vote reads and writes; kernels get `pointers` to them.

    elected: int16 (width,), for each of a row's answers first the candidate's number, then the label. against: int16
    (candidates, LANES). share: float32 (width,), 1 / the number of voting columns. width: of the ballots.
    """

    ballots: Ballots
    cost: Uint8
    answer: LabelAnswers
    elected: Int16
    against: Int16
    share: Float32
    width: int
    columns: int
    labels: int


def vote(ballots: Ballots, cost: Uint8, first_row: int, last_row: int, answer: LabelAnswers) -> None:
    """Correct the answers of rows first_row..last_row-1; cost: (rows, columns, labels), C-contiguous.

    The ballots of all columns must have been collected before.
    """
    rows, columns, labels = cost.shape
    width = ballots.label.shape[1]
    elected, against = np.zeros(width, np.int16), np.zeros((_CANDIDATES, LANES), np.int16)
    c, share = np.arange(columns), np.zeros(width, np.float32)
    share[:columns] = 1.0 / (np.minimum(c + REACH, columns - 1) - np.maximum(c - REACH, 0) + 1)
    hall = _Hall(ballots, cost, answer, elected, against, share, width, columns, labels)
    _vote_rows(pointers(hall), rows, first_row, last_row)


@numba.njit(cache=True, nogil=True)
def _vote_rows(hall: _Hall, rows: int, first_row: int, last_row: int) -> None:
    for y in range(first_row, last_row):
        _elect_row(hall, y)
        _settle_row(hall, y, min(y + REACH, rows - 1) - max(y - REACH, 0) + 1)


@numba.njit(cache=True, nogil=True)
def _elect_row(hall: _Hall, y: int) -> None:
    """Elect a candidate for each weak answer of row y."""
    line = (y + REACH) * hall.width + REACH
    for c in range(0, hall.columns, LANES):
        weak = _weak_lanes(hall.ballots.votes, line + c, hall.columns - c)
        if weak == 0:
            continue
        _count_votes(hall.ballots.whole, hall.ballots.votes, line + c, hall.width, hall.against)
        best = _elect(hall.against)
        store_int16(hall.elected, c, best)
        moved = weak & ~np.int64(equal_mask(best, np.int16(0)))
        while moved != 0:
            i = np.int64(lowest_bit(np.uint32(moved)))
            moved &= moved - 1
            own = hall.cost + (y * hall.columns + c + i) * hall.labels
            other = line + c + i + _step(hall.width, read_int16(hall.elected, c + i))
            prefetch(own + read_int16(hall.ballots.whole, line + c + i))
            prefetch(own + read_int16(hall.ballots.whole, other))


@numba.njit(cache=True, nogil=True)
def _settle_row(hall: _Hall, y: int, high: int) -> None:
    """Reject elections to which the counts of row y object, and write its weak answers; high: number of voting rows."""
    line, down = (y + REACH) * hall.width + REACH, np.float32(1.0 / high)
    for c in range(0, hall.columns, LANES):
        pixel, at = y * hall.columns + c, line + c
        weak = _weak_lanes(hall.ballots.votes, at, hall.columns - c)
        if weak == 0:
            continue
        best = load_int16(hall.elected, c)
        moved = weak & ~np.int64(equal_mask(best, np.int16(0)))
        store_int16(hall.against, 0, best)
        store_int16(hall.elected, c, load_int16(hall.ballots.whole, at))
        while moved != 0:
            i = np.int64(lowest_bit(np.uint32(moved)))
            moved &= moved - 1
            own, other = hall.cost + (pixel + i) * hall.labels, at + i + _step(hall.width, read_int16(hall.against, i))
            label, least = read_int16(hall.ballots.whole, other), read_byte(own, read_int16(hall.ballots.whole, at + i))
            if np.int64(read_byte(own, label)) <= np.int64(least) + OBJECTION:
                write_int16(hall.elected, c + i, label)
                write_float32(hall.answer.label, pixel + i, read_float32(hall.ballots.label, other))
        _count_support(hall.ballots.whole, hall.ballots.votes, at, hall.width, hall.elected + 2 * c, hall.against)
        support = to_float32(larger(load_int16(hall.against, 0), np.int16(0)) * np.int16(SHARE))
        # Half a unit is added, so that no whole quotient is rounded down.
        share = (support + np.float32(0.5)) * (load_float32(hall.share, c) * down)
        store_int16(hall.against, 0, to_int16(share))
        while weak != 0:
            i = np.int64(lowest_bit(np.uint32(weak)))
            weak &= weak - 1
            write_byte(hall.answer.margin, pixel + i, np.uint8(read_int16(hall.against, i)))


@numba.njit(forceinline=True)
def _weak_lanes(votes, at, end):  # type: ignore[no-untyped-def]
    """A number with a bit for each of LANES answers, set if the answer is weak; never set from answer `end` on."""
    strong = equal_mask(smaller(load_int16(votes, at), np.int16(WEAK // SHARE)), np.int16(WEAK // SHARE))
    return ~np.int64(strong) & ((1 << min(LANES, end)) - 1)


@numba.njit(forceinline=True)
def _step(width, k):  # type: ignore[no-untyped-def]
    """Offset of candidate k in the ballots: the answer itself, then its neighbours left, right, above and below."""
    return (0, -1, 1, -width, width)[k]


@numba.njit(cache=True, nogil=True)
def _count_votes(whole: int, votes: int, at: int, width: int, room: int) -> None:
    """Write the votes against each candidate to room (candidates, LANES). whole, votes, room: addresses."""
    own, left, right = load_int16(whole, at), load_int16(whole, at - 1), load_int16(whole, at + 1)
    above, below = load_int16(whole, at - width), load_int16(whole, at + width)
    a = b = c = d = e = zero_int16()
    for line in range(at - REACH * width, at + REACH * width + 1, width):
        for i in range(line - REACH, line + REACH + 1):
            label, cast = load_int16(whole, i), load_int16(votes, i)
            a, b, c = a + cast * _apart(label, own), b + cast * _apart(label, left), c + cast * _apart(label, right)
            d, e = d + cast * _apart(label, above), e + cast * _apart(label, below)
    store_int16(room, 0, a)
    store_int16(room, LANES, b)
    store_int16(room, 2 * LANES, c)
    store_int16(room, 3 * LANES, d)
    store_int16(room, 4 * LANES, e)


@numba.njit(forceinline=True)
def _apart(label, other):  # type: ignore[no-untyped-def]
    off = label - other
    return smaller(larger(off, zero_int16() - off), np.int16(FAR))


@numba.njit(forceinline=True)
def _elect(against):  # type: ignore[no-untyped-def]
    """Number of each lane's candidate with the fewest votes against it, the first of equal ones."""
    none, least = zero_int16(), load_int16(against, 0)
    best = none
    for k in range(1, _CANDIDATES):
        here = load_int16(against, k * LANES)
        fewer = smaller(larger(least - here, none), np.int16(1))
        best = best + fewer * (none + np.int16(k) - best)
        least = smaller(least, here)
    return best


@numba.njit(cache=True, nogil=True)
def _count_support(whole: int, votes: int, at: int, width: int, elected: int, room: int) -> None:
    """Write the votes for elected labels, less those for others, to room (LANES,). All but at and width: addresses."""
    own, none = load_int16(elected, 0), zero_int16()
    support, total = none, none
    for line in range(at - REACH * width, at + REACH * width + 1, width):
        for i in range(line - REACH, line + REACH + 1):
            off, cast = load_int16(whole, i) - own, load_int16(votes, i)
            near = larger(none + np.int16(SAME + 1) - larger(off, none - off), none)
            support = support + cast * smaller(near, np.int16(1))
            total = total + cast
    store_int16(room, 0, support + support - total)
