"""Light that pixels see of each pattern, with its variance, and steps that all strategies with patterns share.

One-bit counts of a SPAD become flux. If N of K frames fired, it is lambda = ln((K + 1/2) / (K - N + 1/2)) photons per
frame, with the variance (N + 1/2) / ((K + 1) (K - N + 1/2)) (delta method on the binomial; the halves keep both finite
if no frame or every frame fired). Grey levels of a conventional camera have the variance alpha + beta level. Its read
noise and gain are not known to a strategy. So alpha and beta are fitted to the differences between the levels and those
expected of the decoded pattern.

Every pattern lights about half of the columns. So a lit column is equally bright in all of them, whatever the rule by
which the columns share the power.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from rig.simd import Bools, Float32, Float64
from rig.strategies.apparatus import Apparatus, Budget
from rig.strategies.strategy import GOOD, Answer, ColumnGeometry, TooShort

Camera = Literal["spad", "camera"]
ROUNDING: Final = 1e-9
"""Relative error of rounding that is allowed for: a budget of exactly n frames must hold n frames."""
FILL: Final = 0.7
"""Share of full scale that the brightest pixels may reach; a test exposure tells how long that takes."""
BRIGHTEST: Final = 0.999
"""Quantile of the test exposure that counts as brightest: a few lamps and hot pixels may saturate."""
NOISE_BINS: Final = 12
"""Number of classes of brightness for the fit of a camera's noise."""
ADC_VARIANCE: Final = 1.0 / 12.0
"""Variance of rounding to whole grey levels, the least that a camera's noise can be."""


@dataclass(frozen=True, slots=True, eq=False)
class Levels:
    """Light that pixels saw of each pattern.

    light, variance: float64 (patterns, rows, width), in photons per frame of the SPAD, or grey levels of one exposure.
    clipped: bool (rows, width), pixels that were at full scale with any pattern.
    """

    light: Float64
    variance: Float64
    clipped: Bools

    def take(self, patterns: slice) -> "Levels":
        """Levels of some of the patterns."""
        return replace(self, light=self.light[patterns], variance=self.variance[patterns])


def spad_frames(apparatus: Apparatus, budget: Budget, weights: Sequence[float]) -> NDArray[np.int64]:
    """Number of frames for each pattern, int64, in proportion to its weight and at least 1.

    Raises `TooShort` if the budget has fewer frames than there are patterns.
    """
    share = np.asarray(weights, np.float64)
    total = budget.frames(apparatus.spad_frame_s)
    if total < len(share):
        needed_s = len(share) * apparatus.spad_frame_s
        raise TooShort(f"{len(share)} patterns take {needed_s:.3g} s, the budget is {budget.time_s:.3g} s")
    frames: NDArray[np.int64] = np.maximum((total - len(share)) * share / share.sum(), 0).astype(np.int64) + 1
    return frames


def flux_of(counts: NDArray[np.uint32], frames: NDArray[np.int64]) -> tuple[Float64, Float64]:
    """Photons per frame and their variance, float64 like counts. counts: (patterns, rows, width), at most frames
    (patterns,), else ValueError is raised."""
    k = frames[:, None, None].astype(np.float64)
    n = counts.astype(np.float64)
    if np.any(n > k):
        raise ValueError(f"a pixel fired in {int(counts.max())} frames, more than the {int(frames.max())} it was given")
    rest = k - n + 0.5
    return np.log((k + 0.5) / rest), (n + 0.5) / ((k + 1.0) * rest)


def measured(
    apparatus: Apparatus, camera: Camera, patterns: Float32, weights: Sequence[float], budget: Budget
) -> Levels:
    """Show patterns (patterns, columns) and return what pixels saw. weights: shares of the SPAD's time, by pattern.

    A conventional camera exposes all patterns equally. If an exposure would saturate, it takes several shorter ones of
    each pattern, and their levels are averaged. Raises `TooShort` if the budget is too short for all patterns. A
    camera's variance is only that of rounding until `with_noise` has fitted it.
    """
    if camera == "spad":
        frames = spad_frames(apparatus, budget, weights)
        light, variance = flux_of(apparatus.spad_counts(patterns, frames), frames)
        return Levels(light, variance, np.zeros(light.shape[1:], np.bool_))
    exposure_s, repeats = _exposure(apparatus, patterns, budget)
    full = apparatus.camera_full_scale
    light = np.zeros((len(patterns), len(apparatus.rows), apparatus.width))
    clipped = np.zeros(light.shape[1:], np.bool_)
    for _ in range(repeats):
        images = apparatus.camera_images(patterns, exposure_s)
        light += images
        clipped |= (images >= full).any(axis=0)
    light /= repeats
    return Levels(light, np.full(light.shape, ADC_VARIANCE / repeats), clipped)


def _exposure(apparatus: Apparatus, patterns: Float32, budget: Budget) -> tuple[float, int]:
    """Seconds of an exposure, and the number of exposures for each pattern. One that is long enough for it is set by a
    test exposure, which is part of the budget, as anyone sets a camera."""
    shortest_s, total_s = apparatus.camera_frame_s, budget.time_s * (1 + ROUNDING)
    each_s = total_s / len(patterns)
    if each_s < shortest_s:
        needed_s = len(patterns) * shortest_s
        raise TooShort(f"{len(patterns)} patterns take {needed_s:.3g} s, the budget is {budget.time_s:.3g} s")
    each_s = min(each_s, budget.time_s / len(patterns))
    if (total_s - shortest_s) / len(patterns) < 2 * shortest_s:
        return max(each_s, shortest_s), 1
    each_s = (budget.time_s - shortest_s) / len(patterns)
    bright = float(np.quantile(apparatus.camera_images(patterns[-1:], shortest_s), BRIGHTEST))
    longest_s = max(shortest_s, shortest_s * FILL * apparatus.camera_full_scale / max(bright, 1.0))
    repeats = min(int(np.ceil(each_s / longest_s)), int(each_s / shortest_s * (1 + ROUNDING)))
    return max(each_s / repeats, shortest_s), repeats


