"""Block matching along the row, with the probability that a match is right. Dots and stereo both use it.

Each hypothesis (a shift, or an inverse depth) has a reference picture. The picture is compared with it by the
normalised correlation r of the blocks around each pixel. In a block of n independent values the best fit of gain and
offset leaves the share 1 - r^2 of the picture's variance. The Bayes factor of a regression with Zellner's g-prior, g =
n, tells whether the hypothesis explains a block better than noise does (Liang et al., J. Am. Stat. Assoc. 103, 2008):

    B = (1 + n)^((n - 2) / 2) / (1 + n (1 - r^2))^((n - 1) / 2),      r > 0

The probability of an answer is the sum of B over the hypotheses next to it, divided by the sum of (B + 1) over all
hypotheses: beforehand it is as likely that none of them is right as that one is. Neighbouring pixels are not
independent: n is the number of pixels of a block, divided by the sum over all lags of the product of the two pictures'
autocorrelations (Bartlett, J. R. Stat. Soc. 98, 1935).

About its minimum 1 - r^2 is a parabola a + q (d - d0)^2. So d0 can be found between hypotheses. The curvature gives the
standard deviation of d0, sqrt(a / (n q)), in the same unit as d.
"""

from collections.abc import Callable, Iterator
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rig.simd import Bools, Float32

BLOCK_PX: Final = (9, 11)
"""Rows and pixels of a block; it is cut where neighbouring rows are not measured."""
ROWS_AT_ONCE: Final = 48
"""Rows that are matched together; bounds the memory to some tens of megabytes."""
LAGS_PX: Final = 3
"""Largest lag of the autocorrelations."""
PEAK_PX: Final = 1.0
"""Pixels of disparity to either side of the best hypothesis that belong to the same answer."""
EXPOSED: Final = 0.7
"""Share of the full scale that the brightest pixels may reach."""
BRIGHTEST: Final = 99.5
"""Percentile of the pixels that counts as the brightest."""
MOST_EXPOSURES: Final = 64
"""Largest number of exposures that are added up."""


class Matches(NamedTuple):
    """Best hypothesis of each pixel, float32 (rows, width).

    place: fractional index of the hypothesis, NaN where the block shows nothing. sd: standard deviation of the place,
    in hypotheses, if this one is right. confidence: probability that it is right, 0 to 1.
    """

    place: Float32
    sd: Float32
    confidence: Float32


def bands(rows: NDArray[np.int64]) -> Iterator[tuple[slice, slice]]:
    """Parts of `rows` to match one after the other. Each part is two slices. The first selects, from `rows`, the rows
    to match together. The second selects, from these, the rows whose result is to be kept.

    Rows that are matched together are neighbours in the picture. Half a block of rows on either side is added to those
    whose result is kept, where there are such rows.
    """
    ends = np.flatnonzero(np.diff(rows) != 1) + 1
    margin = BLOCK_PX[0] // 2
    for run in np.split(np.arange(len(rows)), ends):
        start, stop = int(run[0]), int(run[-1]) + 1
        for first in range(start, stop, ROWS_AT_ONCE):
            last = min(first + ROWS_AT_ONCE, stop)
            low = max(first - margin, start)
            yield slice(low, min(last + margin, stop)), slice(first - low, last - low)


