"""Flash time of flight on a SPAD array: the whole picture is lit by pulses, and every pixel times its first photon.

A photon that comes at time t after the middle of its pulse tells of a surface at the range c t / 2. Four ways to make
a depth of a pixel's photon times, all of which look at each pixel alone:

- first photon (Kirmani et al., "First-photon imaging", Science 343, 2014, without its smoothing over neighbours): the
  time of the very first photon is the answer. Further photons are not used, so its error does not fall with time.
- peak: histogram of all first photons of all pulses, a matched filter, and its largest value.
- Coates (J. Phys. E 1, 1968): the same after correction of the pile-up. A pixel is blind after its first photon, so of
  N pulses only E = N - (photons before) could put one into a bin; its rate is -log(1 - n / E) a pulse.
- gamma (Satat, Tancik and Raskar, "Towards photography through realistic fog", ICCP 2018): light of the fog is fitted
  by a gamma distribution a t^b exp(-c t), and the peak is sought in what exceeds it. Light that is scattered once
  follows the lidar equation, which is this with b = -2 and c = speed of light x extinction.

Within its peak a surface's time is the maximum of the likelihood of a Gaussian pulse on a constant background b (counts
a second), whose error is at least the Cramer-Rao bound 1 / sqrt(I), with A photons from the surface,

    I = integral of (A g')^2 / (A g + b) dt;      without background I = A / sigma^2.

Confidence is the probability that the answer is within 2 % of the depth, with even odds beforehand that nothing can be
seen. It comes from the counts alone: a matched filter's value m is held against the background mu there, as the
Poisson likelihood ratio exp(m log(m / mu) - m + mu), averaged over an unknown amplitude. mu is the model's background,
or what lies directly before and behind if that is more. So a hump of fog, which is wider than the pulse, is not
believed to be a surface, even where a method takes it for one.
"""

import math
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rig.simd import Float32, Float64
from rig.strategies.apparatus import Apparatus, Budget, PulseTimes
from rig.strategies.strategy import Answer, ColumnGeometry, Light, TooShort

LIGHT_M_PER_S: Final = 299792458.0
"""Speed of light, exact by definition of the SI."""
BINS_PER_SIGMA: Final = 1.0
"""Bins per standard deviation of the pulse. Their width squared over 12 adds to its variance: 4 % of the error."""
RIGHT: Final = 0.02
"""Share of the depth within which an answer counts as right."""
REACH: Final = 4.0
"""Standard deviations of the pulse to either side that belong to a peak."""
FLANK_SIGMAS: Final = (3.5, 10.0)
"""Where the light before and behind a peak is looked at, in standard deviations of the pulse."""
BLOCK_PIXELS: Final = 8192
"""Pixels that are worked on together; bounds the memory to some tens of megabytes."""
FOG_NODES: Final = 48
"""Intervals of time, evenly spaced in its logarithm, by which fog is fitted."""

Method = Literal["first-photon", "peak", "gamma"]


class Peaks(NamedTuple):
    """The surface of each pixel, float64 (pixels,): time_s of its return; sd_s, standard deviation of that time by the
    Cramer-Rao bound with the pixel's own counts; photons of it; confidence that it is a surface, 0 to 1. time_s is NaN
    and the others 0 where no photon came while a surface could have sent it.
    """

    time_s: Float64
    sd_s: Float64
    photons: Float64
    confidence: Float64


