"""Bodies and surfaces: where rays meet simple bodies, depth and albedo on the camera's pixel grid, procedural texture.

Bodies are convex solids, upright cylinders and ellipsoids. Each has a function that returns the depth z at which a
ray meets the body, and inf if the ray misses it. Bodies must lie wholly in front of the camera; around or behind it the
depth may be negative. A ray is t (u, v, 1), so t is the depth z itself. Frame: x right, y down, z forward, metres. A
2.5-D world consists only of depth and albedo by pixel. Texture is smooth noise from hashed lattice points, the same on
every machine.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DeviceError

Array = NDArray[np.float64]
Face = tuple[float, float, float, float]
"""(nx, ny, nz, d): the half space n.X <= d."""


def convex(u: Array, v: Array, faces: Sequence[Face]) -> Array:
    """Depth at which rays meet the solid {X: n.X <= d for all faces}."""
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
    """Depth at which rays meet an axis-parallel box."""
    faces = [(1, 0, 0, x[1]), (-1, 0, 0, -x[0]), (0, 1, 0, y[1]), (0, -1, 0, -y[0]), (0, 0, 1, z[1]), (0, 0, -1, -z[0])]
    return convex(u, v, faces)


def post(u: Array, v: Array, x: float, z: float, radius: float, y: tuple[float, float]) -> Array:
    """Depth at which rays meet the side of an upright cylinder between two heights."""
    a, b, c = u * u + 1, x * u + z, x * x + z * z - radius * radius
    root = b * b - a * c
    with np.errstate(invalid="ignore"):
        t = (b - np.sqrt(root)) / a
    return np.where((root > 0) & (t * v >= y[0]) & (t * v <= y[1]), t, np.inf)


def ellipsoid(u: Array, v: Array, centre: tuple[float, float, float], half: tuple[float, float, float]) -> Array:
    """Depth at which rays meet an ellipsoid with half axes along x, y, z."""
    du, dv, dw = u / half[0], v / half[1], np.full_like(u, 1 / half[2])
    cx, cy, cz = (c / h for c, h in zip(centre, half, strict=True))
    a, b = du * du + dv * dv + dw * dw, du * cx + dv * cy + dw * cz
    root = b * b - a * (cx * cx + cy * cy + cz * cz - 1)
    with np.errstate(invalid="ignore"):
        t = (b - np.sqrt(root)) / a
    return np.where(root > 0, t, np.inf)


@dataclass(frozen=True, slots=True, eq=False)
class Surfaces:
    """One surface point per pixel.

    depth_m: float32 (rows, width), z in metres; inf = nothing there. albedo: float32 (rows, width), 0..1.
    trusted: bool (rows, width), False where the depth was guessed and no result should be scored.
    """

    depth_m: NDArray[np.float32]
    albedo: NDArray[np.float32]
    trusted: NDArray[np.bool_]


def checked(name: str, depth_m: object, albedo: object, trusted: object, size: tuple[int, int]) -> Surfaces:
    """Surfaces from arrays of any float type and of `size` (rows, width). Raises DeviceError for another size or an
    impossible value. name: of the scene, for messages."""
    depth, light = np.asarray(depth_m, dtype=np.float32), np.asarray(albedo, dtype=np.float32)
    trust = np.asarray(trusted, dtype=bool)
    for key, array in (("depth_m", depth), ("albedo", light), ("trusted", trust)):
        if array.shape != size:
            have = " x ".join(str(n) for n in reversed(array.shape))
            raise DeviceError(
                f"scene {name}: {key} is {have} pixels, the camera {size[1]} x {size[0]}; "
                "prepare the scene at the camera's size"
            )
    if not (np.all(depth > 0)):
        raise DeviceError(
            f"scene {name}: depth_m must be above 0 m everywhere (inf where nothing is), NaN is not allowed"
        )
    if not (np.all(light >= 0) and np.all(light <= 1)):
        raise DeviceError(f"scene {name}: albedo must lie within 0 to 1 everywhere")
    return Surfaces(np.ascontiguousarray(depth), np.ascontiguousarray(light), np.ascontiguousarray(trust))


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


def layered_noise(a: Array, b: Array, size: float, seed: int) -> Array:
    """Sum of noises of `size`, size/2 and size/4, each half as strong as the one before, scaled to 0..1."""
    total: Array = sum((noise(a, b, size / 2**k, seed + k) / 2**k for k in range(3)), np.zeros_like(a))
    return total / 1.75


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
