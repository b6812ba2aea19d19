"""A galvo behind a DAC: its config, its limits, and paths between two commands that keep within these limits.

The paths lead to the first point of a waveform, to a stop, to where the beam is dumped and back to the centre:

    ramp   from a to b in time T: x(t) = a + (b - a) (1 - cos(pi t / T)) / 2
           largest speed |b - a| pi / (2 T), largest acceleration |b - a| pi^2 / (2 T^2)
    brake  constant deceleration from the mirror's present speed

DACs pass the steps of their input to the galvo unfiltered (docs/reference/devices/helios.md), and a full-range jump at
every point can overheat it. So no path contains a jump.
"""

import math
from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from drivers.interfaces import ScannerLimits
from drivers.registry import KindConfig
from drivers.units import PerSecond, PerSecondSquared

LOWEST_RATE_HZ = 1000.0
"""Lowest point rate. At lower ones the mirror follows every point as a visible step."""
MOST_WAVEFORM_POINTS = 1_000_000
"""Most points of a waveform, which stays in the host's memory, 9 bytes a point."""

Drive = Annotated[float, Field(ge=-1, le=1)]
"""Normalised drive: -1 to 1 is the DAC's range."""


class GalvoConfig(KindConfig):
    """Port and axis of a galvo, and its limits from the data sheet: the DAC itself would play anything."""

    port: str = "usb"
    """Port: "usb"; if several are attached, "usb:serial=ABC" for a LaserCube or "usb:path=1-2" for a Helios, which has
    no serial number; or "emulated:NAME"."""
    axis: Literal["x", "y"] = "x"
    """Output that drives the mirror."""
    max_velocity: Annotated[PerSecond, Field(gt=0, le=1e6)]
    """Largest change of the normalised drive per second; its full range is 2."""
    max_acceleration: Annotated[PerSecondSquared, Field(gt=0, le=1e10)]
    """Largest change of the drive's velocity per second."""
    max_step: Annotated[float, Field(gt=0, le=2)] = 0.1
    """Largest change of the drive from one point to the next."""
    rms_duty: Annotated[float, Field(gt=0, le=1)] = 0.5
    """Largest root-mean-square acceleration as a share of max_acceleration. It bounds the galvo's heat."""
    command_range: tuple[Drive, Drive] = (-1.0, 1.0)
    """Lowest and highest drive to which the mirror may be sent."""
    park: Drive = -1.0
    """Drive at which the beam hits the dump; within command_range."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        low, high = self.command_range
        if not low < high:
            raise ValueError(f"command_range {low:g} to {high:g} is empty; give the lower end first")
        if not low <= self.park <= high:
            raise ValueError(f"park {self.park:g} is outside command_range {low:g} to {high:g}; move it inside")
        return self

    def limits(self, highest_rate_hz: float) -> ScannerLimits:
        """The limits of the galvo on a DAC whose highest point rate is `highest_rate_hz`."""
        return ScannerLimits(
            command_range=self.command_range,
            velocity_per_s=self.max_velocity,
            acceleration_per_s2=self.max_acceleration,
            step=self.max_step,
            rms_duty=self.rms_duty,
            max_points=MOST_WAVEFORM_POINTS,
            point_rate_hz=(LOWEST_RATE_HZ, highest_rate_hz),
        )


_HEADROOM = 0.9
"""Share of a limit that ramps and brakes use."""


def ramp(start: float, end: float, limits: ScannerLimits, rate_hz: float) -> NDArray[np.float64]:
    """Commands from `start` (excluded) to `end` (included), at rest at both ends. float64 (n,); n = 0 if `start`
    equals `end`.
    """
    way = abs(end - start)
    if way == 0:
        return np.empty(0)
    velocity = min(limits.velocity_per_s, limits.step * rate_hz) * _HEADROOM
    # The root mean square of a cosine is its peak / sqrt 2: below a duty of 0.7 the duty is the stricter limit.
    acceleration = limits.acceleration_per_s2 * min(1.0, limits.rms_duty * math.sqrt(2)) * _HEADROOM
    least_s = max(way * math.pi / (2 * velocity), math.pi * math.sqrt(way / (2 * acceleration)))
    points = max(2, math.ceil(least_s * rate_hz))
    phase = np.arange(1, points + 1) / points
    commands: NDArray[np.float64] = start + (end - start) * (1 - np.cos(math.pi * phase)) / 2
    commands[-1] = end
    return commands


def brake(position: float, velocity_per_s: float, limits: ScannerLimits, rate_hz: float) -> NDArray[np.float64]:
    """Commands from `position` (excluded) to rest at a constant deceleration, inside the command range. float64 (n,).

    The deceleration exceeds its limit only if the command range leaves too little room. When a waveform within the
    limits is stopped, only rounding to whole points can cause that; the excess is then below a factor of 2.
    """
    step = velocity_per_s / rate_hz
    if step == 0:
        return np.empty(0)
    low, high = limits.command_range
    room = max((high - position) if step > 0 else (position - low), 0.0)
    # Steps s (1 - k / m), k = 1 ... m - 1: each is shorter than the one before by s / m; their sum is s (m - 1) / 2.
    decrements = math.ceil(abs(step) * rate_hz**2 / (limits.acceleration_per_s2 * _HEADROOM))
    decrements = int(min(decrements, 1 + 2 * room / abs(step)))
    steps = step * (1 - np.arange(1, decrements) / decrements)
    commands: NDArray[np.float64] = position + np.cumsum(steps)
    return np.clip(commands, low, high)
