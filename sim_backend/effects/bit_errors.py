"""Bit errors of the read-out: each pixel of a frame is read wrongly with probability e, 0 as 1 and 1 as 0.

    P(1) = p (1 - e) + (1 - p) e

They happen inside the sensor, on the way from the pixels to the logic that packs frames: checksums are made of the
wrong bits, so no CRC tells of them, and neither does a recording's `verify`. Errors behind the checksum, on the cable,
are not modelled here; those are damage that the link's CRC finds (`sim_backend.wire.serve.wire_server`).

Called for by `world.sensor.bit_error_rate` above 0, which is e. Exact; cost per frame of 512 x 512: 5 us at 0.1 %, in
proportion to e.
"""

import numba
import numpy as np
from numpy.typing import NDArray

from sim_backend.effects.rare_bits import bit_of, log_miss, next_hit
from sim_backend.effects.setting import FrameTimes, Setting, Words
from sim_backend.random_numbers import WORD_PX, frame_key

_STREAM = np.uint64(0x8EBC6AF09C88C6E3)
"""Stream that keeps these draws apart from those of photons and other effects."""


class BitErrors:
    """Acts on the bits as they are read, the last of all."""

    reads_before = False

    def __init__(self, setting: Setting) -> None:
        self._width = setting.view.width
        self._log_miss = log_miss(setting.sensor.bit_error_rate)

    def apply(self, seed: np.uint64, first_frame: int, words: Words, before: Words, times: FrameTimes) -> None:
        """See `BitEffect`."""
        _flip(words, self._width, seed ^ _STREAM, first_frame, self._log_miss)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _flip(words: NDArray[np.uint64], width: int, seed: np.uint64, first_frame: int, log_miss: float) -> None:
    frames, rows, _ = words.shape
    for f in range(frames):
        key = frame_key(seed, np.uint64(first_frame + f))
        draw = 0
        place = next_hit(-1.0, key, draw, log_miss)
        while place < rows * width:
            y = int(place) // width
            x = int(place) - y * width
            words[f, y, x // WORD_PX] ^= bit_of(x)
            draw += 1
            place = next_hit(place, key, draw, log_miss)