@dataclass(frozen=True, slots=True)
class FlashLidar:
    """A flash lidar with one of the ways above to make a depth of the times. coates: whether pile-up is corrected."""

    name: str
    sentence: str
    source: str
    clear_px: float
    method: Method
    coates: bool = False
    light: Light = "flash"

    def measure(self, apparatus: Apparatus, geometry: ColumnGeometry, budget: Budget, rng_seed: int) -> Answer:
        """See `Strategy`. All of the time is spent on pulses, one for each frame of the SPAD."""
        pulses = int(budget.time_s / apparatus.spad_frame_s * (1 + 1e-9))
        if pulses < 1:
            raise TooShort(f"{self.name} needs {apparatus.spad_frame_s:g} s for one pulse")
        sigma_s = apparatus.pulse_sigma_s
        seen = apparatus.pulse_times(pulses, sigma_s / BINS_PER_SIGMA)
        path = 2 / LIGHT_M_PER_S * np.sqrt(1 + np.square(geometry.u, dtype=np.float64) + np.square(geometry.v))
        near_m, far_m = geometry.depth_range_m
        usable = np.isfinite(path) & ~geometry.defects
        path = np.where(usable, path, 2 / LIGHT_M_PER_S)
        if self.method == "first-photon":
            found = first_photons(seen, sigma_s, np.random.default_rng(rng_seed))
        else:
            bins = seen.counts.shape[-1]
            counts, nearest_s, farthest_s = (
                seen.counts.reshape(-1, bins),
                (near_m * path).ravel(),
                (far_m * path).ravel(),
            )
            parts = []
            for first in range(0, len(counts), BLOCK_PIXELS):
                some = slice(first, first + BLOCK_PIXELS)
                block = PulseTimes(counts[some, None], seen.start_s, seen.bin_s, seen.pulses)
                parts.append(surfaces(block, sigma_s, (nearest_s[some], farthest_s[some]), self.method, self.coates))
            found = Peaks(*(np.concatenate(values).reshape(path.shape) for values in zip(*parts, strict=True)))
        depth_m = found.time_s / path
        good = usable & (depth_m >= near_m * (1 - RIGHT)) & (depth_m <= far_m * (1 + RIGHT))
        near_enough = within(RIGHT * found.time_s, found.sd_s)
        confidence = np.where(good, np.nan_to_num(found.confidence * near_enough), 0.0)
        return Answer(np.where(good, depth_m, np.nan).astype(np.float32), confidence.astype(np.float32))


def first_photons(seen: PulseTimes, sigma_s: float, rng: np.random.Generator) -> Peaks:
    """The first photon that each pixel detected in all pulses, arrays (rows, width).

    Pulses are alike, so each of a pixel's photons was the first one with the same probability; it is drawn. Whether it
    came from a surface is judged by the first photons of up to `NEIGHBOURS` pixels to either side in the row: those
    that come with it (within 3 standard deviations of the pulse) against those shortly before and behind, which would
    come with it by chance. The share of photons that come from surfaces is estimated over the whole picture.
    """
    before = np.cumsum(seen.counts, axis=-1, dtype=np.int64)
    total = before[..., -1]
    drawn = rng.integers(0, np.maximum(total, 1))
    time_s = seen.start_s + seen.bin_s * (np.sum(before <= drawn[..., None], axis=-1) + 0.5)
    time_s = np.where(total > 0, time_s, np.nan)
    with_it, around, others = (np.zeros(time_s.shape) for _ in range(3))
    width = time_s.shape[1]
    for offset in range(1, min(NEIGHBOURS, width - 1) + 1):
        apart = np.abs(time_s[:, offset:] - time_s[:, :-offset])
        for part in (slice(offset, None), slice(None, width - offset)):
            with_it[:, part] += apart < NEAR_SIGMAS * sigma_s
            around[:, part] += (apart >= NEAR_SIGMAS * sigma_s) & (apart < AROUND_SIGMAS * sigma_s)
            others[:, part] += np.isfinite(apart)
    chance = (around + 0.5) * NEAR_SIGMAS / (AROUND_SIGMAS - NEAR_SIGMAS)
    seen_at_all = np.isfinite(time_s)
    pairs = np.sum(others[seen_at_all])
    excess = np.sum((with_it - chance)[seen_at_all])
    share = min(max(math.sqrt(max(excess, 0.0) / max(pairs, 1.0)), 1e-6), 1 - 1e-6)
    more = others * share
    odds = math.log(share / (1 - share)) + with_it * np.log1p(more / chance) - more
    believed = np.where(seen_at_all, _logistic(odds), 0.0)
    return Peaks(time_s, np.where(seen_at_all, sigma_s, 0.0), seen_at_all * 1.0, believed)


