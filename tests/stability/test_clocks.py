"""Clocks and counters after 48 hours: nanoseconds beyond 2^32, frames beyond 2^32, ticks at any rational rate."""

import dataclasses
import itertools
from fractions import Fraction

import mpmath
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from drivers.clock import NS_PER_S, VirtualClock
from drivers.frames import FrameBlock, frame_bytes, packed_row_bytes
from drivers.replay.pace import Pace, ReplayClock
from drivers.units import DIMENSIONS, format_quantity, parse_exact, parse_quantity
from rig.count.bind import FrameBinder
from rig.count.bind_kernels import walk
from rig.count.blanking import MarkerLine
from tests.stability.inventory import EXAMPLES, covers
from tests.unit.rig.count.streams import plan_of, scan, stream_of

TWO_DAYS_S = 48 * 3600


@covers(VirtualClock.now_ns, VirtualClock.sleep, VirtualClock.advance_to_ns)
@EXAMPLES
@given(start=st.integers(0, 2**63), steps=st.lists(st.floats(-1.0, 1e6), max_size=20), to=st.integers(0, 2**64))
def test_virtual_time_never_runs_back_and_keeps_its_nanoseconds(start, steps, to) -> None:
    clock, exact = VirtualClock(start), Fraction(start)
    for step in steps:
        clock.sleep(step)
        exact += max(Fraction(step), 0) * NS_PER_S
    assert abs(clock.now_ns() - exact) <= Fraction(1 + len(steps), 2) + exact * Fraction(1, 2**52)
    before = clock.now_ns()
    clock.advance_to_ns(to)
    assert clock.now_ns() == max(before, to)


@covers(Pace.most_frames, Pace.wait, Pace.hold)
@EXAMPLES
@given(
    uptime_s=st.integers(0, 10**9), speed=st.sampled_from([1e-4, 1.0, 1e4]), ahead_s=st.floats(0, 1),
    late_s=st.floats(0, 5), held_s=st.floats(0, 5), period=st.fractions(Fraction(1, 10**6), Fraction(1)),
)  # fmt: skip
def test_a_replay_keeps_its_pace_after_any_time_of_running(uptime_s, speed, ahead_s, late_s, held_s, period) -> None:
    clock = VirtualClock(uptime_s * NS_PER_S)
    pace = Pace(ReplayClock(speed), clock)
    assert pace.most_frames(period) >= 1
    pace.start()
    clock.sleep(late_s)
    pace.hold(0.0, held_s)
    due_s = (late_s + ahead_s) * pace.speed
    assert pace.wait(due_s, 1e9)
    assert clock.now_ns() / NS_PER_S >= uptime_s + due_s / speed - 1e-6
    report = pace.report
    assert report.late_sd_s >= 0
    assert 0 <= report.held_s <= min(late_s, held_s) + 1e-6


@covers(Pace.wait)
def test_the_spread_of_lateness_is_not_lost_behind_its_mean(worst) -> None:
    clock = VirtualClock()
    pace = Pace(ReplayClock(1.0), clock)
    pace.start()
    late_ns = 10**15 + np.arange(1000) % 7 * 1000
    for ns in late_ns:
        clock._now_ns = int(ns)
        assert pace.wait(0.0, 1.0)
    exact = float(np.std((late_ns - 10**15) / 1e9))
    worst("standard deviation of lateness, mean 10^6 s", "exact", pace.report.late_sd_s / exact - 1, 1e-3)


@covers(parse_quantity, parse_exact, format_quantity)
@EXAMPLES
@given(value=st.floats(allow_nan=False, allow_infinity=False), dimension=st.sampled_from(sorted(DIMENSIONS)))
def test_every_finite_number_is_written_and_read_back_to_the_bit(value, dimension) -> None:
    text = format_quantity(value, dimension)
    assert parse_quantity(text, dimension) == value
    assert float(parse_exact(text, dimension)) == value


