"""Moving windows: what the plan asks for, that every bound frame carries its column, and how a link is used."""

import dataclasses
import itertools
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from calibration.model.camera import Camera
from calibration.model.rig_model import Lag, RigModel
from calibration.model.scanner import PivotScanner
from drivers.errors import ProtocolError
from drivers.frames import FrameBlock, Mark
from drivers.interfaces import BurstMode, StreamMode
from rig.config.files import load_config
from rig.count.bind import FrameBinder
from rig.count.sweeps import SweepAssembler
from rig.count.volume import BIN_DARK, BIN_UNUSABLE
from rig.devices.open import open_rig
from rig.devices.prepare import prepare
from rig.errors import PlanError
from rig.plan import describe
from rig.plan.compile import compile_plan, spad_request
from rig.plan.describe import plan_text
from tests.stability.inventory import covers
from tests.unit.rig.count.streams import NO_LAG, SPAD, scan, scanner_limits, stream_of, timer_clock

covers(describe)

WIDTH, HEIGHT = 512, 4
WIDE = dataclasses.replace(SPAD, width=WIDTH, height=HEIGHT)
FULL_BYTES, RECORD_BYTES = HEIGHT * WIDTH // 8, 16


def wide_model(lag=NO_LAG, width=WIDTH, left=True):
    """A camera of 512 pixels a row; the mirror on the left or on the right of it."""
    focal = 400.0 * width / WIDTH
    camera = Camera(width, HEIGHT, np.array([[focal, 0, (width - 1) / 2], [0, focal, 1.5], [0, 0, 1]]), np.zeros(5))
    side = -1.0 if left else 1.0
    scanner = PivotScanner(
        np.array([0.3 * side, 0, 0]),
        np.array([0.0, 1, 0]),
        np.array([1.0, 0, 0]),
        np.array([-0.09 * side, 0.5]),
        (-1, 1),
    )
    return RigModel(camera, scanner, lag, None)


def plan_of(config, lag=NO_LAG, spad=WIDE, limits=None, left=True):
    model = wide_model(lag, spad.width, left)
    return compile_plan(config, limits or scanner_limits(), timer_clock, model, spad)


def linked(bytes_per_s, **changes):
    return dataclasses.replace(WIDE, stream=StreamMode(bytes_per_s), **changes)


@st.composite
def cases(draw):
    lag = Lag(draw(st.floats(0, 4e-4)), draw(st.floats(0, 4e-4)))
    ends = draw(st.tuples(st.floats(-0.8, 0.8), st.floats(-0.8, 0.8)))
    assume(abs(ends[0] - ends[1]) > 0.05)
    config = scan(
        columns=draw(st.integers(3, 120)),
        exposures=draw(st.sampled_from([1, 2, 3, 7, 10, 40])),
        frame_rate=draw(st.sampled_from(["100 kHz", "50 kHz", "6.25 kHz"])),
        depth_range=draw(st.sampled_from([["1 m", "8 m"], ["3 m", "3.2 m"], ["0.5 m", "50 m"]])),
        command_range=list(ends),
        bidirectional=draw(st.booleans()),
    )
    assume(config.columns * config.exposures <= 3000)
    fastest = draw(st.sampled_from([7e3, 40.001e3, 2e5]))
    limits = scanner_limits(velocity_per_s=1e6, acceleration_per_s2=1e10, point_rate_hz=(1e3, fastest))
    spad = dataclasses.replace(WIDE, roi_step_px=draw(st.sampled_from([1, 32, 64, 128])))
    try:
        plan = plan_of(config, lag, spad, limits, draw(st.booleans()))
    except PlanError:
        assume(False)
        raise
    error = draw(st.floats(-1e-4, 1e-4))
    exposure = draw(st.sampled_from([None, 700]))
    latency_s = draw(st.floats(1e-5, 1e-3))
    stream = stream_of(plan, 3, lag=lag, clock_error=error, latency_s=latency_s, exposure_ticks=exposure)
    return plan, stream, spad


def latched(plan, stream):
    """x0 of every frame, from the markers that the records of the frames before it tell."""
    line = np.concatenate([[0], stream.records["line"][:-1].astype(int)])
    sweep = np.concatenate([[0], stream.records["sweep"][:-1].astype(int)])
    tables = plan.windows.x0
    return np.array([tables[(s - 1) % len(tables)][n] if s else tables[0][0] for s, n in zip(sweep, line, strict=True)])


@pytest.mark.long
@settings(max_examples=80, deadline=None)
@given(cases())
def test_every_bound_frame_carries_the_window_of_its_column(case):
    plan, stream, spad = case
    assume(plan.windows is not None)
    plan.windows.check(spad.width, spad.roi_step_px)
    assert [len(x0) for x0 in plan.windows.x0] == [len(plan.marker_points) + 1] * len(plan.legs)
    x0 = latched(plan, stream)
    (block,) = stream.blocks(itertools.repeat(10**6))
    bound, _ = FrameBinder(plan).bind(block)
    np.testing.assert_array_equal(plan.window_x0(block.records["marks"], block.records["line"], bound.sweep), x0)
    on_column = bound.bins >= 0
    first = plan.x0[bound.bins[on_column]]
    assert (x0[on_column] <= first).all()
    assert (first + plan.window <= x0[on_column] + plan.windows.width_px).all()
    assert plan.windows.width_px < WIDTH


