"""The stripe: the sheet's light on the surface, seen by the camera.

A fan of power P spread evenly over an angle F carries J = P/F per radian; its flux vector is J/r delta(n.X - d) e, with
r the distance from the source and e the direction from it. On a Lambertian surface (albedo rho, normal N) in a medium
of extinction sigma, the radiance L integrated along the row is

    integral of L dx = (rho/pi) (J/r) |N.e| / |d(n.X)/dx| exp(-sigma (r + |X|))          per pixel of row

with n.X taken on the surface along the row. For a rectified rig, with the rays q_p = (u_p, v_p, 1) of the projector
and q = q_c of the camera and the depth Z, this is the camera-side cosine law (rho/pi) I0 du |N.q| / Z^2
exp(-sigma Z (|q_p| + |q_c|)), with I0 du = J sqrt(1 + u_p^2)/|q_p|^2. The surface is the facet m.X = 1 through the
point: |N.e| = |1 - m.S|/(|m| r) for a source at S. The profile along the row is a Gaussian integrated over each pixel,
of the width that `sim_backend.light.line` gives.

A share f of what the medium scatters (`forward_share`; droplets: half) is diffraction, which turns light by 1 to 2
degrees only. The stripe's extinction counts this light as lost; `ForwardBlur` brings it back as a wider copy. On a path
of length l, there and back, the number of such turns is Poisson of mean t = f sigma_s l, with the scattering
coefficient sigma_s. So the extra light is exp(t) - 1 times the ballistic light. A turn by an angle of standard
deviation s per axis, at the share x of the way to the surface or back, shifts the light by (1 - x) of the angle: a
variance of s^2/3 on average over x. Light that was turned at all was turned t / (1 - exp(-t)) times on average. The
blur is one Gaussian of the resulting variance (small-angle scattering as a random walk, Ishimaru, "Wave propagation and
scattering in random media", 1978, chapter 13). Light is computed in float64 and added to `rate` (rows, width), float64
or float32. Cost: about 0.5 ms per mirror position for 512 rows.
"""

import math

import numba
import numpy as np

from sim_backend.effects.setting import Array, Setting
from sim_backend.light.line import edge, line_width, sigma_px
from sim_backend.light.sheet import Arrays, LightSheet, Traced
from sim_backend.scenes.medium import FORWARD_ANGLE

REACH_SIGMAS = 5.0
"""Standard deviations at which the Gaussian is cut; 6e-7 of the stripe is left out."""
MIN_SLOPE = 0.02
"""Smallest slope of the sheet against the surface along a row, as a share of the sheet's own: keeps a stripe that runs
along the row, which has no position in it, from being infinitely bright."""
MOST_TURNS = 600.0
"""Mean number of turns beyond which no light comes back; keeps exponentials finite."""


class Stripe:
    """Adds the stripe of a sheet, from light that was not deflected."""

    def __init__(self, setting: Setting) -> None:
        self._view = setting.view
        self._width = line_width(setting.view, setting.optics, setting.sensor, setting.line)
        self._turned_per_m, self._angle_px = 0.0, 0.0
        self._light = setting.gain / math.pi / setting.line.fan, setting.scene.extinction_per_m

    def add(self, sheet: LightSheet, first_row: int, last_row: int, rate: Array) -> None:
        """See `LaserEffect`."""
        light = *self._light, self._turned_per_m, self._angle_px
        _add_lines(self._view.at(sheet.time_s).arrays, sheet.traced, light, self._width, first_row, last_row, rate)


class ForwardBlur(Stripe):
    """Adds the blurred copy of the stripe, from light that was deflected a little."""

    def __init__(self, setting: Setting) -> None:
        super().__init__(setting)
        assert setting.scene.medium is not None, "called for by scenes with a medium only"
        self._turned_per_m = setting.scene.medium.forward_per_m
        self._angle_px = FORWARD_ANGLE / math.sqrt(3) * setting.view.focal_px


@numba.njit(inline="always")
def _between(values: Array, y: int, x: int, t: float) -> float:
    return float((1.0 - t) * values[y, x] + t * values[y, x + 1])


@numba.njit(inline="always")
def row_light(
    view: Arrays, inverse: Array, offset_m: Array, extinction_per_m: float, y: int, centre: float
) -> tuple[float, float, float, float]:
    """The undeflected light of the stripe at position `centre` (in pixels) of row y, integrated along the row.

    Returns rho |N.e| / (r |d(n.X)/dx|) exp(-sigma way), for J/pi = 1; the length `way` of the light's path in metres;
    the distance r from the mirror; and the inverse depth.
    """
    u, v, u_x, v_x, facet, albedo, source = view
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
def spread_line(total: float, centre: float, sigma: float, row: Array) -> None:
    """Add a Gaussian line with `total` light to a row, integrated over each pixel."""
    reach = REACH_SIGMAS * sigma
    unit = 1.0 / sigma
    first, last = max(0, math.ceil(centre - reach - 0.5)), min(len(row) - 1, math.floor(centre + reach + 0.5))
    below = edge((first - 0.5 - centre) * unit)
    for i in range(first, last + 1):
        above = edge((i + 0.5 - centre) * unit)
        row[i] += total * (above - below)
        below = above


@numba.njit(cache=True, nogil=True)
def _add_lines(
    view: Arrays, sheet: Traced, light: tuple[float, ...], width: Array, first_row: int, last_row: int, rate: Array
) -> None:
    """Add the stripe, or its blurred copy if `light` has turns. light: scale, extinction, turns per metre, their angle
    in pixels. width: as in `line_width`.
    """
    inverse, offset_m, x_stripe, _, _, _ = sheet
    scale, extinction_per_m, turned_per_m, angle_px = light
    for y in range(first_row, last_row):
        centre = x_stripe[y]
        if np.isnan(centre):
            continue
        ballistic, way_m, r, w = row_light(view, inverse, offset_m, extinction_per_m, y, centre)
        total, sigma = scale * ballistic, sigma_px(width, w, r)
        if turned_per_m > 0.0:
            turns = min(turned_per_m * way_m, MOST_TURNS)
            total *= math.expm1(turns)
            sigma = math.hypot(sigma, angle_px * math.sqrt(-turns / math.expm1(-turns)))
        spread_line(total, centre, sigma, rate[y])
