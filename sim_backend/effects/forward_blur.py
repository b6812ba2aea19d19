"""Forward scatter: light that droplets only turn a little, by diffraction, comes in as a blurred copy of the stripe.

Called for by `medium: {forward_share: 0.5}`: half of what droplets take out of the beam is diffraction within 1 to 2
degrees. The stripe's extinction counts it as lost; this brings it back, wider. On a way of length l the number of such
turns is Poisson of mean t = f sigma_s l, so there is exp(t) - 1 times the ballistic light more. A turn by an angle of
standard deviation s per axis at the share x of the way to or from the surface shifts the light by (1 - x) of the angle,
which has the variance s^2/3 on average over x; light that was turned at all was turned t / (1 - exp(-t)) times. The
blur is one Gaussian of that variance (small-angle scattering as a random walk, Ishimaru, "Wave propagation and
scattering in random media", 1978, chapter 13). About 0.5 ms per mirror position for 512 rows."""

import math

import numba
import numpy as np
from numpy.typing import NDArray

from sim_backend.effects.setting import Array, Setting
from sim_backend.effects.stripe import Lit, lit_surface, row_light, spread_line
from sim_backend.light.line import line_width, sigma_px
from sim_backend.light.sheet import LightSheet
from sim_backend.scenes.medium import FORWARD_ANGLE

MOST_TURNS = 600.0
"""Mean number of turns beyond which no light comes back; keeps exponentials finite."""


class ForwardBlur:
    """Adds the blurred light of a sheet."""

    def __init__(self, setting: Setting) -> None:
        medium = setting.scene.medium
        assert medium is not None, "called for by scenes with a medium only"
        self._view = setting.view
        self._scale = setting.gain / math.pi / setting.line.fan
        self._width = line_width(setting.view, setting.optics, setting.sensor, setting.line)
        self._extinction_per_m = setting.scene.extinction_per_m
        self._forward_per_m = medium.forward_per_m
        self._angle_px = FORWARD_ANGLE / math.sqrt(3) * setting.view.focal_px

    def add(self, sheet: LightSheet, first_row: int, last_row: int, rate: Array) -> None:
        """Add detections per second and watt of laser power."""
        _add_blur(
            lit_surface(self._view.at(sheet.time_s)),
            sheet.inverse,
            sheet.offset_m,
            sheet.x_stripe_px,
            self._scale,
            self._width,
            self._extinction_per_m,
            self._forward_per_m,
            self._angle_px,
            first_row,
            last_row,
            rate,
        )


@numba.njit(cache=True, nogil=True)
def _add_blur(
    lit: Lit,
    inverse: NDArray[np.float64],
    offset_m: NDArray[np.float64],
    x_stripe: NDArray[np.float64],
    scale: float,
    width: NDArray[np.float64],
    extinction_per_m: float,
    forward_per_m: float,
    angle_px: float,
    first_row: int,
    last_row: int,
    rate: NDArray[np.float64],
) -> None:
    for y in range(first_row, last_row):
        centre = x_stripe[y]
        if np.isnan(centre):
            continue
        light, way_m, r, w = row_light(lit, inverse, offset_m, extinction_per_m, y, centre)
        turns = min(forward_per_m * way_m, MOST_TURNS)
        if not turns > 0.0:
            continue
        turned = -turns / math.expm1(-turns)
        sigma = math.hypot(sigma_px(width, w, r), angle_px * math.sqrt(turned))
        spread_line(scale * light * math.expm1(turns), centre, sigma, rate[y])
