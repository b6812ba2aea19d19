"""The temporal prior: what a map leaves, what it costs, when it is forgotten, and that maps come out the same again."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from rig.estimate.joint import temporal
from rig.estimate.joint.joint import Joint
from rig.estimate.joint.labels.grid import label_grid
from rig.estimate.joint.temporal import FREE, MOST, SLOPE, TemporalPrior
from rig.geometry.stripe_table import StripeTable
from rig.threads import RowWorkers
from tests.reference.scene import procedural_scene
from tests.reference.tables.moving import Disc, measure
from tests.stability.inventory import covers
from tests.unit.small_maps import assert_same, simulated

covers(temporal)

WORKERS = RowWorkers(2)
ROWS, COLUMNS = 32, 96


def volume_at(seed: int):
    return simulated(exposures=1, seed=seed).volume


@cache
def geometry():
    return simulated(exposures=1).geometry


@cache
def sequence():
    """Tables of three maps with the prior, and the states that they were estimated with."""
    estimator = Joint(2, temporal_prior=True)
    found = []
    for seed in (1, 2, 3):
        found.append((estimator.estimate(volume_at(seed), geometry()), estimator.used))
    return found


def told(confidence: float) -> tuple[TemporalPrior, StripeTable]:
    """A prior that was left a map with stripes 40 labels from the far end, of one confidence."""
    at = geometry()
    grid = label_grid(at)
    x_px = (grid.x_far - grid.side * 20.0).astype(np.float32)
    table = replace(StripeTable.empty(ROWS, COLUMNS), x_px=x_px, confidence=np.full_like(x_px, confidence))
    prior = TemporalPrior(True)
    prior.begin(at, grid)
    prior.leave(table, grid)
    prior.begin(at, grid)
    return prior, table


def added(prior: TemporalPrior, volume) -> np.ndarray:
    """What the prior adds to costs that are even, and such that the most it may add just fits a byte."""
    cost = 255 - MOST
    out = np.full((ROWS, COLUMNS, label_grid(geometry()).labels), cost, np.uint8)
    prior.add(volume, 0, ROWS, out)
    return out.astype(int) - cost


@pytest.mark.parametrize(("confidence", "most"), [(1.0, MOST), (0.75, round(MOST / 2)), (0.5, 0)])
def test_labels_far_from_the_last_one_cost_more_up_to_what_its_confidence_allows(confidence, most):
    prior, table = told(confidence)
    more = added(prior, volume_at(1))
    away = np.abs(np.arange(more.shape[2]) - 40)
    expected = np.minimum(SLOPE * np.maximum(away - FREE, 0), most)
    for y, c in np.argwhere(np.isfinite(table.x_px)):
        np.testing.assert_array_equal(more[y, c], expected)
    assert not more[np.isnan(table.x_px)].any()


def test_behind_a_map_without_frames_and_at_another_geometry_there_is_no_prior():
    plain = replace(sequence()[0][1], before=None)
    alone = Joint(2, plain).estimate(volume_at(2), geometry())
    without_frames = replace(volume_at(1), n_frames=np.zeros(COLUMNS, np.int32))
    for first, then in ((without_frames, geometry()), (volume_at(1), replace(geometry()))):
        estimator = Joint(2, plain, temporal_prior=True)
        estimator.estimate(first, geometry())
        assert_same(estimator.estimate(volume_at(2), then), alone)
        assert estimator.used.before is None


def test_what_stands_still_is_found_better_from_one_exposure():
    plain = replace(sequence()[0][1], before=None)
    means = {}
    for on in (False, True):
        estimator = Joint(2, plain, temporal_prior=on)
        tables = [estimator.estimate(volume_at(seed), geometry()) for seed in range(1, 4)]
        errors = [simulated(exposures=1, seed=seed).errors(tables[seed - 1].x_px) for seed in (2, 3)]
        means[on] = np.mean([np.minimum(error, 10).mean() for error in errors])
    assert means[True] < means[False]


@pytest.mark.long
def test_what_moves_is_not_held_back():
    without, prior = measure(procedural_scene(64, 512), Disc(albedo=0.1), exposures=1, maps=3)
    for part, more_px in (("disc", 0.01), ("uncovered", 0.03), ("all", 0.0)):
        assert without.parts[part].sum() > 30
        assert prior.mean_px(part) <= without.mean_px(part) + more_px, part
