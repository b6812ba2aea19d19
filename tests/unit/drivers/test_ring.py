"""The ring: order, release, optional readers, ends and errors, alone and under real threads."""

import random
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.errors import DeviceFault, DeviceTimeout, RingOverflow, WrongState
from drivers.frames import FRAME_RECORD, FrameBlock
from drivers.ring import BlockRing, OnFull, RingReader
from tests.unit.drivers.spb1.spb1_bytes import GOLDEN_HEADER

STRIDE = 4096


def block_in(memory: np.ndarray, seq: int) -> FrameBlock:
    """A block that lies in `memory` and whose bytes are all `seq`."""
    memory[:] = seq % 251
    header = replace(GOLDEN_HEADER, block_seq=seq, first_frame=seq)
    return FrameBlock(header, np.zeros(1, FRAME_RECORD), memory[:64].reshape(1, 8, 8))


def put(ring: BlockRing, seq: int) -> None:
    memory = ring.claim(0)
    assert memory is not None
    ring.publish(block_in(memory, seq))


def sequence(block: FrameBlock | None) -> int | None:
    return None if block is None else block.header.block_seq


def test_a_full_ring_gives_no_slot_until_the_slowest_reader_moves_on() -> None:
    ring = BlockRing(2, STRIDE)
    quick, slow = ring.reader("quick"), ring.reader("slow")
    memory = ring.claim(0)
    assert memory is not None
    assert memory.ctypes.data % 4096 == 0
    ring.discard()
    put(ring, 0)
    put(ring, 1)
    assert [sequence(quick.next(0)), sequence(quick.next(0))] == [0, 1]
    assert ring.claim(0) is None
    assert sequence(slow.next(0)) == 0  # holds slot 0
    assert ring.claim(0.01) is None
    assert sequence(slow.next(0)) == 1  # gives it back
    assert ring.claim(0) is not None
    assert ring.high_water == 2


def test_a_reader_may_hold_the_newest_blocks_for_work_that_is_under_way() -> None:
    ring = BlockRing(4, STRIDE)
    reader = ring.reader("count", holds=3)
    for seq in range(4):
        put(ring, seq)
    blocks = [reader.next(0) for _ in range(3)]
    assert ring.claim(0) is None
    blocks.append(reader.next(0))  # the first one's slot is free now, the others' bytes are theirs
    put(ring, 4)
    assert [int(block.bits.ravel()[0]) for block in blocks[1:] if block is not None] == [1, 2, 3]
    reader.release()
    for seq in range(5, 8):
        put(ring, seq)
    assert ring.claim(0) is None


def test_readers_that_could_hold_every_slot_and_a_ring_of_nothing_are_refused() -> None:
    for slots, stride in ((0, 1), (1, 0), (-1, 4096)):
        with pytest.raises(ValueError, match="at least 1"):
            BlockRing(slots, stride)
    ring = BlockRing(2, STRIDE)
    with pytest.raises(ValueError, match="holds 3 of 2 slots"):
        ring.reader("count", holds=3)
    ring.reader("monitor", required=False)
    with pytest.raises(ValueError, match="holds 2 of 2 slots"):
        ring.reader("count", holds=2)
    with pytest.raises(ValueError, match="make the ring longer"):
        ring.reader("two", required=False)
    with pytest.raises(ValueError, match="can hold one"):
        BlockRing(9, STRIDE).reader("monitor", required=False, holds=2)
    ring = BlockRing(2, STRIDE)
    ring.reader("count", holds=2)
    with pytest.raises(ValueError, match="holds 2 of 2 slots, and 1 optional"):  # in either order
        ring.reader("monitor", required=False)


