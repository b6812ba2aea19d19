"""Every SPAD array: states, limits, contiguous frames with records, counters that add up, an end that ends."""

import threading
from dataclasses import replace
from fractions import Fraction
from functools import partial
from itertools import pairwise

import numpy as np
import pytest

from drivers.errors import DeviceTimeout, LimitExceeded, WrongState
from drivers.frames import BlockFlag, FrameBlock, packed_row_bytes
from drivers.interfaces import DeviceState, SpadTiming, WindowTable
from drivers.ring import BlockRing
from tests.conformance.cases import SpadCase, leave_with_an_error, require_final

N_FRAMES = 1000
TIMEOUT_S = 60.0


def roomy_ring(case: SpadCase, timing: SpadTiming, n_frames: int) -> BlockRing:
    """A ring that takes a whole run, however short the device makes its blocks after a loss."""
    return BlockRing(2 * n_frames // case.request.block_frames + n_frames // 8, timing.stride)


def run_again(case: SpadCase, timing: SpadTiming, n_frames: int) -> tuple[BlockRing, list[FrameBlock]]:
    """One run of n frames to its end, all blocks still in the ring."""
    ring = roomy_ring(case, timing, n_frames)
    reader = ring.reader("test")
    case.device.start(n_frames)
    while case.device.fill(ring, TIMEOUT_S):
        assert case.device.state is DeviceState.RUNNING
    ring.finish()
    return ring, list(reader)


def run(case: SpadCase, n_frames: int = N_FRAMES) -> tuple[SpadTiming, list[FrameBlock]]:
    """One run from configure to its end."""
    timing = case.device.configure(case.request)
    return timing, run_again(case, timing, n_frames)[1]


def test_it_describes_itself(spad: SpadCase) -> None:
    info = spad.device.info
    assert spad.device.name
    assert info.model
    assert info.serial
    assert min(info.width, info.height, info.roi_step_px) >= 1
    assert info.max_frame_rate_hz > 0
    assert info.rotation_deg in (0, 90, 180, 270)
    assert info.burst is not None or info.stream is not None


def test_verbs_out_of_order_are_refused_and_say_what_to_call(spad: SpadCase) -> None:
    device = spad.device
    with pytest.raises(WrongState, match="configure"):
        device.start(10)
    timing = device.configure(spad.request)
    ring = BlockRing(8, timing.stride)
    with pytest.raises(WrongState, match="start"):
        device.fill(ring, 0.1)
    device.start(10)
    with pytest.raises(WrongState, match="stop"):
        device.configure(spad.request)
    with pytest.raises(WrongState, match="stop"):
        device.start(10)
    device.stop()
    assert device.state is DeviceState.CONFIGURED
    device.configure(spad.request)


def test_stop_without_a_run_does_nothing(spad: SpadCase) -> None:
    spad.device.stop()
    assert spad.device.state is DeviceState.READY


def test_a_frame_rate_beyond_the_limit_is_refused_with_value_and_limit(spad: SpadCase) -> None:
    fastest = spad.device.info.max_frame_rate_hz
    for rate in (fastest * 2, Fraction(0), -fastest):
        with pytest.raises(LimitExceeded) as refused:
            spad.device.configure(replace(spad.request, frame_rate_hz=rate))
        assert f"{float(rate):g}" in str(refused.value)
        assert f"{float(fastest):g}" in str(refused.value)
    assert spad.device.state is DeviceState.READY


def test_an_exposure_beyond_the_frame_period_is_refused_with_value_and_limit(spad: SpadCase) -> None:
    period_s = float(1 / spad.request.frame_rate_hz)
    for exposure_s in (period_s * 1.01, 0.0, -1e-6, float("nan")):
        with pytest.raises(LimitExceeded) as refused:
            spad.device.configure(replace(spad.request, exposure_s=exposure_s))
        assert f"{exposure_s:g}" in str(refused.value)
        assert f"{period_s:g}" in str(refused.value)
    spad.device.configure(replace(spad.request, exposure_s=period_s))


def test_a_mode_it_does_not_have_is_refused(spad: SpadCase) -> None:
    info = spad.device.info
    if info.burst is None:
        with pytest.raises(LimitExceeded, match="'burst' is not available"):
            spad.device.configure(replace(spad.request, mode="burst"))
    if info.stream is None:
        with pytest.raises(LimitExceeded, match="'stream' is not available"):
            spad.device.configure(replace(spad.request, mode="stream"))


def test_windows_beyond_the_sensor_are_refused(spad: SpadCase) -> None:
    info = spad.device.info
    if info.stream is None:
        pytest.skip("no stream mode")
    beyond = WindowTable(info.roi_step_px * 64, (np.array([info.width // 64 * 64 + 64], np.int32),))
    with pytest.raises(LimitExceeded, match="reaches beyond"):
        spad.device.configure(replace(spad.request, mode="stream", window=beyond))


def test_blocks_are_of_the_window_that_was_asked_for(spad: SpadCase) -> None:
    window = spad.request.window
    _, blocks = run(spad)
    assert {block.header.width for block in blocks} == {spad.device.info.width if window is None else window.width_px}
    first = 0 if window is None else window.x0[0][0]  # there was no marker yet
    assert all((block.records["x0"] == first).all() for block in blocks)


def test_blocks_and_runs_of_no_frames_are_refused(spad: SpadCase) -> None:
    with pytest.raises(LimitExceeded, match="blocks of 0 frames"):
        spad.device.configure(replace(spad.request, block_frames=0))
    spad.device.configure(spad.request)
    with pytest.raises(LimitExceeded, match="0 frames"):
        spad.device.start(0)


def test_a_burst_beyond_the_memory_is_refused(spad: SpadCase) -> None:
    burst = spad.device.info.burst
    if burst is None:
        pytest.skip("no burst mode")
    spad.device.configure(replace(spad.request, mode="burst", window=None))
    for n_frames in (burst.capacity_frames + 1, None):
        with pytest.raises(LimitExceeded, match=str(burst.capacity_frames)):
            spad.device.start(n_frames)


def test_the_timing_is_what_was_asked_for(spad: SpadCase) -> None:
    timing = spad.device.configure(spad.request)
    period_s = timing.frame_period_ticks / timing.tick_hz
    assert abs(period_s - 1 / spad.request.frame_rate_hz) <= 1 / (2 * timing.tick_hz)
    assert 1 <= timing.exposure_ticks <= timing.frame_period_ticks
    assert abs(timing.exposure_ticks / timing.tick_hz - Fraction(spad.request.exposure_s)) <= 1 / timing.tick_hz
    assert timing.stride % 1024 == 0


def test_frames_are_contiguous_within_blocks_and_a_jump_is_the_loss(spad: SpadCase) -> None:
    timing, blocks = run(spad)
    counters = spad.device.counters
    numbers = np.concatenate([block.frame_numbers for block in blocks])
    assert (np.diff(numbers) >= 1).all()
    assert numbers[0] >= 0
    assert numbers[-1] < N_FRAMES
    lost = 0
    for block in blocks:
        assert 1 <= block.n_frames <= spad.request.block_frames
        missing = block.header.first_frame - (lost + sum(b.n_frames for b in blocks[: block.header.block_seq]))
        assert block.header.lost_before == lost + missing
        assert bool(block.header.flags & BlockFlag.LOST_BEFORE) == (missing > 0)
        lost += missing
        expected = block.header.t0_ticks + np.arange(block.n_frames) * timing.frame_period_ticks
        assert np.array_equal(block.start_ticks, expected)
    for before, after in pairwise(blocks):
        ticks = (after.header.first_frame - before.header.first_frame) * timing.frame_period_ticks
        assert after.header.t0_ticks - before.header.t0_ticks == ticks
    assert counters.delivered == len(numbers)
    if counters.lost is not None:
        assert counters.lost == N_FRAMES - len(numbers)
    if counters.exposed is not None:
        assert counters.exposed == N_FRAMES


def test_the_header_of_every_block_tells_the_geometry_and_the_timing(spad: SpadCase) -> None:
    timing, blocks = run(spad)
    info = spad.device.info
    assert [block.header.block_seq for block in blocks] == list(range(len(blocks)))
    assert len({block.header.run_id for block in blocks}) == 1
    assert [bool(block.header.flags & BlockFlag.FIRST) for block in blocks] == [True] + [False] * (len(blocks) - 1)
    for block in blocks:
        header = block.header
        assert (header.sensor_width, header.sensor_height) == (info.width, info.height)
        assert (header.bits_per_px, header.payload_type, header.frame_step) == (1, 0, 1)
        assert header.tick_hz == timing.tick_hz
        assert (header.frame_period_ticks, header.exposure_ticks) == (timing.frame_period_ticks, timing.exposure_ticks)
        assert block.status == 0


def test_bits_are_packed_rows_with_pad_bits_zero_inside_the_window(spad: SpadCase) -> None:
    _, blocks = run(spad)
    ones = 0
    for block in blocks:
        header = block.header
        assert block.bits.dtype == np.uint8
        assert block.bits.shape == (block.n_frames, header.height, packed_row_bytes(header.width))
        pixels = np.unpackbits(block.bits, axis=2)
        assert not pixels[:, :, header.width :].any()
        beyond = block.records["x0"][:, None] + np.arange(pixels.shape[2]) >= header.sensor_width
        assert not (pixels & beyond[:, None, :]).any()
        row_px = 8 * packed_row_bytes(header.sensor_width)  # the last window may end in the padding
        assert (block.records["x0"] + header.width <= row_px).all()
        assert (block.records["y0"] + header.height <= header.sensor_height).all()
        ones += int(pixels.sum())
    assert 0 < ones < sum(block.n_frames for block in blocks) * blocks[0].header.height * blocks[0].header.width


def test_blocks_lie_in_the_ring(spad: SpadCase) -> None:
    ring, blocks = run_again(spad, spad.device.configure(spad.request), 200)
    assert blocks
    assert all(np.shares_memory(block.bits, ring._memory) for block in blocks)


def test_after_the_end_it_gives_no_more_and_starts_again_at_frame_0(spad: SpadCase) -> None:
    timing, blocks = run(spad, 200)
    assert spad.device.state is DeviceState.CONFIGURED
    assert spad.device.fill(roomy_ring(spad, timing, 200), TIMEOUT_S) is False
    _, second = run_again(spad, timing, 200)
    assert second[0].header.block_seq == 0
    assert second[0].header.run_id != blocks[0].header.run_id
    assert second[-1].frame_numbers[-1] < 200
    assert spad.device.counters.delivered == sum(block.n_frames for block in second)


def test_an_endless_run_ends_when_another_thread_stops_it(spad: SpadCase) -> None:
    if spad.request.mode == "burst":
        pytest.skip("a burst has an end")
    device = spad.device
    timing = device.configure(spad.request)
    ring = BlockRing(4, timing.stride)
    reader = ring.reader("test")
    device.start(None)

    def source() -> None:
        try:
            while device.fill(ring, TIMEOUT_S):
                pass
        except BaseException as error:
            ring.finish(error)
            raise
        ring.finish()

    thread = threading.Thread(target=source)
    thread.start()
    for count, _ in enumerate(reader):
        if count == 5:
            device.stop()
    thread.join(TIMEOUT_S)
    assert not thread.is_alive()
    assert device.state is DeviceState.CONFIGURED
    assert device.fill(ring, TIMEOUT_S) is False
    counters = device.counters
    if counters.exposed is not None and counters.lost is not None:
        assert counters.exposed == counters.delivered + counters.lost


def test_a_full_ring_is_waited_for_or_the_loss_is_counted(spad: SpadCase) -> None:
    device = spad.device
    timing = device.configure(spad.request)
    ring = BlockRing(2, timing.stride)
    reader = ring.reader("test")
    device.start(N_FRAMES)
    waited = False
    try:
        for _ in range(3):
            device.fill(ring, 0.05)
    except DeviceTimeout:
        waited = True
    assert waited or ring.dropped_blocks
    more = True
    numbers: list[int] = []
    while more:
        try:
            more = device.fill(ring, 0.05)
        except DeviceTimeout:
            block = reader.next(0)
            assert block is not None
            numbers += block.frame_numbers.tolist()
    ring.finish()
    for block in reader:
        numbers += block.frame_numbers.tolist()
    assert numbers == sorted(set(numbers))
    counters = device.counters
    assert counters.delivered == len(numbers)
    if counters.lost is not None:
        assert counters.lost == N_FRAMES - len(numbers)


def test_close_is_final_and_may_be_called_twice(spad: SpadCase) -> None:
    device = spad.device
    timing = device.configure(spad.request)
    device.start(None if spad.request.mode == "stream" else 10)
    fill = partial(device.fill, BlockRing(1, timing.stride), 0.1)
    require_final(device, lambda: device.configure(spad.request), lambda: device.start(1), fill, device.stop)
    assert device.counters.delivered == 0


def test_leaving_the_with_block_closes_it_whatever_happened(spad: SpadCase) -> None:
    def expose() -> None:
        spad.device.configure(spad.request)
        spad.device.start(10)

    leave_with_an_error(spad.device, expose)
