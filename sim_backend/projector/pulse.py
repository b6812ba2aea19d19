"""Flashes: short pulses that light the whole picture, and the time at which each pixel detects its first photon.

The source stands at the camera and spreads the energy Q of a pulse evenly over the picture's solid angle W. With the
gain g (detections per W s/(m^2 sr)), a surface of albedo rho at the distance R and under the angle i sends back

    g rho/pi cos i  Q/(W R^2)  exp(-2 sigma R)                  detections a pulse

and a medium of the backscatter coefficient b (scattering x phase function at 180 degrees), per metre of distance r < R,

    g b  Q/(W r^2)  exp(-2 sigma r)                             (lidar equation, scattered once)

They arrive 2 R/c and 2 r/c after the pulse left, blurred by a Gaussian for the pulse and the sensor's jitter together.
Drops and flakes are replaced by a medium of the same mean backscatter. Ambient light and dark counts are constant in
time. sigma is the extinction without the light that is only scattered forward: what the path of one pixel loses in this
way, it gains from the paths beside it, as the flash lights them too.

Light scattered more than once multiplies both by 1 + M. M is that of `beam_spread.totals` at the optical depth of R or
r (as if all of the picture were that far away). The additional light of the surface has made a detour. Half of the
length that it adds to the way there and back has an exponential distribution with the mean

    DETOUR (1 - mean cosine) (1 + DETOUR_GROWTH sigma R) R

1 + M was compared with traced pulses in fog of droplets (`tests/unit/sim_backend/projector/traced_pulses.py`). Up to an
optical depth of 1 it is right to 5 % for the surface and to 10 % for the medium; at 1 it is 5.7 and 2.2. At an optical
depth of 2 it is right to 20 %.

A pixel detects at most one photon per pulse. With the mean number L_i of detections in time bin i, the first one comes
in bin i with the chance exp(-L_1 - ... - L_(i-1)) (1 - exp(-L_i)). Of n pulses, Binomial(n, 1 - exp(-L_1)) are detected
in the first bin, and the others go on to the second. Bins without a detection are skipped with one exponential variate.
Measured: 20 ns a bin on one core, most of it for the mean numbers.
"""

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from sim_backend.effects.beam_spread import DEPTHS, totals
from sim_backend.effects.setting import Array, Setting
from sim_backend.light.line import edge, edge_sum
from sim_backend.light.optics import LIGHT_M_PER_S
from sim_backend.projector.draws import SensorBits, count, next_wait
from sim_backend.projector.hardware import PulsedSource
from sim_backend.scenes.medium import Rain, Snow

FWHM_PER_SIGMA = 2 * math.sqrt(2 * math.log(2))
GATE_SIGMAS = 4.0
"""The gate is wider than the depth range by so many standard deviations of the blur."""
MOST_BYTES = 1 << 31
DETOUR, DETOUR_GROWTH = 0.08, 0.4
"""Mean detour as a share of the distance, for isotropic scattering, and its growth; fitted to traced pulses."""
LATE_RISE, MORE_RISE = 2.0, 1.5
"""Approximate exponents with which light scattered more than once rises with the optical depth."""
SHORTEST = 4.0
"""Ratio of blur to mean detour above which all detours are taken to be the mean detour."""
PART_M = 0.1
"""Length of the parts of a bin over which the medium's light is summed."""
LONGEST_DETOURS = 30.0
"""Number of mean detours after which all of a surface's light has arrived."""
FAR_SIGMAS = 10.0
"""Distance from a surface up to which its light is computed, in standard deviations of the blur."""
LEAST_RANGE_M = 1e-3
"""Distance from which on the medium sends light back; keeps 1/r^2 finite."""


