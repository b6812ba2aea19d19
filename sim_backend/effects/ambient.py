"""Ambient light: on the surfaces, and scattered into the pixel by the medium in front of them.

A surface of albedo rho at distance |X| has the radiance rho/pi E exp(-sigma |X|), where E is the irradiance within the
filter's band and sigma the extinction (Lambert, Beer-Lambert). The medium adds L_inf (1 - exp(-sigma |X|))
(Koschmieder) with L_inf = (scattering share) E/pi: a thick layer of a medium that does not absorb looks like a white
surface in the same diffuse light.
"""

import math

import numpy as np

from sim_backend.effects.setting import Array, Setting
from sim_backend.light.optics import ambient_irradiance


def ambient(setting: Setting) -> Array:
    """Light from the surfaces, detections per second, float64 (rows, width); 0 where there is no surface."""
    scene, view = setting.scene, setting.view
    extinction_per_m = scene.diffuse_extinction_per_m
    transmission = np.exp(-extinction_per_m * _path_m(setting)) if extinction_per_m > 0 else 1.0
    radiance = view.albedo / math.pi * ambient_irradiance(scene.illuminance_lux, setting.optics) * transmission
    return np.where(view.surface > 0, setting.gain * radiance, 0.0)


def airlight(setting: Setting) -> Array:
    """Light from the medium, detections per second, float64 (rows, width)."""
    scene = setting.scene
    assert scene.medium is not None, "airlight is asked for by scenes with a medium only"
    thick = scene.medium.scattering_share * ambient_irradiance(scene.illuminance_lux, setting.optics) / math.pi
    return np.asarray(-setting.gain * thick * np.expm1(-scene.diffuse_extinction_per_m * _path_m(setting)))


def _path_m(setting: Setting) -> Array:
    """Distance of each pixel's surface from the camera, infinity if there is none."""
    view = setting.view
    with np.errstate(divide="ignore"):
        return np.asarray(np.sqrt(np.nan_to_num(view.u) ** 2 + np.nan_to_num(view.v) ** 2 + 1) / view.surface)
