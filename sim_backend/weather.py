"""Rain and snow of a scene: how many drops and flakes of which size, how fast they fall, what they scatter.

    rain: {rate: 20 mm/h}
    snow: {rate: 2 mm/h, wind: 1 m/s}

Rain (Marshall and Palmer 1948): N(D) = 8000 exp(-L D) per m^3 and mm, L = 4.1 R^-0.21 /mm; twice the cross-section is
taken out (diffraction included), so sigma = 2 (pi/4) 8000 2/L^3 mm^2/m^3 = 3.65e-4 R^0.63 /m; fall speed 9.65 - 10.3
exp(-0.6 D) m/s (Atlas, Srivastava and Sekhon 1973).
Snow (Gunn and Marshall 1958), by melted diameter: N(D) = 3800 R^-0.87 exp(-L D), L = 2.55 R^-0.48 /mm; a flake has 4.5
times its melted cross-section and falls at 1.6 (D/10)^0.31 m/s (aggregates of dendrites, Langleben 1954). R in mm/h of
water, D in mm."""

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from drivers.units import MetresPerHour, MetresPerSecond
from sim_backend.medium import DROPLET_BACKSCATTER, PerSteradian, Section

Array = NDArray[np.float64]

M2_PER_MM2 = 1e-6
DIFFRACTION = 2.0
"""A particle much larger than the wavelength takes out twice what falls on it."""
FLAKE_AREA = 4.5
"""Cross-section of a flake over that of its melted drop: 4 to 5."""
LAMBERT_SPHERE_BACK = 2 / (3 * math.pi)
"""Phase function of a white diffuse sphere at 180 degrees in 1/sr: 8/3 of the mean 1/(4 pi)."""


@dataclass(frozen=True, slots=True)
class Sizes:
    """Particles per m^3 and mm of diameter: n0 exp(-slope D)."""

    n0_per_m3_mm: float
    slope_per_mm: float

    def density_per_m3(self, above_mm: float = 0.0) -> float:
        """Number of particles above a diameter."""
        return self.n0_per_m3_mm / self.slope_per_mm * math.exp(-self.slope_per_mm * above_mm)

    @property
    def area_per_m(self) -> float:
        """Cross-section of all spheres together, m^2 per m^3."""
        return M2_PER_MM2 * math.pi / 4 * 2 * self.n0_per_m3_mm / self.slope_per_mm**3


class Rain(Section):
    """Rain by the water that falls."""

    rate: Annotated[MetresPerHour, Field(gt=0, le=0.3, examples=["20 mm/h"])]
    backscatter: PerSteradian = DROPLET_BACKSCATTER
    """Phase function of a drop near 180 degrees."""
    wind: MetresPerSecond = 0.0
    """Drift towards +x."""

    @property
    def sizes(self) -> Sizes:
        """How many drops of which diameter."""
        return Sizes(8000.0, 4.1 * (1e3 * self.rate) ** -0.21)

    @property
    def extinction_per_m(self) -> float:
        """Extinction coefficient in 1/m."""
        return DIFFRACTION * self.sizes.area_per_m

    def back_m2_per_sr(self, diameter_mm: Array) -> Array:
        """What a drop sends back, W/sr per W/m^2."""
        return DIFFRACTION * _disc_m2(diameter_mm) * self.backscatter

    def fall_m_per_s(self, diameter_mm: Array) -> Array:
        """Fall speed."""
        result: Array = np.maximum(9.65 - 10.3 * np.exp(-0.6 * diameter_mm), 0.0)
        return result


class Snow(Section):
    """Snow by the water that falls."""

    rate: Annotated[MetresPerHour, Field(gt=0, le=0.05, examples=["2 mm/h"])]
    albedo: float = Field(default=0.9, ge=0, le=1, examples=["0.9"])
    wind: MetresPerSecond = 0.0
    """Drift towards +x."""

    @property
    def sizes(self) -> Sizes:
        """How many flakes of which melted diameter."""
        rate = 1e3 * self.rate
        return Sizes(3800.0 * rate**-0.87, 2.55 * rate**-0.48)

    @property
    def extinction_per_m(self) -> float:
        """Extinction coefficient in 1/m."""
        return DIFFRACTION * FLAKE_AREA * self.sizes.area_per_m

    def back_m2_per_sr(self, diameter_mm: Array) -> Array:
        """What a flake, a diffuse sphere, sends back, W/sr per W/m^2."""
        return FLAKE_AREA * _disc_m2(diameter_mm) * self.albedo * LAMBERT_SPHERE_BACK

    def fall_m_per_s(self, diameter_mm: Array) -> Array:
        """Fall speed."""
        result: Array = 1.6 * (diameter_mm / 10.0) ** 0.31
        return result


def _disc_m2(diameter_mm: Array) -> Array:
    return M2_PER_MM2 * math.pi / 4 * diameter_mm**2
