"""Ambient light and dark counts of every pixel, from dark frames, pixels behind stripes and sums over columns.

For each pixel both are constant during a sweep. So the counts summed over all columns show hot pixels, whatever the
scene: over the whole sweep they fire far more often than their neighbours. If there are few counts, the estimate is
drawn towards the mean of the pixels around.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from rig.count.volume import FrameTally
from rig.estimate.row.likelihood import FLUX_MAX
from rig.geometry.windows import SweepGeometry
from rig.simd import Float32, Float64

NEIGHBOURHOOD_PX = 31
"""Side of the square of pixels whose mean a pixel is drawn to."""
DEFECT_FLUX = float(FLUX_MAX)
"""Ambient light assumed for pixels that must not be used: if they are expected to fire always, they favour nothing."""
HOT_SIGMA = 6.0
"""Excess over the neighbours, in standard deviations, above which a pixel is hot: 1e-9 of good pixels exceed it."""


def ambient_map(
    tally: FrameTally, intensity: NDArray[np.uint32], geometry: SweepGeometry, quiet: Float64 | None
) -> Float32:
    """Ambient light and dark counts of each pixel in photons per exposure, (rows, width).

    intensity: (rows, width), ones of each pixel while inside the stored window. quiet: (2, rows, width), ones and
    exposures of each pixel while clearly behind the stripe; None before any stripe is known. With several lines it is
    not used. quiet[0] may be negative if the expected light of a halo has been subtracted.
    """
    ones = np.zeros((geometry.rows, geometry.width))
    exposures = np.zeros_like(ones)
    if tally.dark_counts is not None:
        ones += tally.dark_counts
        exposures += tally.n_dark if tally.dark_frames is None else tally.dark_frames
    # With several lines, a pixel behind one line's stripe may be lit by another line.
    if quiet is not None and geometry.others is None:
        ones += np.maximum(quiet[0], 0.0)
        exposures += quiet[1]
    totals = np.stack([intensity, np.broadcast_to(_window_exposures(tally, geometry), intensity.shape)])
    if exposures.sum() < ones.size:
        level = _lowest_level(totals)
        base = np.full(ones.shape, level)
    else:
        base = _shrunk(ones, exposures)
    ambient: Float32 = np.maximum(base, hot_pixels(totals)).astype(np.float32)
    ambient[geometry.defects] = DEFECT_FLUX
    return ambient


def _window_exposures(tally: FrameTally, geometry: SweepGeometry) -> NDArray[np.uint32]:
    """Exposures of each pixel of a row while it lay within the stored window (width,)."""
    reached = int(geometry.x0.max(initial=0)) + geometry.window
    change = np.zeros(max(geometry.width, reached) + 1, np.int64)
    np.add.at(change, geometry.x0, tally.n_frames)
    np.add.at(change, geometry.x0 + geometry.window, -tally.n_frames)
    return np.cumsum(change)[: geometry.width].astype(np.uint32)


def _lowest_level(totals: NDArray[np.uint32]) -> float:
    """A level below which hardly any pixel lies: half the flux at the 2nd percentile of the rates, at least 1e-5."""
    seen = totals[1] > 0
    if not seen.any():
        return 1e-5
    rate = np.minimum((totals[0][seen] + 0.5) / (totals[1][seen] + 1.0), 0.999)
    return float(max(-np.log1p(-np.percentile(rate, 2.0)) * 0.5, 1e-5))


def _shrunk(ones: Float64, exposures: Float64) -> Float64:
    """Flux of each pixel, drawn to the local mean, more if pixels are alike (empirical Bayes). Outliers stay."""
    row_rates = ones.sum(1)[exposures.sum(1) > 0] / exposures.sum(1)[exposures.sum(1) > 0]
    overall = max(float(np.median(row_rates)), 1e-6)
    mean = np.full(ones.shape, overall)
    for _ in range(2):
        # Hot pixels must not lift their neighbourhood: they take no part in the mean.
        usual = ones <= mean * exposures + 4.0 * np.sqrt(mean * exposures) + 4.0
        local_ones, local_exposures = (
            cv2.blur(np.where(usual, a, 0.0), (NEIGHBOURHOOD_PX, NEIGHBOURHOOD_PX), borderType=cv2.BORDER_REFLECT)
            for a in (ones, exposures)
        )
        # Neighbourhoods without data take the picture's level.
        mean = np.maximum(local_ones + overall, 0.0) / (local_exposures + 1.0)
    expected = mean * exposures
    outlier = ones > expected + 4.0 * np.sqrt(expected) + 4.0
    usual = ~outlier & (exposures > 0)
    # Variance between pixels beyond that of counting, as the shape of a gamma prior: mean^2 / variance.
    spread = float(np.sum(((ones - expected) ** 2 - expected)[usual]) / max(np.sum(expected[usual] ** 2), 1e-9))
    prior_counts = 1.0 / min(max(spread, 1e-3), 1.0)
    rate = (ones + prior_counts) / (exposures + prior_counts / np.maximum(mean, 1e-7))
    rate = np.where(outlier, ones / np.maximum(exposures, 1.0), rate)
    return np.asarray(-np.log1p(-np.minimum(rate, 0.9999)))


def hot_pixels(totals: NDArray[np.uint32]) -> Float64:
    """Excess flux (rows, width) of pixels far above their neighbours over the whole sweep, 0 elsewhere.

    totals: (2, rows, width), ones and exposures of each pixel while inside the stored window.
    """
    ones, exposures = totals[0].astype(np.float64), totals[1].astype(np.float64)
    rate = np.minimum(ones / np.maximum(exposures, 1.0), 1.0).astype(np.float32)
    around = cv2.medianBlur(rate, 5).astype(np.float64)
    expected = around * exposures
    excess = ones - expected
    # Once in the sweep a stripe that is brighter here than beside may cross the pixel: allow half as much light again
    # as expected, or half of the median pixel's if that is less.
    hot = excess > HOT_SIGMA * np.sqrt(expected + 1.0) + 0.5 * expected.clip(max=np.median(expected))
    excess_rate = np.clip(excess / np.maximum(exposures, 1.0), 0.0, 0.9999)
    return np.where(hot & (exposures > 0), -np.log1p(-excess_rate), 0.0)