@dataclass(frozen=True, slots=True, eq=False)
class Echoes:
    """Light of pulses that comes back to the pixels of chosen rows, float64 (rows, width).

    range_m: distance of the surface, infinite if there is none. surface_per_j, late_per_j: detections per joule of a
    pulse, by light from the surface that was not scattered, and by light from it that was scattered. detour_m: half of
    the mean length that scattering adds to the way there and back. steady_per_s: detections per second without the
    source. fog: light of the medium. stretch: smallest and largest ratio of distance to depth.
    """

    range_m: Array
    surface_per_j: Array
    late_per_j: Array
    detour_m: Array
    steady_per_s: Array
    fog: "FogEcho"
    stretch: tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class FogEcho:
    """The medium's echo.

    per_j: detections per joule and per metre, times r^2. optical: optical depths (depths,). more: at these depths the
    light scattered more than once, relative to light scattered once, divided by exp(`MORE_RISE` depth) - 1.
    """

    per_j: float
    extinction_per_m: float
    optical: Array
    more: Array

    def of_bins(self, opened: "Gate") -> Array:
        """Detections per joule in parts of the gate's bins, float64 (bins, parts), as if there were no surface."""
        per_s = 0.5 * LIGHT_M_PER_S
        parts = max(1, math.ceil(per_s * opened.bin_s / PART_M))
        step_m = per_s * opened.bin_s / parts
        ends_m = per_s * opened.start_s + step_m * np.arange(opened.bins * parts + 1)
        near_m, far_m = np.maximum(ends_m[:-1], LEAST_RANGE_M), np.maximum(ends_m[1:], LEAST_RANGE_M)
        # The integral of 1/r^2, and the extinction where half of it has come in.
        depth = self.extinction_per_m * np.sqrt(near_m * far_m)
        once = self.per_j * (far_m - near_m) / (near_m * far_m) * np.exp(-2 * depth)
        whole = once * (1 + _more(depth, self.optical, self.more, MORE_RISE))
        return np.asarray(whole.reshape(opened.bins, parts))


def _more(depth: Array, optical: Array, more: Array, rise: float) -> Array:
    """Light scattered more than once at these optical depths."""
    capped = np.clip(depth, optical[0] / 10, optical[-1])
    return np.asarray(
        np.interp(np.log(capped), np.log(optical), more) * np.expm1(rise * np.minimum(depth, optical[-1]))
    )


def echoes(setting: Setting, rows: NDArray[np.int64], steady_per_s: Array, multiple: bool) -> Echoes:
    """The echoes from these rows.

    steady_per_s: (rows, width), of ambient light and dark counts. multiple: whether light scattered more than once
    counts.
    """
    view, scene = setting.view, setting.scene
    extinction_per_m = scene.diffuse_extinction_per_m
    with np.errstate(divide="ignore", invalid="ignore"):
        per_depth = np.sqrt(view.u[rows] ** 2 + view.v[rows] ** 2 + 1)
        range_m = np.where(view.surface[rows] > 0, per_depth / view.surface[rows], np.inf)
        # The facet m.X = 1 has the normal m/|m|, and the light comes along X.
        cosine = np.minimum(1 / (np.linalg.norm(view.facet[rows], axis=-1) * range_m), 1.0)
        back = view.albedo[rows] / math.pi * cosine * np.exp(-2 * extinction_per_m * range_m) / range_m**2
    seen = np.isfinite(back)
    range_m, solid_sr = np.where(seen, range_m, np.inf), solid_angle_sr(setting)
    surface_per_j = np.where(seen, setting.gain / solid_sr * back, 0.0)
    optical, of_surface, of_fog, sideways = DEPTHS, np.zeros(len(DEPTHS)), np.zeros(len(DEPTHS)), 0.0
    medium = scene.medium
    if medium is not None and multiple:
        share = (medium.scattering_per_m - medium.forward_per_m) / extinction_per_m
        of_surface, of_fog = totals(medium.lobes, share, math.sqrt(solid_sr) / 2)
        sideways = 1 - sum(weight * g for weight, g in medium.lobes)
    depth = extinction_per_m * np.where(seen, range_m, 0.0)
    scattered = _more(depth, optical, of_surface / np.expm1(LATE_RISE * optical), LATE_RISE)
    detour_m = DETOUR * sideways * (1 + DETOUR_GROWTH * depth) * np.where(seen, range_m, 0.0)
    per_m = 0.0 if medium is None else medium.scattering_per_m * medium.back_per_sr
    per_m += sum(_back_per_m_sr(what) for what in (scene.rain, scene.snow) if what is not None)
    fog = FogEcho(setting.gain / solid_sr * per_m, extinction_per_m, optical, of_fog / np.expm1(MORE_RISE * optical))
    stretch = float(np.nanmin(per_depth)), float(np.nanmax(per_depth))
    return Echoes(range_m, surface_per_j, surface_per_j * scattered, detour_m, steady_per_s, fog, stretch)


