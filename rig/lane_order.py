"""Counts of a row in lane order: what bit planes turn into with shifts and masks alone.

Lane i of step s is pixel 8 i + s, as the bits of packed bytes lie. A row of counts is (STEPS * (lanes + 2 PAD),): eight
steps, each with PAD zeros on both sides, so that the pixel before and behind any pixel is one load away.
"""

from typing import Final

import numba
import numpy as np
from numpy.typing import NDArray

from rig.lanes import LANES, load_int8, load_int16, store_int16, widen, write_int16, zero_int16

STEPS: Final = 8
"""Pixels per lane."""
PAD: Final = 16
"""Zeros on both sides of each step's lanes."""


@numba.njit(cache=True, nogil=True)
def padded_lanes(pixels: int) -> int:
    """Lanes of a row of so many pixels, whole vectors."""
    return -(-pixels // (STEPS * LANES)) * LANES


@numba.njit(cache=True, nogil=True)
def new_counts(lanes: int) -> NDArray[np.int16]:
    """A row of `lanes` lanes, all zero."""
    return np.zeros(STEPS * (lanes + 2 * PAD), np.int16)


@numba.njit(inline="always")
def place_of(x, lanes):  # type: ignore[no-untyped-def]
    """Index of pixel x in a row of counts of so many lanes; from -STEPS * PAD on."""
    return (x & 7) * (lanes + 2 * PAD) + PAD + (x >> 3)


@numba.njit(inline="always")
def _nibbles(b0, b1, b2, b3):  # type: ignore[no-untyped-def]
    """Counts of pixels 0 to 7 of each lane from four bit planes, 16-bit lanes of one byte each; first pixel highest."""
    even_01, odd_01 = (b0 & 0x55) | ((b1 & 0x55) << 1), ((b0 >> 1) & 0x55) | (b1 & 0xAA)
    even_23, odd_23 = (b2 & 0x55) | ((b3 & 0x55) << 1), ((b2 >> 1) & 0x55) | (b3 & 0xAA)
    a, b = (odd_01 & 0x33) | ((odd_23 & 0x33) << 2), ((odd_01 >> 2) & 0x33) | (odd_23 & 0xCC)
    c, d = (even_01 & 0x33) | ((even_23 & 0x33) << 2), ((even_01 >> 2) & 0x33) | (even_23 & 0xCC)
    return b >> 4, d >> 4, a >> 4, c >> 4, b & 15, d & 15, a & 15, c & 15


@numba.njit(cache=True, nogil=True)
def read_planes(planes: int, at: int, plane_bytes: int, n_planes: int, window: int, n: int, lanes: int) -> None:
    """Counts of a row of `window` pixels into n from its bit planes: bytes from `at` on, planes `plane_bytes` apart.

    planes, n: addresses. n_planes: 1, 4 or 8. Reads 16 bytes at a time, whatever the window.
    """
    stride = lanes + 2 * PAD
    for v in range(0, lanes, LANES):
        b0 = widen(load_int8(planes, at + v))
        to = PAD + v
        if n_planes == 1:
            store_int16(n, to, b0 >> 7)
            store_int16(n, to + stride, (b0 >> 6) & 1)
            store_int16(n, to + 2 * stride, (b0 >> 5) & 1)
            store_int16(n, to + 3 * stride, (b0 >> 4) & 1)
            store_int16(n, to + 4 * stride, (b0 >> 3) & 1)
            store_int16(n, to + 5 * stride, (b0 >> 2) & 1)
            store_int16(n, to + 6 * stride, (b0 >> 1) & 1)
            store_int16(n, to + 7 * stride, b0 & 1)
            continue
        b1 = widen(load_int8(planes, at + v + plane_bytes))
        b2 = widen(load_int8(planes, at + v + 2 * plane_bytes))
        b3 = widen(load_int8(planes, at + v + 3 * plane_bytes))
        n0, n1, n2, n3, n4, n5, n6, n7 = _nibbles(b0, b1, b2, b3)
        if n_planes == 8:
            b4 = widen(load_int8(planes, at + v + 4 * plane_bytes))
            b5 = widen(load_int8(planes, at + v + 5 * plane_bytes))
            b6 = widen(load_int8(planes, at + v + 6 * plane_bytes))
            b7 = widen(load_int8(planes, at + v + 7 * plane_bytes))
            h0, h1, h2, h3, h4, h5, h6, h7 = _nibbles(b4, b5, b6, b7)
            n0, n1, n2, n3 = n0 | (h0 << 4), n1 | (h1 << 4), n2 | (h2 << 4), n3 | (h3 << 4)
            n4, n5, n6, n7 = n4 | (h4 << 4), n5 | (h5 << 4), n6 | (h6 << 4), n7 | (h7 << 4)
        store_int16(n, to, n0)
        store_int16(n, to + stride, n1)
        store_int16(n, to + 2 * stride, n2)
        store_int16(n, to + 3 * stride, n3)
        store_int16(n, to + 4 * stride, n4)
        store_int16(n, to + 5 * stride, n5)
        store_int16(n, to + 6 * stride, n6)
        store_int16(n, to + 7 * stride, n7)
    if window < lanes * STEPS:
        # What was read beyond the window belongs to other pixels.
        for s in range(STEPS):
            store_int16(n, s * stride + PAD + window // STEPS, zero_int16())


@numba.njit(cache=True, nogil=True)
def read_counts(counts: NDArray[np.unsignedinteger], halved: int, n: int, lanes: int) -> None:
    """Counts of a row in pixel order (window,) to address n, divided by 2^halved as `halve_counts` does."""
    stride = lanes + 2 * PAD
    half = (1 << halved) >> 1
    for s in range(STEPS):
        for i in range(counts.shape[0] // STEPS):
            count = np.int16((np.int64(counts[STEPS * i + s]) + half) >> halved)
            write_int16(n, s * stride + PAD + i, count)


@numba.njit(cache=True, nogil=True)
def write_counts(n: NDArray[np.int16], counts: NDArray[np.unsignedinteger]) -> None:
    """Add the counts of n to a row in pixel order (window,)."""
    stride = n.shape[0] // STEPS
    for i in range(counts.shape[0] // STEPS):
        for s in range(STEPS):
            counts[STEPS * i + s] += n[s * stride + PAD + i]


@numba.njit(cache=True, nogil=True)
def halve_counts(n: int, lanes: int, times: int) -> None:
    """Divide all counts of the row at address n by 2^times, rounded."""
    half = np.int16((1 << times) >> 1)
    for v in range(0, STEPS * (lanes + 2 * PAD), LANES):
        store_int16(n, v, (load_int16(n, v) + half) >> times)


@numba.njit(cache=True, nogil=True)
def sum_counts(n: int, lanes: int, sums: int) -> None:
    """Add the counts of the row at address n to int16 sums (STEPS, lanes) at address `sums`."""
    stride = lanes + 2 * PAD
    for v in range(0, lanes, LANES):
        for s in range(STEPS):
            at = s * lanes + v
            store_int16(sums, at, load_int16(sums, at) + load_int16(n, s * stride + PAD + v))


def pixel_order(sums: NDArray[np.generic], width: int) -> NDArray[np.generic]:
    """Sums in lane order (rows, STEPS, lanes) as (rows, width)."""
    rows = sums.shape[0]
    return np.ascontiguousarray(sums.transpose(0, 2, 1).reshape(rows, -1)[:, :width])
