"""Mirror paths, plans and blanking patterns over all that a config can ask for: finite, exact, within limits."""

import dataclasses
import itertools
import math
from fractions import Fraction
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from calibration.errors import CalibrationError
from calibration.model.rig_model import RigModel
from drivers.interfaces import LEVEL_BACKWARD, ScanWaveform
from drivers.scanners.galvo import brake, ramp
from rig.count.blanking import PatternSearch, PatternShape, detection_probability
from rig.errors import PlanError
from rig.plan import waveform
from rig.plan.calibration_reach import require_speed
from rig.plan.compile import compile_plan, path_demand
from rig.plan.gate_pulses import sync_program
from rig.plan.mirror_path import (
    MirrorLimits,
    PathDemand,
    PathSegment,
    SweepPath,
    find_path,
    mirrored,
    narrowed,
    sweep_path,
)
from rig.plan.scan_plan import Blanking, ScanPlan, blanking_for, column_command
from rig.plan.waveform import moving_windows, window_widths
from sim_backend.mirror_motion import Playing, resting
from tests.stability.inventory import EXAMPLES, covers
from tests.unit.rig.count.light import blanked_plan
from tests.unit.rig.count.streams import plan_of, scan, scanner_limits

COMMAND = st.floats(-1, 1)
LIMITS = st.builds(
    lambda v, a, step, duty: scanner_limits(velocity_per_s=v, acceleration_per_s2=a, step=step, rms_duty=duty),
    st.floats(1, 1e5), st.floats(1e3, 1e9), st.floats(1e-3, 2), st.floats(0.05, 1),
)  # fmt: skip
RATE = st.floats(1e3, 1e5)


@covers(ramp)
@EXAMPLES
@given(start=COMMAND, end=COMMAND, limits=LIMITS, rate=RATE)
def test_ramps_end_where_they_should_within_limits(start, end, limits, rate) -> None:
    assume(math.sqrt(2 / limits.acceleration_per_s2) * rate < 1e5)
    way = ramp(start, end, limits, rate)
    if start == end:
        assert way.size == 0
        return
    steps = np.diff(way, prepend=start)
    assert way[-1] == end
    assert np.abs(steps).max() <= min(limits.step, limits.velocity_per_s / rate) + 1e-15
    assert np.all(steps * np.sign(end - start) >= -1e-15)


@covers(brake)
@EXAMPLES
@given(at=COMMAND, velocity=st.floats(-1e5, 1e5) | st.sampled_from([0.0, 5e-324, -1e-300]), limits=LIMITS, rate=RATE)
def test_brakes_come_to_rest_inside_the_range(at, velocity, limits, rate) -> None:
    assume(abs(velocity) / limits.acceleration_per_s2 * rate < 1e5)
    way = brake(at, velocity, limits, rate)
    assert np.isfinite(way).all()
    assert np.all(np.abs(way) <= 1)
    steps = np.abs(np.diff(way))
    assert np.all(np.diff(steps) <= 1e-12)


@covers(PathSegment.command, SweepPath.command, SweepPath.rms_acceleration, MirrorLimits, sweep_path)
@EXAMPLES
@given(
    edges=st.tuples(COMMAND, COMMAND), lit_s=st.fractions(Fraction(1, 10**4), Fraction(1, 4)),
    margin=st.floats(0, 1e-2), velocity=st.floats(10, 1e5), acceleration=st.floats(1e4, 1e9),
    rate=st.fractions(Fraction(5000), Fraction(10**5)), fly_back=st.booleans(), least=st.integers(0, 1000),
)  # fmt: skip
def test_sweeps_are_smooth_and_lit_at_constant_velocity(
    edges, lit_s, margin, velocity, acceleration, rate, fly_back, least
) -> None:
    assume(abs(edges[1] - edges[0]) > 1e-9)
    path = sweep_path(
        edges, lit_s, margin, MirrorLimits(velocity, acceleration, rate), fly_back=fly_back, least_points=least
    )
    for way in (path, mirrored(path)):
        command = way.command(np.arange(way.points, dtype=float))
        span = way.high - way.low
        assert np.isfinite(command).all()
        assert np.all((command >= way.low - 1e-12 * span) & (command <= way.high + 1e-12 * span))
        at = float(way.lit_start) + np.linspace(0, 1, 9) * float(way.lit_points)
        slope = np.diff(way.command(at))
        assert np.abs(slope - slope.mean()).max() <= 1e-9 * abs(slope.mean()) + 1e-15
    assert path.command(np.array([float(path.lit_start)]))[0] == pytest.approx(edges[0], abs=1e-9)
    assert path.command(np.array([float(path.lit_start + path.lit_points)]))[0] == pytest.approx(edges[1], abs=1e-9)
    assert np.isfinite(path.rms_acceleration)


