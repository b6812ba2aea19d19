"""`repair` of what is false with the right checksums, and of what is gone at the ends: it costs itself and is told."""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from drivers.frames import FrameBlock
from drivers.recorded import INDEX_FILE, RunRecording
from drivers.spb1.layout import HEADER, IDLE, PACKED, REGISTER_ACK, SPARSE, SUMMED, TRAILER
from rig.recording.cut import cut
from rig.recording.open import info
from rig.recording.repair import repair
from rig.recording.verify import Integrity, Verification, verify
from rig.run_folder.manifest import read_manifest
from tests.unit.rig.recording.forging import (
    HEADER_FIELDS,
    TRAILER_FIELDS,
    forge_header,
    forge_index,
    forge_payload,
    forge_trailer,
    most_of,
)
from tests.unit.rig.recording.recorded import Runs, flip, read, record, run_blocks

pytestmark = pytest.mark.slow

MIDDLE = 9
"""Number of a block amid those of a start."""
Files = dict[str, bytes]
Place = tuple[Path, int]
"""A segment and where in it a block begins."""


@pytest.fixture(scope="module")
def runs() -> Runs:
    return [run_blocks(run_id=1), run_blocks(run_id=2, lost=range(100, 103), seed=1)]


@pytest.fixture(scope="module")
def pristine(runs: Runs, tmp_path_factory: pytest.TempPathFactory) -> Files:
    """The files of a sound recording: writing one through to the disk takes long."""
    folder = record(tmp_path_factory.mktemp("pristine"), runs)
    return {file.name: file.read_bytes() for file in folder.iterdir()}


def copied(pristine: Files, folder: Path) -> Path:
    folder.mkdir(exist_ok=True)
    for name, data in pristine.items():
        (folder / name).write_bytes(data)
    return folder


