"""Compiled counting: bit-sliced addition of packed frames, expanded once per run of frames of one column."""

import numba
import numpy as np
from numpy.typing import NDArray

PLANES = 6
"""Bit planes of a run: up to 63 frames are added before their counts are expanded."""
RUN_FRAMES = (1 << PLANES) - 1


@numba.njit(cache=True, nogil=True)
def _msb_first(word: np.uint64) -> np.uint64:
    """Byte-swap, so that pixel i of a little-endian load of packed bytes is bit 63 - i."""
    word = ((word & np.uint64(0x00FF00FF00FF00FF)) << np.uint64(8)) | (
        (word >> np.uint64(8)) & np.uint64(0x00FF00FF00FF00FF)
    )
    word = ((word & np.uint64(0x0000FFFF0000FFFF)) << np.uint64(16)) | (
        (word >> np.uint64(16)) & np.uint64(0x0000FFFF0000FFFF)
    )
    return (word << np.uint64(32)) | (word >> np.uint64(32))


@numba.njit(cache=True, nogil=True)
def _add_run(
    words: NDArray[np.uint64], first: int, last: int, y: int, start: int, n_words: int, out: NDArray[np.unsignedinteger]
) -> None:
    """Add the 1s of frames first..last-1, row y, words start..start+n_words-1 to out (64 * n_words,)."""
    for k in range(n_words):
        p0 = np.uint64(0)
        p1 = np.uint64(0)
        p2 = np.uint64(0)
        p3 = np.uint64(0)
        p4 = np.uint64(0)
        p5 = np.uint64(0)
        for f in range(first, last):
            carry = words[f, y, start + k]
            t = p0 & carry
            p0 ^= carry
            carry = t
            t = p1 & carry
            p1 ^= carry
            carry = t
            t = p2 & carry
            p2 ^= carry
            carry = t
            t = p3 & carry
            p3 ^= carry
            carry = t
            t = p4 & carry
            p4 ^= carry
            p5 ^= t
        if p0 | p1 | p2 | p3 | p4 | p5 == np.uint64(0):
            continue
        p0 = _msb_first(p0)
        p1 = _msb_first(p1)
        p2 = _msb_first(p2)
        p3 = _msb_first(p3)
        p4 = _msb_first(p4)
        p5 = _msb_first(p5)
        one = np.uint64(1)
        for i in range(64):
            s = np.uint64(63 - i)
            n = (
                ((p0 >> s) & one)
                + (((p1 >> s) & one) << np.uint64(1))
                + (((p2 >> s) & one) << np.uint64(2))
                + (((p3 >> s) & one) << np.uint64(3))
                + (((p4 >> s) & one) << np.uint64(4))
                + (((p5 >> s) & one) << np.uint64(5))
            )
            out[64 * k + i] += n


@numba.njit(cache=True, nogil=True)
def add_runs(
    words: NDArray[np.uint64],
    bins: NDArray[np.int32],
    x0: NDArray[np.int32],
    counts: NDArray[np.unsignedinteger],
    dark: NDArray[np.uint32],
    first_row: int,
    last_row: int,
) -> None:
    """Add frames `words` (n, rows, row words) to `counts` (columns, rows, window) or `dark` (rows, 64 * row words).

    Only rows first_row..last_row-1 are touched, so that threads may share the outputs. bins: column, -1 dark, -2 skip.
    """
    n = words.shape[0]
    n_words = counts.shape[2] // 64
    first = 0
    while first < n:
        last = first + 1
        while last < n and bins[last] == bins[first] and last - first < RUN_FRAMES:
            last += 1
        c = bins[first]
        if c >= 0:
            for y in range(first_row, last_row):
                _add_run(words, first, last, y, x0[c] // 64, n_words, counts[c, y])
        elif c == -1:
            for y in range(first_row, last_row):
                _add_run(words, first, last, y, 0, words.shape[2], dark[y])
        first = last
