"""Rays against simple bodies: convex solids, upright cylinders, ellipsoids. Depth z, inf where a ray misses.

A ray is t (u, v, 1), so t is the depth z itself. Frame: x right, y down, z forward, metres.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Face = tuple[float, float, float, float]
"""(nx, ny, nz, d): the half space n.X <= d."""


def convex(u: Array, v: Array, faces: Sequence[Face]) -> Array:
    """Depth of the solid {X: n.X <= d for all faces}."""
    enter, leave = np.full_like(u, 1e-6), np.full_like(u, np.inf)
    for nx, ny, nz, d in faces:
        along = nx * u + ny * v + nz
        with np.errstate(divide="ignore", invalid="ignore"):
            t = d / along
        enter = np.where(along < 0, np.maximum(enter, t), enter)
        leave = np.where(along > 0, np.minimum(leave, t), leave)
        leave = np.where((along == 0) & (d < 0), -np.inf, leave)
    return np.where(enter < leave, enter, np.inf)


def box(u: Array, v: Array, x: tuple[float, float], y: tuple[float, float], z: tuple[float, float]) -> Array:
    """Depth of an axis-parallel box."""
    faces = [(1, 0, 0, x[1]), (-1, 0, 0, -x[0]), (0, 1, 0, y[1]), (0, -1, 0, -y[0]), (0, 0, 1, z[1]), (0, 0, -1, -z[0])]
    return convex(u, v, faces)


def post(u: Array, v: Array, x: float, z: float, radius: float, y: tuple[float, float]) -> Array:
    """Depth of the mantle of an upright cylinder between two heights."""
    a, b, c = u * u + 1, x * u + z, x * x + z * z - radius * radius
    root = b * b - a * c
    with np.errstate(invalid="ignore"):
        t = (b - np.sqrt(root)) / a
    return np.where((root > 0) & (t * v >= y[0]) & (t * v <= y[1]), t, np.inf)


def ellipsoid(u: Array, v: Array, centre: tuple[float, float, float], half: tuple[float, float, float]) -> Array:
    """Depth of an ellipsoid with half axes along x, y, z."""
    du, dv, dw = u / half[0], v / half[1], np.full_like(u, 1 / half[2])
    cx, cy, cz = (c / h for c, h in zip(centre, half, strict=True))
    a, b = du * du + dv * dv + dw * dw, du * cx + dv * cy + dw * cz
    root = b * b - a * (cx * cx + cy * cy + cz * cz - 1)
    with np.errstate(invalid="ignore"):
        t = (b - np.sqrt(root)) / a
    return np.where(root > 0, t, np.inf)
