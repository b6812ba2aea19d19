"""Flash time of flight on a SPAD array: the whole picture is lit by pulses, and every pixel times its first photon.

A photon that arrives at time t after the middle of its pulse comes from the distance c t / 2. There are four ways to
compute the depth of a pixel from the times of its photons:

- first photon (Kirmani et al., "First-photon imaging", Science 343, 2014, without its smoothing over neighbours): the
  time of the very first photon is the answer. Further photons are not used, so the error does not fall with a longer
  measurement.
- peak: the first photons of all pulses make a histogram. The answer is where its matched filter is largest.
- Coates (J. Phys. E 1, 1968): as peak, after correction of the pile-up. Pile-up arises because a pixel, after its first
  photon, is blind until the next pulse.
- gamma (Satat, Tancik and Raskar, "Towards photography through realistic fog", ICCP 2018): light of the fog is fitted
  by a gamma distribution a t^b exp(-c t), and the peak is sought in the light that exceeds it. Light that is scattered
  once follows the lidar equation, which is this distribution with b = -2 and c = speed of light x extinction. Pile-up
  is corrected first, since it deforms the distribution.

If a pulse gives F photons from the fog before a surface and S from the surface, on average, the first photon that is
detected comes from the surface with the probability exp(-F) (1 - exp(-S)) / (1 - exp(-F - S)).

Confidence is the probability that the answer is within 2 % of the depth. It is the probability that the peak is a
surface (`rig.strategies.photon_times`, or `first_photons` for a first photon), times the probability that its error is
small enough.
"""

import math
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from rig.simd import Float64
from rig.strategies.apparatus import Apparatus, Budget, PulseTimes
from rig.strategies.photon_times import TimedSurfaces, surfaces
from rig.strategies.strategy import GOOD, Answer, ColumnGeometry, Light, TooShort

LIGHT_M_PER_S: Final = 299792458.0
"""Speed of light, exact by definition of the SI."""
BINS_PER_SIGMA: Final = 1.0
"""Bins per standard deviation of the pulse. A twelfth of the squared width of a bin adds to the pulse's variance, which
makes the error 4 % larger."""
NEIGHBOURS: Final = 8
"""Pixels on either side whose first photons say whether the first photon of a pixel came from a surface."""
NEAR_SIGMAS, AROUND_SIGMAS = 3.0, 15.0
"""Differences of arrival times, in standard deviations of the pulse, within which two photons agree, and within which
chance agreement is counted. Two photons of one surface differ by sqrt(2); light of fog is spread over many."""

Method = Literal["first-photon", "peak", "gamma"]


@dataclass(frozen=True, slots=True)
class FlashLidar:
    """A flash lidar. method: how it computes the depth, see the module. coates: whether pile-up is corrected."""

    name: str
    sentence: str
    source: str
    clear_px: float
    method: Method
    coates: bool = False
    light: Light = "flash"

    def measure(self, apparatus: Apparatus, geometry: ColumnGeometry, budget: Budget, rng_seed: int) -> Answer:
        """See `Strategy`. All of the time is used for pulses, one in each frame of the SPAD."""
        pulses = budget.frames(apparatus.spad_frame_s)
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
            between_s = (near_m * path).ravel(), (far_m * path).ravel()
            flat = surfaces(seen, sigma_s, between_s, fog=self.method == "gamma", coates=self.coates)
            found = TimedSurfaces(*(values.reshape(path.shape) for values in flat))
        depth_m = found.time_s / path
        good = usable & (depth_m >= near_m * (1 - GOOD)) & (depth_m <= far_m * (1 + GOOD))
        near_enough = within(GOOD * found.time_s, found.sd_s)
        confidence = np.where(good, np.nan_to_num(found.confidence * near_enough), 0.0)
        return Answer(np.where(good, depth_m, np.nan).astype(np.float32), confidence.astype(np.float32))


def first_photons(seen: PulseTimes, sigma_s: float, rng: np.random.Generator) -> TimedSurfaces:
    """The first photon that each pixel detected in all pulses; arrays (rows, width).

    The histogram does not say which photon came first. All pulses are alike, so each photon of a pixel is equally
    likely to be the first, and one is drawn at random. The first photons of up to `NEIGHBOURS` pixels on either side in
    the row say whether it came from a surface: how many arrive at the same time (within 3 standard deviations of the
    pulse) is compared with how many would do so by chance. The latter follows from those that arrive shortly before or
    after. The share of photons that come from surfaces is estimated over the whole picture, from how often two
    neighbours agree.
    """
    total = seen.counts.sum(axis=-1, dtype=np.int64)
    drawn = rng.integers(0, np.maximum(total, 1))
    at = np.stack(
        [np.sum(np.cumsum(row, axis=-1) <= d[:, None], axis=-1) for row, d in zip(seen.counts, drawn, strict=True)]
    )
    time_s = np.where(total > 0, seen.start_s + seen.bin_s * (at + 0.5), np.nan)
    start_s, end_s = seen.start_s, seen.start_s + seen.bin_s * seen.counts.shape[-1]
    near_s, far_s = (
        np.clip(time_s - start_s, 0, sigmas * sigma_s) + np.clip(end_s - time_s, 0, sigmas * sigma_s)
        for sigmas in (NEAR_SIGMAS, AROUND_SIGMAS)
    )
    by_chance = np.nan_to_num(near_s / np.maximum(far_s - near_s, 1e-3 * sigma_s))
    with_it, around, others = (np.zeros(time_s.shape) for _ in range(3))
    together, width = 0.0, time_s.shape[1]
    for offset in range(1, min(NEIGHBOURS, width - 1) + 1):
        apart = np.abs(time_s[:, offset:] - time_s[:, :-offset])
        near, far = apart < NEAR_SIGMAS * sigma_s, apart < AROUND_SIGMAS * sigma_s
        for part in (slice(offset, None), slice(None, width - offset)):
            with_it[:, part] += near
            around[:, part] += far & ~near
            others[:, part] += np.isfinite(apart)
        if offset == 1:
            together = float(np.sum(with_it - around * by_chance) / max(np.sum(others), 1.0))
    # Two neighbours come together where both came from a surface.
    share = math.sqrt(min(max(together, 1e-12), 1 - 1e-6))
    chance = np.maximum((around + 0.5) * by_chance, 1e-9)
    # Of the neighbours on the same surface a quarter come with it even where the surface is steep.
    most = np.maximum(others * share, 1e-9)
    more = np.clip(with_it - chance, 0.25 * most, most)
    odds = math.log(share / (1 - share)) + with_it * np.log1p(more / chance) - more
    seen_at_all = np.isfinite(time_s)
    believed = np.where(seen_at_all, _logistic(odds), 0.0)
    return TimedSurfaces(time_s, np.where(seen_at_all, sigma_s, 0.0), seen_at_all * 1.0, believed)


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
