import dataclasses
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from calibration.errors import CalibrationError
from calibration.model.rig_model import Lag
from drivers.interfaces import (
    LEVEL_BACKWARD,
    MARKER_LINE,
    MARKER_SCAN,
    OUT_GATE,
    BurstMode,
    StreamMode,
    slices,
)
from drivers.interfaces.scanner import check_waveform
from rig.errors import PlanError
from rig.plan.calibration_reach import model_problems, require_speed
from rig.plan.compile import compile_plan, spad_request
from rig.plan.gate_pulses import sync_program
from rig.plan.mirror_path import remedy
from tests.stability.inventory import covers
from tests.unit.rig.count.streams import SPAD, plan_of, rig_model, scan, scanner_limits, timer_clock

covers(remedy, model_problems)

GALVO = scanner_limits(
    velocity_per_s=500, acceleration_per_s2=2e6, step=0.2, rms_duty=0.5, max_points=20_000, point_rate_hz=(2e3, 65_535)
)


@settings(max_examples=60, deadline=None)
@given(
    columns=st.integers(1, 600),
    exposures=st.integers(1, 300),
    first=st.floats(-1, 1),
    last=st.floats(-1, 1),
    bidirectional=st.booleans(),
    dark=st.floats(0.05, 0.5),
    lag=st.tuples(st.floats(0, 4e-4), st.floats(0, 4e-4)),
)
def test_a_plan_keeps_every_promise_or_is_refused_with_a_remedy(
    columns, exposures, first, last, bidirectional, dark, lag
):
    assume(abs(first - last) > 1e-4)
    config = scan(
        columns=columns,
        exposures=exposures,
        command_range=[first, last],
        bidirectional=bidirectional,
        dark_fraction=dark,
    )
    try:
        plan = plan_of(config, Lag(*lag), GALVO)
    except PlanError as error:
        refused = error.problems
    else:
        refused = ()
        assert_promises_kept(plan, dark)
    assert all("; " in line for line in refused)


def assert_promises_kept(plan, dark):
    check_waveform(plan.waveform, GALVO, plan.point_rate_hz, seamless=True)
    assert plan.dark_fraction >= dark - 1e-12
    assert len(plan.waveform.command) == plan.sweep_points * len(plan.legs)
    rate = float(plan.point_rate_hz)
    for leg in plan.legs:
        start, end = (point / rate for point in leg.path.cruise)
        # Command and mirror are both at constant velocity while the gate is open.
        assert start + leg.lag_s <= leg.gate_open_s
        assert leg.gate_close_s <= end
        columns_at = plan.column(np.array([leg.gate_open_s, leg.gate_close_s]), leg)
        assert columns_at.min() < -0.5
        assert columns_at.max() > plan.columns - 0.5
        ends = np.array([0, plan.columns - 1])
        mirror_at = np.array([plan.command_at(c) for c in ends])
        np.testing.assert_allclose(mirror_at, plan.commands[ends])
    highs = np.flatnonzero(plan.waveform.markers & MARKER_LINE)
    assert np.diff(highs).min(initial=4) >= 4
    assert_scan_marker_holds_the_gate(plan)


def assert_scan_marker_holds_the_gate(plan):
    """It rises where a sweep begins and falls within the last slice of the gate, with room for both clocks' errors."""
    high = (plan.waveform.markers & MARKER_SCAN != 0).reshape(len(plan.legs), plan.sweep_points)
    for leg, levels in zip(plan.legs, high, strict=True):
        fall = int(np.argmin(levels))
        assert fall > 0
        assert levels[:fall].all()
        assert not levels[fall:].any()
        lit_s = leg.gate_close_s - leg.gate_open_s
        slice_s, point_s = lit_s / slices(lit_s), 1 / float(plan.point_rate_hz)
        assert abs(leg.gate_close_s - slice_s / 2 - fall * point_s) <= point_s + 1e-12