def test_every_pixel_that_a_column_uses_has_dark_frames():
    limits = scanner_limits(velocity_per_s=500, acceleration_per_s2=2e6, rms_duty=0.5, point_rate_hz=(2e3, 1e5))
    config = scan(columns=200, exposures=4, command_range=[-0.4, 0.4], depth_range=["2 m", "4 m"])
    plan = plan_of(config, Lag(1e-4, 2e-4), limits=limits)
    stream = stream_of(plan, 2, lag=Lag(1e-4, 2e-4))
    (block,) = stream.blocks(itertools.repeat(10**6))
    bound, clocks = FrameBinder(plan).bind(block)
    assert all(clock.synchronised for clock in clocks)
    x0 = plan.window_x0(block.records["marks"], block.records["line"], bound.sweep)
    for sweep in range(2):
        dark = (bound.bins == BIN_DARK) & (bound.sweep == sweep)
        seen = np.zeros(WIDTH, int)
        for first in x0[dark]:
            seen[first : first + plan.windows.width_px] += 1
        used = slice(plan.x0.min(), plan.x0.max() + plan.window)
        assert seen[used].min() >= 0.1 * dark.sum()


def test_without_a_calibration_or_with_windows_as_wide_as_the_sensor_there_are_none():
    assert compile_plan(scan(), scanner_limits(), timer_clock, None, WIDE).windows is None
    assert plan_of(scan(depth_range=["0.15 m", "100 m"], command_range=[-0.8, 0.8])).windows is None
    narrow = plan_of(scan(), spad=dataclasses.replace(SPAD, width=64, height=HEIGHT))
    assert narrow.windows is None
    assert not narrow.window_x0(np.zeros(3, int), np.arange(3), np.zeros(3, int)).any()


def test_a_link_gets_full_frames_else_windows_else_bursts_else_a_refusal():
    config = scan(depth_range=["2 m", "4 m"])
    windows_bytes = RECORD_BYTES + HEIGHT * plan_of(config).windows.width_px // 8
    full = 1e5 * (FULL_BYTES + RECORD_BYTES)
    some, little = 1e5 * windows_bytes, 1e5 * windows_bytes - 1
    cases = ((full, "stream", False), (full - 1, "stream", True), (some, "stream", True), (little, "burst", False))
    for bytes_per_s, mode, windowed in cases:
        plan = plan_of(config, spad=linked(bytes_per_s, burst=BurstMode(1000, 4.8e5)))
        assert (plan.mode, plan.windowed) == (mode, windowed)
        assert plan.frame_bytes == (windows_bytes if windowed else FULL_BYTES + RECORD_BYTES)
        assert plan.frame_width == (plan.windows.width_px if windowed else WIDTH)
        assert spad_request(config, plan).window is (plan.windows if windowed else None)
        assert spad_request(config, plan).mode == mode
    with pytest.raises(PlanError, match="lower frame_rate to"):
        plan_of(config, spad=linked(little))


@settings(max_examples=30, deadline=None)
@given(st.floats(2e5, 8e6), st.sampled_from([1, 2, 4, 10]), st.floats(0, 4e-4), st.booleans())
def test_the_refusal_names_a_rate_that_the_link_carries(bytes_per_s, exposures, lag_s, bidirectional):
    changes = {"exposures": exposures, "bidirectional": bidirectional, "depth_range": ["2 m", "4 m"]}
    spad = linked(bytes_per_s)
    with pytest.raises(PlanError) as caught:
        plan_of(scan(**changes), Lag(lag_s, lag_s), spad)
    (problem,) = caught.value.problems
    assume("lower frame_rate" in problem)  # else the mirror cannot do it
    carried = Fraction(problem.split("lower frame_rate to ")[1].split(" kHz")[0])
    plan = plan_of(scan(**changes, frame_rate=f"{carried} kHz"), Lag(lag_s, lag_s), spad)
    assert plan.mode == "stream"
    assert plan.bytes_per_s <= bytes_per_s
    assert plan.windowed


def test_the_refusal_names_frames_windows_and_link():
    made = "27.2 MB/s of full frames, 11.2 MB/s of moving windows of 192 pixels"
    then = r"lower frame_rate to 44\.642 kHz or narrow depth_range"
    with pytest.raises(PlanError, match=f"100 kHz makes {made}; the link of the test SPAD carries 5 MB/s; {then}"):
        plan_of(scan(depth_range=["2 m", "4 m"]), spad=linked(5e6))
    with pytest.raises(PlanError, match="carries 0 MB/s; use a SPAD that streams"):
        plan_of(scan(), spad=dataclasses.replace(WIDE, stream=None))


