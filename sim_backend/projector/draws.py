"""Random counts of a one-bit SPAD, and random readings of a conventional camera.

A SPAD pixel that detects on average L photons in a frame reads 1 with probability 1 - exp(-L), so of n frames it fires
in

    N ~ Binomial(n, 1 - exp(-L)),    P(N = 0) = exp(-n L)

These counts are drawn exactly. Most pixels never fire, and little time is spent on them: n L is added up from pixel to
pixel, and the next pixel to fire is the one at which the sum reaches an exponential variate. If few of its frames fire,
or nearly all, its count is found by inversion (the chances of 1, 2, 3, ... one after the other), otherwise by rejection
(`numpy.random.Generator.binomial`, BTPE). With a flux of 0 a pixel never fires, with an infinite one always. Counts are
drawn row by row, pattern by pattern and pixel by pixel, so one call for all rows gives the same counts as calls for
groups of rows in ascending order. Readings of the camera are drawn array by array and depend on the grouping. Measured
on one core: 2 ns for a pixel that does not fire, 40 ns for a few counts, 100 ns for many.
"""

import math

import numba
import numpy as np
from numpy.typing import NDArray

from sim_backend.effects.afterpulsing import after_probability, blind_probability
from sim_backend.effects.sensor_bits import defects
from sim_backend.effects.setting import FrameTimes
from sim_backend.frames.flux import FluxModel
from sim_backend.projector.hardware import ConventionalCamera

Array = NDArray[np.float64]

BLACK_SIGMAS = 4.0
"""Black level of the conventional camera, in standard deviations of its read noise, so that noise is not cut off at 0.
"""
INVERSION = 30.0
"""Counts are drawn by inversion if their mean number, or that of frames without a count, is not above this."""
LEAST_CHANCE = 1e-25
"""Inversion ends at chances below it: only rounding can lead there. The first one is at least exp(-60 ln 2) = 1e-18."""


@numba.njit(cache=True, nogil=True)
def inverted(uniform: float, frames: int, flux: float) -> int:
    """Number of frames in which a pixel fires, for a flux of up to ln 2 and a uniform number in 0..1, by inversion."""
    chance, odds = math.exp(-frames * flux), math.expm1(flux)
    left = uniform - chance
    found = 0
    while left > 0.0 and found < frames and chance > LEAST_CHANCE:
        found += 1
        chance *= odds * (frames - found + 1) / found
        left -= chance
    return found


@numba.njit(cache=True, nogil=True)
def next_wait(rng: np.random.Generator) -> float:
    """An exponential variate. Mean counts are added up from pixel to pixel; where the sum reaches it, a pixel fires."""
    return -math.log(1.0 - rng.random())


@numba.njit(cache=True, nogil=True)
def count(rng: np.random.Generator, wait: float, frames: int, flux: float) -> tuple[int, float]:
    """Number of frames, out of `frames`, in which a pixel with a mean of `flux` photons per frame fires; and the wait
    that is left for the next pixel. wait: what the pixel before has left; at first from `next_wait`."""
    mean = frames * flux
    if not flux > 0.0 or frames <= 0:
        return 0, wait
    if wait >= mean:
        return 0, wait - mean
    # With chance exp(-mean) the wait was longer; within it, exp(-wait) is a uniform number above that.
    dark = math.exp(-flux)
    if dark == 0.0:
        found = frames
    elif dark >= 0.5 and frames * (1.0 - dark) <= INVERSION:
        found = inverted(math.exp(-wait), frames, flux)
    elif dark < 0.5 and frames * dark <= INVERSION:
        # The frames without a count are counted, with the flux that makes them so frequent.
        found = frames - inverted(-math.expm1(-wait), frames, -math.log1p(-dark))
    else:
        found = int(rng.binomial(frames, 1.0 - dark))
    return found, next_wait(rng)


