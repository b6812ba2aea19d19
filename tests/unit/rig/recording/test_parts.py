"""`cut`, `info`, maps of a recording, and compression: parts and compressed recordings give the very frames."""

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drivers.frames import FrameBlock
from drivers.recorded import INDEX_FILE, RunRecording
from rig.errors import DamagedRecordingError, UsageError
from rig.recording.compress import compress
from rig.recording.cut import cut
from rig.recording.open import MapSpan, info, map_spans
from rig.recording.repair import repair
from rig.recording.verify import Integrity, verify
from rig.run_folder.manifest import read_manifest
from tests.unit.rig.count.streams import plan_of, scan, stream_of
from tests.unit.rig.recording.recorded import MAPS, Runs, assert_all_there, assert_same, flip, read, record, run_blocks


@pytest.fixture(scope="module")
def runs() -> Runs:
    return [run_blocks(run_id=1), run_blocks(lost=range(140, 145), run_id=2, seed=1)]


def true_spans() -> list[MapSpan]:
    begins = stream_of(plan_of(scan()), MAPS).scan_frames.tolist()
    return [MapSpan(run, begins[i], begins[i + 1]) for run in (0, 1) for i in range(MAPS)]


def sweeps() -> list[dict[str, float]]:
    frames = [{"first_frame": span.first_frame, "end_frame": span.end_frame} for span in true_spans()]
    return [{**of, "clock_error": (i + 1) * 1e-5, "residual_columns": 0.01} for i, of in enumerate(frames)]


def frames_in(recording: RunRecording, run: int, first: int, end: int) -> tuple[list[int], bytes]:
    blocks = list(recording.blocks(recording.runs[run], first, end))
    numbers = np.concatenate([block.frame_numbers for block in blocks]).tolist()
    return numbers, b"".join(block.bits.tobytes() + block.start_ticks.tobytes() for block in blocks)


@pytest.mark.parametrize("stated", [True, False])
def test_maps_are_found_by_manifest_and_by_markers(tmp_path: Path, runs: Runs, stated: bool) -> None:
    folder = record(tmp_path, runs, **({"sweeps": sweeps()} if stated else {}))
    assert map_spans(RunRecording(folder), read_manifest(folder)) == true_spans()