def test_an_optional_reader_holds_one_slot_and_never_the_last_one() -> None:
    ring = BlockRing(2, STRIDE)
    monitor = ring.reader("monitor", required=False)
    put(ring, 0)
    held = monitor.next(0)
    assert held is not None
    for seq in range(1, 20):
        put(ring, seq)
    assert (held.bits == 0).all()
    assert monitor.skipped == 19
    with pytest.raises(DeviceTimeout):
        monitor.next(0)
    put(ring, 20)
    assert sequence(monitor.next(0)) == 20


def test_an_idle_reader_is_offered_nothing_and_occupies_no_slot() -> None:
    ring = BlockRing(4, STRIDE)
    monitor = ring.reader("monitor", required=False)
    monitor.idle = True
    for seq in range(5):
        put(ring, seq)
    assert (ring.used, monitor.skipped) == (0, 0)
    monitor.idle = False
    put(ring, 5)
    assert ring.used == 1
    assert sequence(monitor.next(0)) == 5


def test_a_reader_that_closes_holds_nobody_up() -> None:
    ring = BlockRing(2, STRIDE)
    with ring.reader("count") as reader:
        put(ring, 0)
        put(ring, 1)
        reader.next(0)
        assert ring.claim(0) is None
    put(ring, 2)
    put(ring, 3)
    put(ring, 4)
    with pytest.raises(WrongState, match="closed"):
        reader.next(0)


def test_readers_get_what_is_left_and_then_the_sources_error() -> None:
    ring = BlockRing(2, STRIDE)
    reader = ring.reader("count")
    put(ring, 0)
    assert sequence(reader.next(0)) == 0
    with pytest.raises(DeviceTimeout, match=r"no block for reader 'count' within 0.01 s"):
        reader.next(0.01)
    ring.finish(DeviceFault("spad: over temperature"))
    ring.finish()
    for _ in range(2):
        with pytest.raises(DeviceFault, match="over temperature"):
            reader.next(0)


def test_a_ring_that_does_not_wait_answers_at_once_and_counts_dropped_blocks_with_their_frames() -> None:
    ring = BlockRing(2, STRIDE, on_full=OnFull.DROP)
    reader = ring.reader("count")
    assert not ring.waits
    assert ring.last_frame == -1
    put(ring, 0)
    put(ring, 1)
    assert ring.last_frame == 1
    assert ring.claim(1e9) is None
    assert ring.waited_s == 0
    ring.mark_overflow(64)
    ring.mark_overflow(10)
    assert (ring.dropped_blocks, ring.dropped_frames, ring.last_frame) == (2, 74, 75)
    assert [sequence(reader.next(0)) for _ in range(2)] == [0, 1]
    put(ring, 76)


def test_where_no_frame_may_be_lost_the_first_dropped_block_ends_the_run_and_says_what_to_do() -> None:
    ring = BlockRing(2, 1_000_000, on_full=OnFull.FAIL, holds_s=0.0125)
    with pytest.raises(RingOverflow) as caught:
        ring.mark_overflow(64)
    assert str(caught.value).startswith("ring: all 2 slots (2 MB, 0.0125 s of the stream) are full and a block of 64")
    assert "'--on-overload drop'" in str(caught.value)
    assert (ring.dropped_blocks, ring.dropped_frames) == (1, 64)


def test_the_time_that_a_source_waits_is_measured_and_its_wait_can_be_ended() -> None:
    ring = BlockRing(1, STRIDE)
    ring.reader("count")
    put(ring, 0)
    assert ring.claim(0.01) is None
    assert ring.waited_s >= 0.009
    threading.Timer(0.02, ring.end_waits).start()
    assert [ring.claim(600) for _ in range(2)] == [None, None]
    assert ring.waited_s < 60


def test_verbs_out_of_order_are_refused() -> None:
    ring = BlockRing(1, STRIDE)
    with pytest.raises(WrongState, match="without a claimed slot"):
        ring.discard()
    memory = ring.claim(0)
    assert memory is not None
    with pytest.raises(WrongState, match="after the first claim"):
        ring.reader("late")
    block = block_in(memory, 0)
    ring.publish(block)
    with pytest.raises(WrongState, match="without a claimed slot"):
        ring.publish(block)
    ring.finish()
    for late in (lambda: ring.claim(0), lambda: ring.publish(block)):
        with pytest.raises(WrongState, match="after finish"):
            late()