NEIGHBOURS: Final = 8
"""Pixels to either side whose first photons say whether a pixel's own came from a surface."""
NEAR_SIGMAS, AROUND_SIGMAS = 3.0, 15.0
"""Photons of one surface differ by sqrt(2) standard deviations of the pulse; light of fog is spread over many."""


def surfaces(
    seen: PulseTimes, sigma_s: float, between_s: tuple[Float64, Float64], method: Method, coates: bool
) -> Peaks:
    """The surface of each pixel of a histogram (pixels, 1, bins), by its largest peak.

    sigma_s: of the pulse. between_s: first and last time (pixels,) at which a surface can answer. method: `gamma` fits
    and removes the light of fog; `peak` takes the background for constant. coates: whether pile-up is corrected.
    """
    counts: Float32 = seen.counts[:, 0].astype(np.float32)
    share = np.ones_like(counts)
    if coates:
        counts, share = without_pile_up(counts, seen.pulses)
    pixels, bins = counts.shape
    bin_number, pixel = np.arange(bins), np.arange(pixels)
    time_s: Float64 = np.asarray(seen.start_s + seen.bin_s * (bin_number + 0.5), np.float64)
    sigma = math.hypot(sigma_s / seen.bin_s, math.sqrt(1 / 12))
    allowed = (time_s >= between_s[0][:, None]) & (time_s <= between_s[1][:, None])
    matched, flank = _matched_filter(sigma), _flanks(sigma)
    value = _along(counts, matched)
    constant = (np.sum(counts, axis=1) + 0.5) / np.maximum(np.sum(share, axis=1), 1)
    best = np.argmax(np.where(allowed, _poisson_ratio(value, _along(constant[:, None] * share, matched)), -1), axis=1)
    for _ in range(TURNS if method == "gamma" else 1):
        kept = np.abs(bin_number - best[:, None]) > REACH * sigma
        model = fog_background(counts * kept, share * kept, time_s) * share
        expected = _along(model, matched)
        if method == "gamma":
            best = np.argmax(np.where(allowed, _poisson_ratio(value, expected), -1), axis=1)
    excess = np.maximum((_along(counts, flank) + 0.5) / (_along(model, flank) + 0.5), 1)
    # Where the background is counted beside the peak, its own error adds to that of the peak (Li and Ma 1983).
    unsure = np.where(excess > 1, 1 + np.sum(matched) / np.sum(flank), 1)
    ratio = _poisson_ratio(value, excess * expected) / unsure
    evidence = np.where(allowed, ratio - 0.5 * np.log1p(value), -np.inf)
    most = np.maximum(evidence.max(axis=1), 0.0)
    weight = np.exp(evidence - most[:, None]) / np.maximum(np.count_nonzero(allowed, axis=1), 1)[:, None]
    near = np.abs(bin_number - best[:, None]) <= REACH * sigma
    confidence = np.sum(weight * near, axis=1) / (np.exp(-most) + np.sum(weight, axis=1))
    at_s, sd_s, photons = _placed(counts, model * excess[pixel, best][:, None], share, best, sigma)
    found = (value[pixel, best] > 0) & allowed[pixel, best]
    return Peaks(
        np.where(found, seen.start_s + seen.bin_s * (at_s + 0.5), np.nan), np.where(found, seen.bin_s * sd_s, 0.0),
        np.where(found, photons, 0.0), np.where(found, confidence, 0.0),
    )  # fmt: skip


def without_pile_up(counts: Float32, pulses: int) -> tuple[Float32, Float32]:
    """Counts of first photons (pixels, bins) as they would be if each pixel were never blind, and the share of pulses
    (pixels, bins) for which it was not blind at the beginning of each bin (Coates 1968).

    The first are scaled by the second: they are still about as many as were counted, so that they vary as counts do.
    """
    left = (pulses + counts - np.cumsum(counts, axis=1, dtype=np.float64)).astype(np.float32)
    # Where every pulse that was left put a photon into the bin, half a pulse stands for those that did not.
    some = np.maximum(left, 1)
    free = np.maximum(1 - counts / some, 0.5 / some)
    return -np.log(free) * left, left / np.float32(pulses)