@pytest.mark.parametrize("known", [{"recording": {"failed": "full", "starts": []}}, {"repaired": ["its end"]}])
def test_maps_that_were_made_of_frames_behind_the_end_are_not_in_a_recording_cut_short(
    tmp_path: Path, runs: Runs, known: dict[str, object]
) -> None:
    short = [runs[0], runs[1][: len(runs[1]) * 2 // 3]]
    folder = record(tmp_path / "short", short, sweeps=sweeps(), **known)
    recording, manifest = RunRecording(folder), read_manifest(folder)
    assert map_spans(recording, manifest) == map_spans(recording, None) == true_spans()[:-2]
    folder = record(tmp_path / "whole", runs, sweeps=sweeps(), **known)
    assert map_spans(RunRecording(folder), read_manifest(folder)) == true_spans()


def test_info_tells_what_there_is(tmp_path: Path, runs: Runs) -> None:
    found = info(record(tmp_path, runs, config={"name": "small"}, devices={"spad": {"name": "SPAD 7"}}))
    assert (found.maps, found.config, found.devices) == (2 * MAPS, "small", {"spad": "SPAD 7"})
    assert [(run.run_id, run.first_map, run.end_map, run.gaps) for run in found.runs] == [(1, 0, 3, 0), (2, 3, 6, 1)]
    assert found.runs[0].duration_s == pytest.approx(found.runs[0].frames * 1e-5)
    assert found.folder == tmp_path


def test_maps_are_cut_out_with_their_closing_marker(tmp_path: Path, runs: Runs) -> None:
    folder = record(tmp_path / "run", runs, sweeps=sweeps(), maps=6, inputs={"plan.yaml": 0})
    (folder / "plan.yaml").write_bytes(b"")
    (folder / "learned").mkdir()
    for i in range(6):
        (folder / "learned" / f"{i:06d}.npz").write_bytes(bytes([i]))
    manifest = cut(folder, tmp_path / "part", maps="2:5")
    spans = true_spans()
    whole, part = RunRecording(folder), RunRecording(tmp_path / "part")
    for run, first, end in (
        (0, spans[2].first_frame, spans[2].end_frame + 1),
        (1, spans[3].first_frame, spans[4].end_frame + 1),
    ):
        assert frames_in(part, run, 0, 10_000) == frames_in(whole, run, first, end)
    assert manifest["cut"]["maps"] == [2, 5]
    assert manifest["cut"]["clock_ratios"] == [1 + 2e-5, 1.0]
    assert manifest["gaps"] == [[140, 144]]
    assert map_spans(part, manifest) == map_spans(part, None) == spans[2:5]
    assert [(tmp_path / "part/learned" / f"{i:06d}.npz").read_bytes() for i in range(3)] == [b"\2", b"\3", b"\4"]
    assert verify(tmp_path / "part").verdict is Integrity.GAPS
    again = cut(tmp_path / "part", tmp_path / "again", maps="1")
    assert again["cut"]["maps"] == [3, 4]
    assert (tmp_path / "again/learned/000000.npz").read_bytes() == b"\3"
    assert verify(tmp_path / "again").verdict is Integrity.INTACT


@pytest.mark.parametrize(
    ("asked", "first", "end"),
    [
        ({"frames": "37:150"}, 37, 150),
        ({"frames": ":20"}, 0, 20),
        ({"frames": "50"}, 50, 51),
        ({"time": "0.0002:0.00101"}, 20, 101),
        ({"time": "0.0025:"}, 250, 10_000),
    ],
)
def test_frames_and_times_are_cut_out(tmp_path: Path, runs: Runs, asked: dict[str, str], first: int, end: int) -> None:
    folder = record(tmp_path / "run", runs)
    cut(folder, tmp_path / "part", start=1, **asked)
    part = RunRecording(tmp_path / "part")
    assert frames_in(part, 0, 0, 10_000) == frames_in(RunRecording(folder), 1, first, end)
    assert not verify(tmp_path / "part").problems


def test_a_part_is_over_and_has_its_own_verdict(tmp_path: Path, runs: Runs) -> None:
    folder = record(tmp_path / "run", runs, verdict="gaps")
    assert cut(folder, tmp_path / "without", frames=":20")["verdict"] == "complete"
    assert cut(folder, tmp_path / "with", frames="100:200", start=1)["verdict"] == "gaps"
    killed = record(tmp_path / "killed", runs, verdict="recording")
    assert cut(killed, tmp_path / "part", frames=":20")["verdict"] == "aborted"
    assert verify(tmp_path / "part").verdict is Integrity.INTACT


def test_what_a_repair_found_missing_is_known_to_be_missing_in_a_part(tmp_path: Path, runs: Runs) -> None:
    folder = record(tmp_path / "run", [runs[0], [*runs[1][:2], *runs[1][3:]]])
    repair(folder)
    cut(folder, tmp_path / "around", frames="10:100", start=1)
    found = verify(tmp_path / "around")
    assert (found.verdict, found.gaps) == (Integrity.GAPS, [(0, 32, 47)])
    cut(folder, tmp_path / "behind", frames="40:100", start=1)
    assert verify(tmp_path / "behind").verdict is Integrity.INTACT


@pytest.mark.parametrize("what", ["lost plan", "changed plan", "damaged frames"])
def test_nothing_is_cut_of_what_is_damaged_or_without_the_plan_that_it_was_taken_with(
    tmp_path: Path, runs: Runs, what: str
) -> None:
    frames = what == "damaged frames"
    folder = record(tmp_path / "run", runs, **({} if frames else {"inputs": {"plan.yaml": 0}}))
    if frames:
        flip(folder / "frames-000000.spb", 500)
    elif what == "changed plan":
        (folder / "plan.yaml").write_bytes(b"other")
    with pytest.raises(DamagedRecordingError, match="repair" if frames else r"plan.yaml .* from a copy"):
        cut(folder, tmp_path / "part", maps="0:2")
    assert not (tmp_path / "part").exists()


def test_maps_cannot_be_cut_where_there_are_no_markers(tmp_path: Path, runs: Runs) -> None:
    def unmarked(block: FrameBlock) -> FrameBlock:
        records = block.records.copy()
        records["marks"] = records["sweep"] = records["line"] = 0
        return replace(block, header=replace(block.header, sweep=0), records=records)

    folder = record(tmp_path / "run", [list(map(unmarked, runs[0]))])
    with pytest.raises(UsageError, match="no markers to tell maps apart"):
        cut(folder, tmp_path / "part", maps="0:2")


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"maps": "0", "time": "0:1"}, "2 were given"),
        ({"maps": "4:9"}, "it has 6"),
        ({"maps": "x"}, "no range"),
        ({"frames": "1", "start": 2}, "it has 2"),
        ({"time": "1:2:3"}, "no range"),
        ({"time": "nan:1"}, "no range"),
        ({"time": "1e300:"}, "holds no frame"),
        ({"frames": "9" * 30 + ":"}, "holds no frame"),
    ],
)
def test_what_is_not_there_is_not_cut(tmp_path: Path, runs: Runs, asked: dict[str, object], words: str) -> None:
    folder = record(tmp_path / "run", runs)
    with pytest.raises(UsageError, match=words):
        cut(folder, tmp_path / "part", **asked)  # type: ignore[arg-type]
    assert not (tmp_path / "part").exists()


