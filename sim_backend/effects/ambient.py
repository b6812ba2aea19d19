"""Ambient light on the surfaces: radiance rho/pi E exp(-sigma |X|), E the irradiance within the filter's band (Lambert,
Beer-Lambert)."""

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
        view = s.view
        with np.errstate(divide="ignore"):
            path_m = np.sqrt(np.nan_to_num(view.u) ** 2 + np.nan_to_num(view.v) ** 2 + 1) / view.surface
        extinction_per_m = s.scene.diffuse_extinction_per_m
        transmission = np.exp(-extinction_per_m * path_m) if extinction_per_m > 0 else 1.0
        radiance = view.albedo / math.pi * ambient_irradiance(s.scene.illuminance_lux, s.optics) * transmission
        result: Array = np.where(view.surface > 0, s.gain * radiance, 0.0)
        return result
