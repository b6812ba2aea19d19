"""Rain: drops that cross the sheet flash up, stay put for a column's exposures, and have fallen on by the next sweep.

Called for by `rain: {rate: 20 mm/h}`; sizes, extinction and fall speed in `sim_backend.scenes.medium`, the picture of a
drop and its cost in `sim_backend.effects.particles`. There are density x thickness x area of them in the sheet (at 20
mm/h and 2 mm: 7 per m^2), bright as 1/z^3; what rain takes out of the beam, next to nothing below 20 m, is in the
extinction of stripe and haze."""

import numpy as np

from sim_backend.effects.particles import HOLD_S, ParticleLight
from sim_backend.effects.setting import Array, Setting
from sim_backend.light.sheet import LightSheet

_STREAM = 1
"""Stream that keeps its random numbers apart from the snow's."""


class RainDrops:
    """Adds the drops in a sheet."""

    hold_s = HOLD_S

    def __init__(self, setting: Setting) -> None:
        rain = setting.scene.rain
        assert rain is not None, "called for by scenes with rain only"
        self.light = ParticleLight(setting, rain, np.random.default_rng([setting.scene.seed, _STREAM]))

    def add(self, sheet: LightSheet, first_row: int, last_row: int, rate: Array) -> None:
        """Add detections per second and watt of laser power."""
        self.light.add(sheet, first_row, last_row, rate)
