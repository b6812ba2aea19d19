"""Lens, sensor and laser line of the simulated rig, and the number of detections that light causes.

Detections per second of a pixel that sees radiance L:  FF PDP T (pi/4)/N^2 pitch^2 L / (h c / wavelength), with fill
factor FF, detection probability PDP, transmission T and f-number N.
"""

import math
from typing import Annotated, Self

from pydantic import Field, model_validator

from drivers.units import CountsPerSecond, Metres, Ppm, Radians, Seconds
from sim_backend.scenes.medium import Section

PLANCK_J_S = 6.62607015e-34
LIGHT_M_PER_S = 299792458.0
"""Exact by definition of the SI."""
DAYLIGHT_W_PER_M3_LUX = 1.4e4
"""Spectral irradiance of daylight near 520 nm per lux, W/m^2 per metre of wavelength: 1.5 W/m^2/nm at 110 klux
(ASTM G173 global sunlight)."""


class Optics(Section):
    """Lens and filter in front of the sensor."""

    f_number: float = Field(default=2.0, gt=0)
    """f-number of the lens."""
    transmission: float = Field(default=0.85, gt=0, le=1)
    """Transmission of lens and filter."""
    filter_width: Annotated[Metres, Field(gt=0)] = 10e-9
    """Bandwidth of the filter around the laser line; it decides how much ambient light gets in."""
    focus: Annotated[Metres, Field(gt=0)] | None = None
    """Depth at which the picture is sharp; leave out for a lens that is sharp at every depth."""


class Sensor(Section):
    """The SPAD array's pixels. The defaults describe the 512 x 512 class at 520 nm."""

    pitch: Annotated[Metres, Field(gt=0)] = 16.38e-6
    """Distance between neighbouring pixels."""
    fill_factor: float = Field(default=0.105, gt=0, le=1)
    """Share of a pixel's area that detects light."""
    detection_probability: float = Field(default=0.5, gt=0, le=1)
    """Probability that a photon on this area is detected."""
    dark_rate: Annotated[CountsPerSecond, Field(ge=0)] = 20.0
    """Median dark rate of the pixels; the distribution has a heavy tail of hot ones."""
    pixel_seed: int = Field(default=1, ge=0)
    """Seed of the hot and dead pixels: they belong to the one sensor and are the same in every run."""
    dead_share: Annotated[Ppm, Field(ge=0, le=1)] = 0.0
    """Share of pixels that read 0 in every frame."""
    hot_share: Annotated[Ppm, Field(ge=0, le=1)] = 0.0
    """Share of pixels that read 1 in every frame, beyond those in the tail of `dark_rate`."""
    crosstalk: Annotated[Ppm, Field(ge=0, le=0.5)] = 0.0
    """Number of neighbours that a detection sets off, on average; 0.1 to 0.2 % in arrays of this class."""
    afterpulsing: Annotated[Ppm, Field(ge=0, le=0.5)] = 0.0
    """Mean number of afterpulses of a detection, at any later time; 0.1 to 1 %."""
    trap_lifetime: Annotated[Seconds, Field(gt=0, le=1)] = 100e-9
    """Mean time until an afterpulse."""
    dead_time: Annotated[Seconds, Field(ge=0, le=1e-6)] = 0.0
    """Time for which a pixel is blind after a detection."""
    bit_error_rate: Annotated[Ppm, Field(ge=0, le=0.5)] = 0.0
    """Probability that a pixel of a frame is read wrongly."""

    @model_validator(mode="after")
    def _one_defect_a_pixel(self) -> Self:
        if self.dead_share + self.hot_share > 1:
            shares = f"dead_share {self.dead_share:g} and hot_share {self.hot_share:g}"
            raise ValueError(f"{shares} are more than all pixels")
        return self


class Line(Section):
    """The laser line as the scene and the camera see it."""

    wavelength: Annotated[Metres, Field(gt=0)] = 520e-9
    """Wavelength of the laser."""
    fan: Annotated[Radians, Field(gt=0, lt=math.pi)] = math.radians(50)
    """Angle over which the power is spread evenly; it is assumed to cover the picture."""
    sigma_px: float = Field(default=0.6, gt=0.05, le=20)
    """Standard deviation of the stripe's Gaussian profile, in pixels: line width and blur of the lens together."""
    spread: Annotated[Radians, Field(ge=0, lt=0.1)] = 0.0
    """Full angle (1/e^2) by which the sheet gets thicker on its way, on top of `sigma_px`."""
    thickness: Annotated[Metres, Field(gt=0, le=0.1)] = 2e-3
    """Full thickness (1/e^2) of the sheet where it leaves the mirror: it decides which drops and flakes are in the
    sheet."""
    speckle: bool = False
    """Whether the laser is coherent enough for its light to come back grainy."""


def detections_per_radiance(optics: Optics, sensor: Sensor, line: Line) -> float:
    """Detections per second of one pixel per W/(m^2 sr)."""
    photon_j = PLANCK_J_S * LIGHT_M_PER_S / line.wavelength
    etendue = math.pi / 4 / optics.f_number**2 * sensor.pitch**2
    return sensor.fill_factor * sensor.detection_probability * optics.transmission * etendue / photon_j


def ambient_irradiance(illuminance_lux: float, optics: Optics) -> float:
    """Daylight within the filter's band, W/m^2."""
    return illuminance_lux * DAYLIGHT_W_PER_M3_LUX * optics.filter_width
