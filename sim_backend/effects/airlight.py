"""Airlight: ambient light scattered into the pixel by the medium, L_inf (1 - exp(-sigma |X|)) (Koschmieder).

L_inf = (scattering share) E/pi: a thick layer of a medium that does not absorb looks like a white surface in the same
diffuse light."""

import math

import numpy as np

from sim_backend.effects.setting import Array, Setting
from sim_backend.light.optics import ambient_irradiance


class Airlight:
    """Steady light from the medium."""

    def __init__(self, setting: Setting) -> None:
        self._setting = setting

    def rate(self) -> Array:
        """Detections per second, float64 (rows, width)."""
        s = self._setting
        medium = s.scene.medium
        assert medium is not None, "airlight is asked for by scenes with a medium only"
        view = s.view
        with np.errstate(divide="ignore"):
            path_m = np.sqrt(np.nan_to_num(view.u) ** 2 + np.nan_to_num(view.v) ** 2 + 1) / view.surface
        thick = medium.scattering_share * ambient_irradiance(s.scene.illuminance_lux, s.optics) / math.pi
        result: Array = -s.gain * thick * np.expm1(-s.scene.diffuse_extinction_per_m * path_m)
        return result
