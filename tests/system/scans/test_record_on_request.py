"""Recording that is switched on and off during a scan: its parts are whole recordings, and nobody waits for them."""

import json
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.frames import FrameBlock
from drivers.recorded import RunRecording
from rig import api
from rig.api import RecordingSwitch, SeenMap
from rig.errors import RecordingError, UsageError
from rig.live.record_wish import STATE, record
from rig.recording.writer import Recording
from rig.scan.on_request import PartsRecording
from tests.system import small_rig
from tests.system.conftest import Rig
from tests.system.run_files import strict


def manifest_of(run: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((run / "manifest.json").read_text())
    return content


@contextmanager
def at_frames(on: Sequence[int], off: Sequence[int] = ()) -> Iterator[None]:
    """Switch as soon as the recorder has these frames: in device time, whatever the host is at."""
    wishes = sorted([*((frame, True) for frame in on), *((frame, False) for frame in off)])
    note = PartsRecording._note

    def noting(self: PartsRecording, block: FrameBlock) -> None:
        note(self, block)
        while wishes and wishes[0][0] < block.header.first_frame + block.n_frames:
            self._switch.on() if wishes.pop(0)[1] else self._switch.off()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(PartsRecording, "_note", noting)
        yield


@pytest.fixture(scope="module")
def parted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with two parts, from maps 2 and 7 on, and `whole`, the same scan recorded as a whole."""
    folder = tmp_path_factory.mktemp("parted")
    config = small_rig.write_rig(folder / "rig")
    with at_frames((3000, 8000), (5000, 9000)):
        api.scan(config, maps=12, seed=3, out=folder / "run", record_on_request=True, before="5 ms")
    api.scan(config, maps=12, seed=3, out=folder / "whole", record=True)
    return folder


def test_a_part_holds_the_very_frames_of_the_whole_recording(parted: Path) -> None:
    """Whatever the switch does: same numbers, records and bits as if all had been recorded."""
    whole = RunRecording(parted / "whole")
    parts = sorted((parted / "run").glob("part-*"))
    assert [part.name for part in parts] == ["part-000", "part-001"]
    for part in parts:
        recording = RunRecording(part)
        (run,) = recording.runs
        assert 0 < run.first_frame < run.end_frame
        blocks = recording.blocks(run)
        others = whole.blocks(whole.runs[0], run.first_frame, run.end_frame)
        for block, other in zip(blocks, others, strict=True):
            assert block.header.first_frame == other.header.first_frame
            assert block.header.sweep == other.header.sweep
            assert np.array_equal(block.records, other.records)
            assert np.array_equal(block.bits, other.bits)


def test_a_part_is_intact_is_played_to_the_bit_and_cut_and_exported_like_any_recording(
    parted: Path, tmp_path: Path
) -> None:
    for part in sorted((parted / "run").glob("part-*")):
        found = api.verify(part)
        assert (found.verdict, found.problems, found.gaps, found.exit_code) == ("intact", [], [], 0)
        manifest = manifest_of(part)
        first, end = manifest["cut"]["maps"]
        assert end > first
        assert manifest["verdict"] == "complete"
        for make in ("replay", "reconstruct"):
            out = tmp_path / f"{make}-{part.name}"
            again = api.replay(part, clock="max", out=out) if make == "replay" else api.reconstruct(part, out=out)
            assert (again.summary.maps, again.summary.verdict) == (end - first, "complete")
            for number, index in enumerate(range(first, end)):
                assert np.array_equal(
                    np.load(out / f"depth/{number:06d}.npy"),
                    np.load(parted / f"run/depth/{index:06d}.npy"),
                    equal_nan=True,
                )
        assert again.truth is not None
        info = api.recording_info(part)
        assert (info.maps, info.problems) == (end - first, [])
        assert info.runs[0].first_frame_utc is not None
        piece = tmp_path / f"piece-{part.name}"
        api.cut(part, piece, maps="0:1")
        assert api.verify(piece).exit_code == 0
        assert api.replay(piece, clock="max").summary.maps == 1
        assert api.export_run(part, "npy", out=tmp_path / f"npy-{part.name}").frames == found.frames


def test_what_was_not_recorded_is_told_and_adds_up(parted: Path) -> None:
    manifest = manifest_of(parted / "run")
    told = manifest["on_request"]
    assert told["before_s"] == 0.005
    recorded = [tuple(part["frames"]) for part in told["parts"]]
    missing = [(first, last + 1) for _, first, last in told["not_recorded"]]
    pieces = sorted([*recorded, *missing])
    assert pieces[0][0] == 0
    assert all(before[1] == after[0] for before, after in pairwise(pieces))
    assert pieces[-1][1] > manifest["sweeps"][-1]["end_frame"]
    assert manifest["verdict"] == "complete"  # the maps of the run have lost nothing
    assert json.loads((parted / "run/summary.json").read_text())["frames"]["lost"] == 0


def test_a_run_of_parts_says_where_its_recordings_are(rig: Rig, parted: Path) -> None:
    ran = rig("verify", parted / "run")
    assert (ran.code, len(ran.problems)) == (2, 1)
    assert "part-000 or another of 2 in it" in ran.problems[0]
    listed = strict(rig("runs", parted, "--json").out)["runs"]
    assert isinstance(listed, list)
    assert [Path(entry["folder"]).name for entry in listed] == ["run", "whole"]


@pytest.mark.slow
def test_a_part_begins_as_long_before_as_was_asked_for_and_with_a_whole_sweep(small: Path, tmp_path: Path) -> None:
    """Without `before` it begins with the sweep under way; with a long one, at the first frame."""
    begins = {}
    for before in ("0 s", "30 ms", "10 s"):
        switch = RecordingSwitch(before)
        out = tmp_path / before.replace(" ", "")
        with at_frames([5000]):
            api.scan(small, maps=8, seed=3, out=out, switch=switch)
        (part,) = switch.parts
        begins[before] = part.first_frame
        whole = manifest_of(out / "part-000")["cut"]["maps"]
        assert whole[1] == 8  # to the end of the scan
        again = api.replay(out / "part-000", clock="max")
        assert again.summary.maps == whole[1] - whole[0]
    assert begins["10 s"] == 0
    # 100 kHz: 30 ms are 3000 frames, give or take a sweep and a block of 500.
    assert begins["0 s"] - begins["30 ms"] == pytest.approx(3000, abs=1023 + 500)
    assert 5000 - 1023 - 2 * 500 <= begins["0 s"] <= 5000


def test_on_and_off_at_once_still_records_one_part_and_a_switch_that_is_never_on_none(
    small: Path, tmp_path: Path
) -> None:
    switch = RecordingSwitch("20 ms")
    with at_frames([3100], [3100]):
        api.scan(small, maps=6, out=tmp_path / "once", switch=switch)
    (part,) = switch.parts
    assert part.sweeps >= 1
    assert api.verify(part.folder).exit_code == 0
    assert api.replay(part.folder, clock="max").summary.maps == part.sweeps

    never = RecordingSwitch("20 ms")
    result = api.scan(small, maps=2, out=tmp_path / "never", switch=never)
    assert never.parts == []
    assert result.summary.verdict == "complete"
    assert not list((tmp_path / "never").glob("part-*"))
    assert manifest_of(tmp_path / "never")["on_request"]["parts"] == []


def test_a_wish_at_the_end_of_a_scan_is_met_out_of_the_ring(small: Path, tmp_path: Path) -> None:
    switch = RecordingSwitch("10 s")
    with at_frames([2170]):
        api.scan(small, maps=2, out=tmp_path / "run", switch=switch)
    (part,) = switch.parts
    assert (part.first_frame, part.sweeps) == (0, 2)
    assert api.verify(part.folder).exit_code == 0


@pytest.mark.slow
def test_learned_states_go_with_a_part(tmp_path: Path) -> None:
    """`likelihood` learns from map to map: the maps of a part come out as in the scan all the same."""
    content = small_rig.config() | {"estimate": {"estimator": "likelihood"}}
    config = small_rig.write_rig(tmp_path / "rig", content)
    switch = RecordingSwitch()
    with at_frames([3000]):
        api.scan(config, maps=6, out=tmp_path / "run", switch=switch)
    (part,) = switch.parts
    first, end = manifest_of(part.folder)["cut"]["maps"]
    assert 0 < first < end == 6
    api.replay(part.folder, clock="max", out=tmp_path / "again")
    for number, index in enumerate(range(first, end)):
        assert np.array_equal(
            np.load(tmp_path / f"again/depth/{number:06d}.npy"),
            np.load(tmp_path / f"run/depth/{index:06d}.npy"),
            equal_nan=True,
        )


def test_a_disk_that_hangs_between_parts_holds_up_no_frame(
    small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second part's folder is not ready for as long as the scan lasts: the scan goes on, and that part begins when
    no frame comes any more, out of the ring."""
    prepare = PartsRecording._prepare
    release = threading.Event()

    def slow(self: PartsRecording, number: int) -> Recording:
        if number == 1:
            assert release.wait(60)
        return prepare(self, number)

    monkeypatch.setattr(PartsRecording, "_prepare", slow)
    switch = RecordingSwitch()

    def act(seen: SeenMap) -> None:
        if seen.left == 0:
            release.set()

    with at_frames((1000, 6000), [3000]):
        result = api.scan(small, maps=9, out=tmp_path / "run", switch=switch, on_map=act)
    assert (result.summary.maps, result.summary.verdict, result.summary.frames.lost) == (9, "complete", 0)
    assert [part.folder.name for part in switch.parts] == ["part-000", "part-001"]
    assert switch.parts[1].first_frame >= switch.parts[0].end_frame  # how far back depends on the host
    for part in switch.parts:
        assert api.verify(part.folder).exit_code == 0


def test_a_disk_that_fails_ends_the_scan_as_with_any_recording(
    small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from rig.recording.segment import OpenSegment

    def full(self: OpenSegment, *_: object) -> None:
        raise OSError(28, "No space left on device")

    switch = RecordingSwitch()
    monkeypatch.setattr(OpenSegment, "write", full)
    with at_frames([3000]), pytest.raises(RecordingError, match="No space left on device"):
        api.scan(small, maps=9, out=tmp_path / "run", switch=switch)
    assert (tmp_path / "run/depth/000000.npy").exists()


@pytest.mark.slow
def test_a_part_that_a_killed_program_left_is_repaired(
    small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is on the disk when nothing more is written: no manifest but the first ones."""
    monkeypatch.setattr(PartsRecording, "finish", lambda self, manifest: None)
    switch = RecordingSwitch("5 ms")
    with at_frames([3000], [5000]):
        api.scan(small, maps=8, out=tmp_path / "run", switch=switch)
    (part,) = switch.parts
    assert api.verify(part.folder).verdict == "unfinished"
    mended = api.repair(part.folder)
    assert mended.after.problems == []
    assert mended.after.frames == part.end_frame - part.first_frame
    again = api.replay(part.folder, clock="max")
    assert again.summary.maps == part.sweeps


def test_scans_that_on_map_changes_have_parts_of_their_own(small: Path, tmp_path: Path) -> None:
    switch = RecordingSwitch()
    switch.on()
    result = api.scan(
        small, maps=2, out=tmp_path / "run", switch=switch, on_map=lambda seen: {"exposures": 5 + seen.number}
    )
    assert [part.folder for part in switch.parts] == [tmp_path / "run/part-000", tmp_path / "run-2/part-000"]
    assert [run.summary.exposures for run in (*result.earlier, result)] == [4, 5]
    for part in switch.parts:
        assert api.verify(part.folder).exit_code == 0
        assert part.sweeps >= 1


def test_wrong_requests_are_refused_before_anything_moves(rig: Rig, small: Path, tmp_path: Path) -> None:
    for wrong, told in (
        (("--record-on-request", "--record"), "leave one of the two out"),
        (("--before", "2 s"), "is for --record-on-request"),
        (("--record-on-request", "--before", "2"), "--before is '2'"),
        (("--record-on-request", "--before", "9999 s"), "half may be used"),
    ):
        ran = rig("scan", small, "--out", "run", *wrong)
        assert (ran.code, len(ran.problems)) == (2, 1), ran.err
        assert told in ran.problems[0]
        assert not Path("run").exists()
    with pytest.raises(UsageError, match="name one with `out`"):
        api.scan(small, switch=RecordingSwitch())
    for before in (-1.0, float("nan"), float("inf"), "soon"):
        with pytest.raises(UsageError, match="`before` is"):
            RecordingSwitch(before)
    used = RecordingSwitch()
    used.on()
    api.scan(small, out=tmp_path / "a", switch=used)
    with pytest.raises(UsageError, match="make a new one"):
        api.scan(small, out=tmp_path / "b", switch=used)


class EnoughError(Exception):
    """Ends a scan from its callback."""


def test_another_process_switches_by_files_in_the_folder(small: Path, tmp_path: Path, rig: Rig) -> None:
    """`rig record` against a scan that goes on until it has been asked everything."""
    over = threading.Event()
    run = tmp_path / "work" / "runs" / "long"
    ended: list[BaseException] = []

    def until_over(seen: SeenMap) -> None:
        time.sleep(0.001)
        if over.is_set():
            raise EnoughError

    def scan() -> None:
        try:
            api.scan(
                small, maps=100_000, save="last", out=run, record_on_request=True, before="1 ms", on_map=until_over
            )
        except BaseException as error:
            ended.append(error)

    thread = threading.Thread(target=scan)
    thread.start()
    try:
        waited_until = time.monotonic() + 60
        while not (run / STATE).exists() and thread.is_alive() and time.monotonic() < waited_until:
            time.sleep(0.01)
        assert "not recording, 0 parts" in rig("record", "state", run).out
        assert rig("record", "on").out == "runs/long: recording, 1 part so far\n"
        assert rig("record", "on", run).code == 0
        ran = rig("record", "off", "--json")
        assert {key: strict(ran.out)[key] for key in ("on", "recording", "parts")} == {
            "on": False, "recording": False, "parts": 1,
        }  # fmt: skip
        assert record(True, run).parts == 2
    finally:
        over.set()
        thread.join(60)
    assert [type(error) for error in ended] == [EnoughError]
    assert not (run / STATE).exists()
    for part in ("part-000", "part-001"):
        assert api.verify(run / part).exit_code == 0
    for where, told in (
        ((), "none goes on in runs"),
        ((run,), "is no scan that goes on"),
        (("none",), "does not exist"),
    ):
        ran = rig("record", "on", *where)
        assert (ran.code, len(ran.problems)) == (2, 1)
        assert told in ran.problems[0]
    assert "write on, off or state" in rig("record", "maybe").problems[0]


@pytest.mark.long
@pytest.mark.slow
def test_real_drivers_record_parts_of_a_stream(tmp_path: Path) -> None:
    config = small_rig.write_rig(tmp_path / "emulated", small_rig.emulated())
    switch = RecordingSwitch("20 ms")
    with at_frames([4000], [6000]):
        result = api.scan(config, maps=8, out=tmp_path / "run", switch=switch)
    assert (result.summary.verdict, result.summary.frames.lost) == ("complete", 0)
    assert switch.parts
    for part in switch.parts:
        assert api.verify(part.folder).exit_code == 0
        if part.sweeps:
            first, end = manifest_of(part.folder)["cut"]["maps"]
            api.replay(part.folder, clock="max", out=tmp_path / f"again-{part.folder.name}")
            for number, index in enumerate(range(first, end)):
                assert np.array_equal(
                    np.load(tmp_path / f"again-{part.folder.name}/depth/{number:06d}.npy"),
                    np.load(tmp_path / f"run/depth/{index:06d}.npy"),
                    equal_nan=True,
                )
