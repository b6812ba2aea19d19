"""The flux of every pixel: detected photons per exposure for one mirror command, from the effects a scene calls for.

    lambda = exposure (steady + share power sheet),     p = 1 - exp(-lambda)

share is the part of the exposure during which the gate let light out. `steady` is made once, `sheet` once per command;
about 3 ms for 512 x 512 pixels in fog on one core.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sim_backend.effects.catalogue import CATALOGUE, Entry
from sim_backend.effects.setting import LaserEffect, Setting, SteadyEffect
from sim_backend.light_sheet import LightSheet

Array = NDArray[np.float64]


class FluxModel:
    """Sums the effects of one rig in one scene. Reads only; any thread may use it."""

    def __init__(self, setting: Setting, entries: Sequence[Entry] | None = None) -> None:
        """entries: the effects to use; by default those that the scene calls for."""
        if entries is None:
            entries = [entry for entry in CATALOGUE if entry.called(setting.scene, setting.sensor)[0]]
        self.setting = setting
        self.names = tuple(entry.name for entry in entries)
        self._laser: list[LaserEffect] = [entry.load()(setting) for entry in entries if entry.from_laser]
        steady: list[SteadyEffect] = [entry.load()(setting) for entry in entries if not entry.from_laser]
        self.steady_per_s: Array = np.zeros(setting.view.u.shape)
        """Detections per second without the laser, float64 (rows, width)."""
        for effect in steady:
            self.steady_per_s += effect.rate()

    def add_sheet(self, sheet: LightSheet, first_row: int, last_row: int, rate: Array) -> None:
        """Add detections per second and watt from the sheet to `rate`, rows first_row..last_row-1. Releases the GIL."""
        for effect in self._laser:
            effect.add(sheet, first_row, last_row, rate)

    def flux(self, plane: Array, exposure_s: float, power_w: float, share: float = 1.0) -> Array:
        """Photons per exposure, float64 (rows, width), with the mirror at the plane (4,) = nx, ny, nz, d."""
        view = self.setting.view
        sheet = view.sheet(plane)
        rate = np.zeros_like(self.steady_per_s)
        self.add_sheet(sheet, 0, view.rows, rate)
        return exposure_s * (self.steady_per_s + share * power_w * rate)