@covers(packed_row_bytes, frame_bytes)
@EXAMPLES
@given(width=st.integers(1, 2**20), height=st.integers(1, 2**20))
def test_frames_hold_their_pixels_in_whole_words(width, height) -> None:
    assert 0 <= packed_row_bytes(width) * 8 - width < 64
    assert packed_row_bytes(width) % 8 == 0
    assert frame_bytes(width, height) == 16 + height * packed_row_bytes(width)


def places(blocks, plan, t0_ticks=None):
    """Sweep, column and bin of each frame; t0_ticks: of a run that has long been going on."""
    binder = FrameBinder(plan)
    binder._t0 = t0_ticks
    bound = [binder.bind(block)[0] for block in blocks]
    return [np.concatenate([getattr(b, name) for b in bound]) for name in ("sweep", "column", "bins")]


@covers(walk, FrameBlock)
def test_a_run_that_has_gone_on_for_two_days_still_places_its_frames(worst) -> None:
    """Frames of one run 48 hours after its first one: sweep numbers beyond 2^16, units of time beyond 2^52."""
    plan = plan_of(scan(columns=24, exposures=5))
    stream = stream_of(plan, 3)
    blocks = stream.blocks(itertools.repeat(64))
    tick_hz = blocks[0].header.tick_hz
    # Whole sweeps that are a whole number of ticks and frames as well.
    sweep_ticks = plan.sweep_s * tick_hz
    sweeps = sweep_ticks.denominator * blocks[0].header.frame_period_ticks
    sweeps *= int(TWO_DAYS_S / float(sweeps * plan.sweep_s)) or 1
    ticks = int(sweeps * sweep_ticks)
    frames = ticks // blocks[0].header.frame_period_ticks
    moved = []
    for block in blocks:
        header = block.header
        records = block.records.copy()
        records["sweep"] = (records["sweep"].astype(np.int64) + sweeps) & 0xFFFF
        header = dataclasses.replace(
            header,
            t0_ticks=header.t0_ticks + ticks,
            first_frame=header.first_frame + frames,
            sweep=header.sweep + sweeps,
        )
        moved.append(dataclasses.replace(block, header=header, records=records))
    early, late = places(blocks, plan), places(moved, plan, blocks[0].header.t0_ticks)
    on = early[2] >= 0
    assert on.sum() > 100
    np.testing.assert_array_equal(late[0][on], early[0][on] + sweeps)
    np.testing.assert_array_equal(late[2], early[2])
    worst("column of a frame after 48 hours", "first second", late[1][on] - early[1][on], 1e-9)


@covers(MarkerLine.fit, MarkerLine.add)
def test_the_line_of_two_days_of_markers_is_exact(worst) -> None:
    line, period = MarkerLine(), 5500.123456789
    index = np.concatenate([np.arange(20), np.arange(3_000_000, 3_000_020)])
    rng = np.random.default_rng(1)
    for i in index:
        line.add(int(i), float(i * period + rng.normal(0, 0.01)), 0.01)
    got = line.fit(int(index[-1]) + 1)
    with mpmath.workdps(50):
        weight = [1 / mpmath.mpf(s) ** 2 for s in line.sd]
        x = [mpmath.mpf(int(i) - int(index[-1]) - 1) for i in index]
        total = sum(weight)
        middle = sum(w * a for w, a in zip(weight, x, strict=True)) / total
        spread = sum(w * (a - middle) ** 2 for w, a in zip(weight, x, strict=True))
        level = sum(w * mpmath.mpf(p) for w, p in zip(weight, line.place, strict=True)) / total
        slope = sum(w * (a - middle) * mpmath.mpf(p) for w, a, p in zip(weight, x, line.place, strict=True)) / spread
        exact = level - slope * middle, mpmath.sqrt(1 / total + middle**2 / spread), slope
        off = [float(abs(mpmath.mpf(a) - b) / abs(b)) for a, b in zip(got, exact, strict=True)]
    worst("line through scan markers of 48 hours", "mpmath, 50 digits", off, 1e-13)
