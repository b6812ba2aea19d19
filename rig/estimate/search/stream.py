"""Judges columns while their frames come in: a fast form of `rig.estimate.row.likelihood`, tested against it.

`rig.estimate.search.rows` judges, and the result is the same, bit for bit, as from the counts of the whole sweep.
`ColumnJudge` is the counter of `likelihood`: it judges each column as soon as it is complete and keeps its counts only
on the rows that are needed to learn and to check the map. Rows are processed in chunks, so that counts never leave the
cache. A chunk's counters, uint64 bit planes (`rig.count.kernels`), take the frames of a column as they come. At the
first frame of the next column the rows of the finished one are read out of the planes as bytes, judged, and dropped. If
a column continues in the next block, its counters stay in memory. `search_volume` judges the counts of a whole sweep,
integers (columns, rows, window).
"""

from dataclasses import dataclass
from typing import Final, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rig.count.kernels import CHUNK, PLANES, WORD_BYTES, add_frames, add_runs, new_planes, planes_for, rows_of_chunk
from rig.count.lane_order import (
    PAIRS,
    STEPS,
    halve_counts,
    padded_lanes,
    pixel_order,
    read_counts,
    read_planes,
    sum_counts,
)
from rig.count.map_checks import check_points
from rig.count.volume import BYTE_FRAMES, Counts, CountVolume, FrameTally, SweepLayout, SweepTally
from rig.estimate.row.em import next_lattice
from rig.estimate.row.inputs import Lines
from rig.estimate.search.prepare import clear_found, nothing_found, quiet_of, stripes_of
from rig.estimate.search.rows import (
    RowAnswers,
    SearchPointers,
    SearchTables,
    halvings,
    judge_rows,
    keep_line,
    pointers_of,
    table_for,
)
from rig.estimate.search.tables import BATCH, search_in, search_memory
from rig.geometry.stripe_table import StripeTable
from rig.geometry.windows import WORD_PX, SweepGeometry
from rig.simd import Float64, Int32, Uint8
from rig.simd.memory import add_bytes, address_of, load_bytes, read_int32, store_bytes
from rig.simd.vectors import LANES, zero_bytes
from rig.threads import RowWorkers

SUM_LIMIT: Final = BYTE_FRAMES
"""Most exposures in the 8-bit sums. Before these overflow, `carry_sums` adds them to the 32-bit ones."""


class OpenColumn(NamedTuple):
    """The column whose frames are being counted. Between two blocks it is the same for all chunks.

    column: -1 if none is open. first_word: of the frames' window. frames: counted so far. sums_x0: first pixel of the
    window of `RowAnswers.light_here` and `quiet_here`; summed: exposures in these sums.
    """

    column: int
    first_word: int
    frames: int
    sums_x0: int
    summed: int


@numba.njit(cache=True, nogil=True)
def _move_window(by, row_words, n, planes):  # type: ignore[no-untyped-def]
    """Shift counters when their window moves `by` words to the right. Words that it leaves are dropped, new ones 0."""
    for q in range(PLANES):
        p = planes[q * CHUNK : q * CHUNK + n]
        for row in range(0, n, row_words):
            old = p[row : row + row_words].copy()
            for k in range(row_words):
                p[row + k] = old[k + by] if 0 <= k + by < row_words else np.uint64(0)


