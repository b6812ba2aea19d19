"""Faults that a sensor adds to the bits of one frame: crosstalk, hot and dead pixels, errors of the read-out.

Rare random events are drawn exactly, through the gaps between them, so the cost depends on the number of events and not
of pixels. If each of the places 0, 1, 2, ... is hit with probability p,

    gap = floor(ln U / ln(1 - p)),    U uniform in (0, 1)

is the number of places skipped before the next hit (geometric distribution; Devroye, Non-Uniform Random Variate
Generation, 1986, X.2). U has 53 bits and comes from a counter, keyed by seed, effect and frame as the photons are. The
hits in a frame depend on these alone, not on blocks or threads. Frames are uint64 (frames, rows, words). Measured: 17
ns a hit.
"""

import math

import numba
import numpy as np
from numpy.typing import NDArray

from sim_backend.effects.setting import FrameTimes, Setting, Words
from sim_backend.light.optics import Sensor
from sim_backend.random_numbers import WORD_PX, frame_key

_CROSSTALK, _ERRORS = np.uint64(0xC6A4A7935BD1E995), np.uint64(0x8EBC6AF09C88C6E3)
"""Streams that keep these draws apart from those of photons and other effects."""
_DEFECTS = 2
"""Stream of the sensor's seed that keeps these draws apart from those of the dark rates."""


def log_miss(probability: float) -> float:
    """ln(1 - p), an argument of `next_hit`."""
    return -math.inf if probability >= 1 else math.log1p(-probability)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def next_hit(place: float, key: np.uint64, draw: int, log_miss: float) -> float:
    """The next hit after `place`, infinity if p is 0. A place of -1 gives the first hit. draw: number of this random
    draw, 0, 1, 2, ..., in the key's stream. log_miss: ln(1 - p)."""
    uniform = (float(frame_key(key, np.uint64(draw)) >> np.uint64(11)) + 0.5) * 2.0**-53
    return place + 1.0 + math.floor(math.log(uniform) / log_miss) if log_miss < 0.0 else math.inf


@numba.njit(cache=True, nogil=True)
def bit_of(x: int) -> np.uint64:
    """The bit of pixel x within its word, which is word x // 64 of the row (`packbits` order, little-endian words)."""
    return np.uint64(1) << np.uint64((x % WORD_PX) ^ 7)


