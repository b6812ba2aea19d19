"""The stripe: the sheet's light on the surface, seen by the camera.

A fan of power P spread evenly over an angle F carries J = P/F per radian; its flux vector is J/r delta(n.X - d) e, with
r the distance from the source and e the direction from it. On a Lambertian surface (albedo rho, normal N), integrated
along the row:

    integral of L dx = (rho/pi) (J/r) |N.e| / |d(n.X)/dx| exp(-sigma (r + |X|))          per pixel of row

n.X taken on the surface along the row. For a rectified rig this is the camera-side cosine law
(rho/pi) I0 du |N.q| / Z^2 exp(-sigma Z (|q_p| + |q_c|)), with I0 du = J sqrt(1 + u_p^2)/|q_p|^2. The surface is the
facet m.X = 1 through the point: |N.e| = |1 - m.S|/(|m| r) for a source at S. The profile across the row is a Gaussian
integrated over each pixel, of the width that `sim_backend.light.line` gives."""

import math

import numba
import numpy as np
from numpy.typing import NDArray

from sim_backend.effects.setting import Array, Setting
from sim_backend.light.line import edge, line_width, sigma_px
from sim_backend.light.sheet import LightSheet
from sim_backend.light.view import CameraView

REACH_SIGMAS = 5.0
"""Sds at which the Gaussian is cut; 6e-7 of the stripe is left out."""
MIN_SLOPE = 0.02
"""Smallest slope of the sheet against the surface along a row, as a share of the sheet's own: keeps a stripe that runs
along the row, which has no position in it, from being infinitely bright."""


Lit = tuple[Array, Array, Array, Array, Array, Array, Array]


def lit_surface(view: CameraView) -> Lit:
    """The arrays of a view that `row_light` takes."""
    return view.u, view.v, view.u_x, view.v_x, view.facet, view.albedo, view.source_m


class Stripe:
    """Adds the stripe of a sheet."""

    def __init__(self, setting: Setting) -> None:
        self._view = setting.view
        self._scale = setting.gain / math.pi / setting.line.fan
        self._width = line_width(setting.view, setting.optics, setting.sensor, setting.line)
        self._extinction_per_m = setting.scene.extinction_per_m

    def add(self, sheet: LightSheet, first_row: int, last_row: int, rate: Array) -> None:
        """Add detections per second and watt of laser power."""
        _add_stripe(
            lit_surface(self._view.at(sheet.time_s)),
            sheet.inverse,
            sheet.offset_m,
            sheet.x_stripe_px,
            self._scale,
            self._width,
            self._extinction_per_m,
            first_row,
            last_row,
            rate,
        )


@numba.njit(inline="always")
def _between(values: NDArray[np.float64], y: int, x: int, t: float) -> float:
    return float((1.0 - t) * values[y, x] + t * values[y, x + 1])


@numba.njit(inline="always")
def row_light(
    lit: Lit, inverse: Array, offset_m: Array, extinction_per_m: float, y: int, centre: float
) -> tuple[float, float, float, float]:
    """The light of the stripe at pixel `centre` of row y, integrated along the row, that nothing has turned on its way.

    As rho |N.e| / (r |d(n.X)/dx|) exp(-sigma way), for J/pi = 1; then the way in metres, the distance from the mirror,
    and the inverse depth.
    """
    u, v, u_x, v_x, facet, albedo, source = lit
    k = min(y, len(inverse) - 1)
    a, b, c = inverse[k, 0], inverse[k, 1], inverse[k, 2]
    x = min(max(math.floor(centre), 0), u.shape[1] - 2)
    t = centre - x
    ray_u, ray_v = _between(u, y, x, t), _between(v, y, x, t)
    slope_u, slope_v = _between(u_x, y, x, t), _between(v_x, y, x, t)
    w = a * ray_u + b * ray_v + c
    z = 1.0 / w
    mx = (1.0 - t) * facet[y, x, 0] + t * facet[y, x + 1, 0]
    my = (1.0 - t) * facet[y, x, 1] + t * facet[y, x + 1, 1]
    mz = w - mx * ray_u - my * ray_v  # the facet's tilt, made to pass through the very point
    away_x, away_y, away_z = z * ray_u - source[0], z * ray_v - source[1], z - source[2]
    r = math.sqrt(away_x**2 + away_y**2 + away_z**2)
    length = math.sqrt(mx * mx + my * my + mz * mz)
    incidence = abs(mx * away_x + my * away_y + mz * away_z) / (length * r)
    sheet_slope = a * slope_u + b * slope_v
    slope = abs(sheet_slope - mx * slope_u - my * slope_v)
    slope = max(slope, MIN_SLOPE * abs(sheet_slope)) * abs(offset_m[k]) * z
    way_m = r + z * math.sqrt(ray_u * ray_u + ray_v * ray_v + 1.0)
    light = _between(albedo, y, x, t) * incidence / (r * slope) * math.exp(-extinction_per_m * way_m)
    return light, way_m, r, w


@numba.njit(inline="always")
def spread_line(total: float, centre: float, sigma: float, row: NDArray[np.float64]) -> None:
    """Add a Gaussian line of that much light to a row, integrated over each pixel."""
    reach = REACH_SIGMAS * sigma
    unit = 1.0 / sigma
    first, last = max(0, math.ceil(centre - reach - 0.5)), min(len(row) - 1, math.floor(centre + reach + 0.5))
    below = edge((first - 0.5 - centre) * unit)
    for i in range(first, last + 1):
        above = edge((i + 0.5 - centre) * unit)
        row[i] += total * (above - below)
        below = above


@numba.njit(cache=True, nogil=True)
def _add_stripe(
    lit: Lit,
    inverse: NDArray[np.float64],
    offset_m: NDArray[np.float64],
    x_stripe: NDArray[np.float64],
    scale: float,
    width: NDArray[np.float64],
    extinction_per_m: float,
    first_row: int,
    last_row: int,
    rate: NDArray[np.float64],
) -> None:
    for y in range(first_row, last_row):
        centre = x_stripe[y]
        if np.isnan(centre):
            continue
        light, _, r, w = row_light(lit, inverse, offset_m, extinction_per_m, y, centre)
        spread_line(scale * light, centre, sigma_px(width, w, r), rate[y])