def exposed(
    take: Callable[[int, float], NDArray[np.uint16]], frame_s: float, time_s: float, full_scale: int
) -> Float32:
    """Take a picture (...) within a time, as the sum of exposures that do not saturate.

    take(n, exposure_s) returns n pictures (n, ...). The first one has the shortest exposure, frame_s, and shows how
    long the others may be. If the time is too short for two, a single picture takes all of it. time_s: time for all
    pictures, at least frame_s.
    """
    if time_s < 2 * frame_s:
        return np.asarray(take(1, max(time_s, frame_s))[0], np.float32)
    first = take(1, frame_s)[0]
    level = max(float(np.percentile(first, BRIGHTEST)) / full_scale, 1e-6)
    left_s = (time_s - frame_s) * (1 + 1e-9)
    number = int(np.clip(np.ceil(left_s * level / (EXPOSED * frame_s)), 1, min(left_s // frame_s, MOST_EXPOSURES)))
    exposure_s = min(left_s / number, max(frame_s * EXPOSED / level, frame_s))
    others = take(number, max(exposure_s / (1 + 1e-9), frame_s))
    return np.asarray(first + others.sum(axis=0, dtype=np.float64), np.float32)


def match(picture: Float32, references: Iterator[tuple[Float32, Bools]], independent: float) -> tuple[Float32, Float32]:
    """The share of the picture's variance that each hypothesis leaves, and the logarithm of its Bayes factor, float32
    (hypotheses, rows, width).

    picture: (rows, width). references: for each hypothesis its picture and the pixels (rows, width) at which it is
    possible. independent: number of independent values of a block. Where a hypothesis is not possible the share is 1
    and the logarithm -inf.
    """
    mean, spread = _moments(picture)
    left, evidence = [], []
    for reference, possible in references:
        other_mean, other_spread = _moments(reference)
        shared = _blurred(picture * reference) - mean * other_mean
        product = spread * other_spread
        some = possible & (product > 0)
        r = np.divide(np.maximum(shared, 0), np.sqrt(product), out=np.zeros_like(product), where=some)
        rest = np.maximum(1 - np.square(np.minimum(r, 1)), LEAST_LEFT)
        left.append(rest)
        evidence.append(np.where(some, log_bayes_factor(rest, independent), -np.inf).astype(np.float32))
    return np.stack(left), np.stack(evidence)


LEAST_LEFT: Final = np.float32(1e-5)
"""Least share of the variance that a match leaves: float32 cannot resolve less."""


def log_bayes_factor(left: Float32, independent: float) -> Float32:
    """Logarithm of the Bayes factor B of the module's docstring.

    left: 1 - r^2, 0 to 1. independent: number n of independent values in a block; less than 3 counts as 3.
    """
    n = max(independent, 3.0)
    return np.asarray(0.5 * (n - 2) * np.log1p(n) - 0.5 * (n - 1) * np.log1p(n * left), np.float32)


def independent_values(picture: Float32, reference: Float32) -> float:
    """Number of independent values in a block of two pictures (rows, width), from their autocorrelations."""
    parts = []
    for values in (picture, reference):
        mean, spread = _moments(values)
        flat = np.divide(values - mean, np.sqrt(spread), out=np.zeros_like(values), where=spread > 0)
        parts.append(flat)
    rows, width = picture.shape
    total = 0.0
    for down in range(-min(LAGS_PX, rows - 1), min(LAGS_PX, rows - 1) + 1):
        for right in range(-min(LAGS_PX, width - 1), min(LAGS_PX, width - 1) + 1):
            total += float(np.prod([_lagged(flat, down, right) for flat in parts]))
    block = float(min(BLOCK_PX[0], rows) * min(BLOCK_PX[1], width))
    return block / min(max(total, 1.0), block)


def best_match(
    left: Float32, evidence: Float32, independent: float, step_px: float, at: NDArray[np.int64] | None = None
) -> Matches:
    """The best hypothesis of each pixel. left, evidence: results of `match`. step_px: pixels of disparity between two
    hypotheses. at: indices (rows, width) of the hypotheses that are judged instead of the best ones.

    A block over a depth edge matches the surface with more contrast, while its middle may lie on the other surface. So
    if confident answers within a block are more than `EDGE_PX` apart, the confidence is halved.
    """
    number = len(evidence)
    peak = np.argmax(evidence, axis=0)
    best = peak if at is None else at
    most = np.maximum(evidence.max(axis=0), 0)
    weight = np.exp(evidence - most)
    near = np.zeros_like(most)
    reach = max(round(PEAK_PX / step_px), 1)
    for step in range(-reach, reach + 1):
        index = best + step
        taken = np.take_along_axis(weight, index.clip(0, number - 1)[None], axis=0)[0]
        near += np.where((index >= 0) & (index < number), taken, 0)
    confidence = near / (number * np.exp(-most) + weight.sum(axis=0))
    before, here, after = (
        np.take_along_axis(left, (best + step).clip(0, number - 1)[None], axis=0)[0].astype(np.float64)
        for step in (-1, 0, 1)
    )
    bend = np.maximum(0.5 * (before + after) - here, 1e-9)
    offset = np.clip(0.25 * (before - after) / bend, -0.5, 0.5)
    offset[(best == 0) | (best == number - 1)] = 0
    least = np.maximum(here - bend * offset**2, float(LEAST_LEFT))
    sd = np.sqrt(least / (independent * bend))
    shown = np.isfinite(evidence.max(axis=0))
    place = np.where(shown, best + offset, np.nan).astype(np.float32)
    confidence = np.where(shown, np.minimum(confidence, 1), 0).astype(np.float32)
    edge = _over_an_edge(np.float32(step_px) * place, confidence)
    return Matches(place, np.where(shown, sd, 0).astype(np.float32), np.where(edge, 0.5 * confidence, confidence))


def _over_an_edge(place_px: Float32, confidence: Float32) -> Bools:
    """Whether confident answers within the block around each pixel lie on different surfaces, (rows, width)."""
    sure = confidence >= 0.5
    rows, width = (min(size, 2 * extent - 1) for size, extent in zip(BLOCK_PX, sure.shape, strict=True))
    block = np.ones((rows, width), np.uint8)
    low, high = (np.where(sure, place_px, nowhere).astype(np.float32) for nowhere in (NOWHERE, -NOWHERE))
    return np.asarray(cv2.dilate(high, block) - cv2.erode(low, block) > EDGE_PX, np.bool_)


NOWHERE: Final = 1e9
"""Stands for a place farther than any hypothesis."""
EDGE_PX: Final = 4.0
"""Difference of disparities within a block that is no slope: a surface with a third of a pixel per pixel has less."""


def _lagged(flat: Float32, down: int, right: int) -> float:
    """Autocorrelation of a picture of mean 0 and variance 1 at a lag."""
    rows, width = flat.shape
    one = flat[max(down, 0) : rows + min(down, 0), max(right, 0) : width + min(right, 0)]
    other = flat[max(-down, 0) : rows + min(-down, 0), max(-right, 0) : width + min(-right, 0)]
    return float(np.mean(one * other) / max(float(np.mean(flat * flat)), 1e-12))


def _blurred(values: Float32) -> Float32:
    """Means over the block around each pixel (rows, width)."""
    rows, width = (min(size, extent - 1 + extent % 2) for size, extent in zip(BLOCK_PX, values.shape, strict=True))
    return np.asarray(cv2.blur(values, (width, rows), borderType=cv2.BORDER_REFLECT), np.float32)


def _moments(values: Float32) -> tuple[Float32, Float32]:
    """Mean and variance over the block around each pixel (rows, width)."""
    mean = _blurred(values)
    variance = _blurred(values * values) - mean * mean
    return mean, np.where(variance > 1e-5 * mean * mean, variance, 0).astype(np.float32)
