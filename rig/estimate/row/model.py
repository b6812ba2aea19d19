"""The learned model of light and medium for the row likelihood. All of it is learned from counts.

Path inverse depth w (w' in `inputs`) is 1 over the mean of the two path lengths, scanner to point and point to camera.
Haze that was scattered once depends on these two lengths only. So there are two profiles over BINS bins of w, haze
before the stripe and the level behind it. Each is multiplied by the factor G of `inputs` (geometry, a gain per row and
one per column). A stripe of amplitude a has a * S(w) photons per exposure. Amplitudes (reflectance times laser power)
are AMPLITUDES learned values; S = w^2 exp(-2 extinction / w), scaled to 1 in the middle bin.

The line is a Gaussian of learned width, integrated over pixels (`pixel_shares`).
"""

import math
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields
from dataclasses import field as field_of
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.estimate.row.likelihood import LABEL_PX, LABELS
from rig.simd import Float32, Float64

BINS = 64
"""Bins of path inverse depth of the profiles."""
AMPLITUDES = 4
"""Number of stripe amplitudes that are learned, with their probabilities."""
EXTINCTION_MAX_PER_M = 5.0
HALO_NODES = 12
"""Number of path inverse depths at which the halo is learned."""
HALO_REACHES_PX = (8.0, 16.0, 32.0, 64.0, 128.0)
"""Decay lengths of the exponentials that make up a halo: from wider than a line to nearly even over most windows."""
OPTICAL_DEPTH_MAX = 50.0
"""Largest extinction times path length in a fit of haze: only e^-100 of the light would come back."""


_SHAPES = {
    "profile": (BINS, 4),
    "amplitude": (AMPLITUDES,),
    "weight": (AMPLITUDES,),
    "halo": (HALO_NODES, len(HALO_REACHES_PX)),
}


_FORMS = {
    **dict.fromkeys(("profile", "ambient", "halo"), ("float32", 2)),
    **dict.fromkeys(("row_gain", "column_gain", "amplitude"), ("float32", 1)),
    "weight": ("float64", 1),
    "before": ("uint16", 3),
}
"""Types and dimensions of the arrays; other fields are numbers. Kernels check neither."""
_LIMITS = {"w_lo": (0.0, 1e3), "per_w": (1e-6, 1e12), "none_weight": (0.0, 1.0), "line_sigma_px": (0.05, 20.0),
           "belief": (0.0, 1.0)}  # fmt: skip
"""Bounds of numbers by which tables are made, far beyond those of any state."""


@dataclass(frozen=True, slots=True)
class RowModel:
    """Learned state of the row likelihood, enough to estimate a map again bit for bit.

    profile: (BINS, 4) float32 over path inverse depth from w_lo in steps 1/per_w: haze before the stripe and level
    behind it in photons per exposure and pixel at G = 1, the stripe scale S, and the log prior of positions. row_gain:
    (rows,) and column_gain: (columns,) float32, strength of the haze on each. ambient: (rows, width) float32, photons
    per exposure of ambient light and dark counts. amplitude, weight: (AMPLITUDES,), photons at S = 1 and their
    probability. none_weight: probability of a row without a stripe. line_sigma_px: standard deviation of the line's
    profile. extinction_per_m: NaN if no haze could be fitted; its standard deviation is then NaN, too, and infinite if
    the fit hardly depends on the extinction. halo: (HALO_NODES, reaches) float32, light of the halo as a share of the
    stripe's (`rig.estimate.row.inputs`), 0 if there is none. before: uint16 (2, rows, columns), the previous map as a
    prior (`rig.estimate.joint.temporal`), None if not used. belief: how far the medium is believed under a halo, 0 to 1
    (`rig.estimate.joint.place.belief`).
    """

    profile: Float32
    w_lo: float
    per_w: float
    row_gain: Float32
    column_gain: Float32
    ambient: Float32
    amplitude: Float32
    weight: Float64
    none_weight: float
    line_sigma_px: float
    extinction_per_m: float
    extinction_sd_per_m: float
    halo: Float32 = field_of(default_factory=lambda: np.zeros((HALO_NODES, len(HALO_REACHES_PX)), np.float32))
    before: NDArray[np.uint16] | None = None
    belief: float = 1.0

    def arrays(self) -> dict[str, NDArray[np.generic]]:
        """Every field that is not None as an array, to be kept with the map."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: np.asarray(value) for name, value in values.items() if value is not None}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[np.generic]]) -> "RowModel":
        """The state from which `arrays` came, bit for bit. Raises KeyError if a field without a default is missing,
        ValueError if a field has another type or shape than any state, or a number that none has."""
        kept = {
            field.name: arrays[field.name]
            for field in fields(cls)
            if field.name in arrays or (field.default is MISSING and field.default_factory is MISSING)
        }
        for name, shape in _SHAPES.items():
            if name in kept and kept[name].shape != shape:
                raise ValueError(f"{name} is of {kept[name].shape} numbers, not {shape}")
        for name, value in kept.items():
            number = value.dtype.kind == "f" and value.ndim == 0
            if (value.dtype.name, value.ndim) != _FORMS[name] if name in _FORMS else not number:
                raise ValueError(f"{name} is {value.dtype} of {value.ndim} dimensions")
        if "before" in kept and len(kept["before"]) != 2:
            raise ValueError(f"before is of {len(kept['before'])} parts, not 2")
        values: dict[str, Any] = {name: value if value.ndim else float(value) for name, value in kept.items()}
        for name, (low, high) in _LIMITS.items():
            if name in values and not low <= values[name] <= high:
                raise ValueError(f"{name} is {values[name]:g}, outside {low:g} to {high:g}")
        return cls(**values)

    def hot_flux(self) -> float:
        """Ambient light in photons per exposure above which a pixel is not used to learn the medium."""
        return 5.0 * float(np.median(self.ambient)) + 1e-3

    def path_m(self) -> Float64:
        """Mean of the two path lengths at each profile bin, (BINS,) metres."""
        return 1.0 / (self.w_lo + np.arange(BINS) / self.per_w)


def stripe_scale(path_m: Float64, extinction_per_m: float) -> Float64:
    """Strength of a stripe of given reflectance at these path lengths, relative to that at the middle one."""
    log_scale = -2.0 * np.log(path_m) - 2.0 * extinction_per_m * path_m
    middle = len(path_m) // 2
    return np.asarray(np.exp(np.clip(log_scale - log_scale[middle], -30.0, 30.0)))


def line_profile(sigma_px: float, reach_px: int | None = None) -> Float32:
    """Share of a Gaussian line in the pixels 0, 1, ... T px from its centre, (T + 1,). T: reach_px, or `line_reach`."""
    reach_px = line_reach(sigma_px) if reach_px is None else reach_px
    return pixel_shares(sigma_px, np.arange(reach_px + 1, dtype=np.float64))


def fine_profiles(sigma_px: float) -> Float32:
    """Share of the line in pixels -R..R, R = T + 1, for LABELS centres LABEL_PX apart around 0, (LABELS, 2R + 1)."""
    reach = line_reach(sigma_px) + 1
    centres = (np.arange(LABELS) - LABELS // 2) * LABEL_PX
    return pixel_shares(sigma_px, np.arange(-reach, reach + 1) - centres[:, None])


def line_reach(sigma_px: float) -> int:
    """Pixels to either side of a line's centre over which its light is counted: 2 to 6, to cover 2.5 sigma."""
    return int(min(max(2, math.ceil(2.5 * sigma_px)), 6))


