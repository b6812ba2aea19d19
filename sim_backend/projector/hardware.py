"""Settings of the hardware that only other ways of measuring depth need: a conventional camera and a pulsed source."""

from typing import Annotated

from pydantic import Field

from drivers.units import CountsPerSecond, Hertz, Metres, Seconds
from sim_backend.scenes.medium import Section


class ConventionalCamera(Section):
    """A camera that collects electrons, behind the lens and filter of the SPAD and with pixels of its pitch."""

    quantum_efficiency: float = Field(default=0.76, gt=0, le=1)
    """Electrons per photon on the pixel's light-sensitive area."""
    fill_factor: float = Field(default=1.0, gt=0, le=1)
    """Share of a pixel's area that detects light."""
    read_noise: float = Field(default=7.0, ge=0, le=1000)
    """Standard deviation of a read-out, in electrons."""
    full_well: float = Field(default=32500, ge=10, le=1e7)
    """Electrons at which a pixel is full, and at which the converter reads its largest value."""
    dark_current: Annotated[CountsPerSecond, Field(ge=0)] = 5.0
    """Electrons per second in the dark."""
    bits: int = Field(default=12, ge=8, le=16)
    """Bits of the analogue-to-digital converter."""
    frame_rate: Annotated[Hertz, Field(gt=0)] = 380.0
    """Largest frame rate."""
    broad_filter: Annotated[Metres, Field(gt=0)] = 300e-9
    """Bandwidth of the filter of stereo cameras, which look in ambient light without the narrow filter of the laser."""


class PulsedSource(Section):
    """A source of short pulses, and the timing of the SPAD array that waits for them."""

    pulse_width: Annotated[Seconds, Field(gt=0)] = 100e-12
    """Full width at half maximum of a pulse."""
    jitter: Annotated[Seconds, Field(ge=0)] = 100e-12
    """Full width at half maximum of the sensor's timing error."""
