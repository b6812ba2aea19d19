"""The surface in a histogram of first photons: its time, the error of this time, and the confidence.

A pixel detects only one photon per pulse. So of N pulses only E = N - (photons in earlier bins) find the pixel still
waiting at a bin. With n photons in the bin the rate is -log(1 - n / E) per pulse (Coates, J. Phys. E 1, 1968). Counts
are corrected to -E log(1 - n / E), whose variance is about that of counts, and every model is multiplied by E / N.

The background of a pixel is a t^b exp(-c t) + u: light of fog, and ambient light with dark counts. It is fitted without
the bins around the surface's peak. The matched filter of the counts has a value m at each time. It is scaled so that a
pulse of A photons gives A on average, and a constant background has a variance equal to its mean. It is compared with
the mean mu that the background gives, by the logarithm of the Poisson likelihood ratio

    L = m log(m / mu) - m + mu,      m > mu.

Averaging over the unknown amplitude subtracts log(1 + m) / 2. The confidence is the sum of these likelihood ratios at
the peak and beside it, divided by their sum over all times; beforehand it is as likely that there is no surface as that
there is one. For this, mu is raised to the light counted directly before and after the peak: a hump that is wider than
the pulse is no surface.

The time of the surface maximises the likelihood of a Gaussian pulse of A photons on its background of b per bin; it is
found by Fisher's scoring. Its error is at least the Cramer-Rao bound, for a pulse g of standard deviation s

    sd^2 = 1 / I,    I = sum over bins of (A g')^2 / (A g + b);      I = A / s^2 without background.
"""

import math
from typing import Final, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rig.simd import Float64
from rig.strategies.apparatus import PulseTimes

REACH: Final = 4.0
"""Half the width of a peak, in standard deviations of the pulse."""
FLANK_SIGMAS: Final = (4.0, 12.0)
"""Distances from a peak between which the light on either side is counted, in standard deviations of the pulse."""
FOG_NODES: Final = 48
"""Number of intervals of time for the fit of a background. They are equally long in the logarithm of time; within an
interval the background is linear."""
FOG_STEPS: Final = 15
FOG_TURNS: Final = 2
"""Number of times that a background is fitted and a peak sought. The peak is left out of the next fit."""
FOG_PRIOR: Final = np.array([1 / 5.0**2, 1 / 3.0**2, 1 / 10.0**2])
"""Precisions (1 / variance) of the prior of log a, of b, and of c times the length of the gate. The prior has its
centre at b = -1 and c = 0."""
PLACING_STEPS: Final = 12

Counts = NDArray[np.uint32]
Whole = NDArray[np.int64]


class TimedSurfaces(NamedTuple):
    """The surface that each pixel sees, float64 (pixels,).

    time_s: time at which its light arrives. sd_s: standard deviation of this time, the Cramer-Rao bound for the pixel's
    own counts. photons: number of its photons. confidence: probability that it is a surface. If no photon arrived while
    light of a surface could arrive, time_s is NaN and the others are 0.
    """

    time_s: Float64
    sd_s: Float64
    photons: Float64
    confidence: Float64


