"""The joint estimator on small maps: the same bits always, missing data stay missing, and answers that are good."""

from dataclasses import fields, replace
from functools import cache

import numpy as np
import pytest

from rig.estimate.joint import confidence, lesson, solver, tables
from rig.estimate.joint.joint import Joint
from rig.estimate.joint.labels.grid import PER_PX, label_grid
from rig.estimate.registry import recalling
from rig.estimate.row.model import RowModel
from rig.geometry.stripe_table import StripeTable
from tests.reference.geometry import Geometry
from tests.reference.scene import Scene
from tests.reference.working_point import POINTS, WorkingPoint
from tests.stability.inventory import covers
from tests.unit.small_maps import assert_same, geometry_of, simulated, street, volume_of

pytestmark = pytest.mark.slow

covers(confidence, lesson, solver, tables, Joint)


@cache
def estimated(light="report", exposures=3, rig="left") -> tuple[StripeTable, RowModel]:
    """The first map of a sweep and the state it was estimated with."""
    sweep, estimator = simulated(light, exposures, rig), Joint(2)
    return estimator.estimate(sweep.volume, sweep.geometry), estimator.used


def test_a_state_that_was_kept_gives_the_same_bits_whatever_came_between():
    sweep, other, (wanted, used) = simulated(exposures=3), simulated(exposures=3, seed=2), estimated()
    kept = RowModel.from_arrays(used.arrays())
    again = recalling("joint", [kept])
    assert_same(again.estimate(sweep.volume, sweep.geometry), wanted)
    between = again.estimate(other.volume, other.geometry)
    assert np.nanmax(np.abs(between.x_px - wanted.x_px)) > 0.01
    assert_same(again.estimate(sweep.volume, sweep.geometry), wanted)
    assert again.used is kept


def test_columns_without_frames_have_no_answer_and_those_beside_them_do():
    sweep, (_, used) = simulated(exposures=3), estimated()
    frames = np.full(96, 3)
    frames[[0, 40, 41, 42, 95]] = 0
    counts = np.where(frames[:, None, None] > 0, sweep.counts, 0).astype(np.uint8)
    found = recalling("joint", [used]).estimate(volume_of(counts, sweep.geometry, frames), sweep.geometry)
    for field in fields(StripeTable):
        values = getattr(found, field.name)
        if values is not None:
            missing = values[:, frames == 0]
            assert not missing.any() if field.name.startswith("confidence") else np.isnan(missing).all()
    beside = np.zeros(96, bool)
    beside[[1, 39, 43, 94]] = True
    scored = sweep.point.trusted & beside
    # The outermost ones have a neighbour on one side only, and that one is at the picture's border.
    assert np.mean(np.abs(found.x_px - sweep.point.x_true)[scored] <= 1) > 0.85


@pytest.mark.parametrize(
    ("light", "shares", "error", "again"),
    [
        ("dense", (0.03, 0.43), 0.1, True),  # answers that agree on a wrong place
        ("dense", (0.43, 0.03), 0.1, True),
        ("dense", (0.3, 0.4), 0.1, False),
        ("dense", (0.3, 0.4), 0.3, True),
        ("clear", (0.03, 0.43), 0.3, False),
    ],
)
def test_lessons_begin_again_by_contrast_if_fog_may_have_hidden_the_stripes(monkeypatch, light, shares, error, again):
    given, alone = [*shares, 0.5, 0.5, 0.5], []

    def taught(self, volume, intensity, geometry, model, witness_px):
        return model, given.pop(0), error

    monkeypatch.setattr(Joint, "_taught", taught)
    monkeypatch.setattr(solver.MapSolver, "by_contrast", lambda *_: alone.append(True) or np.zeros(1))
    sweep = simulated(light, 3)
    Joint(1).estimate(sweep.volume, sweep.geometry)
    assert bool(alone) == again


LIMITS = {("report", 3, "turned"): 0.3, ("dense", 10, "left"): 0.4, ("clear", 3, "left"): 0.3}
"""Mean error in px, cut off at 10, that so few rows and columns allow."""


@pytest.mark.parametrize(("light", "exposures", "rig"), LIMITS)
def test_errors_are_small_on_every_rig(light, exposures, rig):
    sweep, (found, _) = simulated(light, exposures, rig), estimated(light, exposures, rig)
    assert np.minimum(sweep.errors(found.x_px), 10).mean() < LIMITS[light, exposures, rig]


def test_lines_that_leave_the_picture_are_not_believed_at_its_edge(monkeypatch):
    # Planes to both sides of what the camera sees: most of their search lies beside the sensor, the rest is dark.
    monkeypatch.setattr("tests.reference.geometry.TANGENTS", (-0.6, 0.9))
    g = Geometry.build(height=32, columns=96, side="right")
    point = WorkingPoint(street(32), POINTS["clear"], g)
    sweep = volume_of(point.counts(5, 1), geometry_of(g), 5)
    found = Joint(2).estimate(sweep, geometry_of(g))
    at_edge = ~np.isfinite(point.truth()) & ((found.x_px < 1.0) | (found.x_px > 510.0))
    assert at_edge.mean() > 0.05
    assert np.mean(found.confidence[at_edge] > 0.5) < 0.02


def test_room_of_a_map_is_not_carried_to_one_of_another_size():
    small, large = simulated(exposures=3, rows=20), simulated(exposures=3)
    estimator = Joint(2, estimated()[1], learns=False)
    wanted = estimator.estimate(large.volume, large.geometry)
    model = estimator.used
    estimator.model = replace(model, row_gain=model.row_gain[:20], ambient=model.ambient[:20])
    assert estimator.estimate(small.volume, small.geometry).x_px.shape == (20, 96)
    estimator.model = model
    assert_same(estimator.estimate(large.volume, large.geometry), wanted)


@pytest.mark.parametrize(("rig", "depth_m"), [({}, 1.6), ({"side": "right", "roll_deg": 5.0}, 4.0)])
def test_a_wall_has_one_label_over_all_columns_and_rows(rig, depth_m):
    wall = np.full((24, 512), depth_m, np.float32)
    g = Geometry.build(height=24, columns=60, **rig)
    seen = WorkingPoint(Scene("wall", wall, np.ones_like(wall), np.ones(wall.shape, bool)), geometry=g)
    geometry = geometry_of(g)
    grid = label_grid(geometry)
    label = PER_PX * grid.side * (grid.x_far - seen.x_true)
    there = np.isfinite(label)
    assert there.mean() > 0.2
    assert np.ptp(label[there]) < 0.1
    assert np.all((label[there] >= 0) & (label[there] < grid.stripes))
    # Disparity from the far end.
    near_m, far_m = geometry.depth_range_m
    assert near_m < depth_m < far_m
    lateral = np.cos(np.deg2rad(rig.get("roll_deg", 0.0)))
    assert label[there].mean() / PER_PX == pytest.approx(600 * 0.3 * (1 / depth_m - 1 / far_m) / lateral, rel=0.01)