@pytest.fixture(autouse=True)
def _no_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody pulls the plug here."""
    monkeypatch.setattr("rig.recording.repair.os.fsync", lambda fd: None)


def places(folder: Path, start: int) -> list[Place]:
    recording = RunRecording(folder)
    return [
        (folder / f"frames-{entry['segment']:06d}.spb", int(entry["offset"])) for entry in recording.runs[start].entries
    ]


def forge(place: Place, change: Callable[[bytearray, int], None]) -> None:
    data = bytearray(place[0].read_bytes())
    change(data, place[1])
    place[0].write_bytes(data)


def damage(place: Place) -> None:
    flip(place[0], place[1] + 300)


def content(blocks: list[FrameBlock]) -> set[tuple[int, int, bytes]]:
    return {
        (block.header.run_id, number, bits.tobytes())
        for block in blocks
        for number, bits in zip(block.frame_numbers.tolist(), block.bits, strict=True)
    }


def salvaged(folder: Path, runs: Runs, lost: FrameBlock | None) -> Verification:
    """Repair; AssertionError where anything but the frames of one block is gone, or `verify` is not content."""
    after = repair(folder).after
    assert after.problems == []
    assert after.verdict in (Integrity.INTACT, Integrity.GAPS)
    recording = RunRecording(folder)
    assert recording.problems == []
    found = content([block for run in read(recording) for block in run])
    may_go = content([] if lost is None else [lost])
    gone = content([block for run in runs for block in run]) - found
    assert gone <= may_go, f"{len(gone - may_go)} frames of other blocks are gone"
    there = sum(block.n_frames for run in read(recording) for block in run)
    if there < sum(block.n_frames for run in runs for block in run):
        assert after.verdict is Integrity.GAPS
        assert after.lost >= len(gone)
    assert repair(folder).done == []
    return after


PARTS = [
    *(("header", name) for name in HEADER_FIELDS if name not in ("magic", "header_crc")),
    *(("trailer", name) for name in TRAILER_FIELDS if name not in ("magic", "crc")),
    *(("records", name) for name in ("marks", "ticks", "x0", "y0", "line", "sweep")),
]


def forgeries(part: str, name: str, header: dict[str, int]) -> Iterator[Callable[[bytearray, int], None]]:
    """Changes of a block, each of which gives a field of one of its parts a false value."""
    if part == "header":
        most, old = most_of(HEADER, HEADER_FIELDS, name), header[name]
        values = {0, 1, old + 1, old + 17, most // 2 + 1, most}
        if name == "payload_type":
            values |= {PACKED, SPARSE, SUMMED, REGISTER_ACK, IDLE, 5}
        yield from (partial(forge_header, **{name: value}) for value in values if 0 <= value <= most and value != old)
    elif part == "trailer":
        most, end = most_of(TRAILER, TRAILER_FIELDS, name), header["header_len"] + header["payload_len"]
        for value in (0, 700, most):
            yield lambda data, at, value=value: forge_trailer(data, at + end, **{name: value})
    else:
        for frames in (slice(0, 1), slice(None)):
            for value in (0, np.iinfo(np.uint32 if name in ("marks", "ticks") else np.uint16).max):
                yield partial(forge_payload, name=name, frames=frames, value=value)


@pytest.mark.parametrize("number", [0, MIDDLE, -1])
@pytest.mark.parametrize(("part", "name"), PARTS)
def test_what_is_forged_in_a_block_costs_it_alone(
    tmp_path: Path, pristine: Files, runs: Runs, part: str, name: str, number: int
) -> None:
    file, at = places(copied(pristine, tmp_path / "whole"), 0)[number]
    header = dict(zip(HEADER_FIELDS, HEADER.unpack_from(file.read_bytes(), at), strict=True))
    for i, change in enumerate(forgeries(part, name, header)):
        folder = copied(pristine, tmp_path / f"{i}")
        forge(places(folder, 0)[number], change)
        salvaged(folder, runs, runs[0][number])


@pytest.mark.parametrize("name", ["block_seq", "first_frame", "t0_ticks", "sweep", "run_id", "lost_before", "height"])
def test_a_forged_header_in_the_middle_costs_its_block_alone_without_an_index_too(
    tmp_path: Path, pristine: Files, runs: Runs, name: str
) -> None:
    for value in (0, 1, 2**15, 2**16 - 1):
        folder = copied(pristine, tmp_path / f"{value}")
        forge(places(folder, 1)[3], partial(forge_header, **{name: value}))
        (folder / INDEX_FILE).unlink()
        salvaged(folder, runs, runs[1][3])


@pytest.mark.parametrize(
    "name",
    ["segment", "flags", "offset", "length", "run_id", "block_seq", "first_frame", "n_frames", "sweep", "t0_ticks"],
)
def test_a_forged_record_of_the_index_costs_nothing(tmp_path: Path, pristine: Files, runs: Runs, name: str) -> None:
    for number in (0, 4, -1):
        for value in (0, 3, 65_536, 2**31):
            folder = copied(pristine, tmp_path / f"{number}-{value}")
            forge_index(folder, number, name, value)
            reader = content([block for run in read(RunRecording(folder)) for block in run])
            gone = content([block for run in runs for block in run]) - reader
            assert len(gone) <= 16, f"{name} = {value} in record {number} costs a reader {len(gone)} frames"
            after = salvaged(folder, runs, None)
            assert after.lost == 3


def test_blocks_that_were_cut_away_at_either_end_are_gaps(tmp_path: Path, runs: Runs) -> None:
    for number in (0, -1):
        folder = record(tmp_path / f"{number}", runs[:1])
        block = runs[0][number]
        damage(places(folder, 0)[number])
        after = salvaged(folder, runs[:1], block)
        first, last = block.header.first_frame, block.header.first_frame + block.n_frames - 1
        assert after.gaps == [(0, first, last)]
        assert (after.verdict, after.exit_code, after.lost, after.run) == (Integrity.GAPS, 1, block.n_frames, "gaps")
        told = info(folder).runs[0]
        assert (told.gaps, told.lost) == (1, block.n_frames)


@pytest.mark.parametrize("index", ["there", "lost"])
@pytest.mark.parametrize("end", ["first", "last"])
def test_what_is_gone_at_an_end_of_a_part_is_a_gap(tmp_path: Path, runs: Runs, end: str, index: str) -> None:
    cut(record(tmp_path / "run", runs), tmp_path / "part", frames="20:120")
    part = tmp_path / "part"
    number = 0 if end == "first" else -1
    damage(places(part, 0)[number])
    if index == "lost":
        (part / INDEX_FILE).unlink()
    after = repair(part).after
    assert (after.verdict, after.exit_code) == (Integrity.GAPS, 1)
    assert after.gaps == [(0, 20, 31) if end == "first" else (0, 112, 119)]
    told = info(part).runs[0]
    assert (told.gaps, told.lost) == (1, after.lost)
    assert verify(part) == after


def test_a_last_block_is_known_to_be_gone_by_what_the_device_delivered(tmp_path: Path, runs: Runs) -> None:
    folder = record(tmp_path, runs[:1])
    damage(places(folder, 0)[-1])
    (folder / INDEX_FILE).unlink()
    after = repair(folder).after
    last = runs[0][-1]
    assert after.gaps == [(0, last.header.first_frame, last.header.first_frame + last.n_frames - 1)]


@pytest.mark.parametrize("counters", [{"delivered": -5, "lost": 0}, {"lost": 2**60}, {"delivered": 1e300}])
def test_counters_that_cannot_be_are_left_out_and_said(tmp_path: Path, runs: Runs, counters: dict[str, float]) -> None:
    folder = record(tmp_path, runs, counters=counters)
    assert any("which cannot be" in line for line in verify(folder).problems)
    done = repair(folder)
    assert any(line.endswith("which cannot be; left out") for line in done.done)
    assert (done.after.problems, done.after.lost) == ([], 3)
    assert "counters" not in (read_manifest(folder) or {})


def test_a_damaged_compressed_segment_is_unpacked_and_kept(tmp_path: Path, runs: Runs) -> None:
    pytest.importorskip("zstandard", reason="pip install 'spadrig[compress]'")
    from rig.recording.compress import compress

    folder = record(tmp_path, runs)
    compress(folder)
    file = folder / "frames-000000.spb.zst"
    flip(file, 40)
    damaged = file.read_bytes()
    after = salvaged(folder, runs, runs[0][0])
    assert after.gaps[0] == (0, 0, 15)
    assert (folder / "frames-000000.torn.zst").read_bytes() == damaged
    compress(folder)
    assert verify(folder).verdict is Integrity.GAPS
