"""Several lines: which column is lit when, where its plane was, what is counted for it, and what a plan says."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.model.rig_model import Lag
from rig.count.volume import BIN_DARK, BIN_UNUSABLE, LineCounter, SweepCounter, SweepLayout
from rig.depth.depth import share_claims
from rig.errors import PlanError
from rig.geometry import line_grid as line_grid_module
from rig.geometry.line_grid import LineGrid, line_grid, window_overlap
from rig.geometry.stripe_table import StripeTable
from rig.geometry.windows import sweep_geometry
from rig.plan.calibration_reach import recalibrated
from rig.plan.compile import compile_plan
from rig.plan.describe import plan_text
from rig.plan.scan_plan import ScanPlan
from rig.recording.inputs import from_plain, to_plain
from rig.threads import RowWorkers
from tests.stability.inventory import covers
from tests.unit.rig.count.streams import NO_LAG, SPAD, plan_of, rig_model, scan, scanner_limits, timer_clock
from tests.unit.rig.count.test_volume import packed, stream

covers(line_grid_module)

OFFSETS = (-0.3, -0.1, 0.1, 0.3)


def plan_with(offsets, lag=NO_LAG, **changes):
    return compile_plan(scan(**changes), scanner_limits(), timer_clock, rig_model(lag), SPAD, offsets)


@settings(max_examples=60, deadline=None)
@given(
    lines=st.integers(1, 8),
    places=st.integers(1, 40),
    ends=st.sampled_from([(-0.1, 0.1), (0.1, -0.1)]),
    apart=st.floats(0.1, 0.2),
)
def test_every_column_is_lit_once_by_one_line_and_stands_in_the_order_of_the_sweep(lines, places, ends, apart):
    offsets = [apart * line for line in range(lines)]
    grid, commands = line_grid(offsets, lines * places, ends)
    assert grid.places == places
    assert sorted(grid.columns_at().ravel().tolist()) == list(range(lines * places))
    mirror = ends[0] + (grid.place + 0.5) * (ends[1] - ends[0]) / places
    np.testing.assert_allclose(commands, mirror + np.array(offsets)[grid.line], atol=1e-12)
    assert np.all(np.diff(commands) * grid.step >= 0)


def test_lines_that_tile_the_field_have_the_columns_of_a_single_one():
    one = plan_of(scan(command_range=[-0.4, 0.4], columns=40))
    four = plan_with(OFFSETS, command_range=[-0.1, 0.1], columns=40)
    np.testing.assert_allclose(four.commands, one.commands, atol=1e-12)
    assert np.array_equal(four.x0, one.x0)
    assert four.window == one.window
    assert (four.columns, four.places, four.column_s, four.points_per_column) == (
        40, 10, one.column_s, one.points_per_column,
    )  # fmt: skip
    assert four.speed_per_s == pytest.approx(one.speed_per_s)
    assert four.map_rate_hz > 2 * one.map_rate_hz


@pytest.mark.parametrize("ends", [(-0.1, 0.1), (0.1, -0.1)])
def test_bound_columns_say_where_each_line_stood(ends):
    plan = plan_with(OFFSETS, Lag(1e-4, 3e-4), command_range=ends, columns=40, bidirectional=True)
    grid = plan.lines
    for leg in plan.legs:
        tau = np.linspace(leg.gate_open_s, leg.gate_close_s, 23)
        at = plan.column(tau, leg)
        mirror = leg.path.command((tau - leg.lag_s) * float(plan.point_rate_hz))
        for place, command in zip(at, mirror, strict=True):
            column = np.arange(40) + (place - grid.place)
            np.testing.assert_allclose(
                plan.line_commands(column), command + np.array(grid.offsets)[grid.line], atol=1e-9
            )


def test_several_lines_use_whole_rows_of_a_sensor_whose_windows_would_move():
    wide = dataclasses.replace(SPAD, width=512)
    camera = dataclasses.replace(rig_model().camera, width=512)
    model = dataclasses.replace(rig_model(), camera=camera)
    plan = compile_plan(scan(command_range=[-0.1, 0.1]), scanner_limits(), timer_clock, model, wide, OFFSETS)
    assert plan.windows is None
    assert plan.used_px is None


def test_lines_outside_the_calibration_are_refused():
    with pytest.raises(PlanError, match=r"scanner command -1\.3 lies outside the calibrated range"):
        plan_with((-0.9, 0.0, 0.9), command_range=[-0.4, 0.4], columns=21)


def test_a_plan_with_lines_says_so_is_read_back_and_one_without_is_written_as_before():
    plan = plan_with(OFFSETS, command_range=[-0.1, 0.1], columns=40)
    text = plan_text(plan)
    assert "10 x 4 frames at 100 kHz, 40 us each, for 4 lines at once: 40 columns" in text
    assert "of a column's window is other lines' too" in text
    assert "lines" not in plan_text(plan_of(scan()))
    again = from_plain(ScanPlan, to_plain(plan))
    assert again.lines.offsets == OFFSETS
    assert again.lines.overlap == plan.lines.overlap
    assert np.array_equal(again.lines.columns_at(), plan.lines.columns_at())
    assert recalibrated(again, rig_model()).lines.overlap == plan.lines.overlap
    before = to_plain(plan_of(scan()))
    assert "lines" not in before
    assert from_plain(ScanPlan, before).lines is None


def test_the_overlap_is_the_share_of_a_window_that_other_windows_cover():
    grid, commands = line_grid(OFFSETS, 40, (-0.1, 0.1))
    model = rig_model()
    geometry = sweep_geometry(model, commands, (1.0, 8.0))
    shares = []
    for c in range(40):
        others = [o for o in grid.columns_at()[grid.place[c]] if o != c]
        for y in range(geometry.rows):
            own = set(range(geometry.x_lo[y, c], geometry.x_hi[y, c] + 1))
            taken = set().union(*(range(geometry.x_lo[y, o], geometry.x_hi[y, o] + 1) for o in others))
            shares.append((len(own & taken), len(own)))
    covered, whole = np.sum(shares, axis=0)
    assert 0 < window_overlap(grid, geometry) == pytest.approx(covered / whole)


@pytest.mark.parametrize("n", [3, 700])
def test_lines_are_counted_as_if_each_had_the_frames_to_itself(n):
    rows, width, places, lines, window = 5, 150, 3, 2, 64
    frames, bins, column = stream(3, n, rows, width, places)
    bins = np.sort(bins) if n > 600 else bins  # more frames of a place than counters of eight bits hold
    grid = LineGrid((0.0, 1.0), 1.0, np.array([0, 1, 0, 1, 0, 1], np.int32), np.array([0, 0, 1, 1, 2, 2], np.int32))
    x0 = np.array([0, 64, 64, 128, 0, 128], np.int32)
    layout = SweepLayout(6, rows, width, x0, window, 1)
    bits, nowhere = packed(frames), np.zeros(n, np.int32)
    with RowWorkers(2) as workers:
        counter = LineCounter(layout, grid, workers)
        for part in (slice(0, n // 2), slice(n // 2, n)):
            counter.add(bits[part], bins[part], column[part], nowhere[part])
        found = counter.finish()
        for line in range(lines):
            of_line = grid.columns_at()[:, line]
            alone = SweepCounter(SweepLayout(places, rows, width, x0[of_line], window, 1), workers)
            alone.add(bits, bins, column, nowhere)
            expected = alone.finish()
            assert np.array_equal(found.counts[of_line], expected.counts)
            assert found.counts.dtype == expected.counts.dtype
            assert np.array_equal(found.n_frames[of_line], expected.n_frames)
            np.testing.assert_allclose(
                found.column[of_line] - of_line, expected.column - np.arange(places), atol=1e-12, equal_nan=True
            )
    assert found.n_dark == np.count_nonzero(bins == BIN_DARK)
    assert np.array_equal(found.dark_counts, frames[bins == BIN_DARK].sum(axis=0))
    assert np.any(bins == BIN_UNUSABLE)


def test_answers_that_take_the_same_stripe_share_what_they_are_worth():
    grid, _ = line_grid((0.0, 1.0, 2.0), 6, (0.0, 1.0))  # columns 0 2 4 and 1 3 5 are of the same frames
    table = StripeTable.empty(1, 6)
    table.x_px[0] = [10.0, 10.5, 11.0, 30.0, 60.0, np.nan]
    table.confidence[0] = [0.9, 0.8, 0.3, 0.7, 0.6, 0.0]
    shared = share_claims(table, grid)
    np.testing.assert_allclose(shared.confidence[0], [0.9 * 0.75, 0.8, 0.3 * 0.25, 0.7, 0.6, 0.0], rtol=1e-6)
    assert shared.x_px is table.x_px
    assert shared.confidence.dtype == np.float32
