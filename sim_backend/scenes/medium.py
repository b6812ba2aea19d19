"""The medium and the weather of a scene: fog or smoke, rain or snow, their density and how they scatter light.

Henyey and Greenstein (1941): p(theta) = (1 - g^2) / (4 pi (1 + g^2 - 2 g cos theta)^1.5), in 1/sr, of integral 1 over
all directions and mean cosine g; at 180 degrees (1 - g) / (4 pi (1 + g)^2).

In the following D is the diameter in mm, R the rate in mm/h of water, and N the number of particles per m^3 and mm.

Rain (Marshall and Palmer 1948): N(D) = 8000 exp(-L D), L = 4.1 R^-0.21 /mm. A drop's extinction is twice its
cross-section (diffraction included), so sigma = 2 (pi/4) 8000 2/L^3 mm^2/m^3 = 3.65e-4 R^0.63 /m. Fall speed:
9.65 - 10.3 exp(-0.6 D) m/s (Atlas, Srivastava and Sekhon 1973).

Snow (Gunn and Marshall 1958), by melted diameter: N(D) = 3800 R^-0.87 exp(-L D), L = 2.55 R^-0.48 /mm. A flake has 4.5
times its melted cross-section and falls at 1.6 (D/10)^0.31 m/s (aggregates of dendrites, Langleben 1954).
"""

import math
import re
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, PlainSerializer, PlainValidator, model_validator

from drivers.units import Metres, MetresPerHour, MetresPerSecond, PerMetre

KOSCHMIEDER = 3.912
"""-ln(0.02): extinction times visibility at 2 % contrast (Koschmieder's law)."""
DROPLET_BACKSCATTER = 0.05
"""Phase function of water droplets at 180 degrees, in 1/sr: one over a lidar ratio of 18 to 20 sr."""
DROPLET_G = 0.85
"""Mean cosine of scattering of fog droplets in visible light."""
SMOKE_BACKSCATTER, SMOKE_SCATTERING_SHARE = 0.027, 0.96
"""Fresh wood smoke at 532 nm: lidar ratio 38 sr, single-scattering albedo 0.96; 1/(38 * 0.96) per sr (De Rosa et al.,
Remote Sensing 14, 4984, 2022). Soot of open flames mostly absorbs: scattering_share 0.2 to 0.3."""
SMOKE_G = 0.65
"""Mean cosine of particles of 0.15 um effective radius, as in that smoke."""
BACK_LOBE_G = -0.7
"""g of the lobe that stands for a medium's backscatter where only that is given: droplets throw light back within some
30 degrees."""
FORWARD_ANGLE = math.radians(1.5)
"""Standard deviation of the angle, per axis, by which a droplet's diffraction turns light. Half of the light that a
droplet removes from the beam is only turned by 1 to 2 degrees."""

_PER_STERADIAN = re.compile(r"\s*(\d+\.?\d*(?:[eE][+-]?\d+)?|\.\d+)\s*/sr\s*", re.ASCII)


def _parse_per_steradian(text: object) -> float:
    match = _PER_STERADIAN.fullmatch(text) if isinstance(text, str) else None
    if match is None:
        raise ValueError(f'{text!r} is no phase function value; write a number per steradian such as "0.05 /sr"')
    return float(match[1])


PerSteradian = Annotated[
    float,
    PlainValidator(_parse_per_steradian),
    PlainSerializer(lambda value: f"{value!r} /sr", return_type=str, when_used="json"),
]
MeanCosine = Annotated[float, Field(gt=-1, lt=1)]


def henyey_greenstein(cosine: Any, g: float) -> Any:
    """Phase function in 1/sr for the cosine of the scattering angle (-1 = back), a number or an array."""
    ahead, sharp = np.copysign(cosine, cosine * g), abs(g)  # 1 + g^2 - 2 g cos, without cancellation at the peak
    return (1 - g) * (1 + g) / (4 * math.pi * np.power((1 - sharp) ** 2 + 2 * sharp * (1 - ahead), 1.5))


