"""Counts of one image row beside those of a whole sweep, for people who watch a run.

Estimators that judge a column as soon as it is complete keep the counts of few rows only. To count one row more takes
0.2 ms for 500 frames of 512 x 512 pixels, 4 % of the 5 ms that they last at 100 kHz. It is done only while somebody
follows a row.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.count.volume import Counter, FrameTally

_log = logging.getLogger(__name__)

_LONG = 4
"""Frames a column from which adding up column by column is faster than `reduceat`."""


@dataclass(frozen=True, slots=True, eq=False)
class FollowedRow:
    """A row of one sweep. counts: uint16 (bins, width), number of the bin's frames in which each pixel fired; 0 outside
    windows. Bins are columns or, with several lines, places of the mirror."""

    row: int
    counts: NDArray[np.uint16]


class RowWish(NamedTuple):
    """The wish to follow a row. wanted: called at the beginning of each sweep; returns the row to follow, or None.
    found: called at the end of each sweep with its row, if one was followed, before the sweep's counts are used. Both
    are called on the counting thread."""

    wanted: Callable[[], int | None]
    found: Callable[[FollowedRow], None]


class RowFollower:
    """A `Counter` that hands frames on to another one, and counts the wanted row of them as well.

    bins: number of columns, or of the mirror's places. width: of the sensor, in pixels.
    """

    def __init__(self, counter: Counter, wish: RowWish, bins: int, width: int) -> None:
        self._counter, self._wish = counter, wish
        self._shape = bins, width
        self._followed: FollowedRow | None = None

    def reset(self) -> None:
        """Begin the next sweep, and ask which row is wanted in it."""
        row = self._wish.wanted()
        self._followed = None if row is None else FollowedRow(row, np.zeros(self._shape, np.uint16))
        self._counter.reset()

    def add(
        self, bits: NDArray[np.uint8], bins: NDArray[np.int32], column: NDArray[np.float64], x0: NDArray[np.int32]
    ) -> None:
        """Add frames as in `Counter`. An error in counting the row is logged and ends the following for this sweep."""
        followed = self._followed
        if followed is not None and 0 <= followed.row < bits.shape[1]:
            try:
                add_row(followed.counts, bits[:, followed.row], bins, x0)
            except Exception as error:  # only for people who watch; no reason to end a run
                _log.warning("row %d is not followed in this sweep", followed.row, exc_info=error)
                self._followed = None
        self._counter.add(bits, bins, column, x0)

    def settle(self, under_way: int = 0) -> None:
        """Wait as the other counter does; a row is counted at once."""
        self._counter.settle(under_way)

    def finish(self) -> FrameTally:
        """The sweep as the other counter has counted it. The followed row, if any, is handed over first."""
        if self._followed is not None:
            self._wish.found(self._followed)
            self._followed = None
        return self._counter.finish()


def add_row(
    counts: NDArray[np.uint16], bits: NDArray[np.uint8], bins: NDArray[np.int32], x0: NDArray[np.int32]
) -> None:
    """Add one row of packed frames, bits (n, row bytes), to the counts (bins, width) of their bins (n,).

    Frames with a bin below 0 are not counted. x0: (n,), first pixel of each frame's row, if it is shorter than the
    sensor's.
    """
    if not len(bits):
        return
    pixels = np.unpackbits(bits, axis=1)
    whole = pixels.shape[1] >= counts.shape[1]
    first = np.zeros_like(x0) if whole else x0
    # Frames of a column follow one another: they are added up first.
    begins = np.flatnonzero(np.diff(bins, prepend=-9) | np.diff(first, prepend=first[:1]))
    if len(pixels) >= _LONG * len(begins):
        ends = (*begins[1:].tolist(), len(pixels))
        sums = [pixels[a:b].sum(axis=0, dtype=np.uint16) for a, b in zip(begins.tolist(), ends, strict=True)]
    else:
        sums = list(np.add.reduceat(pixels, begins, axis=0, dtype=np.uint16))
    for column, at, summed in zip(bins[begins].tolist(), first[begins].tolist(), sums, strict=True):
        if column >= 0:
            window = counts[column, at : at + pixels.shape[1]]
            window += summed[: len(window)]
