"""Where in a pixel's columns the line stands out most, before anything is fitted: sums over columns, and their peak."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

CORES = (1, 3)
"""Half widths, in columns, of what the line is looked for with."""
RING = 8
"""Columns on either side that it has to stand out from."""
TOP = 0.95
"""Columns that stand out by this much of the best are as good."""
LEAST_SEEN = 3.0
"""How far it stands out before it is fitted: as much as chance makes it along a few dozen columns."""


@dataclass(frozen=True, slots=True, eq=False)
class ColumnSums:
    """1s and frames up to, but without, each column: (columns + 1, pixels) int32; frames (…, 1) where alike for all."""

    ones: NDArray[np.int32]
    frames: NDArray[np.int32]

    @classmethod
    def of(cls, ones: NDArray[np.int32], frames: NDArray[np.int32]) -> "ColumnSums":
        """Of counts (columns, pixels)."""
        return cls(*(np.concatenate([np.zeros_like(a[:1]), a.cumsum(axis=0, dtype=np.int32)]) for a in (ones, frames)))

    @property
    def columns(self) -> int:
        """So many there are."""
        return len(self.ones) - 1

    def some(self, which: "NDArray[np.bool_] | slice") -> "ColumnSums":
        """Those of some pixels."""
        return ColumnSums(self.ones[:, which], self.frames if self.frames.shape[1] == 1 else self.frames[:, which])

    def between(self, begin: int, end: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Share of 1s (columns, pixels), NaN without frames, in the columns `begin` to `end` away; frames."""
        edges = np.arange(self.columns)
        first, last = (np.clip(edges + shift, 0, self.columns) for shift in (begin, end))
        frames = (self.frames[last] - self.frames[first]).astype(np.float32)
        ones = (self.ones[last] - self.ones[first]).astype(np.float32)
        with np.errstate(invalid="ignore", divide="ignore"):
            return ones / frames, frames

    def ranges(self, begin: NDArray[np.int64], end: NDArray[np.int64]) -> tuple[Array, Array]:
        """1s and frames (pixels, n) in columns begin up to end, both (pixels, n), of each pixel."""
        first, last = (np.clip(edge, 0, self.columns) for edge in (begin, end))
        pixel = np.arange(len(begin))[:, None]
        alike = pixel if self.frames.shape[1] > 1 else 0
        return (
            (self.ones[last, pixel] - self.ones[first, pixel]).astype(np.float64),
            (self.frames[last, alike] - self.frames[first, alike]).astype(np.float64),
        )


def brightest(sums: ColumnSums) -> tuple[Array, NDArray[np.bool_]]:
    """Where the line stands out most (pixels,), and whether that is enough.

    Flux within the core is compared with the brighter of two rings beside it: the haze has an edge there, but no peak.
    """
    pixels = sums.ones.shape[1]
    best, at = np.full(pixels, -np.inf), np.zeros(pixels)
    columns = np.arange(sums.columns)[:, None]
    for core in CORES:
        guard = 2 * core + 1
        mean, count = sums.between(-core, core + 1)
        ring = np.fmax(sums.between(-guard - RING, -guard)[0], sums.between(guard + 1, guard + RING + 1)[0])
        with np.errstate(invalid="ignore", divide="ignore"):
            spread = np.sqrt((mean * (1 - mean) + ring * (1 - ring) + 1 / (count + RING)) / count)
            score = np.nan_to_num((mean - ring) / spread, nan=-np.inf)
        top = score.argmax(axis=0)
        value = score[top, np.arange(pixels)]
        # The middle of a flat top, of which the first column would be as good as any.
        alike = (score >= TOP * value) & (np.abs(columns - top) <= RING)
        middle = (alike * columns).sum(axis=0) / np.maximum(alike.sum(axis=0), 1)
        better = value > best
        best, at = np.where(better, value, best), np.where(better, middle, at)
    return at, best > LEAST_SEEN
