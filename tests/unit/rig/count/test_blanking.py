"""Binding by the blanking pattern, against light that is made photon by photon (`tests/unit/rig/count/light.py`)."""

import dataclasses
import math
from itertools import pairwise

import numpy as np
import pytest

from drivers.errors import DeviceFault
from drivers.interfaces import OUT_GATE, BurstMode
from rig.count import blanking
from rig.count.bind import FrameBinder
from rig.count.volume import BIN_DARK
from rig.errors import PlanError
from rig.plan.gate_pulses import sync_program
from tests.stability.inventory import covers
from tests.unit.rig.count.light import blanked_plan, see
from tests.unit.rig.count.streams import SPAD, plan_of, scan

covers(blanking)


def bind(plan, blocks):
    binder = FrameBinder(plan)
    clocks, parts = [], []
    for block in blocks:
        bound, closed = binder.bind(block)
        clocks += closed
        parts.append((block.frame_numbers, bound.sweep, bound.column, bound.bins))
    return [np.concatenate(part) for part in zip(*parts, strict=True)], clocks


def error_of(plan, seen, bound, sweep):
    """Largest distance of the frames of a sweep from where the mirror was, in columns; checks their light besides."""
    frame, number, column, bins = bound
    here = number == sweep
    lit, dark = here & (bins >= 0), here & (bins == BIN_DARK)
    first, last = plan.command_range
    truth = (seen.mirror - first) / ((last - first) / plan.columns) - 0.5
    assert seen.share[frame[lit]].min() > 0.999
    assert seen.share[frame[dark]].max(initial=0) == 0
    return float(np.abs(column[lit] - truth[frame[lit]]).max())


CASES = {
    "daylight": ({}, {"brightness": 400, "level": 8000}),
    "few photons": ({"exposures": 50, "columns": 30}, {"brightness": 12, "level": 3}),
    "light that varies": ({}, {"scene": 0.6}),
    "both ways, downward": ({"bidirectional": True, "command_range": [0.3, -0.3]}, {"scanner_error": -2e-4}),
    "fast scanner": ({}, {"scanner_error": 9e-4, "brightness": 300}),
    "slow scanner": ({}, {"scanner_error": -9e-4, "brightness": 300}),
    "fast sync": ({}, {"sync_error": 9e-4, "brightness": 300}),
    "K = 1": ({"exposures": 1, "columns": 300}, {"brightness": 2000}),
    "short exposure": ({"exposure": "12 us"}, {}),
}


@pytest.mark.parametrize("name", CASES)
def test_frames_are_bound_to_columns_by_their_light_alone(name):
    changes, light = CASES[name]
    plan = blanked_plan(**changes)
    seen = see(plan, 3, **light)
    bound, clocks = bind(plan, seen.blocks())
    assert [clock.sweep for clock in clocks] == [0, 1, 2]
    for clock in clocks:
        assert clock.synchronised, clock
        assert error_of(plan, seen, bound, clock.sweep) < 0.06
        assert clock.detection > 0.5
        assert clock.clock_error == pytest.approx(light.get("scanner_error", 0.0), abs=1.5e-4)
        # From the frame on at which its pattern has passed: a sweep and no more.
        assert clock.end_frame - clock.first_frame == pytest.approx(float(plan.frames_per_sweep), abs=3)
        _, number, _, bins = bound
        counts = np.bincount(bins[(number == clock.sweep) & (bins >= 0)], minlength=plan.columns)
        assert np.abs(counts - plan.exposures).max() <= 1


