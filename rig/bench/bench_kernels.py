"""Compiled work of the bench alone: a plain read of memory, made-up frames, and counting without an estimate."""

import numba
import numpy as np
from numpy.typing import NDArray

from rig.counting_kernels import add_frames, rows_of_chunk

BITS_OF_CHANCE = 16
"""A pixel detects where a random number of so many bits is below its threshold."""


@numba.njit(cache=True, nogil=True)
def read_all(words: NDArray[np.uint64]) -> int:
    """Read every word once; what comes back only keeps the compiler from leaving it out."""
    total = np.uint64(0)
    for i in range(words.shape[0]):
        total ^= words[i]
    return int(total)


@numba.njit(cache=True, nogil=True)
def draw_frames(threshold: NDArray[np.uint32], seed: int, frames: NDArray[np.uint8]) -> None:
    """Draw frames (n, rows, window / 8) of pixels that detect where a 16-bit number is below threshold (rows, window).

    The numbers are SplitMix64's (Steele, Lea, Flood, "Fast splittable pseudorandom number generators", OOPSLA 2014).
    """
    state = np.uint64(seed)
    for f in range(frames.shape[0]):
        for y in range(frames.shape[1]):
            for b in range(frames.shape[2]):
                byte = np.uint64(0)
                for half in range(2):
                    state += np.uint64(0x9E3779B97F4A7C15)
                    z = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
                    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
                    z = z ^ (z >> np.uint64(31))
                    for i in range(4):
                        detected = (z & np.uint64(0xFFFF)) < np.uint64(threshold[y, 8 * b + 4 * half + i])
                        byte = (byte << np.uint64(1)) | np.uint64(detected)
                        z = z >> np.uint64(BITS_OF_CHANCE)
                frames[f, y, b] = byte


@numba.njit(cache=True, nogil=True)
def count_columns(
    words: NDArray[np.uint64],
    rows: int,
    row_words: int,
    exposures: int,
    planes: NDArray[np.uint64],
    first_chunk: int,
    last_chunk: int,
) -> None:
    """Count whole columns of frames, one after the other, into bit planes that the next column takes over.

    words: (all words,) of frames of `rows` rows; planes: see `new_planes`. Expanding counts is part of an estimate.
    """
    frame = rows * row_words
    frames = words.shape[0] // frame
    chunk_rows = rows_of_chunk(row_words)
    for j in range(first_chunk, last_chunk):
        at = j * chunk_rows * row_words
        n = (min((j + 1) * chunk_rows, rows) - j * chunk_rows) * row_words
        counters = planes[j].ravel()
        for first in range(0, frames, exposures):
            add_frames(words, frame, at, first, min(first + exposures, frames), n, 0, counters)
