"""Dark counts: detections without light, a rate per pixel whose distribution has a long tail of hot pixels.

    ordinary pixels: ln(rate / median) normal with sd 0.12
    hot pixels:      P(rate > r median) = 0.01 (r / 10)^-0.7 from r = 2 to 1e5, the largest ratio

The figures are from a 512 x 512 binary SPAD (50 x 50 pixels, 7650 frames of 10 us; public data of LabPresse/SP2T.jl).
Its shares of pixels above 2, 3, 5, 10, 30 and 100 times the median are 3.4, 2.2, 1.4, 1.0, 0.5 and 0.2 %; the formula
gives 3.1, 2.3, 1.6, 1.0, 0.5 and 0.2 %. Neither there nor here do hot pixels form clusters. The median is
`world.sensor.dark_rate`.
"""

import math

import numpy as np

from sim_backend.effects.setting import Array, Setting
from sim_backend.light.optics import Sensor

_BODY_SD = 0.12
"""Standard deviation of ln(rate) of the ordinary pixels: as measured, less the part due to counting statistics."""
_TAIL_SHARE, _TAIL_AT = 0.01, 10.0
_TAIL_START = 2.0
_TAIL_POWER = math.log10(5)
"""Power of the tail: a fifth of the pixels above 10 times the median are above 100 times."""
_MAX_RATIO = 1e5


def dark_counts(setting: Setting) -> Array:
    """Detections per second that each pixel makes without light, float64 (rows, width)."""
    return dark_rates(setting.sensor, setting.view.u.shape)


def dark_rates(sensor: Sensor, size: tuple[int, ...]) -> Array:
    """Dark counts per second of every pixel, float64 of shape `size` (rows, width). They depend on the sensor's
    settings alone."""
    rng = np.random.default_rng(sensor.pixel_seed)
    ordinary = np.exp(_BODY_SD * rng.standard_normal(size))
    hot = rng.random(size) < _TAIL_SHARE * (_TAIL_START / _TAIL_AT) ** -_TAIL_POWER
    tail = _TAIL_START * (1 - rng.random(size)) ** (-1 / _TAIL_POWER)
    return sensor.dark_rate * np.where(hot, np.minimum(tail, _MAX_RATIO), ordinary)
