"""The counter of `likelihood`: judges each column as soon as it is complete and stores no counts of it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rig.counting import FrameTally, SweepLayout, SweepTally
from rig.counting_kernels import CHUNK, add_runs, new_planes
from rig.estimators.judging import clear_found, nothing_found, quiet_of, stripes_of
from rig.estimators.learning import next_lattice
from rig.estimators.row_input import Lines
from rig.estimators.row_search import Bench, Found, Judge, new_bench
from rig.estimators.stream_kernels import SUM_LIMIT, OpenColumn, carry_sums, search_frames
from rig.geometry import SweepGeometry
from rig.lane_order import padded_lanes, pixel_order
from rig.row_threads import RowWorkers
from rig.stripes import StripeTable

MOST_EXPOSURES = 200
"""Nominal exposures of a column up to which its counters (of 8 bits) have room for what it really gets."""
NO_COLUMN = OpenColumn(-1, 0, 0, 0)


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchedSweep(FrameTally):
    """A sweep whose columns have been judged.

    stripe: the stripe table. light: uint32 (rows, width), counts summed over the columns. quiet: int32 (2, rows,
    width), ones and exposures of pixels while clearly behind a stripe. lines: what the learning reads.
    """

    stripe: StripeTable
    light: NDArray[np.uint32]
    quiet: NDArray[np.int32]
    lines: Lines

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
        self._found: Found = nothing_found(geometry, self._lines)
        self._tally = SweepTally(layout)
        self._open = NO_COLUMN
        self._planes: dict[int, NDArray[np.uint64]] = {}
        self._benches: dict[int, Bench] = {}
        self._pending = 0
        self._no_counts = np.zeros((0, layout.rows, layout.window), np.uint8)

    def begin(self, judge: Judge) -> None:
        """Begin the next sweep, under `judge`."""
        self._judge = judge
        clear_found(self._found)
        self._tally.reset()
        self._open, self._pending = NO_COLUMN, 0

    def add(
        self, bits: NDArray[np.uint8], bins: NDArray[np.int32], column: NDArray[np.float64], x0: NDArray[np.int32]
    ) -> None:
        """Add frames, see `Counter`; columns that they complete are judged."""
        first_word = x0 // np.int32(64)
        self._tally.note(bins, column, first_word)
        words, row_words = bits.reshape(-1).view(np.uint64), bits.shape[2] // 8
        frame_words = self._layout.rows * row_words
        # In pieces that the 16-bit sums have room for: blocks of small sensors hold very many frames.
        for first in range(0, len(bins), SUM_LIMIT):
            last = first + SUM_LIMIT
            piece = words[first * frame_words : last * frame_words]
            self._judge_block(piece, bins[first:last], first_word[first:last], row_words, end=False)
        if np.any(bins == -1):
            layout = self._layout

            def work(first: int, last: int) -> None:
                add_runs(
                    words, first_word, row_words, layout.used_words, bins, layout.x0, self._no_counts,
                    self._tally.dark, first, last,
                )  # fmt: skip

            self._workers.over(layout.rows, work)

    def finish(self) -> SearchedSweep:
        """What the sweep gave; the last column is judged now."""
        layout, found = self._layout, self._found
        if self._open.column >= 0:
            row_words = next(iter(self._planes))
            nothing = np.zeros(0, np.int32)
            self._judge_block(np.zeros(0, np.uint64), nothing, nothing, row_words, end=True)
        carry_sums(found, self._open.sums_x0, 0, layout.rows)
        rows, columns = self._lines
        tally = self._tally.finish()
        return SearchedSweep(
            n_frames=tally.n_frames, column=tally.column, dark_counts=tally.dark_counts, n_dark=tally.n_dark,
            width=tally.width, dark_frames=tally.dark_frames, stripe=stripes_of(found, self._workers),
            light=pixel_order(found.light, layout.width).astype(np.uint32),
            quiet=quiet_of(found, layout.width),
            lines=Lines(found.lines.copy(), rows, columns, tally.n_frames[columns]),
        )  # fmt: skip

    def _judge_block(
        self, words: NDArray[np.uint64], bins: NDArray[np.int32], first_word: NDArray[np.int32], row_words: int, *,
        end: bool,
    ) -> None:  # fmt: skip
        layout = self._layout
        # Frames of whole rows begin at the sensor's first word, whatever part of them is used.
        if row_words == layout.padded_width // 64:
            first_word = np.zeros_like(first_word)
        chunk_rows = max(CHUNK // row_words, 1)
        chunks = -(-layout.rows // chunk_rows)
        if row_words not in self._planes:
            self._planes[row_words] = new_planes(chunks)
        planes, opened = self._planes[row_words], self._open
        after: list[OpenColumn] = []
        if self._pending + len(bins) > SUM_LIMIT:
            carry_sums(self._found, opened.sums_x0, 0, layout.rows)
            self._pending = 0
        self._pending += len(bins)

        def work(first: int, last: int) -> None:
            if first not in self._benches:
                self._benches[first] = new_bench(padded_lanes(layout.window))
            state = search_frames(
                words, bins, first_word, row_words, opened, end, self._judge, self._benches[first], self._found, planes,
                first, last,
            )  # fmt: skip
            after.append(state)

        self._workers.over(chunks, work)
        self._open = after[0]
