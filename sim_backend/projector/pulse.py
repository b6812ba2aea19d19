"""Flashes: short pulses that light the whole picture, and the time at which each pixel detects its first photon.

The source stands at the camera and spreads the energy Q of a pulse evenly over the picture's solid angle W. With the
gain g (detections per W s/(m^2 sr)), a surface of albedo rho at the distance R and under the angle i sends back

    g rho/pi cos i  Q/(W R^2)  exp(-2 sigma R)                  detections a pulse

and a medium of the backscatter coefficient b (scattering x phase function at 180 degrees), per metre of distance r < R,

    g b  Q/(W r^2)  exp(-2 sigma r)                             (lidar equation, scattered once)

They arrive 2 R/c and 2 r/c after the pulse left, blurred by a Gaussian of the pulse and the sensor's jitter together.
Drops and flakes count as a medium of their mean backscatter. Ambient light and dark counts come evenly. sigma is the
extinction without what is only turned forward, since a flash lights the neighbours' paths too.

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

from sim_backend.effects.setting import Array, Setting
from sim_backend.light.line import edge, edge_sum
from sim_backend.light.optics import LIGHT_M_PER_S
from sim_backend.projector.draws import SensorBits, count, next_wait
from sim_backend.projector.hardware import PulsedSource
from sim_backend.scenes.medium import Rain, Snow

FWHM_PER_SIGMA = 2 * math.sqrt(2 * math.log(2))
GATE_SIGMAS = 4.0
"""Standard deviations of the blur by which the gate is wider than the depth range."""
MOST_BYTES = 1 << 31
PART_M = 0.1
"""Length of the parts of a bin over which the medium's light is summed."""
FAR_SIGMAS = 10.0
"""Standard deviations of the blur before a surface where the medium is whole."""
LEAST_RANGE_M = 1e-3
"""Distance from which on the medium sends light back; keeps 1/r^2 finite."""


@dataclass(frozen=True, slots=True, eq=False)
class Echoes:
    """What comes back of pulses from the pixels of chosen rows, all float64 (rows, width).

    range_m: distance of the surface, infinite if there is none. surface_per_j: detections per joule of a pulse, of the
    surface. medium_m_per_j: of the medium, per metre, times r^2 exp(2 sigma r). steady_per_s: without the source.
    """

    range_m: Array
    surface_per_j: Array
    medium_m_per_j: float
    extinction_per_m: float
    steady_per_s: Array
    stretch: tuple[float, float]
    """Smallest and largest distance per depth."""


def echoes(setting: Setting, rows: NDArray[np.int64], steady_per_s: Array) -> Echoes:
    """The echoes from these rows. steady_per_s: (rows, width), of ambient light and dark counts."""
    view, scene = setting.view, setting.scene
    with np.errstate(divide="ignore", invalid="ignore"):
        per_depth = np.sqrt(view.u[rows] ** 2 + view.v[rows] ** 2 + 1)
        range_m = np.where(view.surface[rows] > 0, per_depth / view.surface[rows], np.inf)
        # The facet m.X = 1 has the normal m/|m|, and the light comes along X.
        cosine = np.minimum(1 / (np.linalg.norm(view.facet[rows], axis=-1) * range_m), 1.0)
        extinction_per_m = scene.diffuse_extinction_per_m
        back = view.albedo[rows] / math.pi * cosine * np.exp(-2 * extinction_per_m * range_m) / range_m**2
    scale = setting.gain / solid_angle_sr(setting)
    medium = 0.0 if scene.medium is None else scene.medium.scattering_per_m * scene.medium.back_per_sr
    medium += sum(_back_per_m_sr(what) for what in (scene.rain, scene.snow) if what is not None)
    seen = np.isfinite(back)
    stretch = float(np.nanmin(per_depth)), float(np.nanmax(per_depth))
    return Echoes(
        np.where(seen, range_m, np.inf), np.where(seen, scale * back, 0.0), scale * medium, extinction_per_m,
        steady_per_s, stretch,
    )  # fmt: skip


def solid_angle_sr(setting: Setting) -> float:
    """Solid angle of the picture."""
    u, v = setting.view.u, setting.view.v
    (u_y, u_x), (v_y, v_x) = np.gradient(u), np.gradient(v)
    return float(np.nansum(np.abs(u_x * v_y - u_y * v_x) / (u * u + v * v + 1) ** 1.5))


def _back_per_m_sr(what: Rain | Snow) -> float:
    """Mean backscatter coefficient of all drops or flakes, per m and sr."""
    of_disc = float(what.back_m2_per_sr(np.array([1.0]))[0]) / (math.pi / 4 * 1e-6)
    return of_disc * what.sizes.area_per_m


