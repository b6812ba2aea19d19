"""The suite of every SPAD array: contiguous frames with records, counters that add up, runs that end when they
should."""

from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from itertools import pairwise

import numpy as np
import pytest

from drivers.errors import DeviceTimeout, LimitExceeded
from drivers.frames import BlockFlag, packed_row_bytes
from drivers.interfaces import DeviceState
from drivers.ring import BlockRing
from spadrig.conformance.cases import N_FRAMES, TIMEOUT_S, SpadCase, Taken, require_final, run


class SpadArraySuite:
    """Tests of a SPAD. The fixture `spad` gives a `SpadCase`, and `taken` a `Taken`: `open_spad` is enough for both."""

    def test_it_describes_itself_and_blocks_lie_in_the_ring_and_are_of_the_window_that_was_asked_for(
        self, taken: Taken
    ) -> None:
        info, window = taken.case.device.info, taken.case.request.window
        assert all((taken.case.device.name, info.model, info.serial, info.burst or info.stream))
        assert min(info.width, info.height, info.roi_step_px, float(info.max_frame_rate_hz)) > 0
        assert info.rotation_deg in (0, 90, 180, 270)
        width = info.width if window is None else window.width_px
        first = 0 if window is None else window.x0[0][0]  # there was no marker yet
        assert taken.blocks
        for block in taken.blocks:
            assert np.shares_memory(block.bits, taken.ring._memory)
            assert block.header.width == width
            assert (block.records["x0"] == first).all()

    def test_frames_are_contiguous_within_blocks_and_a_jump_is_the_loss(self, taken: Taken) -> None:
        timing, blocks, counters = taken.timing, taken.blocks, taken.counters
        numbers = np.concatenate([block.frame_numbers for block in blocks])
        assert (np.diff(numbers) >= 1).all()
        assert numbers[0] >= 0
        assert numbers[-1] < N_FRAMES
        lost = 0
        for block in blocks:
            assert 1 <= block.n_frames <= taken.case.request.block_frames
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
        assert counters.lost in (None, N_FRAMES - len(numbers))
        assert counters.exposed in (None, N_FRAMES)

    def test_every_block_tells_geometry_and_timing_and_its_bits_are_packed_rows_with_pad_bits_zero(
        self, taken: Taken
    ) -> None:
        info, timing, blocks = taken.case.device.info, taken.timing, taken.blocks
        assert [block.header.block_seq for block in blocks] == list(range(len(blocks)))
        assert len({block.header.run_id for block in blocks}) == 1
        assert [bool(block.header.flags & BlockFlag.FIRST) for block in blocks] == [True] + [False] * (len(blocks) - 1)
        shares = []
        for block in blocks:
            header = block.header
            assert (header.sensor_width, header.sensor_height) == (info.width, info.height)
            assert (header.bits_per_px, header.payload_type, header.frame_step) == (1, 0, 1)
            assert header.tick_hz == timing.tick_hz
            assert (header.frame_period_ticks, header.exposure_ticks) == (
                timing.frame_period_ticks,
                timing.exposure_ticks,
            )
            assert block.status == 0
            assert block.bits.dtype == np.uint8
            assert block.bits.shape == (block.n_frames, header.height, packed_row_bytes(header.width))
            pixels = np.unpackbits(block.bits, axis=2)
            assert not pixels[:, :, header.width :].any()
            beyond = block.records["x0"][:, None] + np.arange(pixels.shape[2]) >= header.sensor_width
            assert not (pixels & beyond[:, None, :]).any()
            row_px = 8 * packed_row_bytes(header.sensor_width)  # the last window may end in the padding
            assert (block.records["x0"] + header.width <= row_px).all()
            assert (block.records["y0"] + header.height <= header.sensor_height).all()
            shares.append(pixels[:, :, : header.width].mean())
        assert 0 < np.mean(shares) < 1

    def test_after_the_end_it_gives_no_more_starts_again_at_frame_0_and_closes_for_good(self, spad: SpadCase) -> None:
        timing = spad.device.configure(spad.request)
        _, blocks = run(spad, timing, 200)
        assert spad.device.state is DeviceState.CONFIGURED
        assert spad.device.fill(BlockRing(1, timing.stride), TIMEOUT_S) is False
        _, second = run(spad, timing, 200)
        assert second[0].header.block_seq == 0
        assert second[0].header.run_id != blocks[0].header.run_id
        assert second[-1].frame_numbers[-1] < 200
        assert spad.device.counters.delivered == sum(block.n_frames for block in second)
        spad.device.start(None if spad.request.mode == "stream" else 10)
        fill = partial(spad.device.fill, BlockRing(1, timing.stride), 0.1)
        verbs = (lambda: spad.device.configure(spad.request), lambda: spad.device.start(1), fill, spad.device.stop)
        require_final(spad.device, *verbs)
        assert spad.device.counters.delivered == 0

    def test_grabbed_frames_are_those_of_the_run_with_the_numbers_of_lost_ones(self, spad: SpadCase) -> None:
        device, asked = spad.device, spad.request
        rate = None if asked.window is not None else asked.frame_rate_hz  # whole frames may be too much for the link
        got = device.grab(150, frame_rate_hz=rate, exposure_s=asked.exposure_s, mode=asked.mode, timeout_s=TIMEOUT_S)
        info, counters = device.info, device.counters
        assert device.state is DeviceState.CONFIGURED
        assert len(got.number) == len(got.records) == len(got.bits) == counters.delivered
        assert (np.diff(got.number) >= 1).all()
        assert sorted([*got.number.tolist(), *got.lost.tolist()]) == list(range(150))
        assert counters.lost in (None, len(got.lost))
        assert got.frames.shape == (len(got.number), info.height, info.width)
        assert got.frames.dtype == np.bool_
        assert np.array_equal(got.frames.sum(axis=0), got.counts)
        assert 0 < got.frames.mean() < 1
        if asked.window is not None and got.records["x0"].any():  # a recording of windows
            outside = (
                np.arange(info.width) // asked.window.width_px != got.records["x0"][:, None] // asked.window.width_px
            )
            assert not (got.frames & outside[:, None]).any()
        with pytest.raises(LimitExceeded):
            device.grab(10, frame_rate_hz=2 * info.max_frame_rate_hz)
        with pytest.raises(LimitExceeded):
            device.grab(0, frame_rate_hz=asked.frame_rate_hz, mode=asked.mode)

    def test_frames_can_be_grabbed_without_saying_how(self, spad: SpadCase) -> None:
        got, info = spad.device.grab(20, timeout_s=TIMEOUT_S), spad.device.info
        assert got.number.size + got.lost.size == 20
        assert got.ended_by is None
        assert got.frames.shape == (got.number.size, info.height, info.width)
        assert got.counts.any()

    def test_an_endless_run_ends_when_another_thread_stops_it(self, spad: SpadCase) -> None:
        if spad.request.mode == "burst":
            pytest.skip("a burst has an end")
        device = spad.device
        ring = BlockRing(4, device.configure(spad.request).stride)
        reader = ring.reader("test")
        device.start(None)

        def source() -> None:
            try:
                while device.fill(ring, TIMEOUT_S):
                    pass
            finally:
                ring.finish()

        with ThreadPoolExecutor(1) as pool:
            filled = pool.submit(source)
            for count, _ in enumerate(reader):
                if count == 5:
                    device.stop()
            filled.result(TIMEOUT_S)
        assert device.state is DeviceState.CONFIGURED
        assert device.fill(ring, TIMEOUT_S) is False
        counters = device.counters
        if counters.exposed is not None and counters.lost is not None:
            assert counters.exposed == counters.delivered + counters.lost

    def test_a_full_ring_is_waited_for_or_the_loss_is_counted(self, spad: SpadCase) -> None:
        device = spad.device
        n_frames = 5 * spad.request.block_frames
        ring = BlockRing(2, device.configure(spad.request).stride)
        reader = ring.reader("test")
        device.start(n_frames)
        more, waited = True, False
        numbers: list[int] = []
        while more:
            try:
                more = device.fill(ring, 0.05)
            except DeviceTimeout:
                with suppress(DeviceTimeout):  # the device was late, and nothing has come
                    block = reader.next(0)
                    assert block is not None
                    numbers += block.frame_numbers.tolist()
                    waited = True
        ring.finish()
        assert waited or ring.dropped_blocks
        for block in reader:
            numbers += block.frame_numbers.tolist()
        assert numbers == sorted(set(numbers))
        counters = device.counters
        assert counters.delivered == len(numbers)
        assert counters.lost in (None, n_frames - len(numbers))
