"""`verify` and `repair`: damage is found and told, what is sound is kept, and a repaired recording stays as it is."""

import json
import re
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from drivers.recorded import INDEX_FILE, RunRecording
from rig.api import reconstruct
from rig.errors import DamagedRecordingError, UsageError
from rig.recording.repair import repair
from rig.recording.verify import Integrity, verify
from rig.recording.writer import Recording
from rig.run_folder.manifest import MANIFEST, read_manifest, sealed_text
from tests.unit.rig.recording.recorded import Runs, assert_all_there, assert_same, flip, read, record, run_blocks

FIRST = "frames-000000.spb"


@pytest.fixture(scope="module")
def runs() -> Runs:
    return [run_blocks(run_id=1), run_blocks(run_id=2, seed=1)]


def files_of(folder: Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in sorted(folder.iterdir())}


def test_an_intact_recording_is_intact_and_repair_leaves_it(tmp_path: Path, runs: Runs) -> None:
    folder = record(tmp_path, runs)
    found = verify(folder)
    assert (found.verdict, found.exit_code, found.problems) == (Integrity.INTACT, 0, [])
    assert (found.runs, found.frames) == (2, sum(block.n_frames for blocks in runs for block in blocks))
    before = files_of(folder)
    assert repair(folder).done == []
    assert files_of(folder) == before


def test_frames_that_the_device_lost_are_gaps_and_those_that_only_the_recording_lost_are_damage(
    tmp_path: Path, runs: Runs
) -> None:
    found = verify(record(tmp_path / "device", [run_blocks(lost=[0, 1, *range(40, 45)])]))
    assert (found.verdict, found.exit_code) == (Integrity.GAPS, 1)
    assert (found.gaps, found.lost, found.problems) == ([(0, 0, 1), (0, 40, 44)], 7, [])
    found = verify(record(tmp_path / "recording", [[*runs[0][:2], *runs[0][3:]]]))
    assert found.verdict is Integrity.DAMAGED
    assert "run 0: frames 32 to 47 are missing, of which the device lost 0" in found.problems


@pytest.mark.parametrize("key", ["delivered", "lost"])
def test_counts_of_the_device_are_compared(tmp_path: Path, key: str) -> None:
    blocks = run_blocks(lost=[20])
    counters = {"delivered": sum(block.n_frames for block in blocks), "lost": 1}
    found = verify(record(tmp_path, [blocks], counters={**counters, key: counters[key] - 1}))
    assert found.verdict is Integrity.DAMAGED
    (problem,) = found.problems
    assert problem.startswith("the device ")


def test_a_changed_manifest_or_calibration_is_found(tmp_path: Path, runs: Runs) -> None:
    folder = record(tmp_path, runs, config={"depth_range": ["1 m", "8 m"]}, inputs={"plan.yaml": 1})
    (folder / "plan.yaml").write_text("columns: 20")
    assert verify(folder).problems == ["plan.yaml is not as it was written, its checksum does not fit"]
    text = (folder / MANIFEST).read_text()
    (folder / MANIFEST).write_text(text.replace('"8 m"', '"9 m"'))
    with pytest.raises(DamagedRecordingError, match="checksum does not fit"):
        read_manifest(folder)
    assert any("manifest" in problem for problem in verify(folder).problems)
    (folder / MANIFEST).write_text(json.dumps(json.loads(text)))  # spaces say nothing
    assert read_manifest(folder) is not None


def test_a_killed_run_is_repaired(tmp_path: Path, runs: Runs) -> None:
    folder = record(tmp_path, runs[:1], verdict="recording", counters=None, recording={"starts": []})
    assert verify(folder).verdict is Integrity.UNFINISHED
    last = sorted(folder.glob("frames-*.spb"))[-1]
    sound = last.read_bytes()
    torn = sound[: 4096 - 700]  # a block that was being written, in space set aside
    last.write_bytes(sound + torn + bytes(100_000))
    index = (folder / INDEX_FILE).read_bytes()
    (folder / INDEX_FILE).write_bytes(index[: -64 - 30])
    assert verify(folder).exit_code == 1
    done = repair(folder)
    assert done.after.verdict is Integrity.INTACT
    assert done.after.run == "aborted"
    assert last.read_bytes() == sound
    assert (folder / INDEX_FILE).read_bytes() == index
    assert (folder / last.name).with_suffix(".torn").read_bytes()[len(sound) :] == torn.rstrip(b"\0")
    before = files_of(folder)
    assert repair(folder).done == []
    assert files_of(folder) == before