def test_the_description_names_the_window_its_rate_and_what_the_link_carries():
    text = plan_text(plan_of(scan(depth_range=["2 m", "4 m"]), spad=linked(12e6)))
    assert "window      128 of 512 pixels for 2 to 4 m" in text
    # 192 pixels are 112 bytes with the record, full rows 272.
    assert "stream of moving windows of 192 pixels, 11.2 MB/s; the link carries full frames up to 44.12 kHz" in text
    assert "windows of 192 pixels up to 107.1 kHz" in text
    assert "burst of full frames" in plan_text(plan_of(scan(), spad=linked(1e5, burst=BurstMode(1000, 1e6))))
    slow = dataclasses.replace(plan_of(scan()), frame_rate_hz=Fraction(2))
    assert "4 frames at 0.002 kHz, 2000000 us each" in plan_text(slow)


class Counter:
    """Notes what it is given instead of counting."""

    def __init__(self):
        self.bins = np.zeros(0, np.int32)
        self.x0 = np.zeros(0, np.int32)

    def add(self, bits, bins, column, x0):
        self.bins = np.append(self.bins, bins)
        self.x0 = np.append(self.x0, x0)

    def reset(self): ...


def blocks_of(plan, stream, width, x0=None):
    """The stream's blocks, as if the SPAD had sent rows of `width` pixels."""
    made = []
    for block in stream.blocks(itertools.repeat(64)):
        records = block.records.copy()
        first = block.header.first_frame
        records["x0"] = 0 if x0 is None else x0[first : first + len(records)]
        header = dataclasses.replace(block.header, width=width, sensor_width=WIDTH)
        made.append(FrameBlock(header, records, np.zeros((len(records), HEIGHT, width // 8), np.uint8)))
    return made


def counted(plan, blocks):
    counter = Counter()
    assembler = SweepAssembler(plan, counter, maps=10)
    for block in blocks[:-1]:
        assert not list(assembler.add(block))
    return counter


@pytest.fixture(scope="module")
def moving():
    """A plan of windows, a stream of it that ends within its second sweep, and the window of every frame."""
    plan = plan_of(scan(columns=100, depth_range=["2 m", "4 m"], command_range=[-0.8, 0.8]), Lag(1e-4, 1e-4))
    whole = stream_of(plan, 1, lag=Lag(1e-4, 1e-4))
    keep = slice(0, int(whole.scan_frames[1]) - 1)
    stream = dataclasses.replace(whole, records=whole.records[keep], ticks=whole.ticks[keep])
    return plan, stream, latched(plan, stream)


def test_a_frame_whose_window_misses_its_column_is_not_counted_in_part(moving):
    plan, stream, x0 = moving
    stuck = np.zeros_like(x0)
    bins = counted(plan, blocks_of(plan, stream, plan.windows.width_px, stuck)).bins
    expected = counted(plan, blocks_of(plan, stream, plan.windows.width_px, x0)).bins
    missed = (expected >= 0) & (plan.x0[np.maximum(expected, 0)] + plan.window > plan.windows.width_px)
    assert missed.any()
    assert not missed.all()
    np.testing.assert_array_equal(bins, np.where(missed, BIN_UNUSABLE, expected))


def test_a_window_that_is_not_to_be_trusted_is_not_used_wherever_it_claims_to_lie(moving):
    plan, stream, x0 = moving
    lost = dataclasses.replace(stream, records=stream.records.copy())
    lost.records["marks"] |= np.uint32(Mark.WINDOW_LOST)
    counter = counted(plan, blocks_of(plan, lost, plan.windows.width_px, np.full_like(x0, 60_000)))
    assert (counter.bins == BIN_UNUSABLE).all()
    assert counter.x0.max() == 0


def test_a_window_or_a_width_where_the_plan_has_none_is_refused_in_a_line(moving):
    plan, stream, x0 = moving
    said = f"frames of 320 x 4 pixels, the plan is for {plan.windows.width_px} x 4 or 512 x 4; configure the SPAD"
    with pytest.raises(ProtocolError, match=rf"\A.*{said}.*\Z"):
        counted(plan, blocks_of(plan, stream, 320, x0))
    x0, wrong = x0.copy(), 32
    x0[70] = wrong
    with pytest.raises(ProtocolError, match=f"window of frame 70 begins at pixel {wrong}, row 0, where"):
        counted(plan, blocks_of(plan, stream, plan.windows.width_px, x0))


def test_columns_that_see_nothing_make_no_window_jump():
    with open_rig(load_config("simulated", {"scan.depth_range": ["4 m", "15 m"]})) as rig:
        plan, _ = prepare(rig)
    assert plan.window == 128
    assert np.abs(np.diff(plan.x0)).max() <= 64
    assert plan.windows is not None
    assert plan.windows.width_px <= plan.window + 128
