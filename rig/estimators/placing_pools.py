"""Compiled sums over neighbours on the same surface, sixteen stripes to a vector.

Neighbours whose distances from the far end differ by too much are left out one by one, so that no running sums will do.
"""

from typing import Final

import numba
import numpy as np
from numpy.typing import NDArray

from rig.estimators.label_volume_buffers import signed_address
from rig.estimators.placing_kernels import Places
from rig.lane_memory import load_float32, store_float32
from rig.lanes import LANES, where_small

Float32 = NDArray[np.float32]

SAME_PX: Final = np.float32(1.0)
"""Neighbours whose distances from the far end differ by no more lie on the same surface."""


@numba.njit(cache=True, nogil=True)
def pool_row(distance: Float32, first: Float32, second: Float32, y: int, reach: int, sums: Float32) -> None:
    """Sums (2, columns) of `first` and `second` over the neighbours of row y on the same surface, itself included."""
    sums[:] = 0.0
    widen_row(distance, first, second, y, -1, reach, np.inf, sums)


@numba.njit(cache=True, nogil=True)
def widen_row(
    distance: Float32, first: Float32, second: Float32, y: int, inner: int, reach: int, enough: float, sums: Float32
) -> None:
    """Add those neighbours that are more than `inner` rows or columns away, up to `reach`.

    Stripes whose second sum is `enough` already may be left as they are. All arrays C-contiguous.
    """
    columns = distance.shape[1]
    rows = max(y - reach, 0), min(y + reach + 1, distance.shape[0])
    at, to = (signed_address(distance), signed_address(first), signed_address(second)), signed_address(sums)
    blocks = max(columns - 2 * reach, 0) // LANES
    for c in range(reach, reach + blocks * LANES, LANES):
        if sums[1, c : c + LANES].min() < enough:
            _widen_block(at, to, columns, y, rows, c, inner, reach)
    for c in range(columns if blocks == 0 else columns - blocks * LANES):
        here = c if c < reach or blocks == 0 else c + blocks * LANES
        if sums[1, here] < enough:
            _widen_one(distance, first, second, y, rows, here, inner, reach, sums)


@numba.njit(cache=True, nogil=True)
def _widen_one(
    distance: Float32, first: Float32, second: Float32, y: int, rows: tuple[int, int], c: int, inner: int, reach: int,
    sums: Float32,
) -> None:  # fmt: skip
    for other in range(rows[0], rows[1]):
        for there in range(max(c - reach, 0), min(c + reach + 1, distance.shape[1])):
            near = abs(other - y) <= inner and abs(there - c) <= inner
            if not near and abs(distance[other, there] - distance[y, c]) <= SAME_PX:
                sums[0, c] += first[other, there]
                sums[1, c] += second[other, there]


@numba.njit(cache=True, nogil=True)
def _widen_block(
    at: tuple[int, int, int], to: int, columns: int, y: int, rows: tuple[int, int], c: int, inner: int, reach: int
) -> None:
    """The same of stripes c..c+LANES-1; at: addresses of the three arrays, to: of the sums."""
    own = load_float32(at[0], y * columns + c)
    a, b = load_float32(to, c), load_float32(to, columns + c)
    for other in range(rows[0], rows[1]):
        line = other * columns + c
        nearest = inner if abs(other - y) <= inner else -1
        for i in range(line - reach, line - max(nearest, 0)):
            off = load_float32(at[0], i) - own
            a = a + where_small(load_float32(at[1], i), off, SAME_PX)
            b = b + where_small(load_float32(at[2], i), off, SAME_PX)
        for i in range(line + nearest + 1, line + reach + 1):
            off = load_float32(at[0], i) - own
            a = a + where_small(load_float32(at[1], i), off, SAME_PX)
            b = b + where_small(load_float32(at[2], i), off, SAME_PX)
    store_float32(to, c, a)
    store_float32(to, columns + c, b)


@numba.njit(cache=True, nogil=True)
def pool_amplitude(
    reach: int, faintest: float, brightest: float, first_row: int, last_row: int, places: Places
) -> None:
    """Fill amplitude: brightness of each stripe over that of its scale, pooled over neighbours, between two limits."""
    amplitude = places.amplitude
    sums = np.empty((2, amplitude.shape[1]), np.float32)
    for y in range(first_row, last_row):
        pool_row(places.distance, places.light, places.scale, y, reach, sums)
        for c in range(amplitude.shape[1]):
            own = sums[0, c] / max(sums[1, c], np.float32(1e-12))
            amplitude[y, c] = min(max(own, np.float32(faintest)), np.float32(brightest))


@numba.njit(cache=True, nogil=True)
def pool_places(
    places: Places, reaches: tuple[int, ...], enough: float, first_row: int, last_row: int, moved: Float32, sd: Float32
) -> None:
    """By how far in x each stripe is to move, and the standard deviation of where it is then, in px.

    reaches: sizes of the neighbourhood, smallest first; the first one that knows `enough` (1/px^2) is taken.
    """
    columns = moved.shape[1]
    sums = np.empty((2, columns), np.float32)
    for y in range(first_row, last_row):
        waiting = columns
        sums[:] = 0.0
        for i in range(len(reaches)):
            if waiting == 0:
                break
            inner = reaches[i - 1] if i > 0 else -1
            widen_row(places.distance, places.score, places.known, y, inner, reaches[i], enough, sums)
            waiting = 0
            for c in range(columns):
                if i > 0 and sd[y, c] >= 0.0:
                    continue
                known = sums[1, c]
                if known < enough and i < len(reaches) - 1:
                    sd[y, c] = -1.0
                    waiting += 1
                    continue
                step = sums[0, c] / max(known, np.float32(1e-12)) - places.distance[y, c]
                moved[y, c] = min(max(step, np.float32(-1.0)), np.float32(1.0)) if known > 0.0 else np.float32(0.0)
                sd[y, c] = min(np.float32(1.0) / np.sqrt(max(known, np.float32(1e-12))), np.float32(1.0))
