"""Compiled estimators `argmax` (brightest pixel of the row, the naive reference) and `edge` (from the report that this
project follows).

`argmax` takes the largest count inside the search window, and the smallest x among equal ones. `edge` fits an
exponential background to the near side of the row and finds the pixel with the largest product of (count - background)
and the drop of the level from the 8 px before it (nearer) to the 8 px behind it (farther). The answer of `edge` is the
pixel of the largest count within 2 px of it. Counts are integers (columns, rows, window); answers are float32 (rows,
columns), refined to sub-pixel positions with the two pixels beside each. Neither estimator uses or learns a model.
"""

from dataclasses import dataclass
from typing import Final

import numba
import numpy as np

from rig.count.volume import Counter, Counts, CountVolume, SweepCounter, SweepLayout
from rig.geometry.stripe_table import StripeTable
from rig.geometry.windows import MARGIN_PX, SweepGeometry
from rig.simd import Bools, Float32, Float64, Int32
from rig.threads import RowWorkers

EDGE_REACH_PX: Final = 8
"""Pixels on each side between which `edge` measures the drop of the level (the report's discontinuity)."""
STRIPE_PX: Final = 2
"""Pixels on each side of the peak that belong to the stripe: 3 sigma of a line with sigma = 0.6 px."""
NO_STRIPE: Final = 0.1
"""Prior probability that a row has no stripe: about the share of shadows and borders in the scenes measured."""
NEAR_SHARE: Final = 0.25
"""Share of the row, from its near end, to which `edge` fits the decaying background."""


@numba.njit(cache=True, nogil=True)
def sub_pixel(weight: Float64, peak: int, length: int) -> float:
    """Offset of the line from the peak's pixel towards higher indices, -0.5 to 0.5 px: centroid of the pixel and its
    two neighbours, after the smaller neighbour's weight is subtracted from all three. 0 where nothing remains, and at
    either end of the row."""
    if peak <= 0 or peak >= length - 1:
        return 0.0
    left, centre, right = weight[peak - 1], weight[peak], weight[peak + 1]
    floor = min(left, right)
    mass = left + centre + right - 3.0 * floor
    if not mass > 0.0:
        return 0.0
    return float(min(max((right - left) / mass, -0.5), 0.5))


@numba.njit(cache=True, nogil=True)
def peak_confidence(weight: Float64, counts: Float64, k: float, peak: int, length: int) -> tuple[float, float]:
    """Probability that the true peak is within 1 px of `peak`, and the mean count more than 1 px away.

    The row is the first `length` pixels. Model: one pixel fires with the peak's probability p_peak, all others with the
    mean probability p_rest of the pixels more than 1 px away. Over k frames the log-likelihood ratio of 'stripe at x'
    to 'no stripe' (prior NO_STRIPE) is

        weight[x] (logit p_peak - logit p_rest) + k log((1 - p_peak) / (1 - p_rest))

    Half a count is added so that no probability is 0 or 1. (0, 0) if the peak has no count.
    """
    if counts[peak] <= 0.0:
        return 0.0, 0.0
    total = 0.0
    for t in range(length):
        total += counts[t]
    around = counts[peak]
    pixels = 1.0
    for t in (peak - 1, peak + 1):
        if 0 <= t < length:
            around += counts[t]
            pixels += 1.0
    rest = (total - around) / max(length - pixels, 1.0)
    # 1 - p is computed from the counts: 1 less p would lose half of its digits at K = 10^6.
    p_peak, q_peak = (counts[peak] + 0.5) / (k + 1.0), (k - counts[peak] + 0.5) / (k + 1.0)
    rest_k = k + 1.0 / length
    p_rest = min((max(rest, 0.0) + 0.5 / length) / rest_k, p_peak)
    q_rest = max((k - max(rest, 0.0) + 0.5 / length) / rest_k, q_peak)
    gain = np.log(p_peak / q_peak) - np.log(p_rest / q_rest)
    evidence = gain * counts[peak] + k * (np.log(q_peak) - np.log(q_rest))
    near = 0.0
    everything = length * NO_STRIPE / (1.0 - NO_STRIPE) * np.exp(-min(max(evidence, -60.0), 60.0))
    for t in range(length):
        share = np.exp(min(max(gain * (weight[t] - weight[peak]), -60.0), 60.0))
        everything += share
        if abs(t - peak) <= 1:
            near += share
    return near / everything, rest


