"""The order of a recording's blocks, and which of them contradict the others. A wrong number in one block costs only
that block.

Within a run the numbers of blocks, frames, ticks and sweeps never fall. If blocks contradict each other, the consistent
set with the largest sum of weights is kept. A block weighs more if it agrees with its neighbours and with the index.
"""

from bisect import bisect_left, bisect_right
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Entries = NDArray[Any]
"""Entries (n,) of INDEX_RECORD."""
Ints = NDArray[np.int64]

_NEIGHBOURS: Final = 2
"""Number of blocks on either side with whose numbers a block's numbers are compared."""
_OF_BLOCK: Final = 16
_OF_INDEX: Final = 8
"""Weight of a block, and the weight that a record in the index adds. Each agreeing neighbour adds 1. So one block never
outweighs two."""
_OUTLIERS: Final = 4
"""Blocks whose ticks (or sweeps) do not fit are left out only if they are at most one in this many, or a single one. If
there are more, the device probably counts like that, and all blocks are kept."""


def in_order(entries: Entries, told: Entries, problems: list[str], *, folder: bool) -> tuple[Entries, bool]:
    """The blocks, run after run and with rising numbers, without those that contradict others; and whether they are
    also in this order in the files.

    told: the sound records of the index, ordered by place; they give the order of the runs. problems: a line is
    appended for each reason why blocks are left out. folder: whether the segments are those of a run's folder, where
    each holds blocks of one run.
    """
    if len(entries) == 0:
        return entries, True
    by_place = np.sort(entries, order=["segment", "offset"], kind="stable")
    if folder:
        foreign = _foreign(by_place, told)
        if foreign.any():
            problems.append(f"{int(foreign.sum())} blocks are of another run than the rest of their segment")
        by_place = by_place[~foreign]
    kept = [mine[_rising(by_place[mine], told)] for mine in _runs(by_place, told)]
    order = np.concatenate(kept)
    if len(order) < len(by_place):
        problems.append(
            f"{len(by_place) - len(order)} blocks come twice, tell of frames of others, or have a number, time or "
            "sweep that does not fit those around them"
        )
    return by_place[order], bool((np.diff(order) > 0).all())


def _foreign(by_place: Entries, told: Entries) -> NDArray[np.bool_]:
    """Whether each block is of another run than its segment, bool (n,).

    The run of a segment is that of most of its blocks. A block that is alone in its segment is foreign if the index
    names another run, that run has other segments, and the block's own run has none.
    """
    run, segment = by_place["run_id"].astype(np.uint64), by_place["segment"].astype(np.uint64)
    runs, of_run = np.unique(run, return_counts=True)
    pairs, votes = np.unique(segment << np.uint64(32) | run, return_counts=True)
    at, claimed = pairs >> np.uint64(32), pairs & np.uint64(0xFFFFFFFF)
    best = np.lexsort((of_run[np.searchsorted(runs, claimed)], votes, at))
    best = best[np.append(at[best][1:] > at[best][:-1], True)]
    owned, owner = at[best], claimed[best]
    foreign: NDArray[np.bool_] = run != owner[np.searchsorted(owned, segment)]
    for number in np.flatnonzero(np.bincount(np.searchsorted(owned, segment)) == 1):
        i, others = int(np.searchsorted(segment, owned[number])), np.delete(owner, number)
        same = told[(told["segment"] == segment[i]) & (told["offset"] == by_place["offset"][i])]
        foreign[i] |= len(same) > 0 and run[i] not in others and int(same["run_id"][0]) in others
    return foreign


def _runs(by_place: Entries, told: Entries) -> list[Ints]:
    """Indices of each run's blocks. Runs are sorted by the median place of their records in the index; runs without
    records come last.
    """
    place = {run: float(np.median(at)) for run, at in _grouped(told["run_id"]).items()}
    mine = _grouped(by_place["run_id"])
    return [mine[run] for run in sorted(mine, key=lambda run: (run not in place, place.get(run, np.median(mine[run]))))]


def _grouped(values: NDArray[Any]) -> dict[int, Ints]:
    """Indices at which each value stands."""
    found, counts = np.unique(values, return_counts=True)
    pieces = np.split(np.argsort(values, kind="stable"), np.cumsum(counts)[:-1])
    return dict(zip(found.tolist(), pieces, strict=False))


