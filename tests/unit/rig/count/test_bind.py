import dataclasses
import itertools

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from calibration.model.rig_model import Lag
from drivers.errors import ProtocolError
from drivers.frames import SUBFRAME_SHIFT, Mark
from rig.count import sweeps
from rig.count.bind import FrameBinder, _fit
from rig.count.bind_kernels import cover
from rig.count.volume import BIN_DARK, BIN_UNUSABLE
from rig.errors import PlanError
from tests.stability.inventory import covers
from tests.unit.rig.count.streams import Stream, plan_of, scan, scanner_limits, stream_of

covers(cover, sweeps)


def bind(plan, blocks):
    binder = FrameBinder(plan)
    bound, clocks = [], []
    for block in blocks:
        places, closed = binder.bind(block)
        bound.append(places)
        clocks += closed
    merged = {name: np.concatenate([getattr(b, name) for b in bound]) for name in ("sweep", "column", "bins")}
    return merged, clocks


def placed_one_by_one(plan, blocks, clocks):
    """Sweep, column and bin of each frame by the rule alone: one after the other, each from the latest marker.

    clocks: what the binder found, of which the ratios are taken.
    """
    ratios = {clock.sweep + 1: 1 + clock.clock_error for clock in clocks if clock.synchronised and clock.markers > 2}
    ratio, running, anchor, used, found = 1.0, -1, None, [], []
    for block in blocks:
        header = block.header
        for record, tick in zip(block.records, block.start_ticks, strict=True):
            sweep, line, marks = int(record["sweep"]) - 1, int(record["line"]), int(record["marks"])
            while running < sweep:
                running, used = running + 1, []
                ratio = ratios.get(running, ratio)
            time = (int(tick) - blocks[0].header.t0_ticks) * 512
            numbered = marks & Mark.LINE and 1 <= line <= len(plan.marker_points)
            if (numbered or marks & Mark.SCAN) and not marks & Mark.GATE_EDGE and sweep >= 0:
                edge = time + (2 * (marks >> 8 & 255) + 1) * header.frame_period_ticks
                anchor = edge, sweep * plan.sweep_points + (int(plan.marker_points[line - 1]) if numbered else 0)
            column = np.nan
            if anchor is not None and sweep >= 0:
                rate = float(plan.point_rate_hz / header.tick_hz / 512) * ratio
                since = (time + 256 * header.exposure_ticks - anchor[0]) * rate
                tau_s = (anchor[1] - sweep * plan.sweep_points + since) / float(plan.point_rate_hz)
                column = float(plan.column(tau_s, plan.leg(sweep)))
            found.append((sweep, column, placed_in(plan, sweep, column, marks, used)))
    return [np.array(values) for values in zip(*found, strict=True)]


def placed_in(plan, sweep, column, marks, used):
    """The bin of a frame behind those of its sweep that used columns, and notes it among them."""
    if np.isnan(column) or marks & (Mark.GATE_EDGE | Mark.WINDOW_LOST):
        return BIN_UNUSABLE
    if not marks & Mark.GATE_HIGH:
        return BIN_DARK
    nearest = int(np.floor(column + 0.5))
    left = used and (nearest < max(used) if plan.leg(sweep).columns_rise else nearest > min(used))
    full = plan.exposures <= 200 and used.count(nearest) >= 255
    if not 0 <= nearest < plan.columns or left or full:
        return BIN_UNUSABLE
    used.append(nearest)
    return nearest


def whole(stream: Stream, sizes=None, lost=()):
    return stream.blocks(sizes or itertools.repeat(64), lost)


@st.composite
def cases(draw):
    lag = Lag(draw(st.floats(0, 4e-4)), draw(st.floats(0, 4e-4)))
    first = draw(st.floats(-0.3, 0.3))
    width = draw(st.floats(0.001, 0.2)) * draw(st.sampled_from([1, -1]))
    config = scan(
        columns=draw(st.integers(1, 60)),
        exposures=draw(st.sampled_from([1, 2, 3, 7, 10, 40, 255, 300])),
        frame_rate=draw(st.sampled_from(["100 kHz", "50 kHz", "6.25 kHz"])),
        command_range=[first, first + width],
        bidirectional=draw(st.booleans()),
        dark_fraction=draw(st.sampled_from([0.05, 0.3])),
    )
    assume(config.columns * config.exposures <= 4000)
    fastest = draw(st.sampled_from([7e3, 25e3, 40.001e3, 65.535e3, 2e5]))
    limits = scanner_limits(velocity_per_s=1e6, acceleration_per_s2=1e10, point_rate_hz=(1e3, fastest))
    try:
        plan = plan_of(config, lag, limits)
    except PlanError:
        assume(False)
        raise
    errors = st.floats(-1e-4, 1e-4)
    stream = stream_of(
        plan,
        3,
        lag=lag,
        clock_error=draw(errors),
        gate_error=draw(errors),
        latency_s=draw(st.floats(1e-5, 1e-3)),
        exposure_ticks=draw(st.sampled_from([None, 700])),
    )
    return plan, stream


