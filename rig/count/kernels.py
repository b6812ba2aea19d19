"""Compiled counting of packed frames: bits are added 64 pixels at a time into counters that are stored as bit planes.

A counter of a pixel is sum over i of 2^i (bit of plane i). Planes are uint64; PLANES of them hold up to MOST_FRAMES
frames. Seven frames at a time go through a tree of full adders (Harley and Seal; see Muła, Kurz, Lemire, "Faster
population counts using AVX2 instructions", 2018) and into the planes as one 3-bit number. Adding frame after frame
without the tree takes about twice as long. The planes of `CHUNK` words lie side by side, so that they stay in the
fastest cache while frames are added. The distances between planes are constants, so compiled code need not check
whether they overlap.
"""

from typing import Final

import numba
import numpy as np
from numpy.typing import NDArray

from rig.count.lane_order import PAD, PAIRS, STEPS, new_counts, padded_lanes, read_planes, write_counts
from rig.geometry.windows import WORD_PX
from rig.simd.memory import address_of, aligned_zeros, keep_alive
from rig.simd.vectors import LANES

Words = NDArray[np.uint64]
"""Packed bits of frames, or bit planes of counters."""
WORD_BYTES: Final = 8
CHUNK: Final = 256
"""Words of a frame that are counted together; their planes fill half of a 32 KiB cache."""
PLANES: Final = 8
"""Bit planes of a counter."""
MOST_FRAMES: Final = (1 << PLANES) - 1
FEW_FRAMES: Final = 15
"""Most frames that four planes can count."""