def surfaces(
    seen: PulseTimes, sigma_s: float, between_s: tuple[Float64, Float64], *, fog: bool, coates: bool
) -> TimedSurfaces:
    """The surface that each pixel sees, found as the largest peak of its histogram; arrays (rows x width,).

    seen: its histogram is (rows, width, bins). sigma_s: standard deviation of the pulse. between_s: first and last time
    at which light of a surface can arrive, (rows x width,) each. fog: whether the peak is sought above the fitted light
    of fog; otherwise above a constant background. Time and confidence of the peak follow from the fitted light in both
    cases. coates: whether pile-up is corrected.
    """
    bins = seen.counts.shape[-1]
    counts = np.ascontiguousarray(seen.counts).reshape(-1, bins)
    time_s: Float64 = np.asarray(seen.start_s + seen.bin_s * (np.arange(bins) + 0.5), np.float64)
    places = (
        np.searchsorted(time_s, between_s[0], side="left").astype(np.int64),
        np.searchsorted(time_s, between_s[1], side="right").astype(np.int64),
    )
    # Photons that lie anywhere in a bin are spread by its width, too.
    sigma = math.hypot(sigma_s / seen.bin_s, math.sqrt(1 / 12))
    pulses = seen.pulses if coates else 0
    nodes = Nodes.over(time_s)
    n, e = np.zeros((2, len(counts), nodes.number))
    nowhere, best = np.full(len(counts), -bins), np.zeros(len(counts), np.int64)
    _add_up(counts, pulses, nodes.of_bin, nowhere, 0, n, e)
    light = np.repeat(((n.sum(axis=1) + 0.5) / np.maximum(e.sum(axis=1), 1.0))[:, None], nodes.number + 1, axis=1)
    matched = matched_filter(sigma)
    _find(counts, pulses, matched, places, light, nodes.of_bin, nodes.share, best)
    for _ in range(FOG_TURNS if fog else 1):
        n[:], e[:] = 0, 0
        _add_up(counts, pulses, nodes.of_bin, best, math.ceil(REACH * sigma), n, e)
        light = fog_background(n, e, nodes)
        if fog:
            _find(counts, pulses, matched, places, light, nodes.of_bin, nodes.share, best)
    found = np.zeros((4, len(counts)))
    nearest, farthest = (max(round(border * sigma), 1) for border in FLANK_SIGMAS)
    widths = sigma, nearest, farthest
    _judge(counts, pulses, matched, places, light, nodes.of_bin, nodes.share, best, widths, found)
    at, sd, photons, confidence = found
    return TimedSurfaces(
        np.where(photons > 0, seen.start_s + seen.bin_s * (at + 0.5), np.nan), seen.bin_s * sd, photons, confidence
    )


class Nodes(NamedTuple):
    """Intervals of time, for the fit of a background.

    of_bin: int64 (bins,), the interval of each bin. share: (bins,), place of the bin in its interval, 0 to 1. edges:
    (number + 1, 3), the terms 1, log t and -t at the ends of intervals. log t and -t are shifted to 0 at the first end,
    and -t is scaled to -1 at the last. middle: (number, 3), means of the terms over the bins of an interval. used:
    (number,), 1 for intervals with a bin, else 0.
    """

    of_bin: Whole
    share: Float64
    edges: Float64
    middle: Float64
    used: Float64

    @property
    def number(self) -> int:
        """Number of intervals."""
        return len(self.middle)

    @classmethod
    def over(cls, time_s: Float64) -> "Nodes":
        """Intervals over bins at these times (bins,), ascending. Times below a thousandth of the last one are raised to
        that."""
        t = np.maximum(time_s, 1e-3 * time_s[-1])
        number = min(FOG_NODES, len(t))
        ends = np.geomspace(t[0], max(t[-1], t[0] * (1 + 1e-9)), number + 1)
        of_bin = np.searchsorted(ends[1:-1], t, side="right")
        share = (t - ends[of_bin]) / (ends[of_bin + 1] - ends[of_bin])

        def features(at: Float64) -> Float64:
            return np.stack([np.ones_like(at), np.log(at / ends[0]), (ends[0] - at) / (ends[-1] - ends[0])], axis=1)

        in_it = np.bincount(of_bin, minlength=number)
        middle = np.stack([np.bincount(of_bin, column, number) for column in features(t).T], axis=1)
        used = (in_it > 0).astype(np.float64)
        return cls(
            of_bin.astype(np.int64), share.clip(0, 1), features(ends), middle / np.maximum(in_it, 1)[:, None], used
        )


def fog_background(counts: Float64, share: Float64, nodes: Nodes) -> Float64:
    """The background a t^b exp(-c t) + u in counts per bin, at the ends of the intervals, float64 (pixels, number + 1).

    counts: photons in each interval, (pixels, number). share: sum over the bins of each interval of the share of pulses
    that find the pixel waiting. Newton's method for the Poisson likelihood of a, b and c alternates with expectation
    and maximisation for u. a, b and c have a broad prior, so that few photons do not give an extreme curve.
    """
    total = np.maximum(share.sum(axis=1), 1.0)
    mean = (counts.sum(axis=1) + 0.5) / total
    prior = np.stack([np.log(mean), np.full_like(mean, -1.0), np.zeros_like(mean)], axis=1)
    theta, flat = prior.copy(), 0.2 * mean
    x = nodes.middle * nodes.used[:, None]
    pairs = (x[:, :, None] * x[:, None, :]).reshape(-1, 9)
    for _ in range(FOG_STEPS):
        fog = np.exp(np.clip(theta @ x.T, -80.0, 80.0))
        of_fog = counts * fog / (fog + flat[:, None])
        flat = (np.sum(counts - of_fog, axis=1) + 0.1) / total
        expected = share * fog
        slope = (of_fog - expected) @ x - FOG_PRIOR * (theta - prior)
        curvature = (expected @ pairs).reshape(-1, 3, 3) + np.diag(FOG_PRIOR)
        theta = theta + np.clip(np.linalg.solve(curvature, slope[:, :, None])[:, :, 0], -2.0, 2.0)
    return np.asarray(np.exp(np.clip(theta @ nodes.edges.T, -80.0, 80.0)) + flat[:, None], np.float64)


