"""Writing recordings: segments, index and starts; wherever a block lies in memory, and whatever ends the program."""

import errno
import os
import threading
import zlib
from collections.abc import Callable
from concurrent.futures import wait
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.frames import FrameBlock
from drivers.recorded.contents import HEADER_BYTES, INDEX_FILE, INDEX_RECORD, decode_index, segment_name
from drivers.spb1 import BlockLayout, block_parts, parse_block, walk_blocks
from rig.errors import RecordingError
from rig.recording import segment as segment_module
from rig.recording.segment import PAGE_BYTES, OpenSegment, paged
from rig.recording.writer import RESERVE_FILE, Recording
from tests.campaigns.recording.strikes import HEIGHT, WIDTH, Striker, blocks_of

BLOCKS = blocks_of(0, 0)
SIZES = [paged(BlockLayout(block.n_frames, WIDTH, HEIGHT).block_bytes) for block in BLOCKS]


def written(folder: Path, **options: int) -> Recording:
    recording = Recording(folder, **options)
    for each in [recording.submit(block) for block in BLOCKS]:
        each.result()
    recording.close()
    return recording


def test_segments_hold_the_bytes_of_each_block_at_the_place_that_the_index_tells(tmp_path: Path) -> None:
    recording = written(tmp_path, segment_bytes=1 << 20)
    records, sound = decode_index(np.fromfile(tmp_path / INDEX_FILE, np.uint8))
    assert sound.all()
    assert len(records) == len(BLOCKS) == recording.blocks
    assert recording.files == [segment_name(i) for i in range(len(recording.files))]
    assert len(recording.files) > 3
    files = [(tmp_path / name).read_bytes() for name in recording.files]
    assert sum(map(len, files)) == recording.bytes == sum(SIZES)
    assert max(map(len, files)) <= 1 << 20
    for block, record in zip(BLOCKS, records, strict=True):
        at, length = int(record["offset"]), int(record["length"])
        assert at % PAGE_BYTES == 0
        stored = files[record["segment"]][at : at + length]
        assert stored == b"".join(block_parts(block))[:length]
        assert (record["first_frame"], record["n_frames"]) == (block.header.first_frame, block.n_frames)
        assert zlib.crc32(record.tobytes()[:-4]) == record["crc"]


@given(shift=st.integers(0, 2 * PAGE_BYTES), n=st.integers(0, 20), height=st.integers(1, 40), direct=st.booleans())
@settings(max_examples=40, deadline=None)
def test_a_block_is_written_alike_wherever_it_lies(
    tmp_path_factory: pytest.TempPathFactory, shift: int, n: int, height: int, direct: bool
) -> None:
    folder = tmp_path_factory.mktemp("run")
    memory = np.random.default_rng(n).integers(0, 256, 3 * PAGE_BYTES + n * height * 64, np.uint8)
    bits = memory[shift : shift + n * height * 64].reshape(n, height, 64)
    header = replace(BLOCKS[0].header, width=512, height=height, sensor_width=512, sensor_height=height)
    block = FrameBlock(header, np.zeros(n, BLOCKS[0].records.dtype), bits)
    with pytest.MonkeyPatch.context() as patch:
        if not direct:
            patch.setattr(segment_module.os, "O_DIRECT", 0)
        recording = Recording(folder, segment_bytes=1 << 20)
        recording.append(block)
        recording.close()
    data = np.fromfile(folder / segment_name(0), np.uint8)
    assert len(data) % PAGE_BYTES == 0
    assert parse_block(data, check_payload=True).bits.tobytes() == bits.tobytes()


