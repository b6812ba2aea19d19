"""Settings of hardware for ways of measuring depth without a scanned line: a conventional camera and a pulsed source.

The camera's defaults are those of a common industrial sensor with a global shutter, Sony IMX174, by EMVA 1288
measurements of Point Grey ("Sony Pregius global shutter CMOS imaging performance", 2015): quantum efficiency 77 % at
525 nm, read noise 6.83 electrons, full well 32691 electrons. With 12 bits it reads 128 pictures of 1216 rows per
second, thus 304 of 512 rows. The dark current at room temperature is about that of its slower sister IMX249, 1.5
electrons per second, and of no consequence. Its own pixels are 5.86 um wide; here they are as large as the SPAD's,
which favours it.

A pulsed source of 50 mW with one pulse per frame of 10 us has 0.5 uJ per pulse. Q-switched microchip lasers have pulses
of this energy and of some hundred picoseconds (11 uJ in 337 ps: Zayhowski and Dill, Optics Letters 19, 1427, 1994). The
jitter is that of the instrument response of LinoSPAD, below 100 ps with a laser of 50 ps (Burri, Homulle, Bruschini and
Charbon, Proc. SPIE 9899, 2016).
"""

from typing import Annotated

from pydantic import Field

from drivers.units import CountsPerSecond, Hertz, Metres, Seconds
from sim_backend.scenes.medium import Section


class ConventionalCamera(Section):
    """A camera that collects electrons, behind the lens and filter of the SPAD and with pixels of its pitch."""

    quantum_efficiency: float = Field(default=0.77, gt=0, le=1)
    """Electrons per photon on the pixel's light-sensitive area."""
    fill_factor: float = Field(default=1.0, gt=0, le=1)
    """Share of a pixel's area that collects light, microlenses included."""
    read_noise: float = Field(default=6.8, ge=0, le=1000)
    """Standard deviation of a read-out, in electrons."""
    full_well: float = Field(default=32700, ge=10, le=1e7)
    """Electrons at which a pixel is full. The converter's largest value lies above it by the black level."""
    dark_current: Annotated[CountsPerSecond, Field(ge=0)] = 1.5
    """Electrons per second in the dark."""
    bits: int = Field(default=12, ge=8, le=16)
    """Bits of the analogue-to-digital converter."""
    frame_rate: Annotated[Hertz, Field(gt=0)] = 300.0
    """Largest frame rate. An exposure lasts a frame or longer; the next one begins while it is read out."""
    broad_filter: Annotated[Metres, Field(gt=0)] = 300e-9
    """Bandwidth of the filter of stereo cameras, which look in ambient light without the narrow filter of the laser."""


class PulsedSource(Section):
    """A source of short pulses, and the timing of the SPAD array that waits for them."""

    pulse_width: Annotated[Seconds, Field(gt=0)] = 500e-12
    """Full width at half maximum of a pulse."""
    jitter: Annotated[Seconds, Field(ge=0)] = 100e-12
    """Full width at half maximum of the sensor's timing error."""