def fog_background(counts: Float32, share: Float32, time_s: Float64) -> Float32:
    """Light a t^b exp(-c t) + u of fog and surroundings, in counts per bin (pixels, bins), fitted to each pixel.

    counts: (pixels, bins), those of a surface left out. share: (pixels, bins) of the pulses that could put a photon
    there, 0 for bins that are left out. time_s: (bins,). Newton's method for the Poisson likelihood of a, b and c
    alternates with expectation and maximisation for the share of u. b and c are drawn to those of a lidar in clear air
    by a broad prior, so that few photons do not make a wild curve.
    """
    least_s = time_s[-1] * 1e-3
    t = np.maximum(time_s, least_s)
    edges = np.geomspace(t[0], t[-1], FOG_NODES + 1)
    member = (np.searchsorted(edges, t, side="right").clip(1, FOG_NODES) - 1)[:, None] == np.arange(FOG_NODES)
    member = member[:, member.any(axis=0)].astype(np.float64)
    features = np.stack([np.ones_like(t), np.log(t / t[0]), -(t - t[0]) / (t[-1] - t[0])], axis=1)
    x = member.T @ features / member.sum(axis=0)[:, None]
    n, e = (np.asarray(of @ member.astype(np.float32), np.float64) for of in (counts, share))
    mean = (n.sum(axis=1) + 0.5) / np.maximum(e.sum(axis=1), 1.0)
    prior_mean = np.stack([np.log(mean), np.full_like(mean, -1.0), np.zeros_like(mean)], axis=1)
    theta, flat = prior_mean.copy(), 0.2 * mean
    for _ in range(FOG_STEPS):
        fog = np.exp(np.clip(theta @ x.T, -80.0, 80.0))
        of_fog = n * fog / (fog + flat[:, None])
        flat = (np.sum(n - of_fog, axis=1) + 0.1) / np.maximum(e.sum(axis=1), 1.0)
        slope = (of_fog - e * fog) @ x - FOG_PRIOR * (theta - prior_mean)
        curvature = np.einsum("pk,ki,kj->pij", e * fog, x, x) + np.diag(FOG_PRIOR)
        theta = theta + np.clip(np.linalg.solve(curvature, slope[:, :, None])[:, :, 0], -2.0, 2.0)
    exponent = theta.astype(np.float32) @ features.T.astype(np.float32)
    light: Float32 = np.exp(np.clip(exponent, -80, 80)) + flat[:, None].astype(np.float32)
    return light


TURNS: Final = 2
"""Number of times that a background is fitted and a peak is sought in what exceeds it; the last peak is left out of the
next fit."""
FOG_STEPS: Final = 15
FOG_PRIOR: Final = np.array([1 / 5.0**2, 1 / 3.0**2, 1 / 10.0**2])
"""Precisions of log a, b and of c times the length of the gate."""


def _matched_filter(sigma: float) -> Float32:
    """Gaussian of `sigma` bins, scaled such that a constant background has a variance equal to its mean, as a count
    has; then the photons of a pulse give their number."""
    half = math.ceil(REACH * sigma)
    pulse = np.exp(-0.5 * np.square(np.arange(-half, half + 1) / sigma))
    return np.asarray(pulse * (np.sum(pulse) / np.sum(pulse**2)), np.float32)


def _flanks(sigma: float) -> Float32:
    """1 in the bins before and behind a peak, 0 in the peak."""
    first, last = (max(round(border * sigma), 1) for border in FLANK_SIGMAS)
    return (np.abs(np.arange(-last, last + 1)) >= first).astype(np.float32)


def _along(values: Float32, weights: Float32) -> Float32:
    """Sums of values (pixels, bins) with symmetrical weights around each bin; nothing lies beyond the ends."""
    return np.asarray(cv2.filter2D(values, -1, weights[None], borderType=cv2.BORDER_CONSTANT), np.float32)