def matched_filter(sigma: float) -> Float64:
    """A Gaussian of `sigma` bins. Its scale makes the variance of a filtered constant background equal to its mean."""
    half = math.ceil(REACH * sigma)
    pulse = np.exp(-0.5 * np.square(np.arange(-half, half + 1) / sigma))
    return np.asarray(pulse * (np.sum(pulse) / np.sum(pulse**2)), np.float64)


@numba.njit(cache=True, nogil=True)
def without_pile_up(counts: Counts, pulses: int, corrected: Float64, share: Float64) -> None:
    """Write the counts without pile-up into `corrected`, and the share of pulses that find the pixel waiting into
    `share`; all are (bins,). With 0 pulses counts stay as they are, and shares are 1.
    """
    left = float(pulses)
    for i in range(len(counts)):
        n = float(counts[i])
        corrected[i], share[i] = n, 1.0
        if pulses > 0:
            share[i] = max(left, 0.5) / pulses
            if n > 0.0:
                # Half a pulse stands for none: where every pulse that was left put a photon into the bin, and after it.
                corrected[i] = -left * math.log(max(left - n, 0.5) / max(left, 1.0))
                left = max(left - n, 0.0)


@numba.njit(cache=True, nogil=True)
def _add_up(counts: Counts, pulses: int, of_bin: Whole, best: Whole, half: int, n: Float64, e: Float64) -> None:
    """Add counts and shares of bins more than `half` from the best to their intervals, n and e (pixels, nodes)."""
    bins = counts.shape[1]
    corrected, share = np.empty(bins), np.empty(bins)
    for p in range(len(counts)):
        without_pile_up(counts[p], pulses, corrected, share)
        for i in range(bins):
            if abs(i - best[p]) > half:
                n[p, of_bin[i]] += corrected[i]
                e[p, of_bin[i]] += share[i]


@numba.njit(cache=True, nogil=True)
def _filter(corrected: Float64, matched: Float64, value: Float64) -> None:
    """Write into value (bins,) the matched filter of the counts."""
    bins, half = len(value), len(matched) // 2
    value[:] = 0.0
    for i in range(bins):
        if corrected[i] > 0.0:
            for k in range(max(-half, -i), min(half, bins - 1 - i) + 1):
                value[i + k] += corrected[i] * matched[k + half]


@numba.njit(cache=True, nogil=True)
def ratio(value: float, expected: float) -> float:
    """Logarithm L of the likelihood ratio of a count with and without a surface; 0 if the count is below the mean."""
    if value <= expected:
        return 0.0
    return value * math.log(value / expected) - (value - expected)


@numba.njit(cache=True, nogil=True)
def _find(
    counts: Counts, pulses: int, matched: Float64, places: tuple[Whole, Whole], light: Float64, of_bin: Whole,
    within: Float64, best: Whole,
) -> None:  # fmt: skip
    """Write into best (pixels,) the bin of the largest likelihood ratio, of those where a surface can be."""
    bins, whole = counts.shape[1], np.sum(matched)
    corrected, share, value = np.empty(bins), np.empty(bins), np.empty(bins)
    for p in range(len(counts)):
        without_pile_up(counts[p], pulses, corrected, share)
        _filter(corrected, matched, value)
        first, last = places[0][p], places[1][p]
        best[p], most = min(first, bins - 1), -1.0
        for i in range(first, last):
            if value[i] > 0.0:
                k = of_bin[i]
                expected = whole * share[i] * (light[p, k] + within[i] * (light[p, k + 1] - light[p, k]))
                here = ratio(value[i], expected)
                if here > most:
                    best[p], most = i, here


