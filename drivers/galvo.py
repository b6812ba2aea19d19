"""The config of a galvo behind a DAC: what the mirror can follow, where it may go, where the beam is dumped."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from drivers.interfaces import ScannerLimits
from drivers.registry import KindConfig
from drivers.units import PerSecond, PerSecondSquared

LOWEST_RATE_HZ = 1000.0
"""Slower than that a mirror shows every point as a step."""
MOST_WAVEFORM_POINTS = 1_000_000
"""A waveform stays in the host's memory, 9 bytes a point."""

Drive = Annotated[float, Field(ge=-1, le=1)]
"""Normalised: -1 to 1 is the DAC's range."""


class GalvoConfig(KindConfig):
    """Limits of the galvo; they are in its data sheet. The DAC itself would follow anything."""

    port: str = "usb"
    """usb; where several are attached usb:serial=ABC, or usb:path=1-2 for a Helios, which has none; emulated:NAME."""
    axis: Literal["x", "y"] = "x"
    max_velocity: Annotated[PerSecond, Field(gt=0, le=1e6)]
    """Of the normalised drive: the full range is 2."""
    max_acceleration: Annotated[PerSecondSquared, Field(gt=0, le=1e10)]
    max_step: Annotated[float, Field(gt=0, le=2)] = 0.1
    """Largest change of the drive from one point to the next."""
    rms_duty: Annotated[float, Field(gt=0, le=1)] = 0.5
    """Largest root-mean-square acceleration as a share of max_acceleration: the galvo's heat."""
    command_range: tuple[Drive, Drive] = (-1.0, 1.0)
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
        """The limits, on a DAC that runs up to that rate."""
        return ScannerLimits(
            command_range=self.command_range,
            velocity_per_s=self.max_velocity,
            acceleration_per_s2=self.max_acceleration,
            step=self.max_step,
            rms_duty=self.rms_duty,
            max_points=MOST_WAVEFORM_POINTS,
            point_rate_hz=(LOWEST_RATE_HZ, highest_rate_hz),
        )