class TestCompressed:
    @pytest.fixture(autouse=True)
    def _zstandard(self) -> None:
        pytest.importorskip("zstandard", reason="pip install '.[compress]'")

    def test_every_frame_is_read_by_the_same_index(self, tmp_path: Path, runs: Runs) -> None:
        folder = record(tmp_path, runs)
        index = (folder / INDEX_FILE).read_bytes()
        plain = sum(file.stat().st_size for file in folder.glob("frames-*.spb"))
        made = compress(folder)
        assert (made.bytes_before, list(folder.glob("frames-*.spb"))) == (plain, [])
        assert made.bytes_after < plain
        recording = RunRecording(folder)
        assert recording.problems == []
        assert_all_there(recording, runs)
        assert frames_in(recording, 1, 30, 50)[0] == list(range(30, 50))
        assert (folder / INDEX_FILE).read_bytes() == index
        assert verify(folder).verdict is Integrity.GAPS
        assert repair(folder).done == []
        assert compress(folder).bytes_before == plain

    def test_any_zstd_gives_the_plain_segment_back(self, tmp_path: Path, runs: Runs) -> None:
        import zstandard

        folder = record(tmp_path, runs)
        plain = (folder / "frames-000000.spb").read_bytes()
        compress(folder)
        with (folder / "frames-000000.spb.zst").open("rb") as file:
            assert zstandard.ZstdDecompressor().stream_reader(file, read_across_frames=True).read() == plain

    @pytest.mark.parametrize("what", ["table", "frame"])
    def test_damage_costs_what_it_hit(self, tmp_path: Path, runs: Runs, what: str) -> None:
        folder = record(tmp_path, runs)
        compress(folder)
        flip(folder / "frames-000000.spb.zst", -2 if what == "table" else 40)
        assert_same(read(RunRecording(folder))[0], runs[0][0 if what == "table" else 1 :])
        assert verify(folder).verdict is (Integrity.GAPS if what == "table" else Integrity.DAMAGED)

    def test_a_recording_that_is_not_whole_is_not_compressed(self, tmp_path: Path, runs: Runs) -> None:
        folder = record(tmp_path, runs, verdict="recording")
        with pytest.raises(DamagedRecordingError, match="not over"):
            compress(folder)
        (folder / INDEX_FILE).unlink()
        with pytest.raises(DamagedRecordingError, match="repair"):
            compress(folder)
        assert list(folder.glob("*.zst")) == []


@pytest.mark.parametrize("act", [compress, verify, repair, info])
def test_without_the_package_the_command_to_install_it_is_told(
    tmp_path: Path, runs: Runs, monkeypatch: pytest.MonkeyPatch, act: Callable[[Path], object]
) -> None:
    pytest.importorskip("zstandard", reason="pip install '.[compress]'")
    compress(record(tmp_path, runs))
    monkeypatch.setitem(sys.modules, "zstandard", None)
    with pytest.raises(
        UsageError, match=r"need the package zstandard; install it: .* -m pip install .*(\[compress\]|zstandard)"
    ):
        act(tmp_path)
