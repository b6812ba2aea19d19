"""From light to detections: lens, sensor, laser line and dark counts of the simulated rig.

Detections per second of a pixel that sees radiance L:  FF PDP T (pi/4)/N^2 pitch^2 L / (h c / wavelength).
"""

import math
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from drivers.units import CountsPerSecond, Metres, Radians

PLANCK_J_S = 6.62607015e-34
LIGHT_M_PER_S = 299792458.0
"""SI definitions of 2019."""
DAYLIGHT_W_PER_M3_LUX = 1.4e4
"""Spectral irradiance of daylight near 520 nm per lux, W/m^2 per metre of wavelength: 1.5 W/m^2/nm at 110 klux
(ASTM G173 global sunlight)."""

_TAIL_SHARE = 0.01
_TAIL_START, _TAIL_POWER = 10.0, math.log(5) / math.log(10)
"""1 % of the pixels lie above 10 times the median dark rate, a fifth of those above 100 times: a power law of exponent
log10(5), as in published dark count maps of arrays of this class."""
_BODY_WIDTH = 0.5
"""Standard deviation of ln(dark rate) of the ordinary pixels."""
_MAX_DARK_RATIO = 1e5


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Optics(_Part):
    """Lens and filter in front of the sensor."""

    f_number: float = Field(default=2.0, gt=0)
    transmission: float = Field(default=0.85, gt=0, le=1)
    filter_width: Annotated[Metres, Field(gt=0)] = 10e-9
    """Bandwidth of the filter around the laser line; it decides how much ambient light gets in."""


class Sensor(_Part):
    """The SPAD array's pixels. Defaults: 512 x 512 class at 520 nm."""

    pitch: Annotated[Metres, Field(gt=0)] = 16.38e-6
    fill_factor: float = Field(default=0.105, gt=0, le=1)
    detection_probability: float = Field(default=0.5, gt=0, le=1)
    dark_rate: Annotated[CountsPerSecond, Field(ge=0)] = 20.0
    """Median over the pixels; the distribution has a heavy tail of hot ones."""
    pixel_seed: int = Field(default=1, ge=0)
    """Which pixels are hot: a property of the one sensor, the same in every run."""


class Line(_Part):
    """The laser line as the scene and the camera see it."""

    wavelength: Annotated[Metres, Field(gt=0)] = 520e-9
    fan: Annotated[Radians, Field(gt=0, lt=math.pi)] = math.radians(50)
    """The power is spread evenly over this angle; it is taken to cover the picture."""
    sigma_px: float = Field(default=0.6, gt=0.05, le=20)
    """Gaussian width of the stripe in the picture, pixels: line width and blur of the lens together."""


def detections_per_radiance(optics: Optics, sensor: Sensor, line: Line) -> float:
    """Detections per second of one pixel per W/(m^2 sr)."""
    photon_j = PLANCK_J_S * LIGHT_M_PER_S / line.wavelength
    etendue = math.pi / 4 / optics.f_number**2 * sensor.pitch**2
    return sensor.fill_factor * sensor.detection_probability * optics.transmission * etendue / photon_j


def ambient_irradiance(illuminance_lux: float, optics: Optics) -> float:
    """Daylight within the filter's band, W/m^2."""
    return illuminance_lux * DAYLIGHT_W_PER_M3_LUX * optics.filter_width


def dark_rates(sensor: Sensor, size: tuple[int, int]) -> NDArray[np.float64]:
    """Dark counts per second of every pixel, float64 (rows, width), the same for the same sensor."""
    rng = np.random.default_rng(sensor.pixel_seed)
    ratio = np.exp(_BODY_WIDTH * rng.standard_normal(size))
    hot = rng.random(size) < _TAIL_SHARE
    tail = _TAIL_START * (1 - rng.random(size)) ** (-1 / _TAIL_POWER)
    return sensor.dark_rate * np.where(hot, np.minimum(tail, _MAX_DARK_RATIO), ratio)
