"""Compiled counting and estimation in one pass over a block of frames: counts never leave the cache.

Rows are worked through in chunks. A chunk's counters take the frames of a column as they come; with the first frame of
the next column the rows of the finished one are read out of the bit planes into registers, judged, and forgotten. A
column may lie in several blocks; its counters wait in memory in between.
"""

from typing import Final, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rig.counting import BYTE_FRAMES
from rig.counting_kernels import CHUNK, PLANES, WORD_BYTES, add_frames, planes_for, rows_of_chunk
from rig.estimators.row_search import halvings, judge_rows, keep_line, table_for
from rig.estimators.search_buffers import BATCH, search_in
from rig.estimators.search_desk import Desk, Found, Judge, desk_of
from rig.geometry import WORD_PX
from rig.lane_memory import add_bytes, address_of, load_bytes, read_int32, store_bytes
from rig.lane_order import PAIRS, STEPS, halve_counts, read_counts, read_planes, sum_counts
from rig.lanes import LANES, zero_bytes

SUM_LIMIT: Final = BYTE_FRAMES
"""Exposures after which the 8-bit sums are carried over."""


class OpenColumn(NamedTuple):
    """The column whose frames are being counted; the same for every chunk between two blocks.

    column: -1 where none is open. first_word: of the frames' window. frames: counted so far. sums_x0: where the window
    of `Found.light_here` and `quiet_here` begins; summed: exposures that they hold.
    """

    column: int
    first_word: int
    frames: int
    sums_x0: int
    summed: int


@numba.njit(cache=True, nogil=True)
def _move_window(by, row_words, n, planes):  # type: ignore[no-untyped-def]
    """Let counters follow a window that moved `by` words to the right; what leaves it is dropped, what is new is 0."""
    for q in range(PLANES):
        p = planes[q * CHUNK : q * CHUNK + n]
        for row in range(0, n, row_words):
            old = p[row : row + row_words].copy()
            for k in range(row_words):
                p[row + k] = old[k + by] if 0 <= k + by < row_words else np.uint64(0)


