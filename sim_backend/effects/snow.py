"""Snow: flakes that cross the sheet flash up, and have drifted on by the next sweep.

Called for by `snow: {rate: 2 mm/h}`; sizes, extinction and fall speed in `sim_backend.scenes.medium`, the picture of a
flake and its cost in `sim_backend.effects.particles`. A flake is taken as a diffuse sphere of albedo 0.9 and 4.5 times
its melted cross-section: seen from the side it is lit from, it sends 8/3 of the mean of all directions back, at equal
melted diameter eight times as much light as a drop."""

import numpy as np

from sim_backend.effects.particles import HOLD_S, ParticleLight
from sim_backend.effects.setting import Array, Setting
from sim_backend.light.sheet import LightSheet

_STREAM = 2
"""Stream that keeps its random numbers apart from the rain's."""


class SnowFlakes:
    """Adds the flakes in a sheet."""

    hold_s = HOLD_S

    def __init__(self, setting: Setting) -> None:
        snow = setting.scene.snow
        assert snow is not None, "called for by scenes with snow only"
        self.light = ParticleLight(setting, snow, np.random.default_rng([setting.scene.seed, _STREAM]))

    def add(self, sheet: LightSheet, first_row: int, last_row: int, rate: Array) -> None:
        """Add detections per second and watt of laser power."""
        self.light.add(sheet, first_row, last_row, rate)
