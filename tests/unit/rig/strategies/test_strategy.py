"""Geometry of columns and the registry: depth and column are inverse, and names lead to one strategy or one line."""

from dataclasses import replace
from importlib.metadata import EntryPoint

import numpy as np
import pytest

from calibration.model.light_sheet import depth as exact_depth
from rig.errors import UsageError
from rig.strategies import strategy as module
from rig.strategies.line_scan import JOINT
from rig.strategies.strategy import ColumnGeometry, Strategy, find_strategy, strategy_names
from tests.stability.inventory import covers
from tests.unit.rig.strategies.plain_scene import COLUMNS, RANGE_M, plain_geometry, plain_rig

covers(ColumnGeometry)


def test_depth_and_column_are_inverse_to_each_other():
    geometry = plain_geometry()
    true_m = np.random.default_rng(2).uniform(*RANGE_M, geometry.shape)
    column = geometry.column_of(true_m)
    seen = np.isfinite(column)
    assert seen.mean() > 0.5
    np.testing.assert_allclose(geometry.depth_m(column)[seen], true_m[seen], rtol=1e-5)
    assert np.isnan(geometry.depth_m(np.full(geometry.shape, np.nan))).all()


def test_columns_are_those_of_the_light_planes():
    geometry = plain_geometry()
    column = np.full(geometry.shape, 40.0)
    planes = geometry.model.planes(geometry.commands[40])
    expected = exact_depth(geometry.u, geometry.v, planes)
    found = geometry.depth_m(column)
    both = np.isfinite(found)
    assert both.any()
    np.testing.assert_allclose(found[both], expected[both], rtol=1e-4)
    between = exact_depth(geometry.u, geometry.v, geometry.model.planes(geometry.commands[40:42].mean()))
    half = geometry.depth_m(column + 0.5)
    both = np.isfinite(half)
    np.testing.assert_allclose(half[both], between[both], rtol=1e-3)


def test_feasible_columns_bound_every_depth_of_the_range():
    geometry = plain_geometry()
    for depth_m in (1.0, 2.0, 5.0, 10.0):
        column = geometry.column_of(np.full(geometry.shape, depth_m))
        seen = np.isfinite(column)
        assert np.all(column[seen] >= geometry.first[seen] - 0.51)
        assert np.all(column[seen] <= geometry.last[seen] + 0.51)
    assert np.all(
        np.isnan(geometry.depth_m(np.where(geometry.first <= geometry.last, geometry.first - 30.0, 0.0))[0, :5])
    )


def test_rows_are_those_of_the_picture():
    model = plain_rig()
    some = np.array([3, 4, 9])
    geometry = ColumnGeometry(model, plain_geometry().commands, RANGE_M, some)
    np.testing.assert_array_equal(geometry.v, plain_geometry().v[some])
    assert geometry.sweep().x_lo.shape == (3, COLUMNS)


@pytest.mark.parametrize(
    ("commands", "rows", "said"),
    [([0.1], [0, 1], "at least 2"), ([0.0, 0.1], [1, 1], "ascend"), ([0.0, 0.1], [40], "31"), ([0.0, 0.1], [], "rows")],
)
def test_what_cannot_be_is_refused_in_one_line(commands, rows, said):
    with pytest.raises(UsageError, match=said):
        ColumnGeometry(plain_rig(), commands, RANGE_M, np.array(rows, np.int64))


def test_every_name_leads_to_a_strategy_that_has_it():
    names = strategy_names()
    assert len(names) >= 30
    assert all(find_strategy(name).name == name for name in names)
    assert all(isinstance(find_strategy(name), Strategy) for name in names)


STRIPED = replace(JOINT, name="striped", light="stripes")


def test_unknown_broken_and_doubled_names_are_said_in_one_line(monkeypatch):
    group = module.GROUP
    entries = [
        EntryPoint("gone", "rig.strategies.nowhere:X", group),
        EntryPoint("twice", "rig.strategies.line_scan:JOINT", group),
        EntryPoint("twice", "rig.strategies.line_scan:EDGE", group),
        EntryPoint("other", "rig.strategies.line_scan:JOINT", group),
        EntryPoint("number", "math:pi", group),
        EntryPoint("class", "fractions:Fraction", group),
        EntryPoint("striped", f"{__name__}:STRIPED", group),
    ]
    monkeypatch.setattr(module, "added", lambda group: entries)
    problems = {
        "gone": "cannot be loaded",
        "twice": "offered twice",
        "other": "calls itself",
        "number": "is no rig.strategies.strategy.Strategy, but without clear_px, light, ",
        "class": "but a class, where an instance is needed",
        "xyz": "no strategy is named 'xyz'; choose one of: class, gone, number, other, striped, twice; or install",
        "the": "similar ones are other; or install",
        "twise": "similar ones are twice; or install",
        "striped": "one of spot",
    }
    for name, said in problems.items():
        with pytest.raises(UsageError, match=said) as error:
            find_strategy(name)
        assert "\n" not in str(error.value)
