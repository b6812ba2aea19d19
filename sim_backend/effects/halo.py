"""Light that the medium scatters more than once: a halo around the stripe, and a pedestal under the whole row.

This is a fit to path tracing (walls at tau 0.5, 1 and 2, forward-peaked and isotropic), not a closed form:

    halo(r) = eta (e^(2 tau) - 1) k(r)    times the ballistic stripe, per pixel of row at the distance r from it

where eta = 0.76 - 0.13 tau, at least 0.18 (traced: 0.7, 0.64, 0.5 at tau 0.5, 1, 2), if the medium scatters forward,
and 0.12 + 0.06 tau, at most 0.18, if it scatters evenly; between the two it is interpolated by the mean cosine over
0.85. k has integral 1, half of it exponential of 1.7 degrees and half of 6 degrees (in pixels as in the middle of the
picture). 2 tau is the medium's scattering along the light's own way, there and back. It counts neither absorption, nor
rain and snow, nor light that is turned only a little (`forward_share`), which blurs the stripe itself.

The haze, too, is scattered further: P = 0.16 (e^(1.5 tau) - 1) of its level at its end is added to everything behind
it, and P (1 + 0.8 (1 - e^(-r / 6 degrees))) of that level before it. In the traced scene with a black wall it is as
bright behind the stripe as 0.12, 0.23 and 0.43 of the light 10 pixels before it, at tau 0.5, 1 and 2 (traced:
0.08-0.13, 0.18-0.32, 0.35-0.45). In isotropic fog at tau 0.5 and 1 the light scattered more than once is right within
30 % all along the traced rows. Cost: about 0.2 ms per mirror position for 512 x 512 pixels.
"""

import math
from typing import Any

import numba
import numpy as np

from sim_backend.effects.setting import Array, Setting
from sim_backend.effects.stripe import row_light
from sim_backend.light.sheet import Arrays, LightSheet, Traced
from sim_backend.scenes.medium import DROPLET_G

NARROW, WIDE = math.radians(1.7), math.radians(6.0)
"""The halo's two exponentials."""
MOST_EVEN = 0.18
"""eta of isotropic scattering at an optical depth of 1 and more."""
MOST_DEPTH = 600.0
"""Optical depth beyond which no light comes back; keeps exponentials finite."""
PEDESTAL, PEDESTAL_RISE, BEFORE = 0.16, 1.5, 0.8
"""The haze's further scattering: size, rise with the optical depth, and how much more of it there is before its end."""


class Halo:
    """Adds the light of a sheet that is scattered more than once."""

    def __init__(self, setting: Setting) -> None:
        medium = setting.scene.medium
        assert medium is not None, "called for by scenes with a medium only"
        self._view = setting.view
        per_radian = setting.gain / setting.line.fan
        haze = per_radian * medium.scattering_per_m * medium.back_per_sr
        scattering_per_m = medium.scattering_per_m - medium.forward_per_m
        peaked = min(max(medium.mean_cosine / DROPLET_G, 0.0), 1.0)
        self._light = per_radian / math.pi, haze, setting.scene.diffuse_extinction_per_m, scattering_per_m, peaked
        self._scales_px = (NARROW * setting.view.focal_px, WIDE * setting.view.focal_px)
        away_px = np.arange(setting.view.width + 1)
        narrow, wide = (np.exp(-away_px / scale) for scale in self._scales_px)
        self._tables = narrow, wide, narrow[::-1].copy(), wide[::-1].copy()

    def add(self, sheet: LightSheet, first_row: int, last_row: int, rate: Array) -> None:
        """Add detections per second and watt of laser power."""
        parts = self._light, self._scales_px, self._tables
        _add_halo(self._view.at(sheet.time_s).arrays, sheet.traced, parts, first_row, last_row, rate)