def with_noise(levels: Levels, camera: Camera, expected: Float64, free: int) -> tuple[Levels, Float64]:
    """Levels with the fitted noise of a camera (those of a SPAD as they are), and how many times larger the variance is
    than noise explains.

    expected: light (patterns, rows, width) that the decoded pattern would give. free: number of parameters that were
    fitted for it in each pixel, less than the number of patterns. The second result is float64 (rows, width), at least
    1. It is more where haze or blur change the light: there the levels are less exact than their noise says.
    """
    spare = len(levels.light) - free
    squares = np.square(levels.light - expected)
    if camera == "camera":
        mean = levels.light.mean(axis=0)
        spread = squares.sum(axis=0) / spare
        alpha, beta = _fitted_noise(mean[~levels.clipped], spread[~levels.clipped], spare)
        levels = replace(levels, variance=alpha + beta * np.maximum(levels.light, 0.0))
    return levels, np.maximum((squares / levels.variance).sum(axis=0) / spare, 1.0)


def _fitted_noise(mean: Float64, spread: Float64, spare: int) -> tuple[float, float]:
    """alpha and beta of variance = alpha + beta level, neither less than 0, from the typical spread of pixels of like
    brightness; medians, so that the pixels whose pattern was decoded wrong do not count."""
    if not len(mean):
        return ADC_VARIANCE, 0.0
    order = np.array_split(np.argsort(mean, kind="stable"), min(NOISE_BINS, len(mean)))
    # The median of chi-square over its degrees of freedom (Wilson and Hilferty).
    typical = np.array([np.median(spread[each]) for each in order]) / (1.0 - 2.0 / (9.0 * spare)) ** 3
    level = np.array([mean[each].mean() for each in order])
    centred = level - level.mean()
    beta = max(float((centred * typical).sum() / max(float((centred**2).sum()), 1e-12)), 0.0)
    alpha = max(float(np.mean(typical) - beta * level.mean()), ADC_VARIANCE)
    return alpha, beta


def normal_cdf(z: Float64) -> Float64:
    """Probability that a standard normal variable is below z, exact to 2e-7 (Abramowitz and Stegun 26.2.17)."""
    t = 1.0 / (1.0 + 0.2316419 * np.abs(z))
    poly = t * (0.319381530 + t * (-0.356563782 + t * (1.781477937 + t * (-1.821255978 + t * 1.330274429))))
    upper = np.exp(-0.5 * np.square(np.minimum(np.abs(z), 38.0))) * (poly / np.sqrt(2.0 * np.pi))
    return np.asarray(np.where(z >= 0, 1.0 - upper, upper))


def columns_at_infinity(geometry: ColumnGeometry) -> Float64:
    """Column (rows, width) whose light plane meets a pixel's ray at infinity; mostly it is outside the field.

    The inverse depth is proportional to the distance from this column. So an error of 2 % of this distance is an error
    of 2 % of the depth. NaN for pixels without columns.
    """
    low, high = geometry.first - 0.25, np.maximum(geometry.last, geometry.first) + 0.25
    near, far = 1.0 / geometry.depth_m(low).astype(np.float64), 1.0 / geometry.depth_m(high).astype(np.float64)
    slope = (far - near) / (high - low)
    return low - near / np.where(slope == 0, np.nan, slope)


def answer_of(geometry: ColumnGeometry, column: Float64, sd: Float64, right: Float64) -> Answer:
    """Answer with the depths of fractional columns (rows, width), NaN where there is none.

    sd: standard deviation of the column, provided that it is not grossly wrong. right: probability of that.
    """
    depth = geometry.depth_m(np.where(geometry.defects, np.nan, column))
    allowed = np.nan_to_num(GOOD * np.abs(column - columns_at_infinity(geometry)))
    within = 2.0 * normal_cdf(allowed / np.maximum(np.nan_to_num(sd, nan=np.inf), 1e-6)) - 1.0
    confidence = np.clip(np.where(np.isfinite(depth), within * np.nan_to_num(right), 0.0), 0.0, 1.0)
    return Answer(depth, confidence.astype(np.float32))


def peak_offset(before: Float64, at: Float64, after: Float64) -> Float64:
    """Position of a peak with two straight flanks of equal slope, from three equally spaced scores: -1/2 to 1/2.

    at: the middle score, at least as large as the others. The result is 0 for three equal scores.
    """
    fall = at - np.minimum(before, after)
    return np.where(fall > 0, 0.5 * (after - before) / np.where(fall > 0, fall, 1.0), 0.0)


def window_columns(geometry: ColumnGeometry) -> int:
    """Number of columns after which a code may repeat: more than those that can light one pixel's surface within the
    depth range."""
    return int(np.max(geometry.last - geometry.first + 1, initial=1)) + 2


def unwrapped(geometry: ColumnGeometry, number: Float64, period: float) -> Float64:
    """Column (rows, width) of a code number that repeats after `period` columns.

    It is the first such column, counted from one column before the first feasible one. NaN if it is more than a column
    after the last feasible one.
    """
    low = geometry.first - 1.0
    column = low + np.mod(number - low, period)
    return np.where(column <= geometry.last + 1.0, column, np.nan)
