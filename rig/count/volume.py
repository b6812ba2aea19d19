"""Counts per column from packed frames: bits are added in bit-sliced form and never unpacked outside the window.

`rig.count.kernels` does the adding. `SweepCounter` keeps the counts of a whole sweep, unsigned integers (columns, rows,
window), and `LineCounter` those of a rig with several lines. Estimators that judge a column as soon as it is complete
have their own counter, which keeps less. All of them follow `Counter` and also record a `FrameTally`.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rig.geometry.line_grid import LineGrid
from rig.geometry.windows import WORD_PX
from rig.threads import RowWorkers

MOST_WIDTH_PX = WORD_PX * 256
"""Widest row: its words must fit one chunk of the counters."""
BIN_DARK = -1
"""Bin of a frame with the gate low during the whole exposure."""
BIN_UNUSABLE = -2
"""Bin of a frame that is not counted, such as one with a gate edge inside, off all columns, repeated or damaged."""
BYTE_FRAMES = 255
"""Most frames of a column that counters of 8 bits hold."""
BYTE_EXPOSURES = 200
"""Most nominal exposures for 8-bit counters: up to this, binding lets no column have more than BYTE_FRAMES frames."""

Counts = NDArray[np.unsignedinteger[Any]]
"""uint8, uint16 or uint32, as wide as the counts need."""


@dataclass(frozen=True, slots=True, eq=False)
class SweepLayout:
    """Pixels of each column that are counted: `window` pixels from x0 (columns,) on. rows, width: of the sensor.

    exposures: frames nominally taken per column. used_px: pixels used per row of a frame; None for whole rows.
    dark: whether there will be frames with the gate low.
    """

    columns: int
    rows: int
    width: int
    x0: NDArray[np.int32]
    window: int
    exposures: int
    used_px: int | None = None
    dark: bool = True

    def __post_init__(self) -> None:
        """Raises ValueError for windows that are not on whole words, and for rows too wide."""
        if self.padded_width > MOST_WIDTH_PX:
            raise ValueError(f"rows of {self.width} pixels; counters take {MOST_WIDTH_PX} at most")
        if self.window % WORD_PX or np.any(self.x0 % WORD_PX):
            raise ValueError(f"window {self.window} and its starts must be multiples of {WORD_PX} pixels")

    @property
    def padded_width(self) -> int:
        """Pixels of a row as stored in memory, including padding."""
        return -(-self.width // WORD_PX) * WORD_PX

    @property
    def used_words(self) -> int:
        """Number of words of each row that are used."""
        return (self.padded_width if self.used_px is None else self.used_px) // WORD_PX


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameTally:
    """Frames of a sweep, which every counter records besides the counts.

    n_frames: (columns,), frames in each column's bin. column: (columns,), mean fractional column of those frames, NaN
    if there are none. dark_counts: (rows, width), ones over n_dark frames with the gate low, None if there are none.
    width: of the sensor, pixels. dark_frames: (width,), number of the n_dark frames in which a pixel was used; None: in
    all of them. velocity_per_s: of the mirror command over the columns, negative if it fell, 0 if unknown. doubts: of
    the frames' order and time (`rig.count.sweep_watch`).
    """

    n_frames: NDArray[np.int32]
    column: NDArray[np.float64]
    dark_counts: NDArray[np.uint32] | None
    n_dark: int
    width: int
    dark_frames: NDArray[np.int32] | None = None
    velocity_per_s: float = 0.0
    doubts: tuple[str, ...] = ()

    def intensity(self, workers: RowWorkers | None = None) -> NDArray[np.uint32]:
        """Counts summed over the columns, (rows, width) uint32. workers: threads that share the work. Raises
        NotImplementedError except in subclasses that keep counts."""
        raise NotImplementedError

    def bound_column(self) -> NDArray[np.float64]:
        """Mean fractional column of each column's frames (columns,); the column's centre if it has none."""
        return np.where(self.n_frames > 0, self.column, np.arange(len(self.column), dtype=np.float64))


@dataclass(frozen=True, slots=True, kw_only=True)
class CountVolume(FrameTally):
    """Counts of one sweep.

    counts: (columns, rows, window) uint8, uint16 or uint32, 1s of each pixel over the frames of the column.
    x0: (columns,) int32, first pixel of each column's window. exposures: frames nominally taken per column.
    """

    counts: Counts
    x0: NDArray[np.int32]
    exposures: int

    def intensity(self, workers: RowWorkers | None = None) -> NDArray[np.uint32]:
        """Counts summed over the columns, (rows, width) uint32. workers: threads that share the work."""
        from rig.count.kernels import sum_columns

        _, rows, window = self.counts.shape
        out = np.zeros((rows, max(self.width, int(self.x0.max(initial=0)) + window)), np.uint32)
        share = partial(sum_columns, self.counts, self.x0, out)
        if workers is None:
            share(0, rows)
        else:
            workers.over(rows, share)
        return out[:, : self.width]


class Counter(Protocol):
    """Takes the frames of one sweep after another. Results depend neither on threads nor on the size of blocks."""

    def reset(self) -> None:
        """Begin the next sweep."""

    def add(
        self, bits: NDArray[np.uint8], bins: NDArray[np.int32], column: NDArray[np.float64], x0: NDArray[np.int32]
    ) -> None:
        """Add packed frames `bits` (n, rows, row bytes) to `bins` (n,); `column` (n,): each frame's fractional column.

        Row bytes are a multiple of 8. A bin is a column (with several lines, a place of the mirror), BIN_DARK or
        BIN_UNUSABLE; the frames of a column follow one another. x0: (n,), first used pixel of each frame, a multiple of
        64; if rows are shorter than the sensor's, their first pixel. The used pixels of a frame on a column must
        contain that column's window. The frames may still be read after this returns, see `settle`.
        """

    def settle(self, under_way: int = 0) -> None:
        """Wait until the frames of all but the last `under_way` calls of `add` have been read."""

    def finish(self) -> FrameTally:
        """The counted sweep. Call `reset` before counting the next one."""
        ...


class SweepTally:
    """Adds up a sweep's `FrameTally`: frames per column, their mean column, and dark counts."""

    def __init__(self, layout: SweepLayout) -> None:
        from rig.count.lane_order import PAIRS
        from rig.simd.vectors import LANES

        self._layout = layout
        self.dark = np.zeros((layout.rows, PAIRS, layout.padded_width // 8 + LANES, 2), np.int32)
        """Sums of the ones of dark frames in lane order, filled by kernels. A row ends with room for a whole vector."""
        self.reset()

    def reset(self) -> None:
        """Begin the next sweep."""
        self.n_frames = np.zeros(self._layout.columns, np.int32)
        self._column_sum = np.zeros(self._layout.columns, np.float64)
        self.dark.fill(0)
        self._n_dark = 0
        self._dark_frames = np.zeros(self._layout.padded_width, np.int32)

    def note(self, bins: NDArray[np.int32], column: NDArray[np.float64], first_word: NDArray[np.int32]) -> None:
        """Record the frames of a block; bins, column: as in `Counter.add`. first_word: (n,), word at which each frame's
        used pixels begin."""
        lit = bins >= 0
        if lit.any():
            here, columns = bins[lit], self._layout.columns
            self.n_frames += np.bincount(here, minlength=columns).astype(np.int32)
            # Frames are added one by one, in order: the rounding of the sum must not depend on where a block ends.
            np.add.at(self._column_sum, here, column[lit])
        dark = first_word[bins == BIN_DARK]
        if len(dark):
            self._n_dark += len(dark)
            for word, frames in zip(*np.unique(dark, return_counts=True), strict=True):
                self._dark_frames[WORD_PX * word : WORD_PX * (word + self._layout.used_words)] += frames

    def finish(self) -> FrameTally:
        """The tally so far."""
        from rig.count.lane_order import pixel_order

        layout = self._layout
        column = np.where(self.n_frames > 0, self._column_sum / np.maximum(self.n_frames, 1), np.nan)
        dark = pixel_order(self.dark, layout.width).astype(np.uint32) if self._n_dark else None
        dark_frames = None if layout.used_px is None else self._dark_frames[: layout.width]
        return FrameTally(
            n_frames=self.n_frames, column=column, dark_counts=dark, n_dark=self._n_dark, width=layout.width,
            dark_frames=dark_frames,
        )  # fmt: skip


def with_room(counts: Counts, n_frames: NDArray[np.int32]) -> Counts:
    """`counts`, or a copy in a wider type if columns of `n_frames` (columns,) frames could overflow."""
    most = int(n_frames.max(initial=0))
    for wider in (np.uint16, np.uint32):
        if most <= np.iinfo(counts.dtype).max:
            break
        counts = counts.astype(wider)
    return counts


class SweepCounter:
    """A `Counter` that keeps the counts of a whole sweep: a `CountVolume`."""

    def __init__(self, layout: SweepLayout, workers: RowWorkers) -> None:
        self._layout = layout
        self._workers = workers
        self._bins = layout
        """Layout whose columns are the bins of frames."""
        self._columns_at = np.arange(layout.columns, dtype=np.int32)[:, None]
        """Columns (bins, lines) that each bin's frames are counted for."""
        self.reset()

    def reset(self) -> None:
        """Begin the next sweep."""
        layout = self._layout
        self._counts: Counts = np.zeros((layout.columns, layout.rows, layout.window), np.uint8)
        self._tally = SweepTally(self._bins)

    def add(
        self, bits: NDArray[np.uint8], bins: NDArray[np.int32], column: NDArray[np.float64], x0: NDArray[np.int32]
    ) -> None:
        """Add frames as in `Counter`."""
        from rig.count.kernels import add_runs

        layout, first_word = self._layout, x0 // np.int32(WORD_PX)
        self._tally.note(bins, column, first_word)
        self._counts = with_room(self._counts, self._tally.n_frames)
        words, row_words = bits.reshape(-1).view(np.uint64), bits.shape[2] // 8

        def work(first: int, last: int) -> None:
            add_runs(
                words, first_word, row_words, layout.used_words, bins, self._columns_at, layout.x0, self._counts,
                self._tally.dark, first, last,
            )  # fmt: skip

        self._workers.over(layout.rows, work)

    def settle(self, under_way: int = 0) -> None:
        """Do nothing, since `add` leaves no work unfinished."""

    def finish(self) -> CountVolume:
        """The counts so far."""
        tally = self._tally.finish()
        return CountVolume(
            counts=self._counts, x0=self._layout.x0, n_frames=tally.n_frames, column=tally.column,
            dark_counts=tally.dark_counts, n_dark=tally.n_dark, width=tally.width, dark_frames=tally.dark_frames,
            exposures=self._layout.exposures,
        )  # fmt: skip


class LineCounter(SweepCounter):
    """The counter of a rig with several lines. Its bins are places of the mirror, and its frames have whole rows.

    Frames of a place are added once, and each line's window is read from the result. The layout and the volume have the
    columns of all lines.
    """

    def __init__(self, layout: SweepLayout, grid: LineGrid, workers: RowWorkers) -> None:
        super().__init__(layout, workers)
        self._grid = grid
        self._bins = replace(layout, columns=grid.places, x0=layout.x0[: grid.places])
        self._columns_at = grid.columns_at()
        self.reset()

    def finish(self) -> CountVolume:
        """The counts so far. `n_frames` of a column is that of its mirror place; `column` is the column's index plus
        the mean distance of these frames from the place's centre."""
        place, volume = self._grid.place, super().finish()
        column = np.arange(len(place)) + (volume.column - np.arange(self._grid.places))[place]
        return replace(volume, n_frames=volume.n_frames[place], column=column)
