"""Ambient light: on the surfaces, and scattered into the pixel by the medium in front of them.

Surfaces have the radiance rho/pi E exp(-sigma |X|), E the irradiance within the filter's band (Lambert, Beer-Lambert).
The medium has L_inf (1 - exp(-sigma |X|)) (Koschmieder) with L_inf = (scattering share) E/pi: a thick layer of a medium
that does not absorb looks like a white surface in the same diffuse light.
"""

import math

import numpy as np

from sim_backend.effects.setting import Array, Setting
from sim_backend.light.optics import ambient_irradiance


class Ambient:
    """Steady light from the surfaces."""

    def __init__(self, setting: Setting) -> None:
        self._setting = setting

    def rate(self) -> Array:
        """Detections per second, float64 (rows, width); 0 where there is no surface."""
        s = self._setting
        extinction_per_m = s.scene.diffuse_extinction_per_m
        transmission = np.exp(-extinction_per_m * _path_m(s)) if extinction_per_m > 0 else 1.0
        radiance = s.view.albedo / math.pi * ambient_irradiance(s.scene.illuminance_lux, s.optics) * transmission
        result: Array = np.where(s.view.surface > 0, s.gain * radiance, 0.0)
        return result


class Airlight:
    """Steady light from the medium."""

    def __init__(self, setting: Setting) -> None:
        self._setting = setting

    def rate(self) -> Array:
        """Detections per second, float64 (rows, width)."""
        s = self._setting
        medium = s.scene.medium
        assert medium is not None, "airlight is asked for by scenes with a medium only"
        thick = medium.scattering_share * ambient_irradiance(s.scene.illuminance_lux, s.optics) / math.pi
        result: Array = -s.gain * thick * np.expm1(-s.scene.diffuse_extinction_per_m * _path_m(s))
        return result


def _path_m(setting: Setting) -> Array:
    """Distance of each pixel's surface from the camera, infinity where there is none."""
    view = setting.view
    with np.errstate(divide="ignore"):
        path_m: Array = np.sqrt(np.nan_to_num(view.u) ** 2 + np.nan_to_num(view.v) ** 2 + 1) / view.surface
    return path_m
