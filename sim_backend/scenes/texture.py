"""Procedural texture: smooth noise from hashed lattice points, the same on every machine."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_A, _B, _C = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xC2B2AE3D27D4EB4F), np.uint64(0x165667B19E3779F9)
"""Odd constants that spread lattice coordinates over 64 bits (golden ratio and the primes of xxHash64)."""


def noise(a: Array, b: Array, size: float, seed: int) -> Array:
    """Smooth noise in 0..1 over the coordinates (a, b), with structures of `size` (same unit as a and b)."""
    a, b = np.nan_to_num(a / size, posinf=0, neginf=0), np.nan_to_num(b / size, posinf=0, neginf=0)
    i, j = np.floor(a), np.floor(b)
    s, t = _smooth(a - i), _smooth(b - j)
    corners = [[_lattice(i + di, j + dj, seed) for dj in (0, 1)] for di in (0, 1)]
    lower = corners[0][0] * (1 - t) + corners[0][1] * t
    upper = corners[1][0] * (1 - t) + corners[1][1] * t
    return lower * (1 - s) + upper * s


def layered_noise(a: Array, b: Array, size: float, seed: int, layers: int = 3) -> Array:
    """Sum of noises of `size`, size/2, size/4 ... each half as strong as the one before, scaled to 0..1."""
    total, weight = np.zeros_like(a), 0.0
    for k in range(layers):
        total = total + noise(a, b, size / 2**k, seed + k) / 2**k
        weight += 1 / 2**k
    return total / weight


def _smooth(t: Array) -> Array:
    result: Array = t * t * (3 - 2 * t)
    return result


def _lattice(i: Array, j: Array, seed: int) -> Array:
    z = i.astype(np.int64).view(np.uint64) * _A + j.astype(np.int64).view(np.uint64) * _B
    z = z + np.uint64((seed * int(_C)) % 2**64)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    result: Array = (z >> np.uint64(11)).astype(np.float64) / 2.0**53
    return result
