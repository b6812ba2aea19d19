"""Reading recordings: all of them, parts, with a lost, torn or wrong index."""

from pathlib import Path

import numpy as np
import pytest

from drivers.errors import DeviceNotFound, ProtocolError
from drivers.recorded import INDEX_FILE, RunRecording, reader
from drivers.recorded.contents import HEADER_BYTES, RECORD_BYTES
from rig.recording.repair import repair
from rig.recording.verify import Integrity
from tests.unit.rig.recording.recorded import Runs, assert_all_there, flip, read, record, run_blocks


@pytest.fixture(scope="module")
def runs() -> Runs:
    return [run_blocks(run_id=1), run_blocks(lost=range(40, 45), run_id=2, seed=1)]


@pytest.mark.parametrize("ahead", [0, 10_000, reader.READ_AHEAD_BYTES])
def test_what_was_recorded_is_read(tmp_path: Path, runs: Runs, ahead: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reader, "READ_AHEAD_BYTES", ahead)
    recording = RunRecording(record(tmp_path, runs))
    assert_all_there(recording, runs)
    assert recording.problems == []
    assert len(list(tmp_path.glob("frames-*.spb"))) > 2
    assert [run.gaps() for run in recording.runs] == [[], [(40, 44)]]


def test_any_frames_can_be_read(tmp_path: Path, runs: Runs) -> None:
    recording = RunRecording(record(tmp_path, runs))
    run = recording.runs[1]
    for first, end in ((0, 1), (37, 47), (20, 90), (run.end_frame - 3, run.end_frame + 5)):
        blocks = list(recording.blocks(run, first, end))
        whole = [block for block in runs[1] if block.header.first_frame < end]
        numbers = np.concatenate([block.frame_numbers for block in whole])
        wanted = (numbers >= first) & (numbers < end)
        for of in (lambda b: b.bits, lambda b: b.start_ticks, lambda b: b.records["sweep"]):
            every, found = (np.concatenate([of(block) for block in these]) for these in (whole, blocks))
            assert np.array_equal(found, every[wanted])
        assert [block.header.sweep & 0xFFFF for block in blocks] == [int(block.records["sweep"][0]) for block in blocks]


@pytest.mark.parametrize("what", ["lost", "no header", "torn", "a record less", "damaged record", "of another"])
def test_blocks_are_found_whatever_became_of_the_index(tmp_path: Path, runs: Runs, what: str) -> None:
    folder = record(tmp_path / "run", runs)
    index = folder / INDEX_FILE
    data = bytearray(index.read_bytes())
    if what == "lost":
        index.unlink()
    elif what == "of another":
        index.write_bytes((record(tmp_path / "other", [run_blocks(run_id=7)]) / INDEX_FILE).read_bytes())
    else:
        if what == "no header":
            data[1] ^= 4
        elif what == "torn":
            del data[-20:]
        elif what == "a record less":
            del data[HEADER_BYTES + RECORD_BYTES : HEADER_BYTES + 2 * RECORD_BYTES]
        else:
            data[HEADER_BYTES + 3 * RECORD_BYTES + 9] ^= 1
        index.write_bytes(data)
    recording = RunRecording(folder)
    assert_all_there(recording, runs)
    assert recording.problems


def test_a_damaged_block_is_a_gap_and_said(tmp_path: Path, runs: Runs) -> None:
    folder = record(tmp_path, runs)
    flip(folder / "frames-000000.spb", 4096 + 500)
    recording = RunRecording(folder)
    found = read(recording)[0]
    assert [block.header.block_seq for block in found] == [0, *range(2, len(runs[0]))]
    assert len(recording.problems) == 1
    assert recording.problems[0].startswith("frames-000000.spb, byte 4096: payload of block 1: CRC is ")


def test_swapped_segments_are_put_in_order(tmp_path: Path, runs: Runs) -> None:
    folder = record(tmp_path, runs)
    first, last = folder / "frames-000000.spb", sorted(folder.glob("frames-*.spb"))[-1]
    one, other = first.read_bytes(), last.read_bytes()
    first.write_bytes(other)
    last.write_bytes(one)
    recording = RunRecording(folder)
    assert_all_there(recording, runs)
    assert recording.problems
    assert repair(folder).after.verdict is Integrity.GAPS  # as the device said
    assert (first.read_bytes(), last.read_bytes()) == (one, other)
    assert_all_there(RunRecording(folder), runs)


def test_starts_stay_in_order_when_index_records_are_swapped(tmp_path: Path, runs: Runs) -> None:
    folder = record(tmp_path, runs)
    data = (folder / INDEX_FILE).read_bytes()
    middle = HEADER_BYTES + len(runs[0]) * RECORD_BYTES
    (folder / INDEX_FILE).write_bytes(data[:HEADER_BYTES] + data[middle:] + data[HEADER_BYTES:middle])
    recording = RunRecording(folder)
    assert_all_there(recording, runs)
    assert recording.problems == ["frames.idx: its records are not in the order in which they were written"]


def test_a_folder_without_a_recording_is_said(tmp_path: Path) -> None:
    with pytest.raises(DeviceNotFound, match="holds no recording"):
        RunRecording(tmp_path)
    (tmp_path / "frames-000000.spb").write_bytes(b"none" * 1000)
    with pytest.raises(ProtocolError, match="holds no whole block"):
        RunRecording(tmp_path)


def test_a_start_of_which_no_block_is_sound_is_said(tmp_path: Path, runs: Runs) -> None:
    folder = record(tmp_path, runs)
    first = {entry["segment"] for entry in RunRecording(folder).runs[0].entries}
    for number in first:
        file = folder / f"frames-{number:06d}.spb"
        data = np.frombuffer(file.read_bytes(), np.uint8).copy()
        data[500::4096] ^= 1  # the pixels of every block
        file.write_bytes(data.tobytes())
    recording = RunRecording(folder)
    assert [run.header.run_id for run in recording.runs] == [2]
    assert recording.problems == [f"run 1: none of its {len(runs[0])} blocks is sound"]


def test_blocks_that_all_moved_are_found(tmp_path: Path, runs: Runs) -> None:
    folder = record(tmp_path, runs)
    file = folder / "frames-000000.spb"
    file.write_bytes(bytes(1024) + file.read_bytes())
    recording = RunRecording(folder)
    assert_all_there(recording, runs)
    assert recording.problems