def solid_angle_sr(setting: Setting) -> float:
    """Solid angle of the picture, in sr."""
    u, v = setting.view.u, setting.view.v
    (u_y, u_x), (v_y, v_x) = np.gradient(u), np.gradient(v)
    return float(np.nansum(np.abs(u_x * v_y - u_y * v_x) / (u * u + v * v + 1) ** 1.5))


def _back_per_m_sr(what: Rain | Snow) -> float:
    """Mean backscatter coefficient of all drops or flakes, per m and sr."""
    of_disc = float(what.back_m2_per_sr(np.array([1.0]))[0]) / (math.pi / 4 * 1e-6)
    return of_disc * what.sizes.area_per_m


@dataclass(frozen=True, slots=True)
class Gate:
    """Time bins after the middle of a pulse has left. sigma_s: blur of arrival times, one standard deviation."""

    start_s: float
    bin_s: float
    bins: int
    sigma_s: float


def blur_s(source: PulsedSource) -> float:
    """Standard deviation of the times of photons from a surface: pulse and jitter together."""
    return math.hypot(source.pulse_width, source.jitter) / FWHM_PER_SIGMA


def gate(source: PulsedSource, depth_range_m: tuple[float, float], stretch: tuple[float, float], bin_s: float) -> Gate:
    """The gate for light from a range of depths. stretch: smallest and largest ratio of distance to depth. Raises
    ValueError for bins that are not positive or longer than the gate."""
    sigma_s = blur_s(source)
    start_s, end_s = (2 * z * q / LIGHT_M_PER_S for z, q in zip(depth_range_m, stretch, strict=True))
    start_s, end_s = max(start_s - GATE_SIGMAS * sigma_s, 0.0), end_s + GATE_SIGMAS * sigma_s
    if not 0 < bin_s <= end_s - start_s:
        raise ValueError(f"bin_s is {bin_s:g} s; give a time above 0 and up to that of the gate, {end_s - start_s:g} s")
    return Gate(start_s, bin_s, math.ceil((end_s - start_s) / bin_s), sigma_s)


def first_photons(
    rng: np.random.Generator, back: Echoes, gate: Gate, pulses: int, pulse_j: float, bits: SensorBits
) -> NDArray[np.uint32]:
    """Number of first photons of all pulses by time bin, uint32 (rows, width, bins). Dead pixels detect none, hot ones
    fire when the gate opens. Raises ValueError if the counts would take more than `MOST_BYTES`."""
    rows, width = back.range_m.shape
    if 4 * rows * width * gate.bins > MOST_BYTES:
        raise ValueError(
            f"{rows} x {width} pixels with {gate.bins} bins are more than {MOST_BYTES >> 30} GiB; measure fewer rows "
            f"or in wider bins than {gate.bin_s:g} s"
        )
    counts = np.zeros((rows, width, gate.bins), np.uint32)
    times = gate.start_s, gate.bin_s, gate.sigma_s
    light = pulse_j * back.surface_per_j, pulse_j * back.late_per_j, back.range_m, back.detour_m, back.steady_per_s
    _time_photons(rng, pulses, times, np.stack(light, axis=-1), pulse_j * back.fog.of_bins(gate), counts)
    if bits.dead is not None and bits.hot is not None:
        counts[bits.dead | bits.hot] = 0
        counts[bits.hot, 0] = pulses
    return counts


