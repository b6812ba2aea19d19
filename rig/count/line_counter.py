"""The counter of a rig with several lines: each frame is counted once, for one column of every line.

Frames of a place of the mirror are added once, by the parts of `rig.count.kernels.add_runs`, and each line's window is
read from that: n lines take an n-th of the additions that a count for each line would take. Counts are unsigned
integers (columns, rows, window), as of one line.
"""

from dataclasses import replace

import numba
import numpy as np
from numpy.typing import NDArray

from rig.count.kernels import CHUNK, MOST_FRAMES, PLANES, WORD_BYTES, add_frames, planes_for, rows_of_chunk
from rig.count.lane_order import new_counts, padded_lanes, read_planes, write_counts
from rig.count.volume import Counts, CountVolume, SweepLayout, SweepTally, with_room
from rig.geometry.line_grid import LineGrid
from rig.geometry.windows import WORD_PX
from rig.simd.memory import address_of
from rig.threads import RowWorkers


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
        from rig.count.kernels import add_runs

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


@numba.njit(cache=True, nogil=True)
def add_line_runs(
    words: NDArray[np.uint64],
    row_words: int,
    bins: NDArray[np.int32],
    columns_at: NDArray[np.int32],
    x0: NDArray[np.int32],
    counts: NDArray[np.unsignedinteger],
    first_row: int,
    last_row: int,
) -> None:
    """Add lit frames of whole rows to `counts` (columns, rows, window), each to the columns (places, lines) of its bin.

    words: (all words,), `row_words` a row; bins: (n,) place, below 0 to skip; x0: (columns,). Only rows
    first_row..last_row-1 are touched, so that threads may share the output.
    """
    rows, window = counts.shape[1], counts.shape[2]
    planes = np.zeros((PLANES + 1) * CHUNK + 2, np.uint64)
    as_bytes = planes.view(np.uint8)
    n_row = new_counts(2, padded_lanes(window))
    chunk_rows, row_bytes = rows_of_chunk(row_words), row_words * WORD_BYTES
    for y0 in range(first_row, last_row, chunk_rows):
        y1 = min(y0 + chunk_rows, last_row)
        f = 0
        while f < bins.shape[0]:
            place, g = bins[f], f + 1
            while g < bins.shape[0] and bins[g] == place and g - f < MOST_FRAMES:
                g += 1
            if place >= 0:
                add_frames(words, rows * row_words, y0 * row_words, f, g, (y1 - y0) * row_words, 0, planes)
                for line in range(columns_at.shape[1]):
                    c = columns_at[place, line]
                    for y in range(y0, y1, 2):
                        at = (y - y0) * row_bytes + x0[c] // WORD_PX * WORD_BYTES
                        read_planes(
                            address_of(as_bytes), at, at + row_bytes if y + 1 < y1 else at, CHUNK * WORD_BYTES,
                            planes_for(g - f), window, address_of(n_row), padded_lanes(window),
                        )  # fmt: skip
                        for r in range(min(2, y1 - y)):
                            write_counts(n_row[r], counts[c, y + r])
            f = g
