"""Counts per column from packed frames: bits are added in bit-sliced form and never unpacked outside the window.

Each 64-bit word of a frame is added to vertical counters (plane i holds bit i of 64 counts), the carry-save way of
Harley and Seal; only the window of the column is expanded to integers, once per run of frames of that column.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

BIN_DARK = -1
"""Bin of a frame with the gate low during the whole exposure."""
BIN_UNUSABLE = -2
"""Bin of a frame that belongs to no column and is not dark (gate edge inside, outside the sweep)."""

Counts = NDArray[np.unsignedinteger[Any]]
"""uint8, uint16 or uint32, as wide as the counts need."""


@dataclass(frozen=True, slots=True)
class CountVolume:
    """Counts of one sweep.

    counts: (columns, rows, window) uint8, uint16 or uint32, 1s of each pixel over the frames of the column.
    x0: (columns,) int32, first pixel of each column's window.
    n_frames: (columns,) int32, frames in each column's bin; 0 where none were received.
    column: (columns,) float64, mean fractional column of those frames, NaN where none.
    dark_counts: (rows, width) uint32 over n_dark frames with the gate low, None where there are none.
    width: sensor width in pixels.
    dark_frames: (width,) int32, those of the n_dark frames in which a pixel was used; None: all of them.
    """

    counts: Counts
    x0: NDArray[np.int32]
    n_frames: NDArray[np.int32]
    column: NDArray[np.float64]
    dark_counts: NDArray[np.uint32] | None
    n_dark: int
    width: int
    dark_frames: NDArray[np.int32] | None = None

    def bound_column(self) -> NDArray[np.float64]:
        """Fractional column of each bin (columns,), its own centre where it has no frames."""
        return np.where(self.n_frames > 0, self.column, np.arange(len(self.column), dtype=np.float64))

    def intensity(self) -> NDArray[np.uint32]:
        """Counts summed over the columns, (rows, width) uint32."""
        columns, rows, window = self.counts.shape
        out = np.zeros((rows, max(self.width, int(self.x0.max(initial=0)) + window)), np.uint32)
        for c in range(columns):
            out[:, self.x0[c] : self.x0[c] + window] += self.counts[c]
        return out[:, : self.width]


class SweepCounter:
    """Adds the frames of one sweep to its count volume.

    n_columns columns of `window` pixels from x0 (columns,) on, multiples of 64, on a sensor of rows x width pixels.
    used_px: pixels of each frame that are used; None: whole rows. The result depends neither on the number of threads,
    nor on how frames are grouped into blocks, nor on whether frames come whole or as their used pixels alone.
    """

    def __init__(
        self,
        n_columns: int,
        rows: int,
        width: int,
        x0: NDArray[np.int32],
        window: int,
        threads: int = 2,
        used_px: int | None = None,
    ) -> None:
        if window % 64 or np.any(x0 % 64):
            raise ValueError(f"window {window} and its starts must be multiples of 64 pixels")
        self._shape = (n_columns, rows, window)
        self._width = width
        self._used_px = used_px
        self._x0 = np.ascontiguousarray(x0, dtype=np.int32)
        self._threads = max(1, threads)
        self._pool = ThreadPoolExecutor(self._threads, thread_name_prefix="count")
        self.reset()

    def reset(self) -> None:
        """Start the next sweep with all counts at zero."""
        columns, rows, _ = self._shape
        self._counts: Counts = np.zeros(self._shape, np.uint8)
        self._n_frames = np.zeros(columns, np.int32)
        self._column_sum = np.zeros(columns, np.float64)
        self._dark = np.zeros((rows, -(-self._width // 64) * 64), np.uint32)
        self._n_dark = 0
        self._dark_frames = np.zeros(self._dark.shape[1], np.int32)

    def add(
        self,
        bits: NDArray[np.uint8],
        bins: NDArray[np.int32],
        column: NDArray[np.float64],
        x0: NDArray[np.int32] | None = None,
    ) -> None:
        """Add packed frames `bits` (n, rows, row bytes) to `bins` (n,); `column` (n,): each frame's fractional column.

        Row bytes are a multiple of 8; bins are a column index, BIN_DARK or BIN_UNUSABLE. x0: (n,) first used pixel of
        each frame, a multiple of 64; with rows shorter than the sensor's, their first pixel. None: 0. The used pixels
        of a frame with a column index must hold that column's window.
        """
        from rig.counting_kernels import add_runs

        lit = bins >= 0
        np.add.at(self._n_frames, bins[lit], 1)
        np.add.at(self._column_sum, bins[lit], column[lit])
        self._make_room()
        words = bits.view(np.uint64)
        first_word = np.zeros(len(bits), np.int32) if x0 is None else x0 // np.int32(64)
        used_words = self._used_words()
        self._note_dark(first_word[bins == BIN_DARK], used_words)
        bins = np.ascontiguousarray(bins, dtype=np.int32)
        for job in [
            self._pool.submit(
                add_runs, words, first_word, used_words, bins, self._x0, self._counts, self._dark, first, last
            )
            for first, last in _pieces(self._shape[1], self._threads)
        ]:
            job.result()

    def _used_words(self) -> int:
        return self._dark.shape[1] // 64 if self._used_px is None else self._used_px // 64

    def _note_dark(self, first_word: NDArray[np.int32], used_words: int) -> None:
        """Count dark frames whose used pixels begin at these words."""
        self._n_dark += len(first_word)
        for word, frames in zip(*np.unique(first_word, return_counts=True), strict=True):
            self._dark_frames[64 * word : 64 * (word + used_words)] += frames

    def _make_room(self) -> None:
        """Widen the counts before they can overflow."""
        most = int(self._n_frames.max(initial=0))
        for wider in (np.uint16, np.uint32):
            if most <= np.iinfo(self._counts.dtype).max:
                return
            self._counts = self._counts.astype(wider)

    def finish(self) -> CountVolume:
        """The counts so far; the counter must be `reset` before the next sweep."""
        with np.errstate(invalid="ignore"):
            column = np.where(self._n_frames > 0, self._column_sum / np.maximum(self._n_frames, 1), np.nan)
        dark = np.ascontiguousarray(self._dark[:, : self._width]) if self._n_dark else None
        dark_frames = None if self._used_px is None else self._dark_frames[: self._width]
        return CountVolume(self._counts, self._x0, self._n_frames, column, dark, self._n_dark, self._width, dark_frames)

    def close(self) -> None:
        """End the counting threads."""
        self._pool.shutdown()


def _pieces(rows: int, threads: int) -> Sequence[tuple[int, int]]:
    edges = np.linspace(0, rows, threads + 1).astype(int)
    return [(int(a), int(b)) for a, b in pairwise(edges) if b > a]