@dataclass(frozen=True, slots=True)
class Gate:
    """Time bins after a pulse. sigma_s: blur of arrival times, one standard deviation."""

    start_s: float
    bin_s: float
    bins: int
    sigma_s: float


def blur_s(source: PulsedSource) -> float:
    """Standard deviation of the times of photons from a surface: pulse and jitter together."""
    return math.hypot(source.pulse_width, source.jitter) / FWHM_PER_SIGMA


def gate(source: PulsedSource, depth_range_m: tuple[float, float], stretch: tuple[float, float], bin_s: float) -> Gate:
    """The gate that lets in light from a range of depths. stretch: smallest and largest distance per depth. Raises
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
    """Number of first photons by time bin, uint32 (rows, width, bins). Dead pixels detect none, hot ones fire when the
    gate opens. Raises ValueError if the counts would take more than `MOST_BYTES`."""
    rows, width = back.range_m.shape
    if 4 * rows * width * gate.bins > MOST_BYTES:
        raise ValueError(
            f"{rows} x {width} pixels with {gate.bins} bins are more than {MOST_BYTES >> 30} GiB; measure fewer rows "
            f"or in wider bins than {gate.bin_s:g} s"
        )
    counts = np.zeros((rows, width, gate.bins), np.uint32)
    times = gate.start_s, gate.bin_s, gate.sigma_s
    light = pulse_j * back.surface_per_j, back.range_m, back.steady_per_s
    _time_photons(rng, pulses, times, light, pulse_j * back.medium_m_per_j, back.extinction_per_m, counts)
    if bits.dead is not None and bits.hot is not None:
        counts[bits.dead | bits.hot] = 0
        counts[bits.hot, 0] = pulses
    return counts


@numba.njit(cache=True, nogil=True)
def expected(
    times: tuple[float, float, float], surface: float, range_m: float, steady_per_s: float, medium: float,
    extinction_per_m: float, mean: Array,
) -> None:  # fmt: skip
    """Write into mean (bins,) the detections that a pulse makes on average in each bin, if none blinds the pixel."""
    start_s, bin_s, sigma_s = times
    per_s = 0.5 * LIGHT_M_PER_S
    sigma_m = per_s * sigma_s
    parts = max(1, math.ceil(per_s * bin_s / PART_M))
    step_m = per_s * bin_s / parts
    below = edge((per_s * start_s - range_m) / sigma_m)
    lit_below = edge_sum((range_m - per_s * start_s) / sigma_m)
    for i in range(len(mean)):
        near_m = per_s * (start_s + i * bin_s)
        far_m = per_s * (start_s + (i + 1) * bin_s)
        above = edge((far_m - range_m) / sigma_m)
        mean[i] = surface * (above - below) + steady_per_s * bin_s
        below = above
        if medium > 0.0:
            for part in range(parts):
                a = near_m + part * step_m
                b = a + step_m
                # Share of the part that lies before the surface, whose edge is blurred.
                lit_above = edge_sum((range_m - b) / sigma_m)
                share = sigma_m * (lit_below - lit_above) / step_m if range_m - b < FAR_SIGMAS * sigma_m else 1.0
                lit_below = lit_above
                a, b = max(a, LEAST_RANGE_M), max(b, LEAST_RANGE_M)
                # The integral of 1/r^2, and the extinction where half of it has come in.
                fog = medium * (b - a) / (a * b) * math.exp(-2.0 * extinction_per_m * math.sqrt(a * b))
                mean[i] += min(max(share, 0.0), 1.0) * fog


@numba.njit(cache=True, nogil=True)
def time_first(rng: np.random.Generator, pulses: int, mean: Array, counts: NDArray[np.uint32]) -> None:
    """Draw counts (bins,) of first photons in so many pulses, from the mean detections (bins,) of a pulse."""
    left, wait = pulses, next_wait(rng)
    for i in range(len(mean)):
        found, wait = count(rng, wait, left, mean[i])
        counts[i] = found
        left -= found


@numba.njit(cache=True, nogil=True)
def _time_photons(
    rng: np.random.Generator, pulses: int, times: tuple[float, float, float], light: tuple[Array, Array, Array],
    medium: float, extinction_per_m: float, counts: NDArray[np.uint32],
) -> None:  # fmt: skip
    """Draw counts (rows, width, bins)."""
    surface, range_m, steady_per_s = light
    mean = np.empty(counts.shape[2])
    for y in range(counts.shape[0]):
        for x in range(counts.shape[1]):
            expected(times, surface[y, x], range_m[y, x], steady_per_s[y, x], medium, extinction_per_m, mean)
            time_first(rng, pulses, mean, counts[y, x])
