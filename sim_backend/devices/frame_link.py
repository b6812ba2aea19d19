"""What becomes of frames between the simulated SPAD's pixels and the computer: some get lost, some come twice.

A frame comes twice where the memory before the link gives its last entry once more instead of the next one: pixels,
markers, counters and ticks are all those of the frame before, and the frame itself is gone. Its number is the next one
all the same, since blocks count what they hold; only its ticks tell. Which frames follows from seed and number.
"""

import numpy as np
from numpy.typing import NDArray

from sim_backend.photon_kernels import dropped_frames

_TWICE = np.uint64(0xE7037ED1A0B428DB)
"""Keeps the draws of frames that come twice apart from those that get lost."""


class FrameLink:
    """lost_frames: numbers of frames that get lost. loss, duplicates: probability of each frame to get lost, and to be
    replaced by the one before it in its block.
    """

    def __init__(self, lost_frames: tuple[int, ...], loss: float, duplicates: float, seed: int) -> None:
        self._lost_frames = np.array(sorted(set(lost_frames)), dtype=np.int64)
        self._loss = loss
        self._duplicates = duplicates
        self._seed = np.uint64(seed & 0xFFFFFFFFFFFFFFFF)

    def loses(self, first_frame: int, n: int) -> NDArray[np.bool_]:
        """Which of n frames get lost, bool (n,)."""
        lost: NDArray[np.bool_] = dropped_frames(self._seed, first_frame, n, self._loss)
        named = self._lost_frames[np.searchsorted(self._lost_frames, first_frame) :]
        lost[named[named < first_frame + n] - first_frame] = True
        return lost

    def repeat(self, first_frame: int, records: NDArray[np.void], bits: NDArray[np.uint8]) -> None:
        """Replace frames of a block by those before them; its first has none before it in the memory."""
        if self._duplicates == 0:
            return
        twice = dropped_frames(self._seed ^ _TWICE, first_frame, len(records), self._duplicates)
        for i in np.flatnonzero(twice[1:]) + 1:
            records[i], bits[i] = records[i - 1], bits[i - 1]
