"""Costs of labels from their surroundings: against sums written out, and that they know no medium."""

from dataclasses import replace

import numpy as np
import pytest

from rig.estimate.joint.labels import contrast as module
from rig.estimate.joint.labels.contrast import (
    BESIDE_PX,
    LEAST_ONES,
    MOST_SHARE,
    REACH_PX,
    ROWS,
    WHOLE,
    contrast_of,
    share_of,
)
from rig.estimate.joint.labels.contrast import cost_contrast as fill
from rig.estimate.joint.labels.cost_rows import COST_LIMIT, EXCLUDED
from rig.estimate.joint.labels.costs import costs_of
from rig.estimate.joint.labels.grid import LABEL, LABEL_END, PER_PX, VARIANT, label_grid
from rig.estimate.row.model import pixel_shares
from rig.threads import RowWorkers
from tests.stability.inventory import covers
from tests.unit.rig.estimate.joint.test_label_volume import known_model
from tests.unit.small_maps import simulated

covers(module)

SIGMA_PX = 0.7


def costs_written_out(volume, width, grid, place, units, y, c):
    """Costs of a row's labels; NaN for those that cannot be."""
    counts, frames, window = volume.counts[c].astype(float), volume.n_frames[c], volume.counts.shape[2]
    scores = np.full(grid.stripes, np.nan)
    near_rows = counts[max(y - ROWS, 0) : y + ROWS + 1]
    for label in range(place[c, y, LABEL], place[c, y, LABEL_END]):
        x = round((grid.x_far[y, c] - grid.side * label / PER_PX) * 8) / 8 - volume.x0[c]
        # Half way between two pixels the one nearer to the scanner has it.
        t = int(np.floor(x + 0.5)) if grid.side < 0 else int(np.ceil(x - 0.5))
        if not 0 <= t < window:  # what was not stored
            scores[label] = 0.0
            continue
        if t >= width - volume.x0[c]:
            continue
        pixels = np.arange(min(window, width - volume.x0[c]))
        w = pixel_shares(SIGMA_PX, np.arange(t - REACH_PX, t + REACH_PX + 1) - x).astype(float)
        inside = (np.arange(t - REACH_PX, t + REACH_PX + 1) >= 0) & (np.arange(t - REACH_PX, t + REACH_PX + 1) < window)
        w /= w.sum()
        n = np.where(inside, counts[y, np.clip(np.arange(t - REACH_PX, t + REACH_PX + 1), 0, window - 1)], 0.0)
        beside = (abs(pixels - t) >= BESIDE_PX[0]) & (abs(pixels - t) <= BESIDE_PX[1])
        p0 = max(near_rows[:, pixels[beside]].sum(), LEAST_ONES) / (near_rows.shape[0] * beside.sum() * frames)
        p0 = min(p0, MOST_SHARE)
        p = min(max((w * n).sum() / frames, p0), MOST_SHARE)
        pooled = frames / np.square(w).sum()
        scores[label] = pooled * (p * np.log(p / p0) + (1 - p) * np.log((1 - p) / (1 - p0)))
    return np.minimum((np.nanmax(scores, initial=0.0) - scores) * units, COST_LIMIT)


@pytest.mark.parametrize(("rig", "padding"), [("left", 0), ("right", 0), ("right", 9)])
def test_costs_are_those_written_out_and_mix_with_others(rig, padding):
    swept = simulated("halo", 10, rig=rig)
    volume, geometry, grid = swept.volume, swept.geometry, label_grid(swept.geometry)
    width, counts = geometry.width - padding, swept.volume.counts.copy()
    if padding:
        # Without light in the last pixels no label behind them has a score.
        counts[volume.x0[:, None, None] + np.arange(counts.shape[2]) + np.zeros_like(counts, int) >= width - 5] = 0
        volume = replace(volume, counts=counts)
    costs = costs_of(known_model(geometry), geometry, grid, 10, RowWorkers(1))
    contrast = contrast_of(costs, SIGMA_PX, width)
    alone, mixed = (np.full((geometry.rows, geometry.columns, grid.labels), 100, np.uint8) for _ in range(2))
    alone[:, :, 7] = mixed[:, :, 7] = EXCLUDED
    for first, last in ((0, 20), (20, geometry.rows)):
        fill(volume, contrast, first, last, alone, 0)
        fill(volume, contrast, first, last, mixed, share_of(1.0))
    checked = 0
    for y in (0, 5, 19, 20, 31):
        for c in range(0, geometry.columns, 7):
            if costs.place[c, y, VARIANT] < 0:
                continue
            wanted = costs_written_out(volume, width, grid, costs.place, costs.units_per_nat, y, c)
            given = np.flatnonzero(np.isfinite(wanted) & (np.arange(grid.stripes) != 7))
            assert np.abs(alone[y, c, given] - wanted[given]).max() < 1.01, (y, c)
            assert (mixed[y, c, given] == (alone[y, c, given].astype(int) + 101) // 2).all()
            checked += len(given)
    assert checked > 5000
    assert (alone[:, :, 7] == EXCLUDED).all()


def test_nothing_and_everything_have_finite_costs():
    swept = simulated("halo", 10)
    volume, geometry, grid = swept.volume, swept.geometry, label_grid(swept.geometry)
    costs = costs_of(known_model(geometry), geometry, grid, 10, RowWorkers(1))
    for value in (0, 10):
        counts = np.full_like(volume.counts, value)
        cost = np.zeros((geometry.rows, geometry.columns, grid.labels), np.uint8)
        same = replace(volume, counts=counts)
        fill(same, contrast_of(costs, SIGMA_PX, geometry.width), 0, geometry.rows, cost, 0)
        assert cost.max() == 0, "no label is better than another"


def test_a_hot_pixel_changes_no_cost_of_the_rows_around_it():
    swept = simulated("halo", 10)
    volume, geometry, grid = swept.volume, swept.geometry, label_grid(swept.geometry)
    costs = costs_of(known_model(geometry), geometry, grid, 10, RowWorkers(1))
    y, x, rows = 15, int(volume.x0.min()) + 30, geometry.rows
    hot_start = np.repeat([0, 1], [y + 1, rows - y]).astype(costs.tables.hot_start.dtype)
    hot = contrast_of(costs, SIGMA_PX, geometry.width)._replace(
        hot_start=hot_start, hot_x=np.array([x], costs.tables.hot_x.dtype)
    )
    filled = []
    for level in (0, 10):
        counts = volume.counts.copy()
        for c in range(geometry.columns):
            if 0 <= x - volume.x0[c] < counts.shape[2]:
                counts[c, y, x - volume.x0[c]] = level
        filled.append(np.full((rows, geometry.columns, grid.labels), 100, np.uint8))
        fill(replace(volume, counts=counts), hot, 0, rows, filled[-1], 0)
    np.testing.assert_array_equal(*filled)


def test_less_believed_medium_has_a_smaller_share():
    assert share_of(1.0) == WHOLE // 2
    assert share_of(0.0) == 0
    assert 0 < share_of(0.1) < share_of(0.5) < WHOLE // 2