def pixel_shares(sigma_px: float, distance_px: Float64) -> Float32:
    """Integral of a unit Gaussian over the pixels at the given distances from its centre."""
    erf = np.vectorize(math.erf, otypes=[np.float64])
    scale = 1.0 / (math.sqrt(2.0) * sigma_px)
    shares = erf((distance_px + 0.5) * scale) - erf((distance_px - 0.5) * scale)
    return np.asarray(0.5 * shares, dtype=np.float32)


@dataclass(frozen=True, slots=True)
class HazeFit:
    """Haze amplitude * exp(-2 extinction path). The standard deviation of the extinction is infinite if unknown."""

    amplitude: float
    extinction_per_m: float
    extinction_sd_per_m: float


def fit_haze(path_m: Float64, flux: Float64, variance: Float64) -> HazeFit | None:
    """Weighted fit of an exponential to haze flux (bins,) with its variance (bins,). None if fewer than 4 bins are
    known or there is hardly any haze.

    Gauss-Newton on amplitude and extinction. The extinction is kept between 0 and EXTINCTION_MAX_PER_M, and its product
    with the path at the nearest bin at most OPTICAL_DEPTH_MAX.
    """
    used = np.isfinite(flux) & np.isfinite(variance) & (variance > 0)
    if used.sum() < 4:
        return None
    s, h, weight = path_m[used], flux[used], 1.0 / variance[used]
    total = float(np.sum(weight * h) / np.sum(weight))
    if total <= 0 or total**2 * np.sum(weight) < 25.0:
        return None
    most = min(EXTINCTION_MAX_PER_M, OPTICAL_DEPTH_MAX / float(s.min()))
    candidates = np.concatenate([[0.0], np.geomspace(min(0.005, most), most, 60)])

    def fitted(extinction: float) -> tuple[float, Float64]:
        """Best amplitude at the nearest bin for an extinction, and the shape of the haze, 1 there."""
        shape = np.exp(-2.0 * extinction * (s - s.min()))
        return float(np.sum(weight * shape * h) / np.sum(weight * shape**2)), shape

    def misfit(extinction: float) -> float:
        amplitude, shape = fitted(extinction)
        return float(np.sum(weight * (h - amplitude * shape) ** 2))

    def linear(extinction: float) -> tuple[float, Float64, Float64]:
        """Amplitude, derivatives of the haze with respect to both parameters, matrix of the normal equations."""
        amplitude, shape = fitted(extinction)
        design = np.stack([shape, -2.0 * (s - s.min()) * amplitude * shape])
        return amplitude, design, (design * weight) @ design.T

    shapes = np.exp(-2.0 * candidates[:, None] * (s - s.min()))
    amplitudes = (shapes @ (weight * h)) / (shapes**2 @ weight)
    extinction = float(candidates[int(np.argmin((h - amplitudes[:, None] * shapes) ** 2 @ weight))])
    for _ in range(20):
        amplitude, design, normal = linear(extinction)
        if np.linalg.det(normal) <= 1e-12 * normal[0, 0] * max(normal[1, 1], 1e-300):
            break
        step = float(np.linalg.solve(normal, (design * weight) @ (h - amplitude * design[0]))[1])
        most_step = 0.5 * extinction + 0.01
        extinction = float(np.clip(extinction + np.clip(step, -most_step, most_step), 0.0, most))
        if abs(step) < 1e-7:
            break
    amplitude, _, normal = linear(extinction)
    determinant, scatter = float(np.linalg.det(normal)), max(misfit(extinction) / (used.sum() - 2), 1.0)
    sd = np.inf if determinant <= 0 else float(np.sqrt(normal[0, 0] / determinant * scatter))
    return HazeFit(amplitude * float(np.exp(2.0 * extinction * s.min())), extinction, sd)