@numba.njit(cache=True, nogil=True)
def _near_fit(n: Float64, length: int) -> tuple[float, float]:
    """Fit an exponential to the near part of a row, from that part's two halves. Returns the level at the nearest pixel
    and the decay per pixel, at least 0; (0, 0) if the row is too short or the nearer half has no count."""
    half = max(int(length * NEAR_SHARE) // 2, 2)
    if 2 * half > length:
        return 0.0, 0.0
    a = 0.0
    b = 0.0
    for t in range(half):
        a += n[t]
        b += n[half + t]
    if a <= 0.0:
        return 0.0, 0.0
    decay = np.log(a / b) / half if b > 0.0 else 0.0
    decay = max(decay, 0.0)
    if decay < 1e-6:
        return (a + b) / (2 * half), 0.0
    return a * -np.expm1(-decay) / -np.expm1(-decay * half), decay


@numba.njit(cache=True, nogil=True)
def peak_rows(
    counts: Counts, n_frames: Int32, x0: Int32, x_lo: Int32, x_hi: Int32, near_is_left: bool, defects: Bools,
    with_edge: bool, first_row: int, last_row: int, out: Float32,
) -> None:  # fmt: skip
    """Run `argmax` (with_edge False) or `edge` on rows first_row..last_row-1.

    out: (5, rows, columns), the first five arrays of a StripeTable; left as it is where a column has no frames or a row
    no window.
    """
    window = counts.shape[2]
    n = np.empty(window + 2 * MARGIN_PX, np.float64)
    score = np.empty(window + 2 * MARGIN_PX, np.float64)
    step = 1 if near_is_left else -1
    for c in range(counts.shape[0]):
        if n_frames[c] == 0:
            continue
        k = np.float64(n_frames[c])
        for y in range(first_row, last_row):
            first, last = max(x_lo[y, c], x0[c]), min(x_hi[y, c], x0[c] + window - 1)
            if first > last:
                continue
            # Pixels beyond the search window only show the levels before and behind; none of them can be the answer.
            low = max(first - EDGE_REACH_PX, x0[c], 0)
            high = min(last + EDGE_REACH_PX, x0[c] + window - 1, defects.shape[1] - 1)
            start = low if near_is_left else high
            for t in range(high - low + 1):
                x = start + step * t
                n[t] = 0.0 if defects[y, x] else counts[c, y, x - x0[c]]
            begin = first - low if near_is_left else high - last
            length = last - first + 1
            inside = n[begin : begin + length]
            background = 0.0
            decay = 0.0
            if with_edge:
                background, decay = _near_fit(inside, length)
                _edge_scores(n[: high - low + 1], begin, length, background, decay, score)
            weights = score[:length] if with_edge else inside
            peak = -1
            for i in range(length):
                # Ties go to the smallest x, whatever side is near.
                t = i if near_is_left else length - 1 - i
                if peak < 0 or weights[t] > weights[peak]:
                    peak = t
            if with_edge:
                # The stripe's far flank scores high, because the stripe's light lies before it: go back to the top.
                top = peak
                for t in range(max(0, peak - STRIPE_PX), min(length, peak + STRIPE_PX + 1)):
                    if inside[t] > inside[top]:
                        top = t
                peak = top
            offset = sub_pixel(inside, peak, length)
            near, rest = peak_confidence(inside, inside, k, peak, length)
            level = background * np.exp(-decay * peak) if with_edge else rest
            net = max(inside[peak] - level, 0.0)
            out[0, y, c] = start + step * (begin + peak + offset)
            out[1, y, c] = near
            out[2, y, c] = np.sqrt(1.0 / 12.0 + 0.5 / max(net, 1.0))
            haze = _flux(min(level, k), k)
            signal = 0.0
            for t in range(max(0, peak - STRIPE_PX), min(length, peak + STRIPE_PX + 1)):
                signal += _flux(inside[t], k) - haze
            out[3, y, c] = max(signal, 0.0)
            out[4, y, c] = haze


@numba.njit(cache=True, nogil=True)
def _edge_scores(n: Float64, begin: int, length: int, background: float, decay: float, score: Float64) -> None:
    """(count - background) times the drop of the mean level from the 8 px before to the 8 px behind.

    Both factors are at least 0; 0.05 is added to the drop. n: counts, also beyond the window. score: its first `length`
    values become those of pixels begin, begin + 1, ...
    """
    for t in range(length):
        at = begin + t
        before = 0.0
        behind = 0.0
        near, far = max(0, at - EDGE_REACH_PX), min(n.shape[0], at + 1 + EDGE_REACH_PX)
        for i in range(near, at):
            before += n[i]
        for i in range(at + 1, far):
            behind += n[i]
        expected = background * np.exp(-decay * t)
        before = before / (at - near) if at > near else expected
        behind = behind / (far - at - 1) if far > at + 1 else before
        rise = max(n[at] - expected, 0.0)
        # A small constant keeps the peak decisive where there is no haze to drop.
        score[t] = rise * (max(before - behind, 0.0) + 0.05)


@numba.njit(cache=True, nogil=True)
def _flux(count: float, k: float) -> float:
    """Photons per exposure from the count of k exposures together, finite at saturation."""
    return float(np.log1p(count / (k - count + 0.5)))  # ln((k + 0.5) / (k - count + 0.5)), exact for few counts too


@dataclass(frozen=True, slots=True)
class Peaks:
    """Peak search on every row. with_edge: whether peaks are weighted with the drop behind them (`edge`)."""

    with_edge: bool
    threads: int = 2
    used: None = None
    """Nothing is learned."""

    def counter(self, layout: SweepLayout, geometry: SweepGeometry) -> Counter:
        """A counter of whole sweeps."""
        return SweepCounter(layout, RowWorkers(self.threads))

    def estimate(self, volume: CountVolume, geometry: SweepGeometry) -> StripeTable:
        """Stripe table of one sweep."""
        out = np.full((5, geometry.rows, geometry.columns), np.nan, np.float32)
        out[1] = 0.0

        def work(first: int, last: int) -> None:
            peak_rows(
                volume.counts, volume.n_frames, volume.x0, geometry.x_lo, geometry.x_hi, geometry.near_is_left,
                geometry.defects, self.with_edge, first, last, out,
            )  # fmt: skip

        with RowWorkers(self.threads) as workers:
            workers.over(geometry.rows, work)
        return StripeTable(*out)
