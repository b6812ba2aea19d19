"""Counts of a row in lane order: the order in which shifts and masks alone turn bit planes into bytes.

Lane i has the pixels of byte i of the packed bits, 8 i to 8 i + 7, in PAIRS pairs: pair q holds the counts of pixels
8 i + 2 q and 8 i + 2 q + 1. A row of counts is uint8 (PAIRS, lanes + 2 PAD, 2). PAD zero lanes on both sides of each
pair's lanes allow a load at any offset of up to PAD lanes. An x86 processor multiplies and adds a pair in one step.
"""

from typing import Final

import numba
import numpy as np
from numpy.typing import NDArray

from rig.simd.memory import load_bytes, load_two_rows, store_bytes, write_byte
from rig.simd.shuffles import first_row_pairs, second_row_pairs
from rig.simd.vectors import LANES, as_bytes, zero_bytes, zero_int16

STEPS: Final = 8
"""Pixels per lane. Step s of a lane is its pixel s."""
PAIRS: Final = 4
"""Pairs of neighbouring pixels per lane."""
PAD: Final = 8
"""Zero lanes before and after the lanes of each pair."""


@numba.njit(cache=True, nogil=True)
def padded_lanes(pixels: int) -> int:
    """Number of lanes for a row of `pixels` pixels, rounded up to whole vectors of LANES lanes."""
    return -(-pixels // (STEPS * LANES)) * LANES


@numba.njit(forceinline=True, cache=True)  # called from Python too
def pair_bytes(lanes: int) -> int:
    """Bytes from one pair to the next in a row of counts with `lanes` lanes."""
    return 2 * (lanes + 2 * PAD)


@numba.njit(cache=True, nogil=True)
def new_counts(rows: int, lanes: int) -> NDArray[np.uint8]:
    """Rows of counts with `lanes` lanes each, uint8 (rows, bytes), all zero."""
    return np.zeros((rows, PAIRS * pair_bytes(lanes)), np.uint8)


@numba.njit(forceinline=True)
def place_of(x, lanes):  # type: ignore[no-untyped-def]
    """Index of pixel x in a row of counts with `lanes` lanes; x may be as low as -STEPS * PAD."""
    return ((x & 7) >> 1) * pair_bytes(lanes) + 2 * (PAD + (x >> 3)) + (x & 1)


@numba.njit(cache=True, nogil=True)
def places_of(x: NDArray[np.int64], lanes: int) -> NDArray[np.int32]:
    """Indices of the pixels x (n,) in a row of counts with `lanes` lanes, int32 (n,)."""
    places = np.empty(x.shape[0], np.int32)
    for i in range(x.shape[0]):
        places[i] = place_of(x[i], lanes)
    return places


@numba.njit(inline="always")
def _nibbles(b0, b1, b2, b3):  # type: ignore[no-untyped-def]
    """Counts of pixels 0 to 7 of each byte from four bit planes; the first pixel is the highest bit."""
    even_01, odd_01 = (b0 & 0x55) | ((b1 & 0x55) << 1), ((b0 >> 1) & 0x55) | (b1 & 0xAA)
    even_23, odd_23 = (b2 & 0x55) | ((b3 & 0x55) << 1), ((b2 >> 1) & 0x55) | (b3 & 0xAA)
    a, b = (odd_01 & 0x33) | ((odd_23 & 0x33) << 2), ((odd_01 >> 2) & 0x33) | (odd_23 & 0xCC)
    c, d = (even_01 & 0x33) | ((even_23 & 0x33) << 2), ((even_01 >> 2) & 0x33) | (even_23 & 0xCC)
    return (b >> 4) & 15, (d >> 4) & 15, (a >> 4) & 15, (c >> 4) & 15, b & 15, d & 15, a & 15, c & 15


@numba.njit(forceinline=True)
def read_planes(
    planes: int, first: int, second: int, plane_bytes: int, n_planes: int, window: int, n: int, lanes: int
) -> None:
    """Write the counts of two rows of `window` pixels to n and to the row after it, from their bit planes.

    planes, n: addresses. first, second: bytes at which the rows begin; planes lie `plane_bytes` apart. n_planes: number
    of planes, 1, 2, 4 or 8. lanes: as in `pair_bytes`. Reads 16 bytes at a time, possibly beyond the rows.
    """
    pair = pair_bytes(lanes)
    for v in range(0, lanes, LANES):
        a, b = first + v, second + v
        b0 = load_two_rows(planes, a, b)
        if n_planes == 1:
            n0, n1, n2, n3 = (b0 >> 7) & 1, (b0 >> 6) & 1, (b0 >> 5) & 1, (b0 >> 4) & 1
            n4, n5, n6, n7 = (b0 >> 3) & 1, (b0 >> 2) & 1, (b0 >> 1) & 1, b0 & 1
        else:
            b1 = load_two_rows(planes, a + plane_bytes, b + plane_bytes)
            b2, b3 = zero_bytes(), zero_bytes()
            if n_planes > 2:
                b2 = load_two_rows(planes, a + 2 * plane_bytes, b + 2 * plane_bytes)
                b3 = load_two_rows(planes, a + 3 * plane_bytes, b + 3 * plane_bytes)
            n0, n1, n2, n3, n4, n5, n6, n7 = _nibbles(b0, b1, b2, b3)
        if n_planes == 8:
            a, b = a + 4 * plane_bytes, b + 4 * plane_bytes
            b4, b5 = load_two_rows(planes, a, b), load_two_rows(planes, a + plane_bytes, b + plane_bytes)
            b6 = load_two_rows(planes, a + 2 * plane_bytes, b + 2 * plane_bytes)
            b7 = load_two_rows(planes, a + 3 * plane_bytes, b + 3 * plane_bytes)
            h0, h1, h2, h3, h4, h5, h6, h7 = _nibbles(b4, b5, b6, b7)
            n0, n1, n2, n3 = n0 | (h0 << 4), n1 | (h1 << 4), n2 | (h2 << 4), n3 | (h3 << 4)
            n4, n5, n6, n7 = n4 | (h4 << 4), n5 | (h5 << 4), n6 | (h6 << 4), n7 | (h7 << 4)
        to = 2 * (PAD + v)
        behind = to + PAIRS * pair
        store_bytes(n, to, first_row_pairs(n0, n1))
        store_bytes(n, to + pair, first_row_pairs(n2, n3))
        store_bytes(n, to + 2 * pair, first_row_pairs(n4, n5))
        store_bytes(n, to + 3 * pair, first_row_pairs(n6, n7))
        store_bytes(n, behind, second_row_pairs(n0, n1))
        store_bytes(n, behind + pair, second_row_pairs(n2, n3))
        store_bytes(n, behind + 2 * pair, second_row_pairs(n4, n5))
        store_bytes(n, behind + 3 * pair, second_row_pairs(n6, n7))
    if window < lanes * STEPS:
        # What was read beyond the window belongs to other pixels.
        for q in range(2 * PAIRS):
            store_bytes(n, q * pair + 2 * (PAD + window // STEPS), zero_bytes())


@numba.njit(inline="always")
def _share(x, times):  # type: ignore[no-untyped-def]
    """Number added to the count of pixel x before it is divided by 2^times: 0 to 2^times - 1, spread over 8 pixels."""
    return ((x & 7) << times) >> 3


@numba.njit(inline="always")
def _fine_share(x, times, turn):  # type: ignore[no-untyped-def]
    """Like `_share`, in 2048 steps that differ from turn to turn: eight steps would not keep the mean of small counts.

    The multipliers are odd, so that 2048 pixels in a row, or turns, take every step once.
    """
    return ((x * 0x9E3 + turn * 0x4F1 & 2047) << times) >> 11


@numba.njit(cache=True, nogil=True)
def read_counts(counts: NDArray[np.unsignedinteger], halved: int, n: int, lanes: int, turn: int = 0) -> None:
    """Write the counts (window,) of a row in pixel order, divided by 2^halved, to address n in lane order.

    For divisors up to 8, counts are rounded as in `halve_counts`. For larger ones, rounding also varies with `turn`,
    such as the number of the column, so that small counts keep their mean.
    """
    for x in range(counts.shape[0]):
        share = _share(x, halved) if halved <= 3 else _fine_share(x, halved, turn)
        write_byte(n, place_of(x, lanes), np.uint8((np.int64(counts[x]) + share) >> halved))


@numba.njit(cache=True, nogil=True)
def write_counts(n: NDArray[np.uint8], counts: NDArray[np.unsignedinteger]) -> None:
    """Add the counts of n, a row in lane order, to `counts` (window,), a row in pixel order."""
    pair = n.shape[0] // PAIRS
    for i in range(counts.shape[0] // STEPS):
        for q in range(PAIRS):
            at = q * pair + 2 * (PAD + i)
            counts[STEPS * i + 2 * q] += n[at]
            counts[STEPS * i + 2 * q + 1] += n[at + 1]


@numba.njit(cache=True, nogil=True)
def halve_counts(n: int, lanes: int, times: int) -> None:
    """Divide the counts of the row at address n by 2^times, rounded up or down so that small counts keep their mean."""
    rest = (1 << times) - 1
    for q in range(PAIRS):
        # A byte plus its share may overflow, so the remainder of the division is rounded separately.
        shares = as_bytes(zero_int16() + np.int16(_share(2 * q, times) | _share(2 * q + 1, times) << 8))
        for v in range(0, 2 * lanes, 2 * LANES):
            at = q * pair_bytes(lanes) + 2 * PAD + v
            counts = load_bytes(n, at)
            store_bytes(n, at, (counts >> times) + (((counts & rest) + shares) >> times))


@numba.njit(forceinline=True)
def sum_counts(n: int, lanes: int, sums: int) -> None:
    """Add the counts of the row at address n to the bytes (PAIRS, lanes, 2) at address `sums`. Sums above 255 wrap
    round."""
    for v in range(0, 2 * lanes, 2 * LANES):
        for q in range(PAIRS):
            at = 2 * q * lanes + v
            store_bytes(sums, at, load_bytes(sums, at) + load_bytes(n, q * pair_bytes(lanes) + 2 * PAD + v))


def pixel_order(sums: NDArray[np.generic], width: int) -> NDArray[np.generic]:
    """Sums in lane order (rows, PAIRS, lanes, 2) rearranged to pixel order (rows, width)."""
    rows = sums.shape[0]
    return np.ascontiguousarray(sums.transpose(0, 2, 1, 3).reshape(rows, -1)[:, :width])
