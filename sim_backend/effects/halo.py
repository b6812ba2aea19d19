"""Light that the medium scatters more than once: a halo around the stripe, and a pedestal under the whole row.

`sim_backend.effects.beam_spread` has the physics. With S the light of the ballistic stripe, less if the beam slants, H
that of the haze at its end, and t half the optical depth of the light's whole way, a pixel x px from that end gets

    S (e^(2 t) - 1) halo(t, x) + H (e^(1.5 t) - 1) haze(t, x)

from tables float32 (depths, pixels), which change little with t and are made once for the medium and the rig (0.1 to
0.3 s). Angles become pixels as in the middle of the picture. `rate`, to which light is added, is (rows, width). Light
that is turned only a little (`forward_share`) counts as not scattered; it blurs the stripe itself.

Against traced rows, levels in the ten pixels before and behind the stripe are right within 10 % up to an optical depth
of 1 and within 20 % at 2 (docs/results/simulator.md). Cost: about 0.2 ms per mirror position for 512 x 512 pixels.
"""

import math
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from sim_backend.effects.beam_spread import AT, DEPTHS, shapes
from sim_backend.effects.setting import Array, Setting
from sim_backend.effects.stripe import row_light
from sim_backend.light.sheet import Arrays, LightSheet, Traced

HALO_RISE, HAZE_RISE = 2.0, 1.5
"""Approximate exponents with which halo and spread haze rise with the optical depth."""
FINER = 4
"""Number of depths that tables have for each of `DEPTHS`. The nearest one is taken, which is within 3 %."""
LEAST_COSINE = 0.1
"""Smallest cosine of the angle between light and camera axis that is used, so that no halo gets infinitely wide."""
LEAST_BASELINE_M = 1e-6
Tables = tuple[NDArray[Any], ...]
"""Halo, haze before its end, haze behind it, by depth and distance in pixels; then the same for falling distances."""


class Halo:
    """Adds the light of a sheet that is scattered more than once."""

    def __init__(self, setting: Setting) -> None:
        medium, extinction_per_m = setting.scene.medium, setting.scene.diffuse_extinction_per_m
        assert medium is not None, "called for by scenes with a medium only"
        self._view = setting.view
        per_radian = setting.gain / setting.line.fan
        haze = per_radian * medium.scattering_per_m * medium.back_per_sr
        self._light = per_radian / math.pi, haze, extinction_per_m
        share = (medium.scattering_per_m - medium.forward_per_m) / extinction_per_m
        baseline_m = max(float(np.linalg.norm(setting.view.source_m)), LEAST_BASELINE_M)
        halo, *haze_of = shapes(medium.lobes, share, extinction_per_m * baseline_m)
        away = np.arange(setting.view.width + 2) / setting.view.focal_px
        rises = np.expm1(HALO_RISE * DEPTHS) * setting.view.focal_px, *2 * [np.expm1(HAZE_RISE * DEPTHS)]
        places = np.arange(len(DEPTHS))
        between = np.maximum(1 - np.abs(np.linspace(0, places[-1], FINER * places[-1] + 1)[:, None] - places), 0)
        tables = [
            (between @ [np.interp(away, AT, row) for row in shape / rise[:, None]]).astype(np.float32)
            for shape, rise in zip((halo, *haze_of), rises, strict=True)
        ]
        self._tables = *tables, *(np.ascontiguousarray(table[:, ::-1]) for table in tables)

    def add(self, sheet: LightSheet, first_row: int, last_row: int, rate: Array) -> None:
        """See `LaserEffect`."""
        view = self._view.at(sheet.time_s).arrays
        _add_halo(view, sheet.traced, self._light, self._tables, first_row, last_row, rate)


@numba.njit(cache=True, nogil=True)
def _add_side(
    halo: NDArray[Any], haze: NDArray[Any], light: tuple[float, float], on: float, side: NDArray[Any]
) -> None:
    """Add halo and spread haze to the pixels on one side, interpolated between two neighbours in the tables. light:
    factors of halo and haze. on: share of the second neighbour."""
    a, b = np.float32(light[0] * (1.0 - on)), np.float32(light[1] * (1.0 - on))
    c, d = np.float32(light[0] * on), np.float32(light[1] * on)
    for i in range(len(side)):
        side[i] += (a * halo[i] + c * halo[i + 1]) + (b * haze[i] + d * haze[i + 1])


@numba.njit(cache=True, nogil=True)
def _add_halo(
    view: Arrays, sheet: Traced, light: tuple[float, ...], tables: Tables, first_row: int, last_row: int, rate: Array
) -> None:
    """Add halo and pedestal. light: scales of stripe and haze, extinction."""
    u, v, _, _, _, _, source = view
    inverse, offset_m, x_stripe, x_end, _, step = sheet
    stripe_scale, haze_scale, extinction_per_m = light
    halo, before, behind, halo_back, before_back, behind_back = tables
    width, per_depth = u.shape[1], (len(halo) - 1) / math.log(DEPTHS[-1] / DEPTHS[0])
    for y in range(first_row, last_row):
        if np.isnan(x_end[y]) or step[y] == 0:
            continue
        end = min(max(x_end[y], -0.5), width - 0.5)
        middle = min(max(round(end), 0), width - 1)
        ray_u, ray_v = u[y, middle], v[y, middle]
        k = min(y, len(inverse) - 1)
        w = inverse[k, 0] * ray_u + inverse[k, 1] * ray_v + inverse[k, 2]
        if not w > 0.0:
            continue
        z, q = 1.0 / w, math.sqrt(ray_u * ray_u + ray_v * ray_v + 1.0)
        away_x, away_y, away_z = z * ray_u - source[0], z * ray_v - source[1], z - source[2]
        r = math.sqrt(away_x**2 + away_y**2 + away_z**2)
        t = 0.5 * extinction_per_m * (r + z * q)
        # The haze at its end, as in `sim_backend.effects.fog`, and what becomes of it.
        level = haze_scale * q / (r * w * abs(offset_m[k])) * math.exp(-2.0 * t)
        total = 0.0
        if not np.isnan(x_stripe[y]):
            # A slanting beam is spread over more of a row, there and back. At some ten pixels half of that is dimming,
            # the other half is made up for by the greater reach.
            ahead = max(away_z, LEAST_COSINE * r)
            slant = r / ahead * math.hypot(1.0, away_x / ahead) + q * math.hypot(1.0, ray_u)
            total = stripe_scale / math.sqrt(0.5 * slant)
            total *= row_light(view, inverse, offset_m, extinction_per_m, y, x_stripe[y])[0]
        t = min(t, DEPTHS[-1])
        parts = total * math.expm1(HALO_RISE * t), level * math.expm1(HAZE_RISE * t)
        i = round(per_depth * math.log(max(t, DEPTHS[0]) / DEPTHS[0]))
        right = math.ceil(end)
        on, left = right - end, halo.shape[1] - 1 - right
        haze, haze_back = (behind, before_back) if step[y] > 0 else (before, behind_back)
        _add_side(halo[i], haze[i], parts, on, rate[y, right:])
        _add_side(halo_back[i, left:], haze_back[i, left:], parts, on, rate[y, :right])
