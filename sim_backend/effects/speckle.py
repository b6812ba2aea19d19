"""Speckle: laser light comes back grainy from a rough surface; a pixel averages the grains it covers.

The light of M independent grains is gamma distributed with mean 1. Behind an f-number N, for a diode of area A,

    contrast = sd / mean = 1 / sqrt(M),    M = 2 (1 + A / a),    a = (4/pi) (wavelength N)^2, the area of a grain

with the factor 2 since a diffuse surface depolarises (Goodman, "Speckle phenomena in optics", 2007, sections 4.2 and
4.6). With the default sensor at f/2 the contrast is 0.15.

Multiplies the stripe, the light that earlier effects added to `rate`, float64 or float32 (rows, width). The grains
depend on the pixel and the position of the sheet in steps of the line's width, so they stay for all exposures of a
column and return in every sweep. Cost: about 0.4 ms per mirror position for 512 rows.
"""

import math

import numba
import numpy as np

from sim_backend.effects.setting import Array, Setting
from sim_backend.light.optics import Line, Optics, Sensor
from sim_backend.light.sheet import LightSheet
from sim_backend.random_numbers import frame_key

POLARISATIONS = 2


def grains(optics: Optics, sensor: Sensor, line: Line) -> float:
    """Number of independent grains that a pixel's diode averages."""
    grain_m2 = 4 / math.pi * (line.wavelength * optics.f_number) ** 2
    return POLARISATIONS * (1 + sensor.fill_factor * sensor.pitch**2 / grain_m2)


class Speckle:
    """Makes a sheet's light on the surfaces grainy."""

    def __init__(self, setting: Setting) -> None:
        self._grains = grains(setting.optics, setting.sensor, setting.line)
        self._seed = np.uint64(setting.scene.seed)
        self._widths_per_tangent = setting.view.focal_px / setting.line.sigma_px

    def add(self, sheet: LightSheet, first_row: int, last_row: int, rate: Array) -> None:
        """Multiply the light of the stripe by the grains."""
        # The `inverse` of a bowed sheet changes while threads draw its rows; the plane that it bows from does not.
        by_u, _, ahead = sheet.inverse[0] if sheet.bowed is None else sheet.bowed.planes[0][:3]
        with np.errstate(divide="ignore", invalid="ignore"):
            place = np.rint(ahead / by_u * self._widths_per_tangent) + 0.0  # no negative zero
        _roughen(self._seed, place.view(np.uint64), self._grains, first_row, last_row, rate)


@numba.njit(cache=True, nogil=True)
def _uniform(key: np.uint64, number: int) -> float:
    """A uniform number in (0, 1)."""
    return (float(frame_key(key, np.uint64(number)) >> np.uint64(11)) + 0.5) * 2.0**-53


@numba.njit(cache=True, nogil=True)
def gamma_of(key: np.uint64, shape: float) -> float:
    """A gamma variate of mean 1 that the key determines (Marsaglia and Tsang 2000). shape: of the distribution, at
    least 1."""
    d = shape - 1.0 / 3.0
    c = 1.0 / math.sqrt(9.0 * d)
    number = 0
    while True:
        a, b, u = _uniform(key, number), _uniform(key, number + 1), _uniform(key, number + 2)
        number += 3
        normal = math.sqrt(-2.0 * math.log(a)) * math.cos(2.0 * math.pi * b)
        v = (1.0 + c * normal) ** 3
        if v > 0.0 and math.log(u) < 0.5 * normal * normal + d - d * v + d * math.log(v):
            return d * v / shape


@numba.njit(cache=True, nogil=True)
def _roughen(seed: np.uint64, place: np.uint64, shape: float, first_row: int, last_row: int, rate: Array) -> None:
    width = rate.shape[1]
    key = frame_key(seed, place)
    for y in range(first_row, last_row):
        for x in range(width):
            if rate[y, x] > 0.0:
                rate[y, x] *= gamma_of(frame_key(key, np.uint64(y * width + x)), shape)