@numba.njit(cache=True, nogil=True)
def _arrived(past_m: float, sigma_m: float, detour_m: float) -> float:
    """Share of a surface's light that has arrived when it would come from past_m behind the surface: a Gaussian, with
    an exponentially distributed detour if detour_m is not 0."""
    at = past_m / sigma_m
    if detour_m * SHORTEST < sigma_m:
        return edge(at - detour_m / sigma_m)
    gone, sharp = edge(at), sigma_m / detour_m
    if gone == 0.0:
        return 0.0
    return max(gone - math.exp(min(sharp * (0.5 * sharp - at), 700.0)) * edge(at - sharp), 0.0)


@numba.njit(cache=True, nogil=True)
def mean_detections(times: tuple[float, float, float], echo: Array, fog: Array, mean: Array) -> None:
    """Write into mean (bins,) the average detections of a pulse in each bin, as if no photon made the pixel blind.

    times: in s, start of the first bin, length of a bin, and blur. echo: (5,), detections of the surface by light not
    scattered and by light scattered, then range_m, detour_m and steady_per_s as in `Echoes`. fog: detections of the
    medium, (bins, parts).
    """
    start_s, bin_s, sigma_s = times
    surface, late, range_m, detour_m, steady_per_s = echo
    per_s = 0.5 * LIGHT_M_PER_S
    sigma_m, blur_m = per_s * sigma_s, FAR_SIGMAS * per_s * sigma_s
    parts = fog.shape[1]
    step_m = per_s * bin_s / parts
    for i in range(len(mean)):
        mean[i] = steady_per_s * bin_s
        near_m = per_s * (start_s + i * bin_s) - range_m
        far_m = near_m + parts * step_m
        for part in range(parts):
            place_m = near_m + part * step_m
            share = 1.0
            if place_m > blur_m:
                break
            if place_m + step_m > -blur_m:
                # Share of the part that lies before the surface, whose edge is blurred.
                lit = edge_sum(-place_m / sigma_m) - edge_sum(-(place_m + step_m) / sigma_m)
                share = min(max(sigma_m * lit / step_m, 0.0), 1.0)
            mean[i] += share * fog[i, part]
        if surface > 0.0 and -blur_m < far_m and near_m < blur_m + LONGEST_DETOURS * detour_m:
            mean[i] += surface * (edge(far_m / sigma_m) - edge(near_m / sigma_m))
            delayed = _arrived(far_m, sigma_m, detour_m) - _arrived(near_m, sigma_m, detour_m)
            mean[i] += late * max(delayed, 0.0)


@numba.njit(cache=True, nogil=True)
def time_first(rng: np.random.Generator, pulses: int, mean: Array, counts: NDArray[np.uint32]) -> None:
    """Draw the number of first photons in each bin, after a number of `pulses`, and write it into `counts` (bins,).

    mean: average detections of a pulse in each bin, (bins,).
    """
    left, wait = pulses, next_wait(rng)
    for i in range(len(mean)):
        found, wait = count(rng, wait, left, mean[i])
        counts[i] = found
        left -= found


@numba.njit(cache=True, nogil=True)
def _time_photons(
    rng: np.random.Generator, pulses: int, times: tuple[float, float, float], light: Array, fog: Array,
    counts: NDArray[np.uint32],
) -> None:  # fmt: skip
    """Draw counts (rows, width, bins). light: (rows, width, 5), the echoes of `mean_detections`."""
    mean = np.empty(counts.shape[2])
    for y in range(counts.shape[0]):
        for x in range(counts.shape[1]):
            mean_detections(times, light[y, x], fog, mean)
            time_first(rng, pulses, mean, counts[y, x])
