"""Rows that a camera sees of a lit sheet in fog before a wall, traced photon by photon. Shares nothing with the
simulator.

The wall is the plane z = 1, Lambertian; the projector at (-b, 0, 0) lights one column, 1/`FOCAL` wide, at the tangent
T, 1 W/m^2 on the plane z = 1, `FAN` up and down; the camera at the origin has `WIDTH` pixels of 1/`FOCAL`. The fog
reaches `BEHIND` behind both. Photons fly freely for exponentially distributed lengths, and every scattering but the
first and every meeting with the wall is connected to the camera, for pixels of a band of +-`BAND` around the middle
row. The direct stripe and single scattering are left out: there are closed forms of them.

A connection over a short last leg, or through the peak of a phase function, is rare and bright. By reciprocity a path
and the same path from camera to projector carry the same light. So each is counted with the weight 2 f/(f + l): f and l
are what its first and its last vertex say of its first and its last leg (scattering, 1/r^2, transmission). The other
half of the light is that of the reversed paths, traced with the tangents of sheet and stripe exchanged.
"""

import math
from collections.abc import Sequence

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FOCAL, WIDTH = 277.128, 320
FAN, BAND, BEHIND = math.tan(math.radians(30.0)), 0.15, 0.6
NEAREST = 0.002
"""Vertices nearer to the camera are left out."""
MOST_STEPS, FARTHEST = 200, 10.0


def traced(
    lobes: Sequence[tuple[float, float]], tau: float, tangent: float, baseline: float, photons: int, seed: int
) -> Array:
    """Radiance (4, `WIDTH`) of light scattered more than once that never met the wall, or once to three times, per
    albedo, albedo^2, albedo^3. lobes: (weight, g).
    """
    terms, total, random = np.array(lobes, float), np.zeros((4, WIDTH)), np.random.default_rng(seed)
    for sheet in (tangent, baseline - tangent):
        row = np.zeros((4, WIDTH))
        _trace(random, photons, tau, terms, sheet, baseline, row)
        x = np.arange(WIDTH)
        shift = (tangent - sheet) * FOCAL  # so that the stripes coincide
        total += [np.interp(x - shift, x, each) / 2 for each in row]
    return total


@numba.njit(inline="always")
def _phase(terms: Array, cosine: float) -> float:
    value = 0.0
    for i in range(len(terms)):
        g = terms[i, 1]
        spread = 1.0 + g * g - 2.0 * g * cosine
        value += terms[i, 0] * (1.0 - g * g) / (4.0 * math.pi * spread * math.sqrt(spread))
    return value


@numba.njit(cache=True, nogil=True)
def _trace(
    random: np.random.Generator, photons: int, tau: float, terms: Array, tangent: float, baseline: float, row: Array
) -> None:
    power = 2.0 * FAN / FOCAL / photons
    for _ in range(photons):
        v = FAN * (2.0 * random.random() - 1.0)
        q = math.sqrt(tangent * tangent + v * v + 1.0)
        dx, dy, dz = tangent / q, v / q, 1.0 / q
        x, y, z = -baseline, 0.0, 0.0
        met, first = 0, 0.0
        for step in range(MOST_STEPS):
            s = -math.log(1.0 - random.random()) / tau
            at_wall = dz > 0.0 and s * dz >= 1.0 - z
            if at_wall:
                s = (1.0 - z) / dz
                met += 1
            x, y, z = x + s * dx, y + s * dy, 1.0 if at_wall else z + s * dz
            if met > 3 or z < -BEHIND or x * x + y * y > FARTHEST * FARTHEST:
                break
            pixel = x / z * FOCAL + 0.5 * WIDTH if z > 0.0 else -1.0
            r2 = x * x + y * y + z * z
            if step > 0 and abs(y) < BAND * z and 0.0 <= pixel < WIDTH and r2 > NEAREST * NEAREST:
                r = math.sqrt(r2)
                f = z / (r * math.pi) if at_wall else _phase(terms, -(x * dx + y * dy + z * dz) / r)
                last = f * math.exp(-tau * r) / r2
                solid_angle = 2.0 * BAND / FOCAL * (z / r) ** 3
                row[met, int(pixel)] += power * last / solid_angle * 2.0 * first / (first + last)
            was_x, was_y, was_z = dx, dy, dz
            around = 2.0 * math.pi * random.random()
            if at_wall:
                cosine = math.sqrt(random.random())
                sine = math.sqrt(1.0 - cosine * cosine)
                dx, dy, dz = sine * math.cos(around), sine * math.sin(around), -cosine
            else:
                pick, i = random.random(), 0
                while i < len(terms) - 1 and pick > terms[i, 0]:
                    pick -= terms[i, 0]
                    i += 1
                g, pick = terms[i, 1], random.random()
                cosine = 2.0 * pick - 1.0
                if abs(g) > 1e-3:
                    cosine = (1.0 + g * g - ((1.0 - g * g) / (1.0 - g + 2.0 * g * pick)) ** 2) / (2.0 * g)
                cosine = min(max(cosine, -1.0), 1.0)
                sine = math.sqrt(1.0 - cosine * cosine)
                a, b = sine * math.cos(around), sine * math.sin(around)
                level = math.sqrt(max(1.0 - dz * dz, 0.0))
                if level < 1e-6:
                    dx, dy, dz = a, b, math.copysign(cosine, cosine * dz)
                else:
                    dx = cosine * was_x + (a * was_x * was_z - b * was_y) / level
                    dy = cosine * was_y + (a * was_y * was_z + b * was_x) / level
                    dz = cosine * was_z - a * level
                length = math.sqrt(dx * dx + dy * dy + dz * dz)
                dx, dy, dz = dx / length, dy / length, dz / length
            if step == 0:
                r2 += 2.0 * baseline * x + baseline * baseline  # from the projector
                cosine = dx * was_x + dy * was_y + dz * was_z
                first = (was_z / math.pi if at_wall else _phase(terms, cosine)) * math.exp(-tau * math.sqrt(r2)) / r2
