"""The inputs that every effect is made from, and the interfaces of the effects."""

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sim_backend.light.optics import Line, Optics, Sensor
from sim_backend.light.sheet import LightSheet
from sim_backend.light.view import CameraView
from sim_backend.scenes.scene import SceneFile

Array = NDArray[np.float64]
Words = NDArray[np.uint64]


@dataclass(frozen=True, slots=True, eq=False)
class Setting:
    """The rig in its scene. gain: detections per second of a pixel per W/(m^2 sr). devices: the effects
    that the rig model has, or that simulated devices reported when they were made, by name; the values say why."""

    view: CameraView
    scene: SceneFile
    optics: Optics
    sensor: Sensor
    line: Line
    gain: float
    devices: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class PlannedFor:
    """The largest values that a plan holds for: laser power in W, of all lines together; exposure of a column's frames
    together in s; and the number of these frames."""

    power_w: float
    exposure_s: float
    exposures: int


@dataclass(frozen=True, slots=True)
class FrameTimes:
    """Timing of a run's frames."""

    exposure_s: float
    period_s: float

    @property
    def gap_s(self) -> float:
        """Time from the end of an exposure to the start of the next."""
        return max(0.0, self.period_s - self.exposure_s)


class LaserEffect(Protocol):
    """Light that comes from the laser's sheet. If it changes with time, the effect has the attribute `hold_s`: the time
    in s for which it stays the same.
    """

    def add(self, sheet: LightSheet, first_row: int, last_row: int, rate: Array) -> None:
        """Add detections per second and watt to `rate` (rows, width), rows first_row..last_row-1. Releases the GIL.
        `sheet` has been traced on these rows.

        `rate` holds what earlier effects of the catalogue have added for this sheet; an effect may change that light.
        `rate` is float64, or float32 when frames are drawn; seven digits are more than photons can show.
        """
        ...


class BitEffect(Protocol):
    """A change that the sensor makes to the bits of its frames."""

    reads_before: bool
    """Whether `before` is read. If so, the simulated SPAD also draws the last frame of every gap."""

    def apply(self, seed: np.uint64, first_frame: int, words: Words, before: Words, times: FrameTimes) -> None:
        """Change whole frames first_frame, first_frame + 1, ... in place: `words` (frames, rows, words) uint64 in
        packbits order (`sim_backend.effects.sensor_bits.bit_of`). Pad bits stay 0.

        seed: of the run. before: (rows, words), the bits of frame first_frame - 1 as this effect received them, zeros
        if that frame was not drawn. times: exposure and period of the frames. The result for a frame depends only on
        the seed, `times`, the frame's number, its own bits and its predecessor's, not on how frames are grouped in
        blocks. Releases the GIL."""
        ...
