"""What every effect is made from, and what an effect is."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sim_backend.light_sheet import LightSheet
from sim_backend.optics import Line, Optics, Sensor
from sim_backend.scene import SceneFile
from sim_backend.view import View

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Setting:
    """The rig in its scene. gain: detections per second of a pixel per W/(m^2 sr)."""

    view: View
    scene: SceneFile
    optics: Optics
    sensor: Sensor
    line: Line
    gain: float


class SteadyEffect(Protocol):
    """Light (or dark counts) that is there whatever the laser does."""

    def rate(self) -> Array:
        """Detections per second of every pixel, float64 (rows, width)."""
        ...


class LaserEffect(Protocol):
    """Light that comes from the laser's sheet."""

    def add(self, sheet: LightSheet, first_row: int, last_row: int, rate: Array) -> None:
        """Add detections per second and watt to `rate` (rows, width), rows first_row..last_row-1. Releases the GIL."""
        ...