def packed(pixels: NDArray[np.bool_]) -> Words:
    """A mask (rows, width) as words (rows, words) uint64 in the order of the frames, pad bits 0."""
    rows, width = pixels.shape
    whole = np.zeros((rows, -(-width // WORD_PX) * WORD_PX), np.bool_)
    whole[:, :width] = pixels
    return np.packbits(whole, axis=1).view(np.uint64)


class Crosstalk:
    """A detection triggers a neighbouring pixel by the light of its own avalanche.

    Acts on the bits of photons, dark counts and afterpulses. Each detection of a frame fires each of its 4 neighbours
    with probability c / 4 (c: `crosstalk`), all independently. Pixels fired in this way trigger no others, an effect of
    order c^2. A pixel that fires by itself with probability p and has m neighbours that fired is 1 with probability
    1 - (1 - p)(1 - c/4)^m. If p is small and equal in all pixels, that is on average p (1 + c). Light that leaves the
    array is lost. c is 0.1 to 0.2 % in 512 x 512 arrays of large pitch; the share beyond 4 neighbours is not modelled.

    Exact for any c. Each pixel has four possible transfers (up, down, left, right), numbered pixel by pixel; the gaps
    between those that occur are drawn. Cost per frame of 512 x 512: 9 us at 0.15 %, in proportion to c.
    """

    reads_before = False

    def __init__(self, setting: Setting) -> None:
        self._width = setting.view.width
        self._log_miss = log_miss(setting.sensor.crosstalk / 4)

    def apply(self, seed: np.uint64, first_frame: int, words: Words, before: Words, times: FrameTimes) -> None:
        """See `BitEffect`."""
        _spark_over(words, self._width, seed ^ _CROSSTALK, first_frame, self._log_miss)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _spark_over(words: Words, width: int, seed: np.uint64, first_frame: int, log_miss: float) -> None:
    """Set the bits of neighbours that detections fire, in frames (frames, rows, words)."""
    frames, rows, _ = words.shape
    fired = np.empty_like(words[0])
    for f in range(frames):
        fired[:] = words[f]
        key = frame_key(seed, np.uint64(first_frame + f))
        draw = 0
        place = next_hit(-1.0, key, draw, log_miss)
        while place < 4 * rows * width:
            pixel, side = int(place) >> 2, int(place) & 3
            y, x = divmod(pixel, width)
            if fired[y, x // WORD_PX] & bit_of(x):
                y += (side == 1) - (side == 0)
                x += (side == 3) - (side == 2)
                if 0 <= y < rows and 0 <= x < width:
                    words[f, y, x // WORD_PX] |= bit_of(x)
            draw += 1
            place = next_hit(place, key, draw, log_miss)


def defects(sensor: Sensor, size: tuple[int, ...]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """The dead and the hot pixels, masks of shape `size` (rows, width) that depend on the sensor's settings alone."""
    # One random number a pixel for both, so that a larger share includes all pixels of a smaller one.
    lot = np.random.default_rng([sensor.pixel_seed, _DEFECTS]).random(size)
    return lot < sensor.dead_share, lot >= 1 - sensor.hot_share


class Defects:
    """Hot pixels read 1 and dead pixels read 0 in every frame, whatever their diodes do.

    Acts on the bits in the pixels' memories, after crosstalk and all other effects between diodes. A real colour SPAD
    has 4 % of defective pixels (crop of 254 x 496, public data of wision-lab/photoncube) without clusters: pairs of
    neighbours are as frequent as by chance (0.98 times along the row, 0.92 along the column, each +-0.07). So a pixel
    is dead with probability `dead_share`, hot with `hot_share`, never both, and independent of all others; `pixel_seed`
    determines which ones. Diodes that fire too often are the tail of the dark counts. Cost: 3 us per 512 x 512 frame.
    """

    reads_before = False

    def __init__(self, setting: Setting) -> None:
        dead, hot = defects(setting.sensor, setting.view.u.shape)
        self._alive, self._hot = packed(~dead), packed(hot)

    def apply(self, seed: np.uint64, first_frame: int, words: Words, before: Words, times: FrameTimes) -> None:
        """See `BitEffect`."""
        np.bitwise_and(words, self._alive, out=words)
        np.bitwise_or(words, self._hot, out=words)


class BitErrors:
    """Each pixel of a frame is read wrongly with probability e, 0 as 1 and 1 as 0: P(1) = p (1 - e) + (1 - p) e.

    Acts on the bits as they are read, after all other effects. These errors happen inside the sensor, between the
    pixels and the logic that packs frames. Checksums are computed from the wrong bits, so neither a CRC nor `rig
    verify` detects them. Errors after the checksum, on the cable, are not simulated; tests make them with
    `SpbUsbModel.mangle`. Exact; cost per frame of 512 x 512: 5 us at 0.1 %, in proportion to e.
    """

    reads_before = False

    def __init__(self, setting: Setting) -> None:
        self._width = setting.view.width
        self._log_miss = log_miss(setting.sensor.bit_error_rate)

    def apply(self, seed: np.uint64, first_frame: int, words: Words, before: Words, times: FrameTimes) -> None:
        """See `BitEffect`."""
        _flip(words, self._width, seed ^ _ERRORS, first_frame, self._log_miss)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _flip(words: Words, width: int, seed: np.uint64, first_frame: int, log_miss: float) -> None:
    frames, rows, _ = words.shape
    for f in range(frames):
        key = frame_key(seed, np.uint64(first_frame + f))
        draw = 0
        place = next_hit(-1.0, key, draw, log_miss)
        while place < rows * width:
            y, x = divmod(int(place), width)
            words[f, y, x // WORD_PX] ^= bit_of(x)
            draw += 1
            place = next_hit(place, key, draw, log_miss)
