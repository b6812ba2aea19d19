"""Compiled exact Bernoulli sampling of packed binary frames, 16 pixels at a time.

A pixel's bit is 1 with probability p. It is set if a random number of 16 bits is below the pixel's level, about 2^16 p.
The rest of p comes from a second draw: each pixel is chosen with chance c = 3 x 2^-16 (about twelve in a frame of
512 x 512), and its bit is drawn again with chance s, where

    p = (1 - c) level / 2^16 + c s,     0 <= s <= 1 for every level within [2^16 (p - c) / (1 - c), 2^16 p / (1 - c)]

That interval is three levels wide. So levels may be computed in float32 while every p is exact to the last bit of a
float64; 0 never fires and 1 always does. The highest 16-bit level stands for 2^16 itself: its pixels are 1 whatever the
random number, so they are set afterwards. Levels are int16 (rows, words, 64), frames uint64 (frames, rows, words).
Random numbers depend only on seed, frame and pixel (`sim_backend.random_numbers`), not on windows, threads or blocks.

Measured for 512 x 512 on one core: 12 us a frame, and 0.12 ms for new levels when half of the words are lit.
"""

import math
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from sim_backend.random_numbers import (
    FRAME_STEP,
    GOLDEN,
    PLACE,
    ROUGHLY,
    WORD_PX,
    block_numbers,
    counter_bits,
    drawn_word,
    frame_key,
    full_word,
    mixed_word,
    one_minus_exp_minus,
    one_minus_exp_minus_32,
    place_levels,
)

LEVELS = 2**16
NEVER = LEVELS // 2 - 1
"""The stored value of level 0. `NEVER` minus the level is stored, so the highest level is stored as -32768."""
CHANCE = 3.0 / LEVELS
"""Probability that a pixel is drawn anew."""
_LEVELING = tuple(np.float32(x) for x in (NEVER + 1.5, LEVELS / (1.0 - CHANCE), NEVER - LEVELS + 1, NEVER))
"""Offset, slope, least and largest stored value. Offset minus slope times p is limited to the least and largest value
and stored without its fraction. So the level lies at least half a level inside its interval, on both sides. Where it is
the highest of 16 bits, 2^16 is within the interval, too."""
_TOGETHER = 8
_KEY_ROWS, _ROW_SHIFT = 8, 16
"""Number of rows that share a key, and the shift in bits of a row's number before it is XORed into the key."""
_WORD_BYTES = WORD_PX * 2
"""Bytes that the levels of a word of pixels take."""
_PER_SKIP = 1.0 / math.log1p(-CHANCE)

_S11 = np.uint64(11)
_ANEW = np.uint64(2**32)
"""Added to a strip's number. The sum replaces the number of the row group in the streams of pixels drawn anew."""
_STRIP_ROWS = 64
_UNIT = 2.0**-53
_PLACE = np.array(PLACE, np.uint8)


Single = NDArray[np.float32]
Words = NDArray[np.uint64]
Places = NDArray[np.int32]
Rows = tuple[int, int]
"""The first row, and that after the last."""
Levels = tuple[NDArray[np.int16], Words]
"""The input for drawing a frame: levels (rows, words, 64), as they are stored, in the order `PLACE`; and bits (rows,
words) of the pixels of the highest level."""
Light = tuple[NDArray[np.float64], Single, float, float]
"""The light of frames: detections per second without the laser and per second and watt of it, (rows, width); exposure
in s and power in W."""
Key = tuple[np.uint64, np.uint64]


def new_levels(rows: int, words: int) -> Levels:
    """Levels of pixels that never fire."""
    return np.full((rows, words, WORD_PX), NEVER, np.int16), np.zeros((rows, words), np.uint64)


def set_levels(
    steady: Single, rate: Single, exposure_w_s: float, rows: Rows, dark: Levels, lit: NDArray[np.bool_],
    levels: Levels,
) -> None:  # fmt: skip
    """Set the levels of rows, in place, for p = 1 - exp(-(steady + exposure_w_s rate)).

    steady: detections per exposure without the laser; rate: the laser's, per second and watt; both (rows, width), not
    negative. exposure_w_s: power times time. In each row, the words of 64 pixels before the first word with laser light
    and after the last one take their levels from `dark`, unless `dark` has no rows. lit (rows, words) says which words
    of `levels` may differ from `dark`; the call updates it.
    """
    rates, constants = (rate, rate.view(np.uint32), np.float32(exposure_w_s)), (ROUGHLY, _LEVELING)
    _set_levels(steady, rates, rows, dark, lit, levels, constants)


