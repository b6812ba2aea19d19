"""The SPB1 driver and a damaged stream or a full ring: docs/reference/spb1-usb.md, What the driver does."""

import struct
import threading
import time
import zlib
from collections.abc import Callable, Iterable

import pytest

from drivers.clock import now_s
from drivers.errors import RingOverflow, WrongState
from drivers.frames import BlockFlag, BlockStatus
from drivers.ring import OnFull
from tests.wire.spad_runs import begin, finish
from tests.wire.spb_device import REQUEST, model, nth, opened, require_right, take

Change = Callable[[bytearray], Iterable[bytes]]


def flipped(at: int) -> Change:
    def change(block: bytearray) -> tuple[bytes]:
        block[at] ^= 0x10
        return (bytes(block),)

    return change


def resealed(offset: int, form: str, value: int) -> Change:
    """Change a header field and sign the header anew."""

    def change(block: bytearray) -> tuple[bytes]:
        struct.pack_into(form, block, offset, value)
        struct.pack_into("<I", block, 92, zlib.crc32(block[:92]))
        return (bytes(block),)

    return change


def truncated(block: bytearray) -> tuple[bytes]:
    """Five whole frames and a bit."""
    end = 384 + 16 * 384
    struct.pack_into("<I", block, end + 4, BlockStatus.TRUNCATED)
    struct.pack_into("<I", block, end + 16, 384 - 96 + 5 * 384 + 100)
    struct.pack_into("<I", block, end + 28, zlib.crc32(block[end : end + 28]))
    return (bytes(block),)


@pytest.mark.parametrize(
    ("change", "lost", "refused"),
    [
        *(
            pytest.param(flipped(at), 16, 1, id=f"flipped byte {at}")
            for at in (0, 24, 92, 300, 6000, 384 + 16 * 384 + 4)
        ),
        pytest.param(resealed(76, "<H", 256), 16, 1, id="another geometry"),
        pytest.param(resealed(14, "<H", 9999), 16, 0, id="another run"),
        pytest.param(truncated, 11, 0, id="truncated: its whole frames count"),
        pytest.param(lambda block: (bytes(block), bytes(block)), 0, 1, id="twice"),
        pytest.param(lambda block: (), 16, 0, id="lost"),
    ],
)
@pytest.mark.parametrize("number", [3, 9])
@pytest.mark.parametrize("zero_packets", [False, True], ids=["", "packets of 0 bytes"])
def test_damage_of_a_block_costs_that_block_only(
    number: int, change: Change, lost: int, refused: int, zero_packets: bool
) -> None:
    device = model(zero_packets=zero_packets)
    with opened(device) as spad:
        device.mangle = nth(number, change)
        begun_s = now_s(spad._clock)
        blocks = take(spad, 160)
        assert now_s(spad._clock) - begun_s < 1.5  # also where the last block is lost: the device is asked
        end = 16 * number + 16
        assert require_right(blocks) == [*range(end - lost), *range(end, 160)]
        counters = spad.counters
        assert (counters.exposed, counters.lost) == (160, lost)
        assert counters.crc_errors == (refused if lost or number < 9 else 0)  # behind the last one nobody listens
        if lost == 16 and number == 3:
            assert blocks[3].header.flags & BlockFlag.LOST_BEFORE
            assert blocks[3].header.lost_before == 16


@pytest.mark.parametrize("keep", [1024, 3072, 6144, None])
def test_a_block_cut_short_or_bytes_between_blocks_shift_the_stream_and_it_is_resynchronised(keep: int | None) -> None:
    device = model()
    with opened(device) as spad:
        device.mangle = nth(4, lambda block: (bytes(2048), bytes(block)) if keep is None else (bytes(block[:keep]),))
        numbers = require_right(take(spad, 3000))
        counters = spad.counters
        assert numbers[:64] == list(range(64))
        assert numbers[-1] == 2999
        assert counters.resyncs == 1
        assert counters.exposed == 3000
        assert counters.lost == 3000 - len(numbers)
        assert len(numbers) > 1000


def test_frames_lost_inside_the_device_are_a_gap_and_its_high_water_mark_is_told() -> None:
    with opened(model(paced=True, fifo_frames=64)) as spad:
        ring, reader = begin(spad, REQUEST, 200)
        with pytest.raises(WrongState, match="health is not possible while running"):
            _ = spad.health
        spad._clock.sleep(0.001)  # 100 frames of 10 us
        finish(spad, ring)
        assert spad.health.memory_high_water_bytes == 64 * (16 + 384)
        blocks = list(reader)
        numbers = require_right(blocks)
        assert numbers == list(range(numbers[0], 200))
        assert blocks[0].header.flags & BlockFlag.MEMORY_OVERFLOW
        assert (spad.counters.exposed, spad.counters.lost) == (200, numbers[0])
        assert numbers[0] >= 36


# The ring


@pytest.mark.parametrize("slots", [1, 3, 40])
def test_a_reader_that_keeps_up_loses_nothing_however_short_the_ring(slots: int) -> None:
    n_frames = 320 if slots >= 3 else 16  # a short one holds what the source needs
    with opened(model(paced=True, fifo_frames=1_000_000)) as spad:
        ring, reader = begin(spad, REQUEST, n_frames, slots, OnFull.DROP)
        numbers: list[int] = []
        thread = threading.Thread(target=lambda: [numbers.extend(block.frame_numbers.tolist()) for block in reader])
        thread.start()
        while spad.fill(ring, 1.0):
            # It keeps up however busy the machine is: a thread that is not let run is another test's.
            while len(numbers) < spad.counters.delivered:
                time.sleep(0.001)
        ring.finish()
        thread.join()
        assert numbers == list(range(n_frames))


def test_a_full_ring_drops_counted_blocks_or_ends_the_run_as_the_policy_says() -> None:
    with opened(model()) as spad:
        ring, reader = begin(spad, REQUEST, 160, 3, OnFull.DROP)
        finish(spad, ring)
        assert require_right(list(reader)) == list(range(48))
        assert (spad.counters.delivered, spad.counters.lost, ring.dropped_frames) == (48, 112, 112)
        ring, _ = begin(spad, REQUEST, None, 3, OnFull.FAIL)
        with pytest.raises(RingOverflow):
            finish(spad, ring)
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
