"""Compiled exact Bernoulli sampling of packed binary frames, 64 pixels at a time.

A bit is 1 where a uniform number lies below the pixel's p. Both are compared bit by bit from the top, 64 pixels in one
word: p as 32 bit planes, the uniform number as random words, until no pixel is undecided: about 8 random words per 64
pixels, with the full 32 bits of p and no approximation. Random words come from a counter (SplitMix64 at position word *
32 + plane of a stream keyed by seed and frame number), so a bit depends on seed, frame number, pixel and p only."""

import math

import numba
import numpy as np
from numpy.typing import NDArray

PLANES = 32
"""Bits of p; p is rounded to 2^-32."""
WORD_PX = 64

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_FRAME_STEP = np.uint64(0xD1342543DE82EF95)
"""SplitMix64 (Steele, Lea, Flood 2014) and an odd multiplier that spreads frame numbers."""
_S27, _S30, _S31 = np.uint64(27), np.uint64(30), np.uint64(31)
_ZERO, _ONE = np.uint64(0), np.uint64(1)
_ALL = np.uint64(0xFFFFFFFFFFFFFFFF)
_SCALE = 2.0**PLANES
_SERIES_BELOW = 0.05
"""Below this lambda eight terms of 1 - exp(-lambda) are exact to 1e-16 and ten times as fast."""


@numba.njit(cache=True, nogil=True, inline="always")
def _mix(z: np.uint64) -> np.uint64:
    z = (z ^ (z >> _S30)) * _MIX_1
    z = (z ^ (z >> _S27)) * _MIX_2
    return z ^ (z >> _S31)


@numba.njit(cache=True, nogil=True)
def frame_key(seed: np.uint64, frame: np.uint64) -> np.uint64:
    """Start of a frame's random stream."""
    return _mix(_mix(seed + _GOLDEN) + frame * _FRAME_STEP)


@numba.njit(cache=True, nogil=True)
def _probability(flux: float) -> float:
    """1 - exp(-flux)."""
    if flux < _SERIES_BELOW:
        f = flux
        return f * (1 - f / 2 * (1 - f / 3 * (1 - f / 4 * (1 - f / 5 * (1 - f / 6 * (1 - f / 7 * (1 - f / 8)))))))
    return -math.expm1(-flux)


@numba.njit(cache=True, nogil=True)
def _transpose(p: NDArray[np.uint32], planes: NDArray[np.uint64]) -> None:
    """From 64 values of 32 bits to 32 words of 64 bits, most significant plane first.

    Pixel i sits at bit 8 (i // 8) + 7 - i % 8: the place `packbits` order gives it in a little-endian word. Two 32 x 32
    bit matrices are transposed by swapping ever smaller squares (Hacker's Delight, 7-3). Destroys p.
    """
    for half in (0, 32):
        j = 16
        mask = np.uint32(0x0000FFFF)
        while j != 0:
            k = 0
            while k < 32:
                t = (p[half + k] ^ (p[half + k + j] >> np.uint32(j))) & mask
                p[half + k] ^= t
                p[half + k + j] ^= t << np.uint32(j)
                k = (k + j + 1) & ~j
            j >>= 1
            mask ^= mask << np.uint32(j)
    for i in range(32):
        planes[i] = np.uint64(p[i]) | (np.uint64(p[32 + i]) << np.uint64(32))


@numba.njit(cache=True, nogil=True)
def bit_planes(
    steady: NDArray[np.float64],
    sheet: NDArray[np.float64],
    exposure_s: float,
    power_share_w: float,
    dark_planes: NDArray[np.uint64],
    first_row: int,
    last_row: int,
    planes: NDArray[np.uint64],
) -> None:
    """Detection probabilities of rows first_row..last_row-1 as bit planes (rows, words, 32) uint64.

    steady: detections per second; sheet: per second and watt, both (rows, width). Words without light from the sheet
    are copied from `dark_planes`, unless that has no rows."""
    width = steady.shape[1]
    words = planes.shape[1]
    p = np.empty(WORD_PX, np.uint32)
    for y in range(first_row, last_row):
        for k in range(words):
            x0 = k * WORD_PX
            n = min(WORD_PX, width - x0)
            if dark_planes.shape[0] > 0:
                lit = False
                for i in range(n):
                    lit |= sheet[y, x0 + i] > 0.0
                if not lit:
                    for i in range(PLANES):
                        planes[y, k, i] = dark_planes[y, k, i]
                    continue
            for i in range(WORD_PX):
                value = np.uint32(0)
                if i < n:
                    flux = exposure_s * (steady[y, x0 + i] + power_share_w * sheet[y, x0 + i])
                    scaled = _probability(flux) * _SCALE + 0.5
                    value = np.uint32(0xFFFFFFFF) if scaled >= _SCALE else np.uint32(scaled)
                # After the transpose row r of a half lands at bit 31 - r.
                place = 8 * (i // 8) + 7 - i % 8
                p[place // 32 * 32 + 31 - place % 32] = value
            _transpose(p, planes[y, k])


@numba.njit(cache=True, nogil=True)
def draw_frames(
    planes: NDArray[np.uint64],
    seed: np.uint64,
    first_frame: int,
    first_row: int,
    last_row: int,
    first_word: NDArray[np.int32],
    words: NDArray[np.uint64],
) -> None:
    """Draw frames first_frame, first_frame + 1, ... into `words` (frames, rows, words) uint64, rows
    first_row..last_row-1.

    first_word: (frames,), word of the row at which each frame's window begins; its bits are those of the whole frame.
    """
    frames, _, n_words = words.shape
    row_words = planes.shape[1]
    keys = np.empty(frames, np.uint64)
    for f in range(frames):
        keys[f] = frame_key(seed, np.uint64(first_frame + f))
    for y in range(first_row, last_row):
        for f in range(frames):
            for i_word in range(n_words):
                k = first_word[f] + i_word
                counter = keys[f] + np.uint64((y * row_words + k) * PLANES) * _GOLDEN
                undecided = _ALL
                result = _ZERO
                for i in range(PLANES):
                    counter += _GOLDEN
                    random = _mix(counter)
                    plane = planes[y, k, i]
                    result |= undecided & plane & ~random
                    undecided &= ~(plane ^ random)
                    if undecided == _ZERO:
                        break
                words[f, y, i_word] = result


_DROP_STREAM = np.uint64(0xA0761D6478BD642F)
"""Keeps the draws of lost frames apart from those of photons."""


@numba.njit(cache=True, nogil=True)
def dropped_frames(seed: np.uint64, first_frame: int, frames: int, probability: float) -> NDArray[np.bool_]:
    """Which of the frames get lost, bool (frames,), each with the given probability."""
    lost = np.zeros(frames, np.bool_)
    for f in range(frames):
        random = frame_key(seed ^ _DROP_STREAM, np.uint64(first_frame + f))
        lost[f] = float(random >> np.uint64(11)) < probability * 2.0**53
    return lost
