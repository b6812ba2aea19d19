"""The SPB1 driver and a damaged stream or a full ring: docs/reference/spb1-usb.md, What the driver does."""

import struct
import threading
import time
import zlib
from collections.abc import Callable

import pytest

from drivers.errors import RingOverflow, WrongState
from drivers.frames import BlockFlag, BlockStatus
from drivers.ring import BlockRing, OnFull
from tests.wire.spads import begin, finish
from tests.wire.spb_device import REQUEST, model, nth, opened, require_right, take


def flipped(at: int) -> Callable[[bytearray], tuple[bytes]]:
    def change(block: bytearray) -> tuple[bytes]:
        block[at] ^= 0x10
        return (bytes(block),)

    return change


@pytest.mark.parametrize(
    "at", [0, 24, 69, 92, 96, 300, 400, 6000, 384 + 16 * 384 + 4, 384 + 16 * 384 + 28], ids=lambda at: f"byte {at}"
)
def test_a_flipped_bit_anywhere_in_a_block_refuses_that_block_only(at: int) -> None:
    device = model()
    with opened(device) as spad:
        device.mangle = nth(3, flipped(at))
        blocks = take(spad, 160)
        assert require_right(blocks) == [*range(48), *range(64, 160)]
        counters = spad.counters
        assert (counters.exposed, counters.delivered, counters.lost, counters.crc_errors) == (160, 144, 16, 1)
        assert blocks[3].header.flags & BlockFlag.LOST_BEFORE
        assert blocks[3].header.lost_before == 16


@pytest.mark.parametrize("keep", [1024, 3072, 6144])
def test_a_block_cut_short_shifts_the_stream_and_is_resynchronised(keep: int) -> None:
    device = model()
    with opened(device) as spad:
        device.mangle = nth(4, lambda block: (bytes(block[:keep]),))
        blocks = take(spad, 3000)
        numbers = require_right(blocks)
        counters = spad.counters
        assert numbers[:64] == list(range(64))
        assert numbers[-1] == 2999
        assert counters.resyncs == 1
        assert counters.exposed == 3000
        assert counters.lost == 3000 - len(numbers)
        assert len(numbers) > 1000


def test_extra_bytes_between_blocks_are_resynchronised() -> None:
    device = model()
    with opened(device) as spad:
        device.mangle = nth(4, lambda block: (bytes(2048), bytes(block)))
        blocks = take(spad, 3000)
        require_right(blocks)
        assert spad.counters.resyncs == 1


def test_repeated_and_swapped_blocks_are_refused() -> None:
    device = model()
    with opened(device) as spad:
        device.mangle = nth(4, lambda block: (bytes(block), bytes(block)))
        blocks = take(spad, 160)
        assert require_right(blocks) == list(range(160))
        assert spad.counters.crc_errors == 1


def resealed(**fields: tuple[int, str, int]) -> Callable[[bytearray], tuple[bytes]]:
    """Change header fields (offset, format, value) and sign the header anew."""

    def change(block: bytearray) -> tuple[bytes]:
        for offset, form, value in fields.values():
            struct.pack_into(form, block, offset, value)
        struct.pack_into("<I", block, 92, zlib.crc32(block[:92]))
        return (bytes(block),)

    return change


def test_a_sound_block_of_another_geometry_is_refused() -> None:
    device = model()
    with opened(device) as spad:
        device.mangle = nth(2, resealed(sensor=(76, "<H", 256)))
        blocks = take(spad, 160)
        assert require_right(blocks) == [*range(32), *range(48, 160)]


def test_a_block_of_another_run_is_passed_over() -> None:
    device = model()
    with opened(device) as spad:
        device.mangle = nth(0, resealed(run=(14, "<H", 9999)))
        blocks = take(spad, 160)
        assert require_right(blocks) == list(range(16, 160))
        assert spad.counters.lost == 16


def test_a_run_whose_last_block_is_lost_ends_with_the_devices_own_count() -> None:
    device = model()
    with opened(device) as spad:
        device.mangle = nth(9, lambda block: ())
        begun_s = spad._now_s()
        blocks = take(spad, 160)
        assert spad._now_s() - begun_s < 1.5
        assert require_right(blocks) == list(range(144))
        assert (spad.counters.exposed, spad.counters.lost) == (160, 16)