@numba.njit(cache=True, nogil=True)
def halo_share(way_depth: float, peaked: float) -> float:
    """Ratio of the halo's light to the ballistic stripe's, for the optical depth there and back. peaked: 0 to 1."""
    tau = 0.5 * way_depth
    even = min(0.12 + 0.06 * tau, MOST_EVEN)
    forward = max(0.76 - 0.13 * tau, even)
    return (even + peaked * (forward - even)) * math.expm1(min(way_depth, MOST_DEPTH))


@numba.njit(cache=True, nogil=True)
def _around(off: float, scale: float, total: float) -> tuple[float, float, float]:
    """An exponential total exp(-|x|/scale)/(2 scale) integrated over the pixel that its centre is in, `off` from the
    pixel's middle, and over the pixels to its left and right.
    """
    left, right = (0.5 + off) / scale, (0.5 - off) / scale
    side = -0.5 * total * math.expm1(-1.0 / scale)
    here = -0.5 * total * (math.expm1(-left) + math.expm1(-right))
    return here, side * math.exp(-left), side * math.exp(-right)


@numba.njit(cache=True, nogil=True)
def _add_side(level: float, a: float, b: float, narrow: Array, wide: Array, side: Array) -> None:
    """Add a constant and two falling parts to the pixels on one side: a loop that processors do eight pixels a step."""
    for i in range(len(side)):
        side[i] += level + a * narrow[i] + b * wide[i]


@numba.njit(cache=True, nogil=True)
def _add_halo(view: Arrays, sheet: Traced, parts: tuple[Any, ...], first_row: int, last_row: int, rate: Array) -> None:
    """Add halo and pedestal. parts: `_light`, `_scales_px` and `_tables` of `Halo`."""
    u, v, _, _, _, _, source = view
    inverse, offset_m, x_stripe, x_end, _, step = sheet
    (stripe_scale, haze_scale, extinction_per_m, scattering_per_m, peaked), scales_px, tables = parts
    narrow, wide, narrow_back, wide_back = tables
    width = u.shape[1]
    for y in range(first_row, last_row):
        if np.isnan(x_end[y]) or step[y] == 0:
            continue
        middle = min(max(round(x_end[y]), 0), width - 1)
        ray_u, ray_v = u[y, middle], v[y, middle]
        k = min(y, len(inverse) - 1)
        w = inverse[k, 0] * ray_u + inverse[k, 1] * ray_v + inverse[k, 2]
        if not w > 0.0:
            continue
        z, q = 1.0 / w, math.sqrt(ray_u * ray_u + ray_v * ray_v + 1.0)
        away_x, away_y, away_z = z * ray_u - source[0], z * ray_v - source[1], z - source[2]
        r = math.sqrt(away_x**2 + away_y**2 + away_z**2)
        way_m = r + z * q
        # The haze at its end, as in `sim_backend.effects.fog`, and what becomes of it.
        level = haze_scale * q / (r * w * abs(offset_m[k])) * math.exp(-extinction_per_m * way_m)
        level *= PEDESTAL * math.expm1(min(PEDESTAL_RISE * 0.5 * scattering_per_m * way_m, MOST_DEPTH))
        total = 0.0
        if not np.isnan(x_stripe[y]):
            ballistic, way_m, _, _ = row_light(view, inverse, offset_m, extinction_per_m, y, x_stripe[y])
            total = stripe_scale * ballistic * halo_share(scattering_per_m * way_m, peaked)
        off = x_end[y] - middle
        near, near_left, near_right = _around(off, scales_px[0], 0.5 * total)
        far, far_left, far_right = _around(off, scales_px[1], 0.5 * total)
        more_left, more_right = (BEFORE * level, 0.0) if step[y] > 0 else (0.0, BEFORE * level)
        right_c, left_c = far_right - more_right * wide[1], far_left - more_left * wide[1]
        rate[y, middle] += level + near + far
        _add_side(level + more_right, near_right, right_c, narrow[:-1], wide[:-1], rate[y, middle + 1 :])
        behind = width + 1 - middle
        _add_side(level + more_left, near_left, left_c, narrow_back[behind:], wide_back[behind:], rate[y, :middle])