@numba.njit(cache=True, nogil=True)
def carry_sums(desk: SearchPointers, x0: int, first_row: int, last_row: int) -> None:
    """Add the 8-bit sums light_here and quiet_here to light and quiet, and clear them. x0: their first pixel."""
    _carry(desk.found.light_here, desk.lanes, desk.found.light, desk.sum_lanes, x0 // STEPS, first_row, last_row)
    _carry(desk.found.quiet_here, desk.lanes, desk.found.quiet, desk.sum_lanes, x0 // STEPS, first_row, last_row)


@numba.njit(cache=True, nogil=True)
def _carry(window: int, window_lanes: int, picture: int, lanes: int, lane: int, first_row: int, last_row: int) -> None:
    """Add bytes (rows, PAIRS, window_lanes, 2) to int32 (rows, PAIRS, lanes, 2) from `lane` on, and clear the bytes.

    window, picture: addresses of the bytes and of the int32."""
    for row in range(PAIRS * first_row, PAIRS * last_row):
        some, lot = window + 2 * window_lanes * row, picture + 8 * (lanes * row + lane)
        for v in range(0, 2 * window_lanes, 2 * LANES):
            add_bytes(lot, v, load_bytes(some, v))
            store_bytes(some, v, zero_bytes())


@numba.njit(cache=True, nogil=True)
def _finish(desk, state, planes, row_bytes, first_row, last_row):  # type: ignore[no-untyped-def]
    """Judge rows first_row..last_row-1 of a finished column; planes: address of the chunk's counters."""
    # With the usual number of lanes as a constant, all offsets are constants and need no registers.
    if desk.lanes == LANES:
        _finish_rows(desk, search_in(desk.memory, LANES), state, planes, row_bytes, first_row, last_row)
    else:
        _finish_rows(desk, search_in(desk.memory, desk.lanes), state, planes, row_bytes, first_row, last_row)


@numba.njit(forceinline=True)
def _finish_rows(desk, search, state, planes, row_bytes, first_row, last_row):  # type: ignore[no-untyped-def]
    """Do the work of `_finish` in a thread's buffers."""
    judge, found, c, k = desk.judge, desk.found, state.column, state.frames
    halved = halvings(k, judge.most)
    exposures = np.float32(k / 2.0**halved)
    n, lanes = search.n, search.lanes
    n_planes = planes_for(k)
    x0 = np.int64(read_int32(judge.x0, c))
    at = (x0 // WORD_PX - state.first_word) * WORD_BYTES
    if x0 != state.sums_x0 or state.summed + k > SUM_LIMIT:
        carry_sums(desk, state.sums_x0, first_row, last_row)
    light = found.light_here + 2 * PAIRS * lanes * first_row
    line, last_line = np.int64(read_int32(found.line_start, c)), np.int64(read_int32(found.line_start, c + 1))
    while line < last_line and read_int32(found.line_row, line) < first_row:
        line += 1
    for band in range(first_row // judge.band_rows, (last_row - 1) // judge.band_rows + 1):
        table = table_for(desk, search, c, band, exposures)
        end = min(last_row, (band + 1) * judge.band_rows)
        for y in range(max(first_row, band * judge.band_rows), end, BATCH):
            rows = min(BATCH, end - y)
            for r in range(0, rows, 2):
                # The partner of an odd last row is not used. Behind the last counters there are some spare ones.
                to = n + r * search.n_bytes
                read_planes(planes, at, at + row_bytes, CHUNK * WORD_BYTES, n_planes, judge.window, to, lanes)
                at += 2 * row_bytes
            for r in range(rows):
                counts = n + r * search.n_bytes
                sum_counts(counts, lanes, light)
                light += 2 * PAIRS * lanes
                while line < last_line and read_int32(found.line_row, line) == y + r:
                    keep_line(counts, lanes, judge.window, found.lines + 4 * judge.window * line)
                    line += 1
                if halved:
                    halve_counts(counts, lanes, halved)
            if rows & 1:
                at -= row_bytes
            judge_rows(desk, search, table, y, rows, c, exposures)


@numba.njit(cache=True, nogil=True)
def search_frames(
    words: NDArray[np.uint64], bins: Int32, first_word: Int32, row_words: int, open_column: OpenColumn, end: bool,
    desk: SearchPointers, planes: NDArray[np.uint64], first_chunk: int, last_chunk: int,
) -> OpenColumn:  # fmt: skip
    """Count and judge a block; returns the column that is open after it.

    words: (all words,) of the block's frames; bins: (n,), column of each frame, negative ones are skipped; first_word:
    (n,) of each frame's window; row_words: words of a row; open_column: the column that is open before it; end: whether
    the sweep ends here, so that no column stays open; desk: with a thread's own memory; planes: see `new_planes`. Only
    chunks first_chunk..last_chunk-1 are touched.
    """
    rows = desk.judge.rows
    frame = rows * row_words
    chunk_rows = rows_of_chunk(row_words)
    counted = address_of(planes)
    chunk_bytes = (PLANES + 1) * CHUNK * WORD_BYTES
    state = open_column
    for j in range(first_chunk, last_chunk):
        first_row, last_row = j * chunk_rows, min((j + 1) * chunk_rows, rows)
        at, n = first_row * row_words, (last_row - first_row) * row_words
        counters = planes[j].ravel()
        state = open_column
        f = 0
        while f < bins.shape[0]:
            c, word = np.int64(bins[f]), np.int64(first_word[f])
            if c < 0:
                f += 1
                continue
            g = f + 1
            while g < bins.shape[0] and bins[g] == c and first_word[g] == word:
                g += 1
            if c != state.column:
                if state.column >= 0:
                    _finish(desk, state, counted + j * chunk_bytes, row_words * WORD_BYTES, first_row, last_row)
                state = _after(state, desk, c, word)
            elif word != state.first_word:
                _move_window(word - state.first_word, row_words, n, counters)
            add_frames(words, frame, at, f, g, n, state.frames, counters)
            state = OpenColumn(c, word, state.frames + g - f, state.sums_x0, state.summed)
            f = g
        if end and state.column >= 0:
            _finish(desk, state, counted + j * chunk_bytes, row_words * WORD_BYTES, first_row, last_row)
    return _after(state, desk, -1, 0) if end else state


@numba.njit(cache=True, nogil=True)
def _after(state: OpenColumn, desk: SearchPointers, column: int, first_word: int) -> OpenColumn:
    """The next column, opened after `state` was finished."""
    if state.column < 0:
        return OpenColumn(column, first_word, 0, state.sums_x0, state.summed)
    x0 = np.int64(read_int32(desk.judge.x0, state.column))
    carried = x0 != state.sums_x0 or state.summed + state.frames > SUM_LIMIT
    return OpenColumn(column, first_word, 0, x0, state.frames + (0 if carried else state.summed))


@numba.njit(cache=True, nogil=True)
def search_counts(counts: Counts, n_frames: Int32, desk: SearchPointers, first_row: int, last_row: int) -> None:
    """Judge rows first_row..last_row-1 of counts (columns, rows, window), without collecting light and lines."""
    judge, search = desk.judge, search_in(desk.memory, desk.lanes)
    sums_x0, pending = np.int64(0), 0
    for c in range(counts.shape[0]):
        k = n_frames[c]
        if k == 0:
            continue
        x0 = np.int64(read_int32(judge.x0, c))
        halved = halvings(k, judge.most)
        if x0 != sums_x0 or pending + (k >> halved) + 1 > SUM_LIMIT:
            carry_sums(desk, sums_x0, first_row, last_row)
            sums_x0, pending = x0, 0
        pending += (k >> halved) + 1
        exposures = np.float32(k / 2.0**halved)
        for band in range(first_row // judge.band_rows, (last_row - 1) // judge.band_rows + 1):
            table = table_for(desk, search, c, band, exposures)
            end = min(last_row, (band + 1) * judge.band_rows)
            for y in range(max(first_row, band * judge.band_rows), end, BATCH):
                rows = min(BATCH, end - y)
                for r in range(rows):
                    read_counts(counts[c, y + r], halved, search.n + r * search.n_bytes, search.lanes, c)
                judge_rows(desk, search, table, y, rows, c, exposures)
    carry_sums(desk, sums_x0, first_row, last_row)


NO_COLUMN = OpenColumn(-1, 0, 0, 0, 0)


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchedSweep(FrameTally):
    """A sweep whose columns have been judged.

    stripe: the stripe table. light: uint32 (rows, width), counts summed over the columns. quiet: float64 (2, rows,
    width), ones and exposures of pixels while clearly behind a stripe. lines: the counts used for learning. checked:
    int32 (lines, points, window), counts of the `check_points` and their partners (`rig.count.map_checks`).
    """

    stripe: StripeTable
    light: NDArray[np.uint32]
    quiet: Float64
    lines: Lines
    checked: Int32

    def intensity(self, workers: RowWorkers | None = None) -> NDArray[np.uint32]:
        """Counts summed over the columns, (rows, width) uint32. They are known, so `workers` has nothing to do."""
        return self.light


class ColumnJudge:
    """A `Counter` that also judges: it counts and estimates sweep after sweep, each with its own `SearchTables`.

    Its memory is allocated once; `begin`, in place of `reset`, clears it for the next sweep.
    """

    def __init__(self, layout: SweepLayout, geometry: SweepGeometry, judge: SearchTables, workers: RowWorkers) -> None:
        self._layout = layout
        self._judge = judge
        self._workers = workers
        self._lines = next_lattice(geometry)
        points = self._points = check_points(geometry)
        rows, columns = (
            np.concatenate([lines, of_points.ravel()])
            for lines, of_points in zip(self._lines, (points.row, points.column), strict=True)
        )
        order = np.lexsort((rows, columns))
        self._found: RowAnswers = nothing_found(geometry, (rows[order], columns[order]))
        self._kept_at = np.argsort(order)
        """Index of each line among the kept ones, first of the lattice's lines, then of the check points'."""
        self._tally = SweepTally(layout)
        self._row_words = 0
        self._open: dict[int, OpenColumn] = {}
        self._planes: dict[int, NDArray[np.uint64]] = {}
        self._desks: dict[int, SearchPointers] = {}
        self._benches: dict[int, Uint8] = {}
        self._no_columns = np.zeros((0, 0), np.int32)
        self._no_counts = np.zeros((0, layout.rows, layout.window), np.uint8)

    def begin(self, judge: SearchTables) -> None:
        """Begin the next sweep, with the tables `judge`."""
        self._workers.settle()
        if judge is not self._judge:  # else the addresses are still valid; to make them takes each thread 0.1 ms
            self._judge, self._desks = judge, {}
        clear_found(self._found)
        self._tally.reset()
        self._open, self._row_words = {}, 0

    def add(self, bits: Uint8, bins: Int32, column: Float64, x0: Int32) -> None:
        """Add frames as in `Counter`; columns that they complete are judged. Raises ValueError if row bytes change."""
        first_word = x0 // np.int32(WORD_PX)
        self._tally.note(bins, column, first_word)
        words, row_words = bits.reshape(-1).view(np.uint64), bits.shape[2] // WORD_BYTES
        self._judge_block(words, bins, first_word, row_words, end=False)
        if np.any(bins == -1):
            layout = self._layout

            def work(first: int, last: int) -> None:
                add_runs(
                    words, first_word, row_words, layout.used_words, bins, self._no_columns, layout.x0, self._no_counts,
                    self._tally.dark, first, last,
                )  # fmt: skip

            self._workers.post(layout.rows, work)

    def settle(self, under_way: int = 0) -> None:
        """See `Counter`."""
        # A block with dark frames was posted as two pieces of work, so fewer blocks may still be under way.
        self._workers.settle(under_way)

    def finish(self) -> SearchedSweep:
        """Judge the last column; returns the sweep with all its columns judged."""
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
            checked=found.lines[of_points].reshape(*self._points.row.shape, layout.window),
        )  # fmt: skip

    def _judge_block(
        self, words: NDArray[np.uint64], bins: Int32, first_word: Int32, row_words: int, *,
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

    def _desk(self, first: int) -> SearchPointers:
        """Addresses for the thread that begins at chunk `first`; made with its first block under these tables."""
        if first not in self._benches:
            self._benches[first] = search_memory(padded_lanes(self._layout.window))
        if first not in self._desks:
            self._desks[first] = pointers_of(self._judge, self._found, self._benches[first])
        return self._desks[first]

    def _opened(self) -> OpenColumn:
        """The open column: the same for all threads once they have done their work."""
        return self._open.get(0, NO_COLUMN)


def search_volume(
    volume: CountVolume, geometry: SweepGeometry, judge: SearchTables, workers: RowWorkers
) -> tuple[StripeTable, Float64]:
    """Stripes of a volume, judged with `judge`; ones and exposures of pixels behind clear stripes (2, rows, width)."""
    found = nothing_found(geometry, None)

    def work(first: int, last: int) -> None:
        memory = search_memory(padded_lanes(geometry.window))
        search_counts(volume.counts, volume.n_frames, pointers_of(judge, found, memory), first, last)

    workers.over(geometry.rows, work)
    return stripes_of(found, judge, workers), quiet_of(found, geometry.width)