def test_a_recording_that_ended_before_its_run_says_why_until_it_is_repaired(tmp_path: Path, runs: Runs) -> None:
    full = "No space left on device"
    delivered = sum(block.n_frames for block in runs[0]) + 100
    folder = record(tmp_path, runs[:1], verdict="aborted", counters={"delivered": delivered, "lost": 0})
    assert verify(folder).verdict is Integrity.DAMAGED  # nobody says why they are not there
    content = json.loads((folder / MANIFEST).read_text())
    content["recording"]["failed"] = full
    (folder / MANIFEST).write_text(sealed_text(json.dumps(content)))
    found = verify(folder)
    assert (found.verdict, found.exit_code, found.ended, found.problems) == (Integrity.UNFINISHED, 1, full, [])
    done = repair(folder)
    assert (done.after.verdict, done.after.run, done.after.ended) == (Integrity.INTACT, "aborted", None)
    assert repair(folder).done == []
    more = record(tmp_path / "more", runs[:1], counters={"delivered": 1, "lost": 0}, recording={"failed": "full"})
    assert verify(more).verdict is Integrity.DAMAGED  # more than the device delivered


def test_one_file_of_a_recording_is_refused_and_left(tmp_path: Path, runs: Runs) -> None:
    folder = record(tmp_path, runs)
    flip(folder / FIRST, 4096 + 500)
    before = files_of(folder)
    for act in (verify, repair):
        with pytest.raises(UsageError, match="is a file; name the folder"):
            act(folder / FIRST)
    assert files_of(folder) == before


def test_damage_in_the_middle_becomes_a_gap(tmp_path: Path, runs: Runs) -> None:
    folder = record(tmp_path, runs)
    whole = (folder / FIRST).read_bytes()
    flip(folder / FIRST, 4096 + 500)
    assert verify(folder).verdict is Integrity.DAMAGED
    done = repair(folder)
    assert (done.after.verdict, done.after.gaps) == (Integrity.GAPS, [(0, 16, 31)])
    assert done.after.run == "gaps"
    kept = np.frombuffer((folder / "frames-000000.torn").read_bytes(), np.uint8)[4096:8192]
    assert np.count_nonzero(kept != np.frombuffer(whole, np.uint8)[4096 : 4096 + len(kept)]) == 1
    recording = RunRecording(folder)
    assert recording.problems == []
    assert_same(read(recording)[0], [runs[0][0], *runs[0][2:]])


@pytest.mark.parametrize("what", ["lost", "damaged"])
def test_a_lost_manifest_is_written_anew(tmp_path: Path, runs: Runs, what: str) -> None:
    folder = record(tmp_path, runs)
    starts = json.loads((folder / MANIFEST).read_text())["recording"]["starts"]
    if what == "lost":
        (folder / MANIFEST).unlink()
    else:
        flip(folder / MANIFEST, 30)
    assert verify(folder).verdict is Integrity.DAMAGED
    done = repair(folder)
    assert done.after.verdict is Integrity.INTACT
    manifest = read_manifest(folder)
    assert manifest is not None
    assert manifest["verdict"] == "aborted"
    assert manifest["recording"]["starts"] == starts
    assert (folder / "manifest.damaged.json").exists() == (what == "damaged")


def test_a_part_whose_manifest_does_not_say_its_frames_is_repaired(tmp_path: Path, runs: Runs) -> None:
    folder = record(tmp_path, [runs[0][1:]], cut={"first_frame": 16})
    assert verify(folder).verdict is Integrity.INTACT
    flip(folder / FIRST, 4096 + 500)
    assert verify(folder).verdict is Integrity.DAMAGED
    assert repair(folder).after.gaps == [(0, 32, 47)]


def test_a_second_repair_leaves_what_the_first_one_kept(tmp_path: Path, runs: Runs) -> None:
    folder = record(tmp_path, runs)
    kept: dict[str, bytes] = {}
    for byte in (b"1", b"2"):
        with (folder / FIRST).open("rb+") as file:  # both times the second block
            file.seek(4096)
            file.write(byte * 4096)
        (folder / MANIFEST).write_bytes(byte)
        repair(folder)
        assert all((folder / name).read_bytes() == data for name, data in kept.items())
        kept = {name: data for name, data in files_of(folder).items() if "torn" in name or "damaged" in name}
    assert [name for name, data in kept.items() if b"2" * 4096 in data or data == b"2"] == [
        "frames-000000-1.torn",
        "manifest-1.damaged.json",
    ]


