"""The scene from a second camera that stands beside the first, and what both cameras see of it.

The second camera stands to the left or right of the first, by as much as the point where the light leaves the mirror.
It has the rays of the first, so from its place S it sees a point X in the direction X - S. The world has one depth per
pixel of the first camera, and a tangent plane (facet). A pixel covers a strip of this plane in its row, and the strip
covers an interval of the second picture. There the nearest of all strips is seen, with the albedo at that very place.
Rows are assumed to be rectified: a point is in the same row of both pictures. With a lens that distorts this is true
only in the middle rows. Some pixels of the second picture see places that are hidden from the first camera, so no strip
covers them. They get the values of the nearest covered pixel to the left or to the right, whichever of the two sees the
farther surface. Computing time: 40 ms for 512 x 512 pixels.

In ambient light alone a surface of albedo rho at the distance r has the radiance rho/pi E exp(-sigma r), and the air in
front of it adds airlight, as in `sim_backend.effects.ambient`.
"""

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from sim_backend.effects.setting import Array, Setting
from sim_backend.light.optics import ambient_irradiance
from sim_backend.light.sheet import DEPTH_JUMP
from sim_backend.light.view import CameraView


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """Surfaces in a picture, float64 (rows, width). range_m: distance from the camera, infinite for open sky."""

    albedo: Array
    range_m: Array


def first_view(view: CameraView, rows: NDArray[np.int64]) -> Seen:
    """The surfaces that the first camera sees in these rows."""
    with np.errstate(divide="ignore", invalid="ignore"):
        range_m = np.sqrt(view.u[rows] ** 2 + view.v[rows] ** 2 + 1) / view.surface[rows]
    return Seen(view.albedo[rows], np.where(np.isnan(range_m), np.inf, range_m))


def second_view(view: CameraView, rows: NDArray[np.int64]) -> Seen:
    """The surfaces that the second camera sees in these rows."""
    u, v, surface, albedo = view.u[rows], view.v[rows], view.surface[rows], view.albedo[rows]
    source_x = view.source_m[0]
    ends = []
    for side in (-0.5, 0.5):
        ray = np.stack([u + side * view.u_x[rows], v + side * view.v_x[rows], np.ones_like(u)], axis=-1)
        inverse = np.sum(view.facet[rows] * ray, axis=-1)
        ends.append((ray[..., 0] - inverse * source_x, np.where(surface > 0, inverse, np.nan)))
    places = np.full((2, *u.shape), np.nan)
    for side, (tangent, _) in enumerate(ends):
        for y in range(len(rows)):
            places[side, y] = _columns(u[y], tangent[y])
    inverse, found = np.zeros_like(u), np.zeros_like(u)
    _project(places[0], places[1], ends[0][1], ends[1][1], surface, albedo, inverse, found)
    for y in range(len(rows)):
        _fill(inverse[y], found[y])
    with np.errstate(divide="ignore", invalid="ignore"):
        range_m = np.sqrt(u * u + v * v + 1) / inverse
    return Seen(found, np.where(np.isnan(range_m), np.inf, range_m))


def _columns(u: Array, tangent: Array) -> Array:
    """Fractional pixels (width,) in which rays of these tangents are seen, of a row with tangents u (width,)."""
    known = np.flatnonzero(np.isfinite(u))
    if len(known) < 2:
        return np.full_like(tangent, np.nan)
    # Half a pixel more at both ends, linearly.
    at = np.concatenate([[known[0] - 1.0], known, [known[-1] + 1.0]])
    rays = np.concatenate([[2 * u[known[0]] - u[known[1]]], u[known], [2 * u[known[-1]] - u[known[-2]]]])
    result: Array = np.interp(tangent, rays, at, left=-np.inf, right=np.inf)
    return result


@numba.njit(cache=True, nogil=True)
def _project(
    low: Array, high: Array, inverse_low: Array, inverse_high: Array, surface: Array, albedo: Array, inverse: Array,
    found: Array,
) -> None:  # fmt: skip
    """Write the inverse depth and the albedo of the second picture (rows, width), 0 where nothing goes to.

    low, high: places in the second picture of both ends of each pixel's strip, with their inverse depths there.
    """
    rows, width = surface.shape
    for y in range(rows):
        for x in range(width):
            a, b = low[y, x], high[y, x]
            if not (-np.inf < a < b < np.inf and inverse_low[y, x] > 0.0 and inverse_high[y, x] > 0.0):
                continue  # beside the picture, or seen from behind
            for column in range(max(math.ceil(a), 0), min(math.floor(b), width - 1) + 1):
                share = (column - a) / (b - a)
                near = inverse_low[y, x] + share * (inverse_high[y, x] - inverse_low[y, x])
                if near > inverse[y, column]:
                    inverse[y, column] = near
                    beside = x - 1 if share < 0.5 else x + 1
                    found[y, column] = albedo[y, x]
                    if 0 <= beside < width:
                        step = abs(surface[y, beside] - surface[y, x])
                        if step <= DEPTH_JUMP * max(surface[y, beside], surface[y, x]):
                            found[y, column] += abs(share - 0.5) * (albedo[y, beside] - albedo[y, x])


def _fill(inverse: Array, albedo: Array) -> None:
    """Fill the pixels (width,) of a row that nothing goes to (inverse depth 0). They get the values of the nearest
    known pixel to the left or to the right, whichever is farther away. A row without any known pixel stays open sky."""
    known = np.flatnonzero(inverse > 0)
    if not len(known):
        return
    place = np.searchsorted(known, np.arange(len(inverse)), side="right")
    left, right = known[np.maximum(place - 1, 0)], known[np.minimum(place, len(known) - 1)]
    taken = np.where(inverse[left] <= inverse[right], left, right)
    empty = inverse == 0
    albedo[empty], inverse[empty] = albedo[taken[empty]], inverse[taken[empty]]


def ambient_radiance(setting: Setting, seen: Seen, filter_width_m: float) -> Array:
    """Radiance of a view in ambient light behind a filter, in W/(m^2 sr), float64 (rows, width)."""
    scene = setting.scene
    optics = setting.optics.model_copy(update={"filter_width": filter_width_m})
    white = ambient_irradiance(scene.illuminance_lux, optics) / math.pi
    extinction_per_m = scene.diffuse_extinction_per_m
    left = np.exp(-extinction_per_m * seen.range_m) if extinction_per_m > 0 else np.isfinite(seen.range_m) * 1.0
    air = 0.0 if scene.medium is None else scene.medium.scattering_share
    return np.asarray(white * (seen.albedo * left + air * (1.0 - left)))