@covers(narrowed)
@EXAMPLES
@given(edges=st.tuples(COMMAND, COMMAND), share=st.floats(0, 1), low=COMMAND, high=COMMAND)
def test_narrowed_ranges_lie_inside_the_scanner_s(edges, share, low, high) -> None:
    low, high = min(low, high), max(low, high)
    first, last = narrowed(edges, share, (low, high))
    assert abs(last - first) == pytest.approx(share * abs(edges[1] - edges[0]), abs=1e-12)
    if share * abs(edges[1] - edges[0]) <= high - low:
        assert min(first, last) >= low - 1e-12
        assert max(first, last) <= high + 1e-12


@st.composite
def plans(draw):
    first = draw(st.floats(-0.3, 0.3))
    config = scan(
        columns=draw(st.sampled_from([1, 2, 500, 4000])),
        exposures=draw(st.sampled_from([1, 3, 10, 255, 65_535])),
        frame_rate=draw(st.sampled_from(["100 kHz", "97.7 kHz", "100000/3 Hz", "10 Hz"])),
        command_range=[first, first + draw(st.floats(1e-4, 0.3)) * draw(st.sampled_from([1, -1]))],
        bidirectional=draw(st.booleans()),
        dark_fraction=draw(st.sampled_from([0.05, 0.5])),
    )
    assume(config.columns * config.exposures / config.frame_rate < 2)
    try:
        return plan_of(config, limits=scanner_limits(velocity_per_s=1e6, acceleration_per_s2=1e10))
    except PlanError:
        assume(False)
        raise


@covers(require_speed)
@EXAMPLES
@given(
    speed=st.floats(0, 1e6), ends=st.lists(st.floats(0, 1e6), min_size=2, max_size=2), exposures=st.integers(1, 10**6)
)
def test_a_speed_that_was_not_calibrated_comes_with_exposures_that_can_be_scanned(speed, ends, exposures) -> None:
    low, high = sorted(ends)
    model = SimpleNamespace(speed_range_per_s=(low, high))
    model.check_speed = lambda asked: RigModel.check_speed(model, asked)
    if low <= speed <= high:
        require_speed(model, speed, exposures)
        return
    with pytest.raises(CalibrationError, match="rig calibrate sync") as refused:
        require_speed(model, speed, exposures)
    advised = [int(number) for number in str(refused.value).rsplit(" ", 1)[1].split(",")]
    assert len(advised) == 2
    assert exposures in advised
    assert 1 <= min(advised) < max(advised) <= 1000 * exposures + 1


@covers(
    ScanPlan, column_command, PathDemand, find_path, sync_program, compile_plan, path_demand, waveform, window_widths
)
@EXAMPLES
@given(plan=plans())
def test_plans_are_exact_in_time_and_finite_in_all_their_figures(plan) -> None:
    for name, kind in vars(ScanPlan).items():
        if isinstance(kind, property):
            value = getattr(plan, name)
            assert value is None or (math.isfinite(value) and value >= 0), name
    assert plan.frames_per_sweep == plan.sweep_points / plan.point_rate_hz * plan.frame_rate_hz
    assert plan.column_s * plan.columns <= plan.sweep_s
    for leg in plan.legs:
        column = np.linspace(-0.5, plan.columns - 0.5, 33)
        tau = (column + 0.5) * float(plan.column_s)
        tau = plan.lit_start_s(leg) + (tau if leg.columns_rise else plan.columns * float(plan.column_s) - tau)
        assert np.abs(plan.column(tau, leg) - column).max() < 1e-6
        assert leg.gate_open_s < plan.lit_start_s(leg) < leg.gate_close_s
        assert plan.pattern_s(leg) <= leg.gate_open_s
    two_days = plan.command(np.array([0.0, 48 * 3600.0, -1.0]))
    assert np.isfinite(two_days).all()
    assert np.all(np.abs(two_days) <= 1)
    assert np.isnan(plan.command_at(np.array([np.nan]))).all()
    assert plan.command_at(np.arange(plan.columns)) == pytest.approx(plan.commands, abs=1e-12)
    for maps in (1, 2, 10**9):
        assert plan.frames_for(maps) >= maps * float(plan.frames_per_sweep)
        assert plan.scanner_repeats(maps) * len(plan.legs) > maps
    pulses, repeats = sync_program(plan, 3)
    assert repeats >= 1
    assert all(pulse.duration_s is None or pulse.duration_s > 0 for pulse in pulses)
    assert plan.readout_s(10) >= 0
    assert plan.leg(10**9) in plan.legs
    assert not plan.window_x0(np.zeros(2, np.uint32), np.zeros(2, np.int64), np.array([-1, 0])).any() or plan.windows


