"""The counter of `likelihood`: judges each column as soon as it is complete and stores no counts of it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rig.counting import FrameTally, SweepLayout, SweepTally
from rig.counting_kernels import WORD_BYTES, add_runs, new_planes, rows_of_chunk
from rig.estimators.judging import clear_found, nothing_found, quiet_of, stripes_of
from rig.estimators.learning import next_lattice
from rig.estimators.row_input import Lines
from rig.estimators.search_buffers import search_memory
from rig.estimators.search_desk import Desk, Found, Judge, desk_of
from rig.estimators.stream_kernels import OpenColumn, carry_sums, search_frames
from rig.geometry import WORD_PX, SweepGeometry
from rig.lane_order import padded_lanes, pixel_order
from rig.map_checks import check_points
from rig.row_threads import RowWorkers
from rig.stripes import StripeTable

NO_COLUMN = OpenColumn(-1, 0, 0, 0, 0)


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchedSweep(FrameTally):
    """A sweep whose columns have been judged.

    stripe: the stripe table. light: uint32 (rows, width), counts summed over the columns. quiet: int32 (2, rows,
    width), ones and exposures of pixels while clearly behind a stripe. lines: what the learning reads. checked: int32
    (3, points, window), counts of the `check_points`.
    """

    stripe: StripeTable
    light: NDArray[np.uint32]
    quiet: NDArray[np.float64]
    lines: Lines
    checked: NDArray[np.int32]

    def intensity(self) -> NDArray[np.uint32]:
        """Counts summed over the columns, (rows, width) uint32."""
        return self.light


class ColumnJudge:
    """The `Counter` that judges: counts and estimates one sweep after the other, each under one `Judge`.

    Its memory is made once; `begin` clears it for the next sweep.
    """

    def __init__(self, layout: SweepLayout, geometry: SweepGeometry, judge: Judge, workers: RowWorkers) -> None:
        self._layout = layout
        self._judge = judge
        self._workers = workers
        self._lines = next_lattice(geometry)
        points = check_points(geometry)
        rows, columns = (
            np.concatenate([lines, of_points.ravel()])
            for lines, of_points in zip(self._lines, (points.row, points.column), strict=True)
        )
        order = np.lexsort((rows, columns))
        self._found: Found = nothing_found(geometry, (rows[order], columns[order]))
        self._kept_at = np.argsort(order)
        """Where the lines of the lattice are among all that are kept, and then those of the points."""
        self._tally = SweepTally(layout)
        self._row_words = 0
        self._open: dict[int, OpenColumn] = {}
        self._planes: dict[int, NDArray[np.uint64]] = {}
        self._desks: dict[int, Desk] = {}
        self._benches: dict[int, NDArray[np.uint8]] = {}
        self._no_counts = np.zeros((0, layout.rows, layout.window), np.uint8)

    def begin(self, judge: Judge) -> None:
        """Begin the next sweep, under `judge`."""
        self._workers.settle()
        self._judge = judge
        clear_found(self._found)
        self._tally.reset()
        self._open, self._desks, self._row_words = {}, {}, 0

    def add(
        self, bits: NDArray[np.uint8], bins: NDArray[np.int32], column: NDArray[np.float64], x0: NDArray[np.int32]
    ) -> None:
        """Add frames, see `Counter`; columns that they complete are judged."""
        first_word = x0 // np.int32(WORD_PX)
        self._tally.note(bins, column, first_word)
        words, row_words = bits.reshape(-1).view(np.uint64), bits.shape[2] // WORD_BYTES
        self._judge_block(words, bins, first_word, row_words, end=False)
        if np.any(bins == -1):
            layout = self._layout

            def work(first: int, last: int) -> None:
                add_runs(
                    words, first_word, row_words, layout.used_words, bins, layout.x0, self._no_counts,
                    self._tally.dark, first, last,
                )  # fmt: skip

            self._workers.post(layout.rows, work)

    def settle(self, under_way: int = 0) -> None:
        """See `Counter`."""
        # Dark frames are work of their own: the more is waited for.
        self._workers.settle(under_way)

    def finish(self) -> SearchedSweep:
        """What the sweep gave; the last column is judged now."""
        layout, found = self._layout, self._found
        if self._row_words:
            nothing = np.zeros(0, np.int32)
            self._judge_block(np.zeros(0, np.uint64), nothing, nothing, self._row_words, end=True)
        self._workers.settle()
        carry_sums(self._desk(0), self._opened().sums_x0, 0, layout.rows)
        rows, columns = self._lines
        alone = np.zeros((2, len(rows)), np.float32)
        of_lattice, of_points = self._kept_at[: len(rows)], self._kept_at[len(rows) :]
        tally = self._tally.finish()
        return SearchedSweep(
            n_frames=tally.n_frames, column=tally.column, dark_counts=tally.dark_counts, n_dark=tally.n_dark,
            width=tally.width, dark_frames=tally.dark_frames, stripe=stripes_of(found, self._judge, self._workers),
            light=pixel_order(found.light, layout.width).astype(np.uint32),
            quiet=quiet_of(found, layout.width),
            lines=Lines(found.lines[of_lattice], rows, columns, tally.n_frames[columns], *alone),
            checked=found.lines[of_points].reshape(3, -1, layout.window),
        )  # fmt: skip

    def _judge_block(
        self, words: NDArray[np.uint64], bins: NDArray[np.int32], first_word: NDArray[np.int32], row_words: int, *,
        end: bool,
    ) -> None:  # fmt: skip
        layout = self._layout
        # Frames of whole rows begin at the sensor's first word, whatever part of them is used.
        if row_words == layout.padded_width // WORD_PX:
            first_word = np.zeros_like(first_word)
        if self._row_words not in (0, row_words):
            raise ValueError(f"frames of {row_words} words a row behind those of {self._row_words}; begin a new sweep")
        self._row_words = row_words
        chunks = -(-layout.rows // rows_of_chunk(row_words))
        if row_words not in self._planes:
            self._planes[row_words] = new_planes(chunks)
        planes = self._planes[row_words]

        def work(first: int, last: int) -> None:
            self._open[first] = search_frames(
                words, bins, first_word, row_words, self._open.get(first, NO_COLUMN), end, self._desk(first), planes,
                first, last,
            )  # fmt: skip

        self._workers.post(chunks, work)

    def _desk(self, first: int) -> Desk:
        """What the thread that begins at chunk `first` works with."""
        if first not in self._benches:
            self._benches[first] = search_memory(padded_lanes(self._layout.window))
        if first not in self._desks:
            self._desks[first] = desk_of(self._judge, self._found, self._benches[first])
        return self._desks[first]

    def _opened(self) -> OpenColumn:
        """The open column: the same for all threads once they have done their work."""
        return self._open.get(0, NO_COLUMN)