@numba.njit(cache=True, nogil=True)
def carry_sums(desk: Desk, x0: int, first_row: int, last_row: int) -> None:
    """Add the light of the window that began at x0 to the picture's, and begin anew."""
    _carry(desk.light, desk.lanes, desk.light_sum, desk.sum_lanes, x0 // STEPS, first_row, last_row)
    _carry(desk.quiet, desk.lanes, desk.quiet_sum, desk.sum_lanes, x0 // STEPS, first_row, last_row)


@numba.njit(cache=True, nogil=True)
def _carry(window: int, window_lanes: int, picture: int, lanes: int, lane: int, first_row: int, last_row: int) -> None:
    """Move bytes (rows, PAIRS, window_lanes, 2) to int32 (rows, PAIRS, lanes, 2) from `lane` on; both addresses."""
    for row in range(PAIRS * first_row, PAIRS * last_row):
        some, lot = window + 2 * window_lanes * row, picture + 8 * (lanes * row + lane)
        for v in range(0, 2 * window_lanes, 2 * LANES):
            add_bytes(lot, v, load_bytes(some, v))
            store_bytes(some, v, zero_bytes())


@numba.njit(cache=True, nogil=True)
def _finish(desk, state, planes, row_bytes, first_row, last_row):  # type: ignore[no-untyped-def]
    """Judge rows first_row..last_row-1 of a finished column; planes: address of the chunk's counters."""
    # With the usual number of lanes as a constant all offsets are, and no register is spent on them.
    if desk.lanes == LANES:
        _finish_rows(desk, search_in(desk.memory, LANES), state, planes, row_bytes, first_row, last_row)
    else:
        _finish_rows(desk, search_in(desk.memory, desk.lanes), state, planes, row_bytes, first_row, last_row)


@numba.njit(forceinline=True)
def _finish_rows(desk, search, state, planes, row_bytes, first_row, last_row):  # type: ignore[no-untyped-def]
    """`_finish` with a thread's buffers."""
    c, k = state.column, state.frames
    halved = halvings(k, desk.most)
    exposures = np.float32(k / 2.0**halved)
    n, lanes = search.n, search.lanes
    n_planes = planes_for(k)
    x0 = np.int64(read_int32(desk.x0, c))
    at = (x0 // WORD_PX - state.first_word) * WORD_BYTES
    if x0 != state.sums_x0 or state.summed + k > SUM_LIMIT:
        carry_sums(desk, state.sums_x0, first_row, last_row)
    light = desk.light + 2 * PAIRS * lanes * first_row
    line, last_line = np.int64(read_int32(desk.line_start, c)), np.int64(read_int32(desk.line_start, c + 1))
    while line < last_line and read_int32(desk.line_row, line) < first_row:
        line += 1
    for band in range(first_row // desk.band_rows, (last_row - 1) // desk.band_rows + 1):
        table = table_for(desk, search, c, band, exposures)
        end = min(last_row, (band + 1) * desk.band_rows)
        for y in range(max(first_row, band * desk.band_rows), end, BATCH):
            rows = min(BATCH, end - y)
            for r in range(0, rows, 2):
                # The partner of an odd last row is never looked at; behind the last counters there are some spare ones.
                to = n + r * search.n_bytes
                read_planes(planes, at, at + row_bytes, CHUNK * WORD_BYTES, n_planes, desk.window, to, lanes)
                at += 2 * row_bytes
            for r in range(rows):
                counts = n + r * search.n_bytes
                sum_counts(counts, lanes, light)
                light += 2 * PAIRS * lanes
                while line < last_line and read_int32(desk.line_row, line) == y + r:
                    keep_line(counts, lanes, desk.window, desk.lines + 4 * desk.window * line)
                    line += 1
                if halved:
                    halve_counts(counts, lanes, halved)
            if rows & 1:
                at -= row_bytes
            judge_rows(desk, search, table, y, rows, c, exposures)


@numba.njit(cache=True, nogil=True)
def search_frames(
    words: NDArray[np.uint64],
    bins: NDArray[np.int32],
    first_word: NDArray[np.int32],
    row_words: int,
    open_column: OpenColumn,
    end: bool,
    desk: Desk,
    planes: NDArray[np.uint64],
    first_chunk: int,
    last_chunk: int,
) -> OpenColumn:
    """Count and judge a block; returns the column that is open behind it.

    words: (all words,) of the block's frames; bins: (n,), column of each frame, negative ones are passed over;
    first_word: (n,) of each frame's window; row_words: words of a row; end: the sweep ends here, nothing stays open;
    desk: with a thread's own memory; planes: see `new_planes`. Only chunks first_chunk..last_chunk-1 are touched.
    """
    rows = desk.rows
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
def _after(state: OpenColumn, desk: Desk, column: int, first_word: int) -> OpenColumn:
    """The next column, opened after `state` was finished."""
    if state.column < 0:
        return OpenColumn(column, first_word, 0, state.sums_x0, state.summed)
    x0 = np.int64(read_int32(desk.x0, state.column))
    carried = x0 != state.sums_x0 or state.summed + state.frames > SUM_LIMIT
    return OpenColumn(column, first_word, 0, x0, state.frames + (0 if carried else state.summed))


@numba.njit(cache=True, nogil=True)
def search_counts(
    counts: NDArray[np.unsignedinteger],
    n_frames: NDArray[np.int32],
    judge: Judge,
    memory: NDArray[np.uint8],
    found: Found,
    first_row: int,
    last_row: int,
) -> None:
    """Judge rows first_row..last_row-1 of counts (columns, rows, window); no light and no lines are kept.

    memory: see `search_memory`.
    """
    desk = desk_of(judge, found, memory)
    search = search_in(desk.memory, desk.lanes)
    sums_x0, pending = np.int64(0), 0
    for c in range(counts.shape[0]):
        k = n_frames[c]
        if k == 0:
            continue
        x0 = np.int64(judge.x0[c])
        halved = halvings(k, desk.most)
        if x0 != sums_x0 or pending + (k >> halved) + 1 > SUM_LIMIT:
            carry_sums(desk, sums_x0, first_row, last_row)
            sums_x0, pending = x0, 0
        pending += (k >> halved) + 1
        exposures = np.float32(k / 2.0**halved)
        for band in range(first_row // desk.band_rows, (last_row - 1) // desk.band_rows + 1):
            table = table_for(desk, search, c, band, exposures)
            end = min(last_row, (band + 1) * desk.band_rows)
            for y in range(max(first_row, band * desk.band_rows), end, BATCH):
                rows = min(BATCH, end - y)
                for r in range(rows):
                    read_counts(counts[c, y + r], halved, search.n + r * search.n_bytes, search.lanes, c)
                judge_rows(desk, search, table, y, rows, c, exposures)
    carry_sums(desk, sums_x0, first_row, last_row)