@pytest.mark.long
@settings(max_examples=60, deadline=None)
@given(cases())
def test_every_column_gets_its_exposures_and_the_column_is_where_the_mirror_is(case):
    plan, stream = case
    bound, clocks = bind(plan, whole(stream))
    first, last = plan.command_range
    true_column = (stream.mirror - first) / ((last - first) / plan.columns) - 0.5
    on_column = bound["bins"] >= 0
    assert np.abs(bound["column"] - true_column)[on_column].max() < 0.05
    # A marker that shares its frame with a gate edge is not used, so these clocks may miss a few.
    assert [clock.sweep for clock in clocks] == [0, 1, 2]
    assert all(clock.synchronised for clock in clocks)
    for sweep in range(3):
        n = np.bincount(bound["bins"][on_column & (bound["sweep"] == sweep)], minlength=plan.columns)
        assert np.abs(n - plan.exposures).max() <= 1
        dark = np.count_nonzero((bound["bins"] == BIN_DARK) & (bound["sweep"] == sweep))
        assert dark >= 0.05 * np.count_nonzero(bound["sweep"] == sweep) - 1


@settings(max_examples=25, deadline=None)
@given(cases(), st.lists(st.integers(1, 300), min_size=1, max_size=5), st.randoms(use_true_random=False), st.booleans())
def test_every_frame_is_where_the_rule_puts_it_to_the_last_bit(case, sizes, rng, disturbed):
    plan, stream = case
    n = len(stream.records)
    lost = [rng.randrange(n) for _ in range(rng.randrange(20))]
    begin = rng.randrange(n)
    lost += range(begin, min(n, begin + rng.randrange(n // 2)))
    if disturbed:
        for frame in (rng.randrange(n) for _ in range(n // 100)):
            stream.records["marks"][frame] ^= np.uint32(1 << rng.randrange(16))
            stream.records["line"][frame] = rng.randrange(plan.columns + 4)
    blocks = whole(stream, itertools.cycle(sizes), lost)
    assume(blocks)
    bound, clocks = bind(plan, blocks)
    sweep, column, bins = placed_one_by_one(plan, blocks, clocks)
    # A damaged line marker shifts the time by which a later sweep is judged to have begun. That time is only asked
    # where no frame behind in the same block confirms the sweep, or where sweeps seem to be missing.
    left_out = disturbed & (bound["bins"] == BIN_UNUSABLE) & np.isnan(bound["column"]) & (bound["sweep"] != sweep)
    last = np.isin(np.arange(len(sweep)), np.cumsum([block.n_frames for block in blocks]) - 1)
    assert (sweep > bound["sweep"])[left_out].all()
    assert (last | (sweep > bound["sweep"] + 1))[left_out].all()
    assert left_out.mean() <= 0.1
    for name, expected in (("sweep", sweep), ("column", column), ("bins", bins)):
        np.testing.assert_array_equal(bound[name][~left_out], expected[~left_out])


def test_a_point_that_is_marked_twice_tells_nothing_of_the_clock():
    error, residual, markers = _fit(np.array([7, 7]), np.array([0, 900]), 1.0, 5.0)
    assert (error, markers) == (0.0, 2)
    assert np.isnan(residual)


@pytest.mark.parametrize("error", [-9e-5, 0.0, 1.1e-4])
def test_the_ratio_of_the_clocks_is_found_and_used_in_the_next_sweep(error):
    plan = plan_of(scan(columns=300, exposures=10))
    stream = stream_of(plan, 2, clock_error=error)
    _, clocks = bind(plan, whole(stream))
    for clock in clocks:
        assert clock.clock_error == pytest.approx(error, abs=2e-6)
        assert clock.residual_columns < 0.002


def test_lost_frames_leave_the_others_where_they_were():
    plan = plan_of(scan())
    stream = stream_of(plan, 3, clock_error=5e-5)
    lost = [*range(30, 45), *range(stream.scan_frames[1] - 8, stream.scan_frames[1] + 9)]
    complete, clocks = bind(plan, whole(stream))
    gappy, gappy_clocks = bind(plan, whole(stream, lost=lost))
    kept = np.setdiff1d(np.arange(len(stream.records)), lost)
    np.testing.assert_array_equal(gappy["bins"], complete["bins"][kept])
    np.testing.assert_array_equal(gappy["sweep"], complete["sweep"][kept])
    np.testing.assert_allclose(gappy["column"], complete["column"][kept], atol=0.01)
    # The second scan marker was among the lost frames: its frame number follows from the scanner's clock.
    assert [(c.first_frame, c.end_frame) for c in gappy_clocks] == [(c.first_frame, c.end_frame) for c in clocks]


def test_a_sweep_that_was_lost_whole_is_still_counted():
    plan = plan_of(scan())
    stream = stream_of(plan, 4)
    lost = range(stream.scan_frames[1] - 5, stream.scan_frames[2] + 7)
    _, clocks = bind(plan, whole(stream, lost=lost))
    assert [c.sweep for c in clocks] == [0, 1, 2, 3]
    frames = [c.first_frame for c in clocks] + [clocks[-1].end_frame]
    assert np.abs(np.array(frames) - stream.scan_frames[:5]).max() <= 1
    assert not clocks[1].synchronised


def test_a_stray_marker_position_or_a_wrong_direction_level_flags_the_sweep():
    plan = plan_of(scan(columns=40, exposures=1))
    stream = stream_of(plan, 2)
    line = np.flatnonzero(stream.records["marks"] & Mark.LINE)[2]
    marks = int(stream.records["marks"][line])
    stream.records["marks"][line] = (marks & 0xFF) | (((marks >> 8) + 100) % 256 << 8)
    _, clocks = bind(plan, whole(stream))
    assert [clock.synchronised for clock in clocks] == [False, True]
    assert clocks[0].residual_columns > 0.05
    stream.records["marks"] ^= np.uint32(Mark.BACKWARD)
    assert not any(clock.synchronised for clock in bind(plan, whole(stream))[1])


def test_counters_of_16_bits_run_over_without_harm():
    plan = plan_of(scan(columns=5))
    stream = stream_of(plan, 3)
    expected, _ = bind(plan, whole(stream))
    counted = stream.records["sweep"].astype(np.int64)
    shifted = []
    for block in whole(stream):
        at = block.header.first_frame
        block.records["sweep"] = (counted[at : at + block.n_frames] + 65534) & 0xFFFF
        header = dataclasses.replace(block.header, sweep=int(counted[at]) + 65534)
        shifted.append(dataclasses.replace(block, header=header))
    bound, clocks = bind(plan, shifted)
    lit = expected["bins"] >= 0
    np.testing.assert_array_equal(bound["bins"][lit], expected["bins"][lit])
    assert [c.sweep for c in clocks][-3:] == [65534, 65535, 65536]


@pytest.mark.parametrize("bit", [0, 1, 5, 15])
@pytest.mark.parametrize("at", [1, 12, 105, 250, 251, 400])
def test_one_flipped_bit_of_a_sweep_number_costs_no_more_than_its_frame(bit, at):
    plan = plan_of(scan())
    stream = stream_of(plan, 5)
    wanted, clocks = bind(plan, whole(stream))
    stream.records["sweep"][at] ^= np.uint16(1 << bit)
    found, same_clocks = bind(plan, whole(stream))
    others = np.arange(len(stream.records)) != at
    for name in ("sweep", "bins"):
        differ = np.flatnonzero((found[name] != wanted[name]) & others)
        # Without the very first marker the frames up to the next one cannot be placed.
        assert differ.size <= (at == 12), name
    assert len(same_clocks) == len(clocks)
    for clock, whole_clock in zip(same_clocks, clocks, strict=True):
        assert abs(clock.end_frame - whole_clock.end_frame) <= 1
        assert abs(clock.first_frame - whole_clock.first_frame) <= 1


def test_a_stream_that_names_wrong_sweeps_on_and_on_is_an_error():
    plan = plan_of(scan(columns=200))
    stream = stream_of(plan, 4)
    stream.records["sweep"][700:] += np.uint16(5)
    with pytest.raises(ProtocolError, match=r"name sweeps that cannot have begun .*check the scan marker's line"):
        bind(plan, whole(stream))


def test_a_scan_marker_beside_a_gate_edge_does_not_say_where_in_its_frame_it_is():
    plan = plan_of(scan())
    stream = stream_of(plan, 3)
    first = int(np.flatnonzero(stream.records["marks"] & Mark.SCAN)[1])
    assert bind(plan, whole(stream))[1][0].synchronised
    stream.records["marks"][first] ^= np.uint16(0x80 << SUBFRAME_SHIFT | Mark.GATE_EDGE)
    assert bind(plan, whole(stream))[1][0].synchronised


@pytest.mark.parametrize("late", [-3, 3])
def test_markers_that_contradict_the_gate_flag_the_sweep(late):
    plan = plan_of(scan(exposures=8))
    stream = stream_of(plan, 2)
    assert [clock.unlit for clock in bind(plan, whole(stream))[1]] == [0, 0]
    gate = np.uint32(Mark.GATE_HIGH | Mark.GATE_EDGE)
    stream.records["marks"] = stream.records["marks"] & ~gate | np.roll(stream.records["marks"] & gate, late)
    _, clocks = bind(plan, whole(stream))
    assert [clock.unlit > 0 for clock in clocks] == [True, True]
    assert not any(clock.synchronised for clock in clocks)