def test_blocks_that_come_twice_or_swapped_are_put_right(tmp_path: Path, runs: Runs) -> None:
    folder = record(tmp_path, runs)
    data = bytearray((folder / FIRST).read_bytes())
    data[4096:8192], data[8192:12288] = data[8192:12288], data[4096:8192]
    (folder / FIRST).write_bytes(data + data[:4096])
    assert verify(folder).verdict is Integrity.DAMAGED
    done = repair(folder)
    assert done.after.verdict is Integrity.INTACT, done
    assert_same(read(RunRecording(folder))[0], runs[0])


@pytest.mark.parametrize("renamed", range(6))
def test_a_repair_that_is_killed_while_it_puts_segments_in_order_loses_none(
    tmp_path: Path, runs: Runs, monkeypatch: pytest.MonkeyPatch, renamed: int
) -> None:
    folder = record(tmp_path, runs)
    names = sorted(file.name for file in folder.glob("frames-*.spb"))[:3]
    for name in names:
        (folder / name).rename(folder / f"{name}.kept")
    for name, other in zip(names, [*names[1:], names[0]], strict=True):
        (folder / f"{name}.kept").rename(folder / other)
    rename, done = Path.rename, []

    def killed(self: Path, target: Path) -> Path:
        if len(done) == renamed:
            raise KeyboardInterrupt
        done.append(target)
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", killed)
    with pytest.raises(KeyboardInterrupt):
        repair(folder)
    monkeypatch.undo()
    assert repair(folder).after.verdict is Integrity.INTACT
    recording = RunRecording(folder)
    assert_all_there(recording, runs)
    starts = (read_manifest(folder) or {})["recording"]["starts"]
    assert [start["segment"] for start in starts] == [int(run.entries["segment"][0]) for run in recording.runs]


@pytest.mark.skipif(sys.platform == "win32", reason="Windows itself keeps others away")
def test_a_run_that_is_still_recording_is_not_repaired(tmp_path: Path, runs: Runs) -> None:
    recording = Recording(tmp_path, expected_bytes=100_000)
    recording.append(runs[0][0])
    with pytest.raises(UsageError, match="still being recorded"):
        repair(tmp_path)
    recording.close()
    assert repair(tmp_path).after.frames == runs[0][0].n_frames


@pytest.mark.parametrize(
    ("files", "said"),
    [
        ([], "is an empty folder: no frames-*.spb; name the folder of a run taken with `record`"),
        (["a/notes.txt"], "is a folder without a recording: no frames-*.spb; name"),
        (["frames.npy"], "no frames-*.spb, but .npy files; if these are frames, 'rig import photoncube"),
        (["RAW00000.bin"], "'rig import swissspad2 (or pi-imaging)"),
        (["manifest.json"], "the frames of this run were not recorded; take it again with 'rig scan --record'"),
        (["first/frames-000000.spb", "second/frames-000000.spb"], "first or another of 2 in it"),
        (None, "does not exist; name the folder of a run"),
    ],
    ids=str,
)
def test_a_folder_without_a_recording_is_called_what_it_is(tmp_path: Path, files: list[str] | None, said: str) -> None:
    for file in files or ():
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).touch()
    for act in (verify, repair):
        with pytest.raises(UsageError, match=re.escape(said)):
            act(tmp_path / "absent" if files is None else tmp_path)


def test_of_a_folder_inside_a_run_the_run_is_named(tmp_path: Path) -> None:
    (tmp_path / "run" / "depth").mkdir(parents=True)
    (tmp_path / "run" / "manifest.json").touch()
    (tmp_path / "run" / "depth" / "000000.npy").touch()
    with pytest.raises(UsageError, match=r"depth is a folder inside a run; name .*run$"):
        verify(tmp_path / "run" / "depth")


def test_a_recording_with_a_similar_name_beside_one_that_is_not_there_is_named(tmp_path: Path, runs: Runs) -> None:
    record(tmp_path / "street", runs[:1])
    (tmp_path / "strett").mkdir()  # holds nothing
    for act in (verify, partial(reconstruct, out=tmp_path / "out")):
        with pytest.raises(UsageError, match=r"does not exist; did you mean '.*street'\? name the folder"):
            act(tmp_path / "stret")