@covers(Blanking, blanking_for, moving_windows)
@pytest.mark.parametrize("exposures", [4, 40, 300])
def test_blanking_patterns_lie_before_the_lit_part_in_order(exposures) -> None:
    plan = blanked_plan(exposures=exposures)
    assert plan.blanking is not None
    for i, leg in enumerate(plan.legs):
        times = np.array(plan.blanking.flashes_s(i)).ravel()
        assert np.all(np.diff(times) > 0)
        assert 0 <= times[0] < times[-1] <= plan.blanking.length_s + 1e-12
        assert plan.pattern_s(leg) + plan.blanking.length_s < leg.gate_open_s
    assert plan.blanking.lead_s > plan.blanking.length_s


SHAPE = PatternShape(np.array([[0.0, 1.3], [2.6, 6.5], [7.8, 9.1], [11.7, 13.0], [15.6, 19.5]]), 0.9)


@covers(PatternSearch, PatternShape, detection_probability)
@EXAMPLES
@given(
    level=st.sampled_from([0.0, 1e-3, 100.0, 262_144.0]), bright=st.sampled_from([0.0, 1.0, 500.0, 1e5]),
    place=st.floats(10, 15), lost=st.lists(st.integers(0, 59), max_size=60), flat=st.booleans(),
    seed=st.integers(0, 99),
)  # fmt: skip
def test_patterns_are_found_or_not_but_never_with_a_warning(level, bright, place, lost, flat, seed) -> None:
    frames = np.arange(60.0)
    mean = level + bright * SHAPE.shares(np.array([place]), frames)[0]
    ones = np.round(mean) if flat else np.random.default_rng(seed).poisson(mean).astype(float)
    ones[lost] = np.nan
    search = PatternSearch(SHAPE)
    score, like = search.scores(ones)
    gone = np.array([np.isnan(ones[i : i + search.window]).any() for i in range(len(score))])
    assert not np.isinf(score).any()
    assert np.isnan(score[gone]).all()
    assert not np.isnan(score[~gone]).any()
    assert not like[gone].any()
    found = search.measure(ones, 0, place, 3)
    if found is not None:
        assert all(math.isfinite(value) for value in dataclasses.astuple(found))
        assert found.sd > 0
        assert 0 <= detection_probability(found.score) <= 1
    if flat and bright >= 500 and not lost:
        assert found is not None
        assert found.place == pytest.approx(place, abs=0.1)


@covers(Playing, resting)
@EXAMPLES
@given(
    points=st.integers(1, 20), repeats=st.integers(1, 10**6), start=st.floats(0, 2e5), rate=st.floats(1e3, 1e5),
    lags=st.tuples(st.floats(0, 1e-3), st.floats(0, 1e-3)), seed=st.integers(0, 99),
)  # fmt: skip
def test_mirrors_stay_within_their_waveform_at_any_time(points, repeats, start, rate, lags, seed) -> None:
    rng = np.random.default_rng(seed)
    waveform = ScanWaveform(rng.uniform(-1, 1, points), rng.integers(0, 2, points).astype(np.uint8), Fraction(rate))
    motion = Playing(waveform, repeats, start, rate, *lags)
    assert motion.end_s > start
    times = np.concatenate([[start - 1, start, motion.end_s, motion.end_s + 1e6], rng.uniform(start, motion.end_s, 20)])
    mirror = motion.mirror(times)
    low, high = waveform.command.min(), waveform.command.max()
    assert np.all((mirror >= low - 1e-12) & (mirror <= high + 1e-12))
    assert not motion.backward(times[:1]).any()
    assert motion.moving(start)
    assert not motion.moving(motion.end_s)
    until = start + 3 * points / rate
    for bit in (1, LEVEL_BACKWARD):
        edges = motion.edges(bit, start, until)
        assert np.all((edges >= start) & (edges < until))
        assert np.all(np.diff(edges) > 0)
        first = motion.first_high(bit, start, until)
        assert first is None or start <= first < until
    still = resting(0.25)
    assert np.all(still.mirror(times) == 0.25)
    assert not any(itertools.chain(still.backward(times), still.edges(1, start, until)))