@numba.njit(cache=True, nogil=True)
def add_counts(
    rng: np.random.Generator, frames: NDArray[np.int64], flux: Array, patterns: NDArray[np.int64],
    counts: NDArray[np.uint32],
) -> None:  # fmt: skip
    """Draw counts and add them to counts[patterns]. counts: (patterns, rows, width). patterns: (n,). frames: number of
    frames for each of these patterns, (n,). flux: mean photons per frame, (rows, n, width)."""
    for y in range(flux.shape[0]):
        wait = next_wait(rng)
        for i in range(flux.shape[1]):
            for x in range(flux.shape[2]):
                found, wait = count(rng, wait, frames[i], flux[y, i, x])
                counts[patterns[i], y, x] += np.uint32(found)


def readings(rng: np.random.Generator, electrons: Array, camera: ConventionalCamera) -> NDArray[np.uint16]:
    """Readings of a conventional camera whose pixels collect `electrons` on average.

    Electrons are Poisson distributed; a full pixel collects no more. The read-out adds Gaussian noise. The converter
    rounds to whole steps. Its range has 2^bits - 1 steps, from 0 to the full well plus the black level, which is
    `BLACK_SIGMAS` standard deviations of the noise.
    """
    # A pixel that is full beyond doubt needs no exact number.
    collected = rng.poisson(np.clip(np.nan_to_num(electrons), 0.0, 4.0 * camera.full_well + 1e3)).astype(np.float64)
    np.minimum(collected, camera.full_well, out=collected)
    collected += camera.read_noise * (rng.standard_normal(collected.shape) + BLACK_SIGMAS)
    full_scale = 2**camera.bits - 1
    steps = collected * (full_scale / (camera.full_well + BLACK_SIGMAS * camera.read_noise))
    return np.asarray(np.clip(np.rint(steps), 0, full_scale), np.uint16)


class SensorBits:
    """The sensor's changes to the bits, pixel by pixel.

    Dead and hot pixels and bit errors are exact. Crosstalk, afterpulses and dead time change the probability of each
    pixel, which is then drawn independently of all others. For crosstalk, the neighbours on the left and right count
    with their own brightness. The rows above and below, which may not be measured, and the frame before are assumed to
    be as bright as the pixel itself. As far as that is so, the means are right."""

    def __init__(self, flux: FluxModel, rows: NDArray[np.int64], frame_s: float) -> None:
        """rows: image rows that are simulated. frame_s: exposure and period of a frame, in seconds."""
        sensor, names = flux.setting.sensor, flux.bits
        times = FrameTimes(frame_s, frame_s)
        self._after = self._blind = 0.0
        if "afterpulsing and dead time" in names:
            self._after = after_probability(sensor.afterpulsing, sensor.trap_lifetime, times)
            self._blind = blind_probability(sensor.dead_time, times)
        self._crosstalk = sensor.crosstalk / 4 if "crosstalk" in names else 0.0
        self._errors = sensor.bit_error_rate if "bit errors" in names else 0.0
        self.dead, self.hot = None, None
        if "hot and dead pixels" in names:
            dead, hot = defects(sensor, flux.setting.view.u.shape)
            self.dead, self.hot = dead[rows], hot[rows]
        self.none = not names
        """Whether the bits stay as they are."""

    def flux(self, flux: Array, rows: slice | NDArray[np.int64]) -> Array:
        """The flux (rows, patterns, width) with which the bits of a perfect sensor would be 1 as often as this
        sensor's; infinite for a pixel that always reads 1. rows: the places of the flux's rows among the measured rows.
        """
        if self.none:
            return flux
        p = -np.expm1(-flux)
        p = 1.0 - (1.0 - p * (1.0 - self._blind * p)) * (1.0 - self._after * p)
        if self._crosstalk:
            beside = np.pad(p, ((0, 0), (0, 0), (1, 1)))
            quiet = (1 - self._crosstalk * beside[..., 2:]) * (1 - self._crosstalk * beside[..., :-2])
            p = 1.0 - (1.0 - p) * quiet * (1 - self._crosstalk * p) ** 2
        if self.dead is not None and self.hot is not None:
            p = np.where(self.hot[rows, None], 1.0, np.where(self.dead[rows, None], 0.0, p))
        p = p + self._errors * (1.0 - 2.0 * p)
        with np.errstate(divide="ignore"):
            return np.asarray(-np.log1p(-np.clip(p, 0.0, 1.0)))
