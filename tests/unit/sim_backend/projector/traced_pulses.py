"""Pulses followed photon by photon through a homogeneous medium in front of a wall. Shares nothing with the simulator.

A photon starts at the camera along the middle of the picture, is scattered or meets the Lambertian wall, and at each of
these places sends its share back to the source beside the camera, if the source lights the place: a square cone. By
reciprocity these are the ways from the source to the camera. Half of a way's length is where its light seems to come
from.
"""

import math

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
NEAREST_M = 0.1
"""Distance from the source within which nothing is sent back: rare, bright light, gone before a gate opens."""


@numba.njit(cache=True)
def _phase(cosine: float, g: float) -> float:
    return (1 - g * g) / (4 * math.pi * (1 + g * g - 2 * g * cosine) ** 1.5)


@numba.njit(cache=True)
def _turned(x: float, y: float, z: float, cosine: float, phi: float) -> tuple[float, float, float]:
    sine = math.sqrt(max(0.0, 1 - cosine * cosine))
    a, b = math.cos(phi) * sine, math.sin(phi) * sine
    if abs(z) > 0.99999:
        return a, b, math.copysign(cosine, cosine * z)
    r = math.sqrt(1 - z * z)
    return (x * z * a - y * b) / r + x * cosine, (y * z * a + x * b) / r + y * cosine, -r * a + z * cosine


@numba.njit(cache=True)
def trace(
    rng: np.random.Generator, photons: int, scene: tuple[float, float, float, float], lobes: Array, light: Array,
    step_m: float,
) -> None:  # fmt: skip
    """Add to light (4, places) what comes back per sr of the source's intensity 1, by kind and by half the way in steps
    of step_m. Kinds: scattered once by the medium, by the wall; more than once, with the wall, without.

    scene: distance of the wall, extinction per m, albedo, tangent of the half angle that is lit. lobes: (n, 2) weight
    and g of the phase function; the first is chosen with its weight, else the last.
    """
    wall_m, extinction_per_m, albedo, reach = scene
    for _ in range(photons):
        x = y = z = dx = dy = path = 0.0
        dz = weight = 1.0
        order, wall = 0, False
        while path < 6 * wall_m and order < 60:
            free = -math.log(1 - rng.random()) / extinction_per_m
            hit = dz > 0 and free * dz >= wall_m - z
            if hit:
                free = (wall_m - z) / dz
            x, y, z = x + dx * free, y + dy * free, z + dz * free
            path, order, wall = path + free, order + 1, wall or hit
            away = math.sqrt(x * x + y * y + z * z)
            if away > NEAREST_M and abs(x) < reach * z and abs(y) < reach * z:
                sent = albedo / math.pi * z / away if hit else 0.0
                if not hit:
                    for lobe in lobes:
                        sent += lobe[0] * _phase(-(dx * x + dy * y + dz * z) / away, lobe[1])
                place = int((path + away) / 2 / step_m)
                if place < light.shape[1]:
                    kind = (1 if hit else 0) if order == 1 else (2 if wall else 3)
                    light[kind, place] += weight * sent * math.exp(-extinction_per_m * away) / away**2 / photons
            phi = 2 * math.pi * rng.random()
            if hit:
                weight *= albedo
                up = rng.random()
                dx, dy, dz = math.sqrt(1 - up) * math.cos(phi), math.sqrt(1 - up) * math.sin(phi), -math.sqrt(up)
            else:
                g = lobes[0, 1] if rng.random() < lobes[0, 0] else lobes[len(lobes) - 1, 1]
                even = rng.random()
                q = (1 - g * g) / (1 - g + 2 * g * even)
                cosine = 2 * even - 1 if g == 0 else (1 + g * g - q * q) / (2 * g)
                dx, dy, dz = _turned(dx, dy, dz, min(max(cosine, -1.0), 1.0), phi)