@numba.njit(cache=True, nogil=True)
def rows_of_chunk(row_words: int) -> int:
    """Number of rows of `row_words` words that are counted together."""
    return max(CHUNK // row_words, 1)


def new_planes(chunks: int) -> Words:
    """Counters, all zero, for a number of chunks of a frame: (chunks, PLANES + 1, CHUNK); the last plane is scratch."""
    size = chunks * (PLANES + 1) * CHUNK
    # Kernels read 16 bytes at a time, beyond the end too.
    return aligned_zeros((size + 2,), np.uint64)[:size].reshape(chunks, PLANES + 1, CHUNK)


@numba.njit(cache=True, nogil=True)
def planes_for(frames: int) -> int:
    """Number of planes that hold the counts of that many frames: 1, 2, 4 or 8."""
    if frames <= 1:
        return 1
    if frames <= 3:
        return 2
    return 4 if frames <= FEW_FRAMES else PLANES


@numba.njit(inline="always")
def _sum_3(a, b, c):  # type: ignore[no-untyped-def]
    """Binary digits (ones, twos) of the sum of three bits."""
    u = a ^ b
    return u ^ c, (a & b) | (u & c)


@numba.njit(inline="always")
def _sum_5(a, b, c, d, e):  # type: ignore[no-untyped-def]
    """Binary digits (ones, twos, fours) of the sum of five bits."""
    ones, t = _sum_3(a, b, c)
    ones, v = _sum_3(ones, d, e)
    return ones, t ^ v, t & v


@numba.njit(inline="always")
def _sum_7(a, b, c, d, e, g, h):  # type: ignore[no-untyped-def]
    """Binary digits (ones, twos, fours) of the sum of seven bits."""
    ones, t = _sum_3(a, b, c)
    ones, v = _sum_3(ones, d, e)
    ones, w = _sum_3(ones, g, h)
    twos, fours = _sum_3(t, v, w)
    return ones, twos, fours


@numba.njit(inline="always")
def _add_number(p, i, ones, twos, fours, few):  # type: ignore[no-untyped-def]
    """Add a 3-bit number to the first four planes; the overflow goes to the scratch plane, unless `few` is set."""
    x = p[i]
    p[i] = x ^ ones
    p[CHUNK + i], carry = _sum_3(p[CHUNK + i], twos, x & ones)
    p[2 * CHUNK + i], carry = _sum_3(p[2 * CHUNK + i], fours, carry)
    x = p[3 * CHUNK + i]
    p[3 * CHUNK + i] = x ^ carry
    if not few:
        p[PLANES * CHUNK + i] = x & carry


@numba.njit(cache=True, nogil=True)
def _add_7(words, at, frame, n, few, p):  # type: ignore[no-untyped-def]
    a, b, c = words[at : at + n], words[at + frame : at + frame + n], words[at + 2 * frame : at + 2 * frame + n]
    d, e = words[at + 3 * frame : at + 3 * frame + n], words[at + 4 * frame : at + 4 * frame + n]
    g, h = words[at + 5 * frame : at + 5 * frame + n], words[at + 6 * frame : at + 6 * frame + n]
    for i in range(n):
        ones, twos, fours = _sum_7(a[i], b[i], c[i], d[i], e[i], g[i], h[i])
        _add_number(p, i, ones, twos, fours, few)


@numba.njit(cache=True, nogil=True)
def _add_3(words, at, frame, n, few, p):  # type: ignore[no-untyped-def]
    a, b, c = words[at : at + n], words[at + frame : at + frame + n], words[at + 2 * frame : at + 2 * frame + n]
    for i in range(n):
        ones, twos = _sum_3(a[i], b[i], c[i])
        _add_number(p, i, ones, twos, np.uint64(0), few)


@numba.njit(cache=True, nogil=True)
def _add_2(words, at, frame, n, few, p):  # type: ignore[no-untyped-def]
    a, b = words[at : at + n], words[at + frame : at + frame + n]
    for i in range(n):
        _add_number(p, i, a[i] ^ b[i], a[i] & b[i], np.uint64(0), few)


@numba.njit(cache=True, nogil=True)
def _add_1(words, at, n, few, p):  # type: ignore[no-untyped-def]
    a = words[at : at + n]
    for i in range(n):
        _add_number(p, i, a[i], np.uint64(0), np.uint64(0), few)


@numba.njit(cache=True, nogil=True)
def _set_first(words, at, frame, n, frames, p):  # type: ignore[no-untyped-def]
    """Set `planes_for(k)` planes to the counts of the first k of `frames` frames and return k: 1, 2, 3, 5 or 7."""
    a = words[at : at + n]
    if frames < 2:
        p[:n] = a
        return 1
    b = words[at + frame : at + frame + n]
    if frames < 3:
        for i in range(n):
            p[i], p[CHUNK + i] = a[i] ^ b[i], a[i] & b[i]
        return 2
    c = words[at + 2 * frame : at + 2 * frame + n]
    if frames < 5:
        for i in range(n):
            p[i], p[CHUNK + i] = _sum_3(a[i], b[i], c[i])
        return 3
    d, e = words[at + 3 * frame : at + 3 * frame + n], words[at + 4 * frame : at + 4 * frame + n]
    if frames < 7:
        for i in range(n):
            p[i], p[CHUNK + i], p[2 * CHUNK + i] = _sum_5(a[i], b[i], c[i], d[i], e[i])
            p[3 * CHUNK + i] = np.uint64(0)
        return 5
    g, h = words[at + 5 * frame : at + 5 * frame + n], words[at + 6 * frame : at + 6 * frame + n]
    for i in range(n):
        p[i], p[CHUNK + i], p[2 * CHUNK + i] = _sum_7(a[i], b[i], c[i], d[i], e[i], g[i], h[i])
        p[3 * CHUNK + i] = np.uint64(0)
    return 7


@numba.njit(cache=True, nogil=True)
def _carry_on(n, p):  # type: ignore[no-untyped-def]
    """Add what overflowed the first four planes (the scratch plane) to the others."""
    for i in range(n):
        carry = p[PLANES * CHUNK + i]
        for q in range(4, PLANES):
            x = p[q * CHUNK + i]
            p[q * CHUNK + i] = x ^ carry
            carry = x & carry


@numba.njit(cache=True, nogil=True)
def add_frames(words: Words, frame: int, at: int, first: int, last: int, n: int, counted: int, planes: Words) -> None:
    """Add words at..at+n-1 of frames first..last-1 to counters that have counted `counted` frames so far.

    words: (all words,), with `frame` words per frame; n: at most CHUNK; planes: ((PLANES + 1) * CHUNK,) of one chunk,
    of which only `planes_for(counted)` are valid, none before the first frame. Frames in all: at most MOST_FRAMES.
    """
    f, all_frames = first, counted + last - first
    if counted == 0:
        f += _set_first(words, f * frame + at, frame, n, last - first, planes)
    if f == last:
        return
    few = all_frames <= FEW_FRAMES
    # Adding changes at least four planes.
    for q in range(planes_for(counted + f - first), 4 if few else PLANES):
        planes[q * CHUNK : q * CHUNK + n] = np.uint64(0)
    while f < last:
        here = f * frame + at
        if f + 7 <= last:
            _add_7(words, here, frame, n, few, planes)
            f += 7
        elif f + 3 <= last:
            _add_3(words, here, frame, n, few, planes)
            f += 3
        elif f + 2 <= last:
            _add_2(words, here, frame, n, few, planes)
            f += 2
        else:
            _add_1(words, here, n, few, planes)
            f += 1
        if not few:
            _carry_on(n, planes)


@numba.njit(cache=True, nogil=True)
def add_runs(
    words: Words,
    first_word: NDArray[np.int32],
    row_words: int,
    used_words: int,
    bins: NDArray[np.int32],
    columns_at: NDArray[np.int32],
    x0: NDArray[np.int32],
    counts: NDArray[np.unsignedinteger],
    dark: NDArray[np.int32],
    first_row: int,
    last_row: int,
) -> None:
    """Add frames to `counts` (columns, rows, window), or to `dark` (rows, PAIRS, lanes + LANES, 2) in lane order.

    words: (all words,), with `row_words` per row. first_word: (n,), word of the sensor's row at which a frame's used
    pixels begin; they are `used_words` words. bins: (n,), -1 dark, -2 skip, else an index of columns_at (bins, lines),
    which holds the columns for which the frame is counted, one for every laser line; with no lines, lit frames are
    skipped. x0: (columns,). counts: of a type wide enough for all frames, see `with_room`. Only rows
    first_row..last_row-1 are touched, so that threads may share the outputs.
    """
    rows, width_words = dark.shape[0], (dark.shape[2] - LANES) * STEPS // WORD_PX
    window = counts.shape[2]
    planes = np.zeros((PLANES + 1) * CHUNK + 2, np.uint64)
    as_bytes = planes.view(np.uint8)
    n_lit = new_counts(2, padded_lanes(window))
    n_dark = new_counts(2, padded_lanes(used_words * WORD_PX))
    n_pairs, eights = n_lit.view(np.uint16), counts.view(np.uint64)
    lit_pair = n_pairs.shape[1] // PAIRS
    chunk_rows = rows_of_chunk(row_words)
    for y0 in range(first_row, last_row, chunk_rows):
        y1 = min(y0 + chunk_rows, last_row)
        n = (y1 - y0) * row_words
        f = 0
        while f < bins.shape[0]:
            bin, g = bins[f], f + 1
            while g < bins.shape[0] and bins[g] == bin and first_word[g] == first_word[f] and g - f < MOST_FRAMES:
                g += 1
            times = columns_at.shape[1] if bin >= 0 else 1 if bin == -1 else 0
            if times > 0:
                add_frames(words, rows * row_words, y0 * row_words, f, g, n, 0, planes)
            # A frame of whole rows begins at the sensor's first word, a windowed frame at its used pixels.
            begins = 0 if row_words == width_words else first_word[f]
            row_bytes, n_planes = row_words * WORD_BYTES, planes_for(g - f)
            for line in range(times):
                c = columns_at[bin, line] if bin >= 0 else -1
                wanted = first_word[f] if c < 0 else x0[c] // WORD_PX
                used_px = used_words * WORD_PX if c < 0 else window
                n_row = n_dark if c < 0 else n_lit
                for y in range(y0, y1, 2):
                    at = ((y - y0) * row_words + wanted - begins) * WORD_BYTES
                    read_planes(
                        address_of(as_bytes), at, at + row_bytes if y + 1 < y1 else at, CHUNK * WORD_BYTES, n_planes,
                        used_px, address_of(n_row), padded_lanes(used_px),
                    )  # fmt: skip
                    for r in range(min(2, y1 - y)):
                        if c < 0:
                            _add_dark(n_row[r], wanted * (WORD_PX // STEPS), dark[y + r])
                        elif counts.itemsize > 1:
                            write_counts(n_row[r], counts[c, y + r])
                        else:  # all pairs of a lane at once: sums of bytes do not overflow, see `with_room`
                            for i in range(window // STEPS):
                                eight = np.uint64(0)
                                for q in range(PAIRS):
                                    eight |= np.uint64(n_pairs[r, q * lit_pair + PAD + i]) << np.uint64(16 * q)
                                eights[c, y + r, i] += eight
            f = g
    keep_alive(as_bytes, n_lit, n_dark)


@numba.njit(cache=True, nogil=True)
def _add_dark(n: NDArray[np.uint8], lane: int, sums: NDArray[np.int32]) -> None:
    """Add a row of counts to sums (PAIRS, lanes, 2) from lane `lane` on."""
    pair = n.shape[0] // PAIRS
    lanes = min(pair // 2 - 2 * PAD, sums.shape[1] - lane)
    for q in range(PAIRS):
        for i in range(lanes):
            at = q * pair + 2 * (PAD + i)
            sums[q, lane + i, 0] += n[at]
            sums[q, lane + i, 1] += n[at + 1]


SUM_ROWS = 16
"""Rows of a band of `sum_columns`."""


@numba.njit(cache=True, nogil=True)
def sum_columns(
    counts: NDArray[np.unsignedinteger], x0: NDArray[np.int32], out: NDArray[np.uint32], first_row: int, last_row: int
) -> None:
    """Add the counts (columns, rows, window) of rows first_row..last_row-1 to out (rows, width or more).

    x0: (columns,), the pixel of `out` at which each column's window begins.
    """
    # Band by band: its sums stay in the cache, and its counts lie together in every column.
    for band in range(first_row, last_row, SUM_ROWS):
        for c in range(counts.shape[0]):
            for y in range(band, min(band + SUM_ROWS, last_row)):
                row = out[y, x0[c] : x0[c] + counts.shape[2]]
                for t in range(counts.shape[2]):
                    row[t] += counts[c, y, t]