@numba.njit(inline="always")
def _is_lit(rate_bits: NDArray[np.uint32], row: np.uint64, word: int, width: int) -> bool:
    """Whether there is laser light in a word of pixels."""
    light = np.uint32(0)
    for i in range(min(WORD_PX, width - word * WORD_PX)):
        light |= rate_bits[row, np.uint64(word * WORD_PX) + np.uint64(i)]
    return bool(light != 0)


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _set_levels(
    steady: Single, rates: tuple[Any, ...], rows: Rows, dark: Levels, lit: Any, levels: Levels, constants: Any
) -> None:
    (first_row, last_row), (rate, rate_bits, factor) = rows, rates
    roughly, (offset, slope, least, largest) = constants
    (stored, sure), (dark_stored, dark_sure) = levels, dark
    copies = len(dark_sure) > 0
    width, words = steady.shape[1], stored.shape[1]
    values = np.full(words * WORD_PX, NEVER, np.int16)
    to_levels, from_values = stored.ctypes.data, values.ctypes.data
    for y in range(first_row, last_row):
        row = np.uint64(y)
        first, last = 0, words
        while copies and first < last and not _is_lit(rate_bits, row, first, width):
            first += 1
        while copies and last > first and not _is_lit(rate_bits, row, last - 1, width):
            last -= 1
        for k in range(words):
            inside = first <= k < last
            if lit[y, k] and not inside:
                for i in range(WORD_PX):
                    stored[y, k, i] = dark_stored[y, k, i]
                sure[y, k] = dark_sure[y, k]
            lit[y, k] = inside
        start = np.uint64(first * WORD_PX)
        for i in range(min(last * WORD_PX, width) - first * WORD_PX):
            x = start + np.uint64(i)
            flux = rate[row, x] * factor + steady[row, x]
            level = offset - slope * one_minus_exp_minus_32(flux, roughly)
            values[x] = np.int16(np.int32(min(max(level, least), largest)))
        for k in range(first, last):
            place = to_levels + (y * words + k) * _WORD_BYTES
            place_levels(from_values + k * _WORD_BYTES, place)
            sure[y, k] = full_word(place)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def draw_frames(
    levels: Levels, light: Light, seed: np.uint64, first_frame: int, rows: Rows, first_word: Places, words: Words
) -> None:
    """Draw rows of frames first_frame, first_frame + 1, ... into `words` (frames, rows, words).

    levels: as `set_levels` computed them for the light. first_word: (frames,), word of the row at which each frame's
    window begins; the window has the same bits as that part of the whole frame.
    """
    first_row, last_row = rows
    frames, _, n_words = words.shape
    key = mixed_word(seed + GOLDEN), mixed_word(seed + FRAME_STEP)
    stored, sure = levels
    row_words = stored.shape[1]
    blocks = block_numbers(row_words)
    of_blocks, of_levels = blocks.ctypes.data, stored.ctypes.data
    # A few frames at a time: rows of all frames would lie on more memory pages than the processor's TLB holds.
    for first in range(0, frames, _TOGETHER):
        for group in range(first_row // _KEY_ROWS, (last_row - 1) // _KEY_ROWS + 1):
            for f in range(first, min(first + _TOGETHER, frames)):
                first_k = np.uint64(first_word[f])
                group_key = counter_bits(key[0], key[1], np.uint64(first_frame + f), np.uint64(group))
                for y in range(max(first_row, group * _KEY_ROWS), min(last_row, (group + 1) * _KEY_ROWS)):
                    row_bits = np.uint64(y % _KEY_ROWS << _ROW_SHIFT)
                    row_key = group_key[0] ^ row_bits, group_key[1] ^ row_bits
                    of_row = of_levels + y * row_words * _WORD_BYTES
                    for i in range(n_words):
                        k = np.uint64(i) + first_k
                        offset = np.int64(k) * _WORD_BYTES
                        bits = drawn_word(row_key, of_blocks + offset, of_row + offset)
                        words[np.uint64(f), np.uint64(y), np.uint64(i)] = bits | sure[np.uint64(y), k]
    _draw_anew(key, levels, light, first_frame, rows, first_word, words)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _draw_anew(
    key: Key, levels: Levels, light: Light, first_frame: int, rows: Rows, first_word: Places, words: Words
) -> None:
    """Draw the pixels that chance chooses anew; arguments as in `draw_frames`."""
    (stored, _), (first_row, last_row) = levels, rows
    steady, rate, exposure_s, power_w = light
    width, row_px = steady.shape[1], stored.shape[1] * WORD_PX
    for f in range(len(words)):
        # Strips of rows have streams of their own, so that a thread need not go through other threads' rows.
        for strip in range(first_row // _STRIP_ROWS, (last_row - 1) // _STRIP_ROWS + 1):
            stream = counter_bits(key[0], key[1], np.uint64(first_frame + f), _ANEW + np.uint64(strip))
            end = min(last_row, (strip + 1) * _STRIP_ROWS) * row_px
            at, number = strip * _STRIP_ROWS * row_px - 1, np.uint64(0)
            while True:
                skip, drawn = counter_bits(stream[0], stream[1], number, np.uint64(0))
                number += np.uint64(1)
                at += 1 + int(math.log((float(skip >> _S11) + 1.0) * _UNIT) * _PER_SKIP)
                if at >= end:
                    break
                y, x = divmod(at, row_px)
                k = x // WORD_PX
                i = k - first_word[f]
                if y < first_row or x >= width or not 0 <= i < words.shape[2]:
                    continue
                p = one_minus_exp_minus(exposure_s * (steady[y, x] + power_w * rate[y, x]))
                level = NEVER - float(stored[y, k, _PLACE[x % WORD_PX]])
                level = LEVELS if level == LEVELS - 1 else level
                share = (p - (1.0 - CHANCE) * (level / LEVELS)) / CHANCE
                bit = np.uint64(1) << np.uint64(x % WORD_PX ^ 7)
                words[f, y, i] &= ~bit
                if float(drawn >> _S11) * _UNIT < share:
                    words[f, y, i] |= bit


_DROP_STREAM = np.uint64(0xA0761D6478BD642F)
"""Stream that keeps the draws of `dropped_frames` apart from those of photons."""


@numba.njit(cache=True, nogil=True)
def dropped_frames(seed: np.uint64, first_frame: int, frames: int, probability: float) -> NDArray[np.bool_]:
    """Mask of frames chosen at random, such as those that get lost, bool (frames,), each with this probability."""
    lost = np.zeros(frames, np.bool_)
    for f in range(frames):
        random = frame_key(seed ^ _DROP_STREAM, np.uint64(first_frame + f))
        lost[f] = float(random >> _S11) < probability * 2.0**53
    return lost