def test_a_source_waits_for_a_slot_that_comes_free_and_a_reader_wakes_up_at_the_end() -> None:
    ring = BlockRing(1, STRIDE)
    reader, last = ring.reader("count"), ring.reader("last")
    put(ring, 0)
    reader.next(0)
    last.next(0)
    last.release()
    threading.Timer(0.02, reader.close).start()
    assert ring.claim(60) is not None
    ring.discard()
    threading.Timer(0.02, ring.finish).start()
    assert last.next() is None


@settings(max_examples=25, deadline=None)
@given(
    slots=st.integers(2, 6),
    required=st.integers(1, 3),
    ahead=st.integers(1, 4),
    monitor=st.booleans(),
    seed=st.integers(0, 2**32),
)
def test_under_threads_every_reader_gets_every_block_unspoilt(
    slots: int, required: int, ahead: int, monitor: bool, seed: int
) -> None:
    """Each reader finds in the memory of each block what the source wrote, at the start and at the end of its use."""
    n_blocks = 200
    ring = BlockRing(slots, STRIDE)
    readers = [ring.reader(f"reader {index}") for index in range(required)]
    watcher = ring.reader("monitor", required=False) if monitor else None
    ahead = min(ahead, slots - monitor)
    seen: dict[str, list[int]] = {}

    def produce() -> None:
        claimed: list[np.ndarray] = []
        seq = 0
        while seq < n_blocks:
            while len(claimed) < ahead and (memory := ring.claim(0 if claimed else 60)) is not None:
                claimed.append(memory)
            ring.publish(block_in(claimed.pop(0), seq))
            seq += 1
        ring.finish()

    def consume(reader: RingReader) -> None:
        pause = random.Random(f"{seed} {reader.name}")
        numbers = seen.setdefault(reader.name, [])
        for block in reader:
            expected = block.header.block_seq % 251
            assert (block.bits == expected).all()
            if pause.random() < 0.05:
                time.sleep(0.0005)
            assert (block.bits == expected).all()
            numbers.append(block.header.block_seq)

    with ThreadPoolExecutor(8) as pool:
        work = [pool.submit(produce), *(pool.submit(consume, reader) for reader in readers)]
        work += [pool.submit(consume, watcher)] if watcher else []
        for each in work:
            each.add_done_callback(lambda done: ring.finish(done.exception()))
    assert [each.exception() for each in work] == [None] * len(work)
    for reader in readers:
        assert seen[reader.name] == list(range(n_blocks))
    if watcher is not None:
        numbers = seen[watcher.name]
        assert numbers == sorted(set(numbers))
        assert len(numbers) + watcher.skipped == n_blocks
    assert 1 <= ring.high_water <= slots
    assert len(ring._free) + len(ring._claimed) == slots


def test_the_newest_frame_is_told_with_its_tick_and_a_block_without_frames_tells_none() -> None:
    ring = BlockRing(3, STRIDE)
    ring.reader("any")
    assert ring.newest is None
    memory = ring.claim(0)
    assert memory is not None
    records = np.zeros(3, FRAME_RECORD)
    records["ticks"] = [0, 1000, 2000]
    header = replace(GOLDEN_HEADER, first_frame=40, t0_ticks=70_000)
    ring.publish(FrameBlock(header, records, np.zeros((3, 8, 8), np.uint8)))
    assert ring.newest == (GOLDEN_HEADER.run_id, 42, 72_000)
    assert ring.claim(0) is not None
    ring.publish(FrameBlock(header, records[:0], np.zeros((0, 8, 8), np.uint8)))
    assert ring.newest == (GOLDEN_HEADER.run_id, 42, 72_000)