def _poisson_ratio(value: Float32, expected: Float32) -> Float32:
    """Logarithm of the likelihood ratio of a count with and without a surface; 0 for fewer than expected."""
    most = np.maximum(value, expected)
    return np.asarray(most * np.log(most / expected) - (most - expected), np.float32)


def _placed(
    counts: Float32, model: Float32, share: Float32, best: NDArray[np.int64], sigma: float
) -> tuple[Float64, Float64, Float64]:
    """Position of the pulse in bins, its standard deviation and its photons (pixels,), by Fisher's scoring.

    model: background (pixels, bins). best: (pixels,) bin of the peak.
    """
    half = math.ceil(REACH * sigma)
    at = best[:, None] + np.arange(-half, half + 1)
    inside = (at >= 0) & (at < counts.shape[1])
    clipped = at.clip(0, counts.shape[1] - 1)
    n, b, e = (np.where(inside, np.take_along_axis(v, clipped, axis=1), 0.0) for v in (counts, model, share))
    b = np.maximum(b, 1e-12)
    place = best.astype(np.float64)
    photons = np.maximum(np.sum(n - b, axis=1), 0.5)
    for _ in range(PLACING_STEPS):
        away = (at - place[:, None]) / sigma
        pulse = e * np.exp(-0.5 * away**2) / (math.sqrt(2 * math.pi) * sigma)
        signal = photons[:, None] * pulse
        weight = n / (signal + b)
        slope = signal * away / sigma
        information = np.maximum(np.sum(slope**2 / (signal + b), axis=1), 1e-12)
        move = np.sum((weight - 1) * slope, axis=1) / information
        place = np.clip(place + np.clip(move, -0.5 * sigma, 0.5 * sigma), best - 2 * sigma, best + 2 * sigma)
        photons = np.maximum(np.sum(weight * signal, axis=1) / np.maximum(np.sum(pulse, axis=1), 1e-12), 1e-3)
    return place, 1 / np.sqrt(information), photons


PLACING_STEPS: Final = 12


def within(limit: Float64, sd: Float64) -> Float64:
    """Probability that a normal error of this standard deviation is smaller than a limit; 1 for a deviation of 0."""
    erf = np.vectorize(math.erf, otypes=[np.float64])
    probability: Float64 = erf(np.nan_to_num(limit) / np.maximum(math.sqrt(2) * sd, 1e-300))
    return probability


def _logistic(odds: Float64) -> Float64:
    """Probability of logarithmic odds."""
    probability: Float64 = 0.5 * (1 + np.tanh(0.5 * odds))
    return probability


FIRST_PHOTON: Final = FlashLidar(
    "lidar-first-photon",
    "Flash time of flight; the first photon that a pixel detects is its answer.",
    "Kirmani, Venkatraman, Shin, Colaco, Wong, Shapiro and Goyal, First-photon imaging, Science 343, 2014",
    clear_px=4.0, method="first-photon",
)  # fmt: skip
PEAK: Final = FlashLidar(
    "lidar-peak",
    "Flash time of flight; the largest peak of the histogram of first photons, after a matched filter.",
    "Becker, Advanced Time-Correlated Single Photon Counting Techniques, Springer, 2005",
    clear_px=0.5, method="peak",
)  # fmt: skip
COATES: Final = FlashLidar(
    "lidar-coates",
    "Flash time of flight; the largest peak of the histogram, corrected for pulses that had fired the pixel before.",
    "Coates, The correction for photon 'pile-up' in the measurement of radiative lifetimes, J. Phys. E 1, 1968",
    clear_px=0.5, method="peak", coates=True,
)  # fmt: skip
GAMMA: Final = FlashLidar(
    "lidar-gamma",
    "Flash time of flight; the largest peak over a gamma distribution that is fitted to the light of the fog.",
    "Satat, Tancik and Raskar, Towards photography through realistic fog, ICCP, 2018",
    clear_px=0.5, method="gamma", coates=True,
)  # fmt: skip