def test_each_start_run_and_width_has_segments_of_its_own(tmp_path: Path) -> None:
    recording = Recording(tmp_path)
    for run_id in (1, 1, 2):
        recording.begin(3)
        for block in BLOCKS[:2]:
            recording.append(replace(block, header=replace(block.header, run_id=run_id)))
    narrow = replace(BLOCKS[0].header, run_id=2, width=64, sensor_width=64)
    recording.append(FrameBlock(narrow, BLOCKS[0].records, np.ascontiguousarray(BLOCKS[0].bits[:, :, :8])))
    recording.close()
    assert recording.content()["starts"] == [{"sweeps": 3, "segment": segment} for segment in (0, 1, 2)]
    assert recording.files == [segment_name(i) for i in range(4)]


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="files are named by their descriptors on Linux only")
def test_what_was_recorded_is_synced_in_time_blocks_before_index(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    order: list[str] = []
    sync, fsync = segment_module._sync_data, os.fsync

    def noted(call: Callable[[int], None], fd: int) -> None:
        order.append(os.readlink(f"/proc/self/fd/{fd}"))
        call(fd)

    monkeypatch.setattr(segment_module, "_sync_data", partial(noted, sync))
    monkeypatch.setattr(os, "fsync", partial(noted, fsync))
    synced = threading.Semaphore(0)

    def companion() -> None:
        order.append("companion")
        synced.release()

    recording = Recording(tmp_path, on_sync=companion)
    order.clear()
    recording.append(BLOCKS[0])
    for _ in range(3):  # the first of them may have begun before
        assert synced.acquire(timeout=60)
    names = [Path(one).name for one in order]
    begin = names.index(segment_name(0), names.index(tmp_path.name) + 1)
    assert names[begin : begin + 3] == [segment_name(0), INDEX_FILE, "companion"]
    recording.close()
    assert recording.longest_unsynced_s > 0


@pytest.mark.parametrize(("slow", "submitted"), [(7, 12), (4, 8)], ids=["behind it is written", "before it is not"])
def test_all_blocks_before_one_that_could_not_be_written_count_and_none_behind_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, slow: int, submitted: int
) -> None:
    write, through = OpenSegment.write, threading.Semaphore(0)

    def failing(self: OpenSegment, block: FrameBlock, *others: object) -> int:
        if block.header.block_seq == slow:
            assert all(through.acquire(timeout=60) for _ in range(submitted - 1))
        try:
            if block.header.block_seq == 7:
                raise OSError(errno.EIO, "Input/output error")
            return write(self, block, *others)  # type: ignore[arg-type]
        finally:
            through.release()

    monkeypatch.setattr(OpenSegment, "write", failing)
    recording = Recording(tmp_path, expected_bytes=sum(SIZES))
    under_way = [recording.submit(block) for block in BLOCKS[:submitted]]
    wait(under_way)
    with pytest.raises(RecordingError, match=r"frames-000000.spb beyond .* MB: Input/output error"):
        under_way[7].result()
    with pytest.raises(RecordingError, match="Input/output error"):
        recording.submit(BLOCKS[12])
    recording.close()
    assert recording.blocks == 7
    assert (tmp_path / segment_name(0)).stat().st_size == sum(SIZES[:7]) == recording.bytes
    assert (tmp_path / INDEX_FILE).stat().st_size == HEADER_BYTES + 7 * INDEX_RECORD.itemsize
    assert not (tmp_path / RESERVE_FILE).exists()
    blocks = list(walk_blocks(np.fromfile(tmp_path / segment_name(0), np.uint8), None, check_payload=True))
    assert [block.header.block_seq for block in blocks if isinstance(block, FrameBlock)] == list(range(7))


def test_a_recording_without_a_block_leaves_no_segment(tmp_path: Path) -> None:
    recording = Recording(tmp_path)
    recording.begin(1)
    recording.close()
    recording.close()
    assert [file.name for file in tmp_path.iterdir()] == [INDEX_FILE]


@pytest.mark.skipif(not hasattr(os, "posix_fallocate"), reason="space is not set aside here")
def test_of_a_disk_with_little_room_half_is_set_aside_and_of_a_full_one_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def full(fd: int, offset: int, size: int) -> None:
        asked.append(size)
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", full)
    monkeypatch.setattr(os, "fstatvfs", lambda fd: SimpleNamespace(f_bavail=1001, f_frsize=PAGE_BYTES))
    recording = Recording(tmp_path)
    recording.append(BLOCKS[0])
    recording.close()
    assert asked == [500 * PAGE_BYTES]
    assert (tmp_path / segment_name(0)).stat().st_size == SIZES[0]


def test_a_killed_recording_has_every_block_that_counted_and_no_other(tmp_path: Path) -> None:
    striker = Striker(tmp_path)
    outcomes = [striker.strike(seed, share) for seed, share in enumerate((0.02, 0.2, 0.4, 0.6, 0.8, 1.0))]
    assert [outcome.wrong for outcome in outcomes] == [None] * 6
    assert any(outcome.found for outcome in outcomes)
