"""The counter of a rig with several lines: each frame is counted once, for one column of every line."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rig.counting import Counts, CountVolume, SweepLayout, SweepTally, with_room
from rig.geometry import WORD_PX
from rig.multi_line import LineGrid
from rig.row_threads import RowWorkers


class LineCounter:
    """A `Counter` whose bins are places of the mirror and whose `CountVolume` has the columns of all lines.

    layout: of the columns. Frames come as whole rows.
    """

    def __init__(self, layout: SweepLayout, grid: LineGrid, workers: RowWorkers) -> None:
        self._layout = layout
        self._grid = grid
        self._columns_at = grid.columns_at()
        self._places = replace(layout, columns=grid.places, x0=layout.x0[: grid.places])
        self._workers = workers
        self.reset()

    def reset(self) -> None:
        """Begin the next sweep."""
        layout = self._layout
        self._counts: Counts = np.zeros((layout.columns, layout.rows, layout.window), np.uint8)
        self._tally = SweepTally(self._places)

    def add(
        self, bits: NDArray[np.uint8], bins: NDArray[np.int32], column: NDArray[np.float64], x0: NDArray[np.int32]
    ) -> None:
        """Add frames, see `Counter`. Raises ValueError for frames that are not of whole rows."""
        from rig.counting_kernels import add_runs
        from rig.multi_line_kernels import add_line_runs

        layout, first_word = self._layout, x0 // np.int32(WORD_PX)
        if bits.shape[2] * 8 != layout.padded_width:
            raise ValueError(
                f"frames of {bits.shape[2] * 8} pixels a row; several lines need all {layout.padded_width}"
            )
        self._tally.note(bins, column, first_word)
        self._counts = with_room(self._counts, self._tally.n_frames)
        words, row_words = bits.reshape(-1).view(np.uint64), bits.shape[2] // 8
        unlit = self._counts[:0]

        def work(first: int, last: int) -> None:
            add_line_runs(words, row_words, bins, self._columns_at, layout.x0, self._counts, first, last)
            add_runs(
                words, first_word, row_words, layout.used_words, bins, layout.x0, unlit, self._tally.dark, first, last
            )

        self._workers.over(layout.rows, work)

    def settle(self, under_way: int = 0) -> None:
        """Nothing is left over by `add`."""

    def finish(self) -> CountVolume:
        """The counts so far; a column's frames are those of its place, as far off its centre as they were off that."""
        place, tally = self._grid.place, self._tally.finish()
        column = np.arange(len(place)) + (tally.column - np.arange(self._grid.places))[place]
        return CountVolume(
            counts=self._counts, x0=self._layout.x0, n_frames=tally.n_frames[place], column=column,
            dark_counts=tally.dark_counts, n_dark=tally.n_dark, width=tally.width, dark_frames=tally.dark_frames,
            exposures=self._layout.exposures,
        )  # fmt: skip