@pytest.mark.parametrize("bidirectional", [False, True])
def test_the_command_crosses_the_columns_at_constant_velocity(bidirectional):
    plan = plan_of(scan(columns=21, exposures=5, bidirectional=bidirectional, command_range=[0.3, -0.2]), limits=GALVO)
    for sweep in range(2):
        leg = plan.leg(sweep)
        begin_s = sweep * float(plan.sweep_s) + float(leg.path.lit_start / plan.point_rate_hz)
        centres = begin_s + (np.arange(21) + 0.5) * float(plan.column_s)
        commands = plan.commands if leg.columns_rise else plan.commands[::-1]
        np.testing.assert_allclose(plan.command(centres), commands, atol=1e-12)


def test_a_falling_sweep_has_the_lag_and_the_level_of_falling_commands():
    plan = plan_of(scan(command_range=[0.2, -0.2]), Lag(1e-4, 3e-4))
    assert plan.legs[0].lag_s == 3e-4
    assert (plan.waveform.markers & LEVEL_BACKWARD).all()
    assert plan.commands[0] > plan.commands[-1]


@pytest.mark.parametrize(("exposures", "fastest"), [(1, 65_535), (50, 5000)])
def test_line_markers_come_as_often_as_the_point_clock_allows(exposures, fastest):
    limits = dataclasses.replace(GALVO, point_rate_hz=(2e3, fastest))
    plan = plan_of(scan(columns=40, exposures=exposures, command_range=[0, 0.01]), limits=limits)
    needed = max(4 / float(plan.points_per_column), 2 / exposures)
    assert needed <= plan.columns_per_marker < needed + 1
    path = plan.legs[0].path
    points = plan.marker_points[plan.marker_points <= path.lit_start + path.lit_points]
    edges = (points - float(path.lit_start)) / float(plan.points_per_column)
    steps = np.arange(len(edges)) * plan.columns_per_marker
    np.testing.assert_allclose(edges, steps, atol=1.01 / float(plan.points_per_column))


@pytest.mark.parametrize(("bidirectional", "maps"), [(False, 3), (True, 4), (True, 3)])
def test_the_gate_program_opens_once_per_map_and_waits_with_the_gate_low(bidirectional, maps):
    plan = plan_of(scan(bidirectional=bidirectional), Lag(1e-4, 3e-4))
    pulses, repeats = sync_program(plan, maps)
    played = [pulse for _ in range(repeats) for pulse in pulses]
    waits = [pulse for pulse in played if pulse.duration_s is None]
    gates = [pulse for pulse in played if pulse.outputs & OUT_GATE]
    assert len(waits) == len(gates) == maps
    assert not any(pulse.outputs for pulse in waits)
    assert all(pulse.held for pulse in gates)
    # Between two waits the program must outlast the marker, or a level trigger would fall through.
    marker_points = np.count_nonzero(plan.waveform.markers[: plan.sweep_points] & MARKER_SCAN)
    assert sum(p.duration_s for p in pulses[1:4]) > (marker_points + 1) / float(plan.point_rate_hz)
    assert plan.scanner_repeats(maps) * len(plan.legs) >= maps + 1


def test_the_remedy_for_a_scan_that_is_too_fast_works():
    config = scan(columns=200, exposures=1, command_range=[-0.8, 0.8])
    with pytest.raises(PlanError, match=r"raise scan\.exposures to \d+ or narrow scan\.command_range to") as caught:
        plan_of(config, Lag(1e-4, 1e-4), GALVO)
    message = str(caught.value)
    exposures = int(message.split("scan.exposures to ")[1].split(" ")[0])
    low, high = (float(x) for x in message.split("command_range to [")[1].split("]")[0].split(", "))
    plan_of(scan(columns=200, exposures=exposures, command_range=[-0.8, 0.8]), Lag(1e-4, 1e-4), GALVO)
    plan_of(scan(columns=200, exposures=1, command_range=[low, high]), Lag(1e-4, 1e-4), GALVO)
    with pytest.raises(PlanError):
        plan_of(scan(columns=200, exposures=exposures - 1, command_range=[-0.8, 0.8]), Lag(1e-4, 1e-4), GALVO)