class Section(BaseModel):
    """Part of a config or a scene file. Unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)


class Fog(Section):
    """Fog, given by its visibility (2 % contrast)."""

    visibility: Annotated[Metres, Field(gt=0, examples=["30 m"])]
    """Distance at which contrast falls to 2 %: the extinction is 3.912 / visibility."""


class Smoke(Section):
    """Smoke, given by its extinction or its visibility (2 % contrast)."""

    extinction: Annotated[PerMetre, Field(gt=0)] | None = Field(default=None, examples=["0.5 /m"])
    """Extinction of wood smoke. Exactly one of this and `visibility` is given."""
    visibility: Annotated[Metres, Field(gt=0)] | None = Field(default=None, examples=["30 m"])
    """Distance at which contrast falls to 2 %."""

    @model_validator(mode="after")
    def _one_density(self) -> "Smoke":
        if (self.extinction is None) == (self.visibility is None):
            raise ValueError("give exactly one of 'extinction' and 'visibility', e.g. smoke: {extinction: 0.5 /m}")
        return self


class Phase(Section):
    """A Henyey-Greenstein phase function of mean cosine g, or the sum of several as (weight, g)."""

    g: MeanCosine | None = Field(default=None, examples=["0.85"])
    """Mean cosine of a Henyey-Greenstein phase function: `phase: {g: 0.85}`. Or write `phase: isotropic`."""
    terms: tuple[tuple[Annotated[float, Field(gt=0)], MeanCosine], ...] | None = Field(
        default=None, examples=["[[0.9, 0.9], [0.1, -0.5]]"]
    )
    """(weight, g) of several Henyey-Greenstein terms: `[[0.9, 0.9], [0.1, -0.5]]`. Weights above 0 add up to 1, each g
    is between -1 and 1."""

    @model_validator(mode="after")
    def _whole(self) -> "Phase":
        if (self.g is None) == (self.terms is None):
            raise ValueError("give exactly one of 'g' and 'terms', e.g. phase: {g: 0.85}")
        if self.terms is not None and not math.isclose(sum(w for w, _ in self.terms), 1.0, rel_tol=1e-6):
            raise ValueError(
                f"the weights of the phase function's terms sum to {sum(w for w, _ in self.terms):g}, not 1"
            )
        return self


class Medium(Section):
    """A homogeneous scattering medium. Exactly one of `fog`, `smoke` and `extinction` says how dense it is."""

    fog: Fog | None = Field(default=None, examples=["{visibility: 30 m}"])
    smoke: Smoke | None = Field(default=None, examples=["{extinction: 0.5 /m}"])
    extinction: Annotated[PerMetre, Field(gt=0)] | None = Field(default=None, examples=["0.1 /m"])
    """Extinction of the medium. Exactly one of `fog`, `smoke` and `extinction` is given."""
    backscatter: PerSteradian = DROPLET_BACKSCATTER
    """Phase function near 180 degrees, if no `phase` is given. Water droplets 0.05, smoke 0.027, isotropic 0.0796."""
    phase: Literal["isotropic"] | Phase | None = Field(default=None, examples=["{g: 0.85}"])
    """The phase function at all angles, in place of `backscatter`."""
    scattering_share: float = Field(default=1.0, ge=0, le=1, examples=["0.96"])
    """Scattering over extinction; droplets hardly absorb visible light."""
    forward_share: float = Field(default=0.0, ge=0, le=0.5, examples=["0.5"])
    """Part of the scattering that is diffraction, which turns light by `FORWARD_ANGLE` only: it blurs the stripe
    instead of dimming it. Droplets 0.5; with 0 all scattered light is lost to the stripe."""
    multiple_scattering: bool = True
    """Whether light scattered more than once is simulated, unless it is negligible."""

    @model_validator(mode="before")
    @classmethod
    def _smoke_is_no_fog(cls, content: Any) -> Any:
        if not isinstance(content, dict) or content.get("smoke") is None:
            return content
        defaults = {"backscatter": f"{SMOKE_BACKSCATTER} /sr", "scattering_share": SMOKE_SCATTERING_SHARE}
        if "phase" in content:
            del defaults["backscatter"]
        return {**defaults, **content}

    @model_validator(mode="after")
    def _said_once(self) -> "Medium":
        if sum(part is not None for part in (self.fog, self.smoke, self.extinction)) != 1:
            raise ValueError("give exactly one of 'fog', 'smoke' and 'extinction', e.g. fog: {visibility: 30 m}")
        if self.phase is not None and "backscatter" in self.model_fields_set:
            raise ValueError("'backscatter' and 'phase' say the same thing; give one of them")
        return self

    @property
    def extinction_per_m(self) -> float:
        """Extinction coefficient in 1/m. Light deflected by any angle, however small, counts as lost."""
        seen = self.fog or self.smoke
        if seen is not None and seen.visibility is not None:
            return KOSCHMIEDER / seen.visibility
        found = self.extinction if self.smoke is None else self.smoke.extinction
        assert found is not None, "the validators let exactly one be there"
        return found

    @property
    def scattering_per_m(self) -> float:
        """Scattering coefficient in 1/m."""
        return self.scattering_share * self.extinction_per_m

    @property
    def forward_per_m(self) -> float:
        """The part of the scattering coefficient that deflects light only a little, in 1/m."""
        return self.forward_share * self.scattering_per_m

    @property
    def phase_terms(self) -> tuple[tuple[float, float], ...] | None:
        """(weight, g) of the Henyey-Greenstein terms; None if only `backscatter` is given."""
        if self.phase is None:
            return None
        if isinstance(self.phase, str):
            return ((1.0, 0.0),)
        return ((1.0, self.phase.g),) if self.phase.g is not None else self.phase.terms

    @property
    def back_per_sr(self) -> float:
        """Phase function at 180 degrees, in 1/sr."""
        if self.phase_terms is None:
            return self.backscatter
        return float(sum(weight * henyey_greenstein(-1.0, g) for weight, g in self.phase_terms))

    @property
    def mean_cosine(self) -> float:
        """Mean cosine of the scattering angle: 0 isotropic, near 1 forward-peaked. If only `backscatter` is given, that
        of droplets or smoke."""
        if self.phase_terms is not None:
            return sum(weight * g for weight, g in self.phase_terms)
        return DROPLET_G if self.smoke is None else SMOKE_G

    @property
    def lobes(self) -> tuple[tuple[float, float], ...]:
        """(weight, g) of Henyey-Greenstein terms for scattering without the forward share, which is taken from the most
        forward term. If only `backscatter` is given, two terms that have about this value and the mean cosine."""
        rest, terms = 1 - self.forward_share, self.phase_terms
        if terms is None:
            g = (self.mean_cosine - self.forward_share) / rest
            lacks = self.backscatter / rest - float(henyey_greenstein(-1.0, g))
            back = min(max(lacks / float(henyey_greenstein(-1.0, BACK_LOBE_G)), 0.0), 0.08)
            return (1 - back, (g - back * BACK_LOBE_G) / (1 - back)), (back, BACK_LOBE_G)
        *others, (weight, g) = sorted(terms, key=lambda term: term[1])
        kept = [*others, (max(weight - self.forward_share, 0.0), g)]
        total = sum(weight for weight, _ in kept)
        return tuple((weight / total, g) for weight, g in kept) if total > 0 else terms


Array = NDArray[np.float64]

M2_PER_MM2 = 1e-6
DIFFRACTION = 2.0
"""A particle much larger than the wavelength removes twice the light that falls on it."""
FLAKE_AREA = 4.5
"""Cross-section of a flake over that of its melted drop: 4 to 5."""
LAMBERT_SPHERE_BACK = 2 / (3 * math.pi)
"""Phase function of a white diffuse sphere at 180 degrees in 1/sr: 8/3 of the mean 1/(4 pi)."""


@dataclass(frozen=True, slots=True)
class Sizes:
    """Particles per m^3 and mm of the diameter D in mm: n0 exp(-slope D)."""

    n0_per_m3_mm: float
    slope_per_mm: float

    def density_per_m3(self, above_mm: float = 0.0) -> float:
        """Number of particles per m^3 above a diameter."""
        return self.n0_per_m3_mm / self.slope_per_mm * math.exp(-self.slope_per_mm * above_mm)

    @property
    def area_per_m(self) -> float:
        """Cross-section of all spheres together, m^2 per m^3."""
        return M2_PER_MM2 * math.pi / 4 * 2 * self.n0_per_m3_mm / self.slope_per_mm**3


class Rain(Section):
    """Rain, given by the amount of water that falls."""

    rate: Annotated[MetresPerHour, Field(gt=0, le=0.3, examples=["20 mm/h"])]
    """Rain rate; drop sizes by Marshall and Palmer."""
    backscatter: PerSteradian = DROPLET_BACKSCATTER
    """Phase function of a drop near 180 degrees."""
    wind: MetresPerSecond = 0.0
    """Speed of drift towards +x (right)."""

    @property
    def sizes(self) -> Sizes:
        """The number of drops by diameter."""
        return Sizes(8000.0, 4.1 * (1e3 * self.rate) ** -0.21)

    @property
    def extinction_per_m(self) -> float:
        """Extinction coefficient in 1/m."""
        return DIFFRACTION * self.sizes.area_per_m

    def back_m2_per_sr(self, diameter_mm: Array) -> Array:
        """Light that a drop sends back, in W/sr per W/m^2."""
        return DIFFRACTION * _disc_m2(diameter_mm) * self.backscatter

    def fall_m_per_s(self, diameter_mm: Array) -> Array:
        """Fall speed of drops by diameter."""
        return np.asarray(np.maximum(9.65 - 10.3 * np.exp(-0.6 * diameter_mm), 0.0))


class Snow(Section):
    """Snow, given by the amount of water that falls."""

    rate: Annotated[MetresPerHour, Field(gt=0, le=0.05, examples=["2 mm/h"])]
    """Rate as melted water; flake sizes by Gunn and Marshall."""
    albedo: float = Field(default=0.9, ge=0, le=1, examples=["0.9"])
    """Albedo of a flake."""
    wind: MetresPerSecond = 0.0
    """Speed of drift towards +x (right)."""

    @property
    def sizes(self) -> Sizes:
        """The number of flakes by melted diameter."""
        rate = 1e3 * self.rate
        return Sizes(3800.0 * rate**-0.87, 2.55 * rate**-0.48)

    @property
    def extinction_per_m(self) -> float:
        """Extinction coefficient in 1/m."""
        return DIFFRACTION * FLAKE_AREA * self.sizes.area_per_m

    def back_m2_per_sr(self, diameter_mm: Array) -> Array:
        """Light that a flake, a diffuse sphere, sends back, in W/sr per W/m^2."""
        return FLAKE_AREA * _disc_m2(diameter_mm) * self.albedo * LAMBERT_SPHERE_BACK

    def fall_m_per_s(self, diameter_mm: Array) -> Array:
        """Fall speed of flakes by melted diameter."""
        return np.asarray(1.6 * (diameter_mm / 10.0) ** 0.31)


def _disc_m2(diameter_mm: Array) -> Array:
    return M2_PER_MM2 * math.pi / 4 * diameter_mm**2
