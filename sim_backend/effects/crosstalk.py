"""Crosstalk: a detection sets off a neighbouring pixel, by the light of its own avalanche.

Each detection of a frame fires each of its 4 neighbours with probability c / 4, all independently; what is fired this
way sets off nobody, which would be of order c^2. A pixel whose own chance is p and whose neighbours fired in m cases is
1 with probability 1 - (1 - p)(1 - c/4)^m; over a flat picture of small p that is p (1 + c). At the border the light is
lost. c is 0.1 to 0.2 % in 512 x 512 arrays of large pitch; the share beyond the 4 neighbours is not modelled.

Called for by `world.sensor.crosstalk` above 0, which is c. Exact for any c: of the 4 x pixels of a frame, in the order
pixel by pixel (up, down, left, right), those that would pass are drawn by their gaps. Cost per frame of 512 x 512: 9 us
at 0.15 %, in proportion to c.
"""

import numba
import numpy as np
from numpy.typing import NDArray

from sim_backend.effects.rare_bits import bit_of, log_miss, next_hit
from sim_backend.effects.setting import FrameTimes, Setting, Words
from sim_backend.random_numbers import WORD_PX, frame_key

_STREAM = np.uint64(0xC6A4A7935BD1E995)
"""Stream that keeps these draws apart from those of photons and other effects."""


class Crosstalk:
    """Acts on the bits of the photons, dark counts and afterpulses."""

    reads_before = False

    def __init__(self, setting: Setting) -> None:
        self._width = setting.view.width
        self._log_miss = log_miss(setting.sensor.crosstalk / 4)

    def apply(self, seed: np.uint64, first_frame: int, words: Words, before: Words, times: FrameTimes) -> None:
        """See `BitEffect`."""
        _spark_over(words, self._width, seed ^ _STREAM, first_frame, self._log_miss)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _spark_over(words: NDArray[np.uint64], width: int, seed: np.uint64, first_frame: int, log_miss: float) -> None:
    """Set the neighbours' bits in frames (frames, rows, words)."""
    frames, rows, n_words = words.shape
    fired = np.empty((rows, n_words), np.uint64)
    for f in range(frames):
        fired[:] = words[f]
        key = frame_key(seed, np.uint64(first_frame + f))
        draw = 0
        place = next_hit(-1.0, key, draw, log_miss)
        while place < 4 * rows * width:
            pixel, side = int(place) >> 2, int(place) & 3
            y = pixel // width
            x = pixel - y * width
            if fired[y, x // WORD_PX] & bit_of(x):
                y += (side == 1) - (side == 0)
                x += (side == 3) - (side == 2)
                if 0 <= y < rows and 0 <= x < width:
                    words[f, y, x // WORD_PX] |= bit_of(x)
            draw += 1
            place = next_hit(place, key, draw, log_miss)