def test_everything_that_does_not_fit_is_listed_at_once():
    spad = dataclasses.replace(SPAD, max_frame_rate_hz=Fraction(50_000), width=128)
    slow = dataclasses.replace(GALVO, velocity_per_s=1)
    model = rig_model(speed_range_per_s=(10.0, 20.0))
    with pytest.raises(PlanError) as caught:
        compile_plan(scan(), slow, timer_clock, model, spad)
    lines = str(caught.value).splitlines()
    assert len(lines) == 4
    for words in ("50 kHz", "64 x 4 pixels", "calibrated at", "it can do"):
        assert sum(words in line for line in lines) == 1, words


@pytest.mark.parametrize(
    ("exposures", "shown"), [(1, "1,10"), (4, "3,4"), (30, "3,30")], ids=["faster", "between", "slower"]
)
def test_a_speed_that_was_not_calibrated_names_the_command_that_measures_the_lag_there(exposures, shown):
    """Calibrated with 3 and 10 exposures, or with 3 alone; a sweep of one exposure takes 600 /s."""
    slowest = 3 if exposures == 4 else 10
    model = rig_model(speed_range_per_s=(0.95 * 600 / slowest, 1.05 * 600 / 3))
    with pytest.raises(CalibrationError, match=f"rig calibrate sync CONFIG --calibration FILE --exposures {shown}$"):
        require_speed(model, 600 / exposures, exposures)
    require_speed(model, 600 / 3, 3)
    with pytest.raises(PlanError, match=r"rig calibrate sync CONFIG --calibration FILE --exposures \d+,\d+"):
        compile_plan(scan(), GALVO, timer_clock, rig_model(speed_range_per_s=(1e-3, 2e-3)), SPAD)


def test_more_points_than_the_scanner_holds_lower_the_point_clock():
    few = dataclasses.replace(GALVO, max_points=1000)
    plan = plan_of(scan(columns=500, exposures=10), limits=few)
    assert 900 < len(plan.waveform.command) <= 1000
    with pytest.raises(PlanError, match=r"needs \d+ points at the slowest .* of 2000 Hz, the scanner holds 50"):
        plan_of(scan(columns=500, exposures=10), limits=dataclasses.replace(GALVO, max_points=50))


@pytest.mark.parametrize(("most_hz", "kept"), [(80_000, "lower frame_rate to 50 kHz"), (40_000, "does is 40 kHz")])
def test_of_two_limits_of_the_frame_rate_only_the_stricter_is_named(most_hz, kept):
    spad = dataclasses.replace(SPAD, stream=StreamMode(2.4e6), max_frame_rate_hz=Fraction(most_hz))
    with pytest.raises(PlanError, match=rf"\A[^\n]*{kept}[^\n]*\Z"):
        plan_of(scan(), spad=spad)


def test_a_spad_that_cannot_stream_fast_enough_takes_bursts():
    spad = dataclasses.replace(SPAD, stream=StreamMode(1e6), burst=BurstMode(1000, 4.8e5))
    plan = plan_of(scan(), spad=spad)
    assert spad_request(scan(), plan).mode == "burst"
    assert plan.readout_s(100) == pytest.approx(0.01)
    small = dataclasses.replace(spad, burst=BurstMode(50, 4.8e5))
    with pytest.raises(PlanError, match="memory holds 50"):
        plan_of(scan(), spad=small)


@pytest.mark.parametrize(
    ("rate", "height", "frames"), [("100 kHz", 4, 500), ("100 kHz", 8192, 255), ("300 Hz", 4, 2), ("100 Hz", 4, 1)]
)
def test_a_block_holds_five_milliseconds_of_frames_and_at_most_sixteen_mebibytes(rate, height, frames):
    tall = dataclasses.replace(SPAD, height=height)
    config = scan(frame_rate=rate)
    plan = compile_plan(config, scanner_limits(), timer_clock, None, tall)
    assert spad_request(config, plan).block_frames == frames