@numba.njit(cache=True, nogil=True)
def _judge(
    counts: Counts, pulses: int, matched: Float64, places: tuple[Whole, Whole], light: Float64, of_bin: Whole,
    within: Float64, best: Whole, widths: tuple[float, int, int], found: Float64,
) -> None:  # fmt: skip
    """Write into found (4, pixels) the place of each best peak in bins, its standard deviation, photons and confidence.
    widths: standard deviation of the pulse, first and last bin of the flanks, in bins."""
    bins, whole, half = counts.shape[1], np.sum(matched), len(matched) // 2
    corrected, share, value, model = np.empty(bins), np.empty(bins), np.empty(bins), np.empty(bins)
    counted, modelled = np.zeros(bins + 1), np.zeros(bins + 1)
    evidence = np.empty(bins)
    sigma, nearest, farthest = widths
    doubt = 1.0 + whole / (2.0 * (farthest - nearest + 1))
    for p in range(len(counts)):
        first, last = places[0][p], places[1][p]
        if last <= first:
            continue
        without_pile_up(counts[p], pulses, corrected, share)
        _filter(corrected, matched, value)
        if not value[best[p]] > 0.0:
            continue
        for i in range(bins):
            k = of_bin[i]
            model[i] = share[i] * (light[p, k] + within[i] * (light[p, k + 1] - light[p, k]))
            counted[i + 1] = counted[i] + corrected[i]
            modelled[i + 1] = modelled[i] + model[i]
        most, excess_there = 0.0, 1.0
        for i in range(first, last):
            a, b = max(i - farthest, 0), max(i - nearest + 1, 0)
            c, d = min(i + nearest, bins), min(i + farthest + 1, bins)
            beside = counted[b] - counted[a] + counted[d] - counted[c]
            due = modelled[b] - modelled[a] + modelled[d] - modelled[c]
            excess = max((beside + 0.5) / (due + 0.5), 1.0)
            if i == best[p]:
                excess_there = excess
            # Where the background is counted beside the peak, its own error adds to that of the peak.
            evidence[i] = ratio(value[i], excess * whole * model[i]) / (doubt if excess > 1.0 else 1.0)
            evidence[i] -= 0.5 * math.log1p(value[i])
            most = max(most, evidence[i])
        near, total = 0.0, math.exp(-most)
        for i in range(first, last):
            weight = math.exp(evidence[i] - most) / (last - first)
            total += weight
            if abs(i - best[p]) <= half:
                near += weight
        found[3, p] = near / total
        low, high = max(best[p] - half, 0), min(best[p] + half + 1, bins)
        found[0, p], found[1, p], found[2, p] = _placed(
            corrected[low:high], share[low:high], excess_there * model[low:high], best[p] - low, sigma
        )
        found[0, p] += low


@numba.njit(cache=True, nogil=True)
def _placed(
    counts: Float64, share: Float64, background: Float64, start: int, sigma: float
) -> tuple[float, float, float]:
    """Place of a pulse in bins, its standard deviation, and its photons, from the bins around it. start: its bin."""
    place, photons = float(start), max(np.sum(counts) - np.sum(background), 0.5)
    information = 0.0
    for _ in range(PLACING_STEPS):
        information, push, of_pulse, open_pulse = 1e-12, 0.0, 0.0, 1e-12
        for i in range(len(counts)):
            away = (i - place) / sigma
            pulse = share[i] * math.exp(-0.5 * away * away) / (math.sqrt(2.0 * math.pi) * sigma)
            signal = photons * pulse
            mean = max(signal + background[i], 1e-30)
            slope = signal * away / sigma
            information += slope * slope / mean
            push += (counts[i] / mean - 1.0) * slope
            of_pulse += counts[i] * signal / mean
            open_pulse += pulse
        step = min(max(push / information, -0.5 * sigma), 0.5 * sigma)
        place = min(max(place + step, start - 2.0 * sigma), start + 2.0 * sigma)
        photons = max(of_pulse / open_pulse, 1e-3)
    return place, 1.0 / math.sqrt(information), photons