def _rising(run: Entries, told: Entries) -> Ints:
    """Indices of the blocks that are kept, in the order of their numbers. run: a run's blocks, in order of place."""
    order: Ints = np.argsort(run["block_seq"], kind="stable")
    seq, first, t0, sweep = (run[name].astype(np.int64) for name in ("block_seq", "first_frame", "t0_ticks", "sweep"))
    end = first + run["n_frames"]
    frames_rise = (np.diff(seq[order]) > 0).all() and (first[order][1:] >= end[order][:-1]).all()
    if frames_rise and all((np.diff(rises[order]) >= 0).all() for rises in (t0, sweep)):
        return order
    known = {entry.tobytes() for entry in told}
    indexed = np.array([entry.tobytes() in known for entry in run])
    weight = _OF_BLOCK + _OF_INDEX * indexed + _agreeing(seq, first, t0, run["n_frames"].astype(np.int64))
    if not frames_rise:
        order = order[_heaviest(first[order], end[order], seq[order], weight[order])]
    for rises in (t0, sweep):
        kept = _heaviest(rises[order], rises[order], np.arange(len(order)), weight[order])
        if (len(order) - len(kept)) * _OUTLIERS <= max(len(order), _OUTLIERS):
            order = order[kept]
    return order


def _agreeing(seq: Ints, first: Ints, t0: Ints, n_frames: Ints) -> Ints:
    """Number of neighbours with which each block agrees, int64 (n,): the least of the counts for block number, frame
    number and ticks; 0 if its frames overlap those of the next block."""
    place = np.arange(len(seq))
    steps = np.diff(first)
    per_frame = float(np.median(np.diff(t0)[steps > 0] / steps[steps > 0])) if (steps > 0).any() else 0.0
    counted = seq - place, first - (np.cumsum(n_frames) - n_frames)
    votes = np.zeros((3, len(seq)), np.int64)
    for step in range(1, _NEIGHBOURS + 1):
        off = np.abs((t0[step:] - t0[:-step]) - per_frame * (first[step:] - first[:-step]))
        agree = *(of[step:] == of[:-step] for of in counted), off < max(1.0, abs(per_frame) / 2)
        for vote, yes in zip(votes, agree, strict=True):
            vote[step:] += yes
            vote[:-step] += yes
    reaches = np.append(first[1:] < (first + n_frames)[:-1], False)  # into the frames of the next one
    least: Ints = np.where(reaches, 0, votes.min(axis=0))
    return least


def _heaviest(low: Ints, high: Ints, group: Ints, weight: Ints) -> Ints:
    """Indices of the chain of items with the largest sum of weights. In a chain, each item's `low` is at least the
    `high` of the item before it, and no two items have the same `group`. group: must be sorted.
    """
    ends: list[int] = []  # last `high` of each chain so far, in rising order; the sums of weights rise too
    totals: list[int] = []
    lasts: list[int] = []
    before = np.full(len(low), -1)
    waiting: list[tuple[int, int, int]] = []
    for i, (a, b, of, mine) in enumerate(
        zip(low.tolist(), high.tolist(), group.tolist(), weight.tolist(), strict=True)
    ):
        if i and of != group[i - 1]:
            _extend(ends, totals, lasts, waiting)
        at = bisect_right(ends, a) - 1
        if at >= 0:
            before[i] = lasts[at]
        waiting.append((b, mine + (totals[at] if at >= 0 else 0), i))
    _extend(ends, totals, lasts, waiting)
    chain = [lasts[-1]]
    while before[chain[-1]] >= 0:
        chain.append(int(before[chain[-1]]))
    return np.array(chain[::-1], np.int64)


def _extend(ends: list[int], totals: list[int], lasts: list[int], waiting: list[tuple[int, int, int]]) -> None:
    """Add the chains that end with the items of one group. A chain is left out if another one ends no later and is at
    least as heavy.
    """
    for end, total, last in waiting:
        at = bisect_right(ends, end)
        if at and totals[at - 1] >= total:
            continue
        at = bisect_left(ends, end)
        stop = at
        while stop < len(ends) and totals[stop] <= total:
            stop += 1
        ends[at:stop], totals[at:stop], lasts[at:stop] = [end], [total], [last]
    waiting.clear()
