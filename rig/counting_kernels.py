"""Compiled counting: packed frames are added as they are, 64 pixels to a word, into counters that lie in bit planes.

Plane i holds bit i of 64 counts a word. Seven frames at a time go through a tree of full adders (Harley and Seal; see
Muła, Kurz, Lemire, "Faster population counts using AVX2 instructions", 2018) and into the planes as one 3-bit number.
The planes of `CHUNK` words lie side by side, so that they stay in the fastest cache while frame after frame is added,
and at distances known to the compiler, which then needs no check that they do not overlap.
Measured on one core of a Zen 3 processor with 16 GB/s of plain reads: 11 to 15 GB/s at 3 to 14 frames a column; one
frame after the other without the tree 4 to 6; with planes in separate arrays 2 to 5 (not vectorised).
"""

from typing import Final

import numba
import numpy as np
from numpy.typing import NDArray

WORD_PX: Final = 64
WORD_BYTES: Final = 8
CHUNK: Final = 256
"""Words of a frame that are counted together; their planes fill half of a 32 KiB cache."""
PLANES: Final = 8
MOST_FRAMES: Final = (1 << PLANES) - 1
"""Frames that a set of planes can count."""
FEW_FRAMES: Final = 15
"""Up to so many frames four planes do."""


def new_planes(words: int) -> NDArray[np.uint64]:
    """Counters, all zero, for `words` words of a frame: (chunks, PLANES + 1, CHUNK); the last plane is scratch.

    Padded by two words, since kernels read 16 bytes at a time.
    """
    chunks = -(-words // CHUNK)
    size = chunks * (PLANES + 1) * CHUNK
    return np.zeros(size + 2, np.uint64)[:size].reshape(chunks, PLANES + 1, CHUNK)


@numba.njit(cache=True, nogil=True)
def _add_7(words, at, frame, n, p):  # type: ignore[no-untyped-def]
    a, b, c = words[at : at + n], words[at + frame : at + frame + n], words[at + 2 * frame : at + 2 * frame + n]
    d, e = words[at + 3 * frame : at + 3 * frame + n], words[at + 4 * frame : at + 4 * frame + n]
    g, h = words[at + 5 * frame : at + 5 * frame + n], words[at + 6 * frame : at + 6 * frame + n]
    for i in range(n):
        u = a[i] ^ b[i]
        ones = u ^ c[i]
        t = (a[i] & b[i]) | (u & c[i])
        u = ones ^ d[i]
        v = (ones & d[i]) | (u & e[i])
        ones = u ^ e[i]
        u = ones ^ g[i]
        w = (ones & g[i]) | (u & h[i])
        ones = u ^ h[i]
        u = t ^ v
        twos = u ^ w
        fours = (t & v) | (u & w)
        x = p[i]
        carry = x & ones
        p[i] = x ^ ones
        x = p[CHUNK + i]
        u = x ^ twos
        p[CHUNK + i] = u ^ carry
        carry = (x & twos) | (u & carry)
        x = p[2 * CHUNK + i]
        u = x ^ fours
        p[2 * CHUNK + i] = u ^ carry
        carry = (x & fours) | (u & carry)
        x = p[3 * CHUNK + i]
        p[3 * CHUNK + i] = x ^ carry
        p[PLANES * CHUNK + i] = x & carry


@numba.njit(cache=True, nogil=True)
def _add_3(words, at, frame, n, p):  # type: ignore[no-untyped-def]
    a, b, c = words[at : at + n], words[at + frame : at + frame + n], words[at + 2 * frame : at + 2 * frame + n]
    for i in range(n):
        u = a[i] ^ b[i]
        ones = u ^ c[i]
        twos = (a[i] & b[i]) | (u & c[i])
        x = p[i]
        carry = x & ones
        p[i] = x ^ ones
        x = p[CHUNK + i]
        u = x ^ twos
        p[CHUNK + i] = u ^ carry
        carry = (x & twos) | (u & carry)
        x = p[2 * CHUNK + i]
        p[2 * CHUNK + i] = x ^ carry
        carry = x & carry
        x = p[3 * CHUNK + i]
        p[3 * CHUNK + i] = x ^ carry
        p[PLANES * CHUNK + i] = x & carry


@numba.njit(cache=True, nogil=True)
def _add_2(words, at, frame, n, p):  # type: ignore[no-untyped-def]
    a, b = words[at : at + n], words[at + frame : at + frame + n]
    for i in range(n):
        ones = a[i] ^ b[i]
        twos = a[i] & b[i]
        x = p[i]
        carry = x & ones
        p[i] = x ^ ones
        x = p[CHUNK + i]
        u = x ^ twos
        p[CHUNK + i] = u ^ carry
        carry = (x & twos) | (u & carry)
        x = p[2 * CHUNK + i]
        p[2 * CHUNK + i] = x ^ carry
        carry = x & carry
        x = p[3 * CHUNK + i]
        p[3 * CHUNK + i] = x ^ carry
        p[PLANES * CHUNK + i] = x & carry


@numba.njit(cache=True, nogil=True)
def _add_1(words, at, n, p):  # type: ignore[no-untyped-def]
    a = words[at : at + n]
    for i in range(n):
        x = p[i]
        carry = x & a[i]
        p[i] = x ^ a[i]
        for q in range(1, 4):
            x = p[q * CHUNK + i]
            p[q * CHUNK + i] = x ^ carry
            carry = x & carry
        p[PLANES * CHUNK + i] = carry


@numba.njit(cache=True, nogil=True)
def _carry_on(n, p):  # type: ignore[no-untyped-def]
    """Add what overflowed the first four planes to the others."""
    for i in range(n):
        carry = p[PLANES * CHUNK + i]
        for q in range(4, PLANES):
            x = p[q * CHUNK + i]
            p[q * CHUNK + i] = x ^ carry
            carry = x & carry


@numba.njit(cache=True, nogil=True)
def add_frames(
    words: NDArray[np.uint64], frame: int, at: int, first: int, last: int, n: int, few: bool, planes: NDArray[np.uint64]
) -> None:
    """Add words at..at+n-1 of frames first..last-1 to counters.

    words: (all words,), `frame` of them a frame; n: at most CHUNK; planes: ((PLANES + 1) * CHUNK,), one chunk's. few: no
    count will exceed FEW_FRAMES.
    """
    f = first
    while f < last:
        here = f * frame + at
        if f + 7 <= last:
            _add_7(words, here, frame, n, planes)
            f += 7
        elif f + 3 <= last:
            _add_3(words, here, frame, n, planes)
            f += 3
        elif f + 2 <= last:
            _add_2(words, here, frame, n, planes)
            f += 2
        else:
            _add_1(words, here, n, planes)
            f += 1
        if not few:
            _carry_on(n, planes)


@numba.njit(cache=True, nogil=True)
def clear(first_plane: int, last_plane: int, n: int, planes: NDArray[np.uint64]) -> None:
    """Set planes first_plane..last_plane-1 of a chunk's first n counters to zero."""
    for q in range(first_plane, last_plane):
        planes[q * CHUNK : q * CHUNK + n] = np.uint64(0)
