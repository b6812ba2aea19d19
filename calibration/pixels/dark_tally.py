"""Dark frames of a SPAD array, added up, and by how much each pixel's counts scatter from block to block.

The counts of a pixel whose rate jumps (random telegraph noise) scatter over the blocks of frames more than counting
does. Index of dispersion: sum (n - e)^2 / e over the blocks, e in proportion to what ordinary pixels count in them, so
that a lamp or a warming sensor makes nobody noisy; chi-square with blocks - 1 degrees of freedom but for the 1 - p of
bits.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

LEAST_COUNTS = 10.0
"""A pixel's mean counts in a block from which on chi-square describes their scatter; quieter ones are not judged."""
LEAST_BLOCKS, MOST_BLOCKS = 8, 64
_APART, _ROUNDS = 6.0, 8
"""Standard deviations of a count, and one more, beyond which a pixel is not ordinary; times that is asked."""
_MANY, _MOST_COMMON = 100, 1.5
"""Scatter that so many pixels have in common is no fault of theirs, up to this factor in variance."""


class DarkTally:
    """Adds up dark frames block by block; blocks follow one another in time and are best of equal length.

    Of many blocks neighbours are joined, so that no more than `MOST_BLOCKS` are kept.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self.ones = np.zeros(shape, np.int64)
        self.frames = np.zeros(shape, np.int64)
        self._blocks: list[tuple[NDArray[np.int32], NDArray[np.int32]]] = []

    def add(self, ones: NDArray[np.integer], frames: NDArray[np.integer] | int) -> None:
        """Add a block: `ones` (rows, width) of the `frames` in which each pixel was read."""
        if len(self._blocks) == MOST_BLOCKS:
            pairs = zip(self._blocks[::2], self._blocks[1::2], strict=True)
            self._blocks = [(one[0] + other[0], one[1] + other[1]) for one, other in pairs]
        block = np.array(ones, np.int32), np.array(frames, np.int32)
        self._blocks.append(block)
        self.ones += block[0]
        self.frames += block[1]

    def ordinary(self) -> Mask:
        """Pixels that no count far above the others' sets apart."""
        seen = self.frames > 0
        kept = seen
        for _ in range(_ROUNDS):
            expected = self.frames * (self.ones[kept].sum() / max(self.frames[kept].sum(), 1))
            kept = seen & (self.ones <= expected + _APART * (np.sqrt(expected) + 1))
        return kept

    def scatter(self) -> tuple[Array, NDArray[np.int64], Mask]:
        """Index of dispersion (rows, width), its degrees of freedom, and where it can be judged."""
        ordinary = self.ordinary()
        blocks = np.zeros(self.ones.shape, np.int64)
        counts, expected, squares = (np.zeros(self.ones.shape) for _ in range(3))
        compared = 0.0
        for ones, given in self._blocks:
            frames = np.broadcast_to(given, ones.shape)
            usual = float(ones[ordinary].sum())
            if usual == 0:
                continue  # nothing to compare by
            compared += usual
            here = frames * (usual / frames[ordinary].sum())
            blocks += frames > 0
            counts += ones
            expected += here
            squares += np.square(ones, dtype=np.float64) / np.where(here > 0, here, 1.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.minimum(counts / self.frames, 1.0)
            few = LEAST_COUNTS * blocks
            judged = (blocks >= LEAST_BLOCKS) & (counts >= few) & (self.frames - counts >= few)
            # What is expected was counted too, and scatters with the root of that.
            index = (squares * expected / counts - counts) / (1.0 - share + counts / max(compared, 1.0))
        index = np.where(judged, index, 0.0)
        dof = np.maximum(blocks - 1, 1)
        if judged.sum() >= _MANY:  # afterpulses make everybody's counts scatter a little
            middle = np.median(index[judged] / (dof[judged] * (1 - 2 / (9 * dof[judged])) ** 3))
            index /= np.clip(middle, 1.0, _MOST_COMMON)
        return index, dof, judged
