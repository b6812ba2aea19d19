"""An estimator: the centroid of the light above the row's median, around the brightest three pixels.

It knows nothing of fog, so it is wrong where haze is brighter than the stripe. Confidence: with n pixels in the window,
excess counts s of noise d = sqrt(s + 5 b) over 5 pixels of background b, the odds that the brightest place is chance
are taken as n exp(-(s/d)^2 / 2).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rig.count.volume import Counter, CountVolume, SweepCounter, SweepLayout
from rig.estimate.registry import EstimatorKind
from rig.geometry.stripe_table import StripeTable
from rig.geometry.windows import SweepGeometry
from rig.threads import RowWorkers

REACH_PX = 2
LINE_SD_PX = 0.7
"""Assumed width of the laser line, for the standard deviation of a position."""


@dataclass(frozen=True, slots=True)
class Centroid:
    """The estimator. It learns nothing, so maps do not depend on each other."""

    threads: int
    used: None = None

    def counter(self, layout: SweepLayout, geometry: SweepGeometry) -> Counter:
        """A counter of whole sweeps."""
        return SweepCounter(layout, RowWorkers(self.threads))

    def estimate(self, sweep: CountVolume, geometry: SweepGeometry) -> StripeTable:
        """Stripe table of one sweep, (rows, columns)."""
        table = StripeTable.empty(geometry.rows, geometry.columns)
        for column in np.flatnonzero(sweep.n_frames > 0):
            _fill(table, int(column), sweep, geometry)
        return table


def _fill(table: StripeTable, column: int, sweep: CountVolume, geometry: SweepGeometry) -> None:
    """Write the answers of one column into the table."""
    exposures, first = int(sweep.n_frames[column]), int(sweep.x0[column])
    counts = sweep.counts[column].astype(np.float64)
    x = first + np.arange(counts.shape[1])
    inside = (x >= geometry.x_lo[:, column, None]) & (x <= geometry.x_hi[:, column, None])
    usable = inside.copy()
    seen = x < geometry.defects.shape[1]
    usable[:, seen] &= ~geometry.defects[:, x[seen]]
    rows = np.flatnonzero(inside.any(axis=1))
    if not rows.size:
        return
    counts, inside, usable = counts[rows], inside[rows], usable[rows]
    background = np.nanmedian(np.where(inside, counts, np.nan), axis=1)
    excess = np.where(usable, counts - background[:, None], 0.0)
    peak = np.where(inside, _sum_around(excess, 1), -np.inf).argmax(axis=1)
    near = np.abs(np.arange(len(x)) - peak[:, None]) <= REACH_PX
    weight = np.where(near & inside, np.maximum(excess, 0.0), 0.0)
    light = weight.sum(axis=1)
    moment = (weight * (x - x[peak][:, None])).sum(axis=1)
    noise = np.sqrt(light + 5 * background + 1e-9)
    chance = inside.sum(axis=1) * np.exp(-0.5 * np.minimum((light / noise) ** 2, 200.0))
    before = near_side(inside, peak, geometry.near_is_left)
    haze = np.where(before, counts, 0.0).sum(axis=1) / np.maximum(before.sum(axis=1), 1) / exposures
    flux = -np.log1p(-np.minimum(weight / exposures, 1 - 0.5 / exposures)).sum(axis=1)
    table.x_px[rows, column] = x[peak] + moment / np.maximum(light, 1e-9)
    table.confidence[rows, column] = 1 / (1 + chance)
    table.x_sd_px[rows, column] = np.sqrt((LINE_SD_PX**2 + 1 / 12) / np.maximum(light, 0.1))
    table.signal[rows, column] = flux
    table.haze[rows, column] = -np.log1p(-np.minimum(haze, 1 - 0.5 / exposures))


def near_side(inside: NDArray[np.bool_], peak: NDArray[np.intp], near_is_left: bool) -> NDArray[np.bool_]:
    """Pixels of the window in front of each peak, up to ten away. (rows, window)."""
    ahead = peak[:, None] - np.arange(inside.shape[1])
    ahead = ahead if near_is_left else -ahead
    return inside & (ahead > REACH_PX) & (ahead <= REACH_PX + 10)


def _sum_around(values: NDArray[np.float64], reach: int) -> NDArray[np.float64]:
    """Sums over the pixels at most `reach` away, along each row."""
    padded = np.pad(values, ((0, 0), (reach, reach)))
    parts = [padded[:, k : k + values.shape[1]] for k in range(2 * reach + 1)]
    return np.asarray(np.sum(parts, axis=0))


KIND = EstimatorKind(create=Centroid)