def test_the_block_size_changes_nothing():
    plan = blanked_plan(bidirectional=True, columns=40)
    seen = see(plan, 2, scanner_error=2e-4)
    lost = [*range(1000, 1010), *range(2300, 2340)]
    once, clocks = bind(plan, seen.blocks(50, lost))
    for size in (1, 7, 10_000):
        again, same = bind(plan, seen.blocks(size, lost))
        assert repr(same) == repr(clocks)  # NaN is not itself
        for a, b in zip(once, again, strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("brightness", [1, 6, 15, 20, 25, 40])
@pytest.mark.parametrize("exposures", [2, 10])
def test_with_too_little_light_a_map_is_refused_or_flagged_never_silently_wrong(brightness, exposures):
    plan = blanked_plan(columns=60, exposures=exposures)
    seen = see(plan, 1, brightness=brightness, level=100, seed=brightness)
    try:
        bound, clocks = bind(plan, seen.blocks())
    except DeviceFault:
        return
    for clock in clocks:
        assert not clock.synchronised or error_of(plan, seen, bound, clock.sweep) < 0.12


def test_without_a_pattern_the_message_says_what_was_looked_for_and_what_to_do():
    plan = blanked_plan()
    with pytest.raises(DeviceFault) as caught:
        bind(plan, see(plan, 1, brightness=0).blocks())
    message = str(caught.value)
    assert "\n" not in message
    for words in ("pattern of 64 frames was not found twice, 118", "sigma at most, at frame", "gate cable", "picture"):
        assert words in message
    with pytest.raises(DeviceFault, match="scan marker at the sync source, and the clocks"):  # one alone
        bind(plan, see(plan, 1, brightness=300, scanner_error=5e-3).blocks())


def test_clocks_further_apart_than_a_crystal_may_be_are_flagged():
    plan = blanked_plan()
    _, clocks = bind(plan, see(plan, 2, brightness=300, scanner_error=1.4e-3).blocks())
    assert [clock.synchronised for clock in clocks] == [False, False]
    assert clocks[0].clock_error == pytest.approx(1.4e-3, abs=5e-5)


def test_a_pattern_that_was_lost_is_taken_from_the_others_and_the_sweep_before_it_flagged():
    plan = blanked_plan()
    seen = see(plan, 3, brightness=300)
    begin = int(seen.scan_frame[2])
    bound, clocks = bind(plan, seen.blocks(lost=range(begin + 10, begin + 70)))
    assert [clock.sweep for clock in clocks] == [0, 1, 2]
    assert [clock.synchronised for clock in clocks] == [False, True, True]
    assert math.isnan(clocks[0].residual_columns)
    assert [clock.detection > 0 for clock in clocks] == [True, False, True]
    assert all(error_of(plan, seen, bound, sweep) < 0.06 for sweep in range(3))


def test_sweeps_follow_one_another_also_where_the_frames_between_them_are_lost():
    plan = blanked_plan(columns=40)
    seen = see(plan, 3, brightness=300)
    begin, end = int(seen.scan_frame[1]) + 300, int(seen.scan_frame[3]) + 150
    bound, clocks = bind(plan, seen.blocks(lost=range(begin, end)))
    assert [clock.sweep for clock in clocks] == [0, 1, 2]
    assert all(a.end_frame == b.first_frame for a, b in pairwise(clocks))
    assert [clock.synchronised for clock in clocks] == [False, False, True]
    assert error_of(plan, seen, bound, 2) < 0.06


def test_frames_that_the_device_dropped_silently_are_noticed():
    plan = blanked_plan()
    seen = see(plan, 2, brightness=500)
    begin = int(seen.scan_frame[1]) + 500
    for dropped in (1, 20):
        _, clocks = bind(plan, seen.without(range(begin, begin + dropped)).blocks())
        assert not clocks[0].synchronised


@pytest.mark.parametrize("bidirectional", [False, True])
def test_light_leaves_in_the_pattern_and_on_columns_only_and_never_at_rest(bidirectional):
    plan = blanked_plan(bidirectional=bidirectional)
    pulses, repeats = sync_program(plan, 2)
    assert repeats == 1
    sweeps: list[list[tuple[float, float]]] = []
    for pulse in pulses:
        if pulse.duration_s is None:
            assert not pulse.outputs
            sweeps.append([])
            now = 0.0
            continue
        if pulse.outputs & OUT_GATE:
            sweeps[-1].append((now, now + pulse.duration_s))
        now += pulse.duration_s
    legs = len(plan.legs)
    assert [len(sweep) for sweep in sweeps] == [8] * legs + [9] * 2 + [8]
    assert len(sweeps) <= plan.scanner_repeats(2) * legs
    for number, sweep in enumerate(sweeps):
        leg = plan.leg(number)
        moves_s = [point / float(plan.point_rate_hz) + leg.lag_s for point in leg.path.cruise]
        assert moves_s[0] <= sweep[0][0]
        assert sweep[-1][1] <= moves_s[1]


def test_a_memory_that_holds_no_pilot_is_refused():
    small = dataclasses.replace(SPAD, markers=False, stream=None, burst=BurstMode(2300, 1e8))
    with pytest.raises(PlanError, match="one sweep, pilots and the blanking pattern behind it takes 24"):
        plan_of(scan(columns=100, exposures=10), spad=small)


def test_a_run_in_that_the_camera_does_not_see_is_refused_with_a_range_that_works():
    near = {"depth_range": ["0.5 m", "1.2 m"]}
    with pytest.raises(PlanError, match=r"begins at -0\.85: .* the camera sees nothing .*; begin it at -0\.") as caught:
        blanked_plan(command_range=[-0.85, 0.3], **near)
    begin = float(str(caught.value).rpartition(" ")[2])
    assert blanked_plan(command_range=[begin, 0.3], **near).blanking is not None
    with pytest.raises(PlanError):
        blanked_plan(command_range=[begin - 0.05, 0.3], **near)
