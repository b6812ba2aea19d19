"""The haze: laser light that the medium scatters once, where a pixel's ray crosses the sheet.

With J = P/F the power per radian of fan and n.X = d the sheet, a ray q = (u, v, 1) crosses it at z = d/(n.q) and sees

    L = sigma_s p J |q| / (r |n.q|) exp(-sigma (r + z |q|)),      r = |z q - S| from the source S

For a rectified rig all powers of z cancel: sigma_s p I0 du |q_p||q_c|/b exp(-sigma z (|q_p| + |q_c|)). The phase
function p is taken constant: scattering angles are all near 180 degrees. The haze ends where the sheet's light ends: at
the object, blurred like the stripe, and in the sheet's own shadow along the row."""

import math

import numba
import numpy as np
from numpy.typing import NDArray

from sim_backend.effects.setting import Array, Setting
from sim_backend.light_sheet import LightSheet


class Haze:
    """Adds the single-scatter haze of a sheet."""

    def __init__(self, setting: Setting) -> None:
        medium = setting.scene.medium
        assert medium is not None, "fog is asked for by scenes with a medium only"
        self._view = setting.view
        self._scale = setting.gain / setting.line.fan * medium.scattering_per_m * medium.backscatter
        self._extinction_per_m = medium.extinction_per_m
        self._sigma_px = setting.line.sigma_px

    def add(self, sheet: LightSheet, first_row: int, last_row: int, rate: Array) -> None:
        """Add detections per second and watt of laser power."""
        view = self._view
        _add_haze(
            view.u,
            view.v,
            view.source_m,
            sheet.inverse,
            sheet.offset_m,
            sheet.x_stripe_px,
            sheet.x_end_px,
            sheet.start_px,
            sheet.step,
            self._scale,
            self._sigma_px,
            self._extinction_per_m,
            first_row,
            last_row,
            rate,
        )


@numba.njit(cache=True, nogil=True)
def _lit_share(distance_px: float, sigma_px: float) -> float:
    """Share of a pixel that lies before an end blurred by sigma; distance from pixel centre to the end."""
    total = 0.0
    for sign in (1.0, -1.0):
        a = (distance_px + 0.5 * sign) / sigma_px
        normal = 0.5 * math.erfc(-a / math.sqrt(2.0))
        total += sign * sigma_px * (a * normal + math.exp(-0.5 * a * a) / math.sqrt(2.0 * math.pi))
    return total


@numba.njit(cache=True, nogil=True)
def _add_haze(
    u: NDArray[np.float64],
    v: NDArray[np.float64],
    source: NDArray[np.float64],
    inverse: NDArray[np.float64],
    offset_m: float,
    x_stripe: NDArray[np.float64],
    x_end: NDArray[np.float64],
    start: NDArray[np.int64],
    step: NDArray[np.int64],
    scale: float,
    sigma_px: float,
    extinction_per_m: float,
    first_row: int,
    last_row: int,
    rate: NDArray[np.float64],
) -> None:
    width = rate.shape[1]
    reach = 5.0 * sigma_px + 0.5
    for y in range(first_row, last_row):
        end = x_end[y]
        if np.isnan(end):
            continue
        move = step[y]
        soft = not np.isnan(x_stripe[y])
        x = start[y]
        while 0 <= x < width:
            ahead = (end - x) * move
            if ahead < (-reach if soft else 0.0):
                break
            ray_u, ray_v = u[y, x], v[y, x]
            w = inverse[0] * ray_u + inverse[1] * ray_v + inverse[2]
            if not w > 0.0:
                break
            z = 1.0 / w
            away_x, away_y, away_z = z * ray_u - source[0], z * ray_v - source[1], z - source[2]
            r = math.sqrt(away_x**2 + away_y**2 + away_z**2)
            q = math.sqrt(ray_u * ray_u + ray_v * ray_v + 1.0)
            light = scale * q / (r * w * abs(offset_m)) * math.exp(-extinction_per_m * (r + z * q))
            if soft and ahead < reach:
                light *= _lit_share(ahead, sigma_px)
            rate[y, x] += light
            x += move