def test_frames_lost_inside_the_device_are_a_gap() -> None:
    device = model()
    with opened(device) as spad:
        ring, reader = begin(spad, REQUEST, 160)
        device.lose_next(5)
        finish(spad, ring)
        blocks = list(reader)
        assert require_right(blocks) == list(range(5, 160))
        assert blocks[0].header.flags & BlockFlag.MEMORY_OVERFLOW
        assert (spad.counters.exposed, spad.counters.lost) == (160, 5)


def test_the_high_water_mark_of_its_memory_is_told_behind_a_run() -> None:
    with opened(model(paced=True, fifo_frames=64)) as spad:
        timing = spad.configure(REQUEST)
        ring = BlockRing(50, timing.stride)
        spad.start(200)
        with pytest.raises(WrongState, match="health is not possible while running"):
            _ = spad.health
        spad._clock.sleep(0.01)  # the memory fills up
        while spad.fill(ring, 1.0):
            pass
        assert spad.health.memory_high_water_bytes == 64 * (16 + 384)
        assert spad.counters.lost


def test_a_truncated_block_counts_for_its_whole_frames() -> None:
    def cut(block: bytearray) -> tuple[bytes]:
        end = 384 + 16 * 384
        struct.pack_into("<I", block, end + 4, BlockStatus.TRUNCATED)
        struct.pack_into("<I", block, end + 16, 384 - 96 + 5 * 384 + 100)
        struct.pack_into("<I", block, end + 28, zlib.crc32(block[end : end + 28]))
        return (bytes(block),)

    device = model()
    with opened(device) as spad:
        device.mangle = nth(1, cut)
        blocks = take(spad, 64)
        assert require_right(blocks) == [*range(21), *range(32, 64)]
        assert spad.counters.lost == 11


# The ring


@pytest.mark.parametrize("slots", [1, 2, 3, 8, 40])
def test_a_reader_that_keeps_up_loses_nothing_however_short_the_ring(slots: int) -> None:
    with opened(model(paced=True, fifo_frames=1_000_000)) as spad:
        timing = spad.configure(REQUEST)
        ring = BlockRing(slots, timing.stride, on_full=OnFull.DROP)
        reader = ring.reader("test")
        numbers: list[int] = []

        def read() -> None:
            for block in reader:
                numbers.extend(block.frame_numbers.tolist())
                if slots < 3:
                    return  # it holds what the source needs

        thread = threading.Thread(target=read)
        thread.start()
        spad.start(320 if slots >= 3 else 16)
        while spad.fill(ring, 1.0):
            # It keeps up however busy the machine is: a thread that is not let run is another test's.
            while slots >= 3 and len(numbers) < spad.counters.delivered:
                time.sleep(0.001)
        ring.finish()
        thread.join()
        assert numbers == list(range(len(numbers)))
        assert len(numbers) == (320 if slots >= 3 else 16)


def test_a_full_ring_drops_counted_blocks_and_the_device_does_not_starve() -> None:
    with opened(model()) as spad:
        ring, reader = begin(spad, REQUEST, 160, 3, OnFull.DROP)
        finish(spad, ring)
        assert require_right(list(reader)) == list(range(48))
        assert (spad.counters.delivered, spad.counters.lost, ring.dropped_frames) == (48, 112, 112)


def test_a_full_ring_ends_the_run_where_the_policy_says_so() -> None:
    with opened(model()) as spad:
        timing = spad.configure(REQUEST)
        ring = BlockRing(3, timing.stride, on_full=OnFull.FAIL)
        ring.reader("test")
        spad.start(None)
        with pytest.raises(RingOverflow):  # noqa: PT012
            while spad.fill(ring, 1.0):
                pass
        spad.stop()
        assert len(ring._claimed) == 0


@pytest.mark.parametrize("slots", [3, 40])
def test_a_system_that_grants_few_reads_gets_few(slots: int) -> None:
    with opened(model()) as spad:
        link = spad._link
        submit = link.submit
        link.submit = lambda endpoint, buffer: len(link._queue) < 2 and submit(endpoint, buffer)  # type: ignore[method-assign]
        ring, reader = begin(spad, REQUEST, 160, slots, OnFull.DROP)
        finish(spad, ring)
        assert require_right(list(reader)) == list(range(min(160, 16 * slots)))
        assert not ring._claimed
