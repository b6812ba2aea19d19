"""`rig replay`: a recording gives the same depth, to the last bit, at every clock, thread count and block size."""

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from drivers.recorded import RunRecording
from rig import api
from rig.errors import DamagedRecordingError, UsageError
from rig.run_folder.manifest import read_manifest, sealed_text
from rig.scan import scan as scanning
from tests.system.conftest import Rig
from tests.system.run_files import arrays
from tests.system.small_rig import config, write_rig


def scan_of(folder: Path, estimator: str, maps: int, **spad: object) -> Path:
    """A run of the small rig with its recording."""
    content = config()
    content["estimate"]["estimator"] = estimator
    content["spad"].update(spad)
    api.scan(write_rig(folder / "rig", content), maps=maps, seed=5, out=folder / "run", record=True)
    return folder / "run"


@pytest.fixture(scope="module")
def learned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Maps that depend on those before them."""
    return scan_of(tmp_path_factory.mktemp("learned"), "likelihood", 3)


@pytest.fixture(scope="module")
def lossy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Maps with gaps, from two starts of the SPAD."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scanning, "_first_alone", lambda rig: True)
        return scan_of(tmp_path_factory.mktemp("lossy"), "argmax", 3, loss_probability=0.01)


def with_manifest(run: Path, copy: Path, change: Callable[[dict[str, Any]], None]) -> Path:
    """A copy of a run whose manifest was changed and sealed again."""
    shutil.copytree(run, copy)
    manifest = read_manifest(copy)
    assert manifest is not None
    change(manifest)
    (copy / "manifest.json").write_text(sealed_text(json.dumps(manifest)))
    return copy


@pytest.mark.parametrize(
    "options",
    [
        {"clock": "realtime"},
        {"clock": "x0.25", "threads": 1, "block_frames": 13},
        {"clock": "max", "threads": 3, "block_frames": 1000},
    ],
    ids=str,
)
def test_the_maps_are_those_of_the_scan_to_the_last_bit(learned: Path, tmp_path: Path, options: dict) -> None:
    api.replay(learned, out=tmp_path / "again", **options)
    assert arrays(tmp_path / "again") == arrays(learned)


def test_gaps_and_starts_are_those_of_the_scan(lossy: Path, tmp_path: Path) -> None:
    result = api.replay(lossy, clock="max", block_frames=5, out=tmp_path / "again", record=True)
    before, after = read_manifest(lossy), read_manifest(tmp_path / "again")
    assert before is not None
    assert after is not None
    assert [start["sweeps"] for start in before["recording"]["starts"]] == [1, 2]
    assert after["gaps"] == before["gaps"] != []
    assert after["sweeps"] == before["sweeps"]
    assert result.summary.verdict.value == "gaps"
    assert arrays(tmp_path / "again") == arrays(lossy)
    api.replay(tmp_path / "again", clock="max", out=tmp_path / "third")  # a replay that was recorded is a recording
    assert arrays(tmp_path / "third") == arrays(lossy)


def test_fewer_maps_are_the_first_ones_and_more_need_a_loop(lossy: Path, tmp_path: Path) -> None:
    api.replay(lossy, clock="max", maps=2, out=tmp_path / "two")
    two = arrays(tmp_path / "two")
    assert two.items() < arrays(lossy).items()
    with pytest.raises(UsageError, match=r"`maps` is 4, .* holds 3; .*`loop=True`"):
        api.replay(lossy, clock="max", maps=4)
    api.replay(lossy, clock="max", loop=True, maps=5, save="all", out=tmp_path / "five")
    first = {name: data for name, data in arrays(tmp_path / "five").items() if "/00000" in name}
    assert first["depth/000003/"] == first["depth/000000/"]
    assert first["depth/000004/"] == first["depth/000001/"]


@pytest.mark.parametrize("why", ["killed", "disk full"])
def test_a_recording_that_was_cut_short_gives_its_whole_maps(learned: Path, tmp_path: Path, why: str) -> None:
    def change(manifest: dict[str, Any]) -> None:
        if why == "killed":
            manifest["verdict"] = "recording"
            for key in ("sweeps", "gaps", "counters"):
                del manifest[key]
        else:  # whose maps went on to be made of what was in the ring
            manifest["verdict"] = "aborted"
            manifest["recording"]["failed"] = "no space"

    run = with_manifest(learned, tmp_path / "torn", change)
    (segment,) = run.glob("frames-*.spb")
    in_the_third = next(entry for entry in RunRecording(run).runs[0].entries if entry["sweep"] == 3)
    os.truncate(segment, int(in_the_third["offset"]) + 5000)
    assert api.recording_info(run).maps == 2
    result = api.replay(run, clock="max", out=tmp_path / "again")
    assert result.summary.maps == 2
    assert arrays(tmp_path / "again").items() < arrays(learned).items()


def test_recordings_in_passes_of_older_versions_are_refused_in_a_sentence(lossy: Path, tmp_path: Path) -> None:
    in_passes = with_manifest(lossy, tmp_path / "passes", lambda manifest: manifest.update(passes=[]))
    for call in (lambda: api.replay(in_passes, clock="max"), lambda: api.cut(in_passes, maps="0", out=tmp_path / "x")):
        with pytest.raises(UsageError, match="was scanned adaptively"):
            call()


def test_a_missing_start_is_not_closed_up(lossy: Path, tmp_path: Path) -> None:
    run = tmp_path / "holed"
    shutil.copytree(lossy, run)
    (run / "frames-000000.spb").unlink()
    with pytest.raises(DamagedRecordingError, match="not the first"):
        api.replay(run, clock="max")


def test_the_command_plays_and_reports_how_the_clock_was_held(learned: Path, rig: Rig) -> None:
    ran = rig("replay", learned, "--clock", "x2", "--maps", 2, "--json", "--out", "again")
    assert ran.code == 0, ran.err
    summary = json.loads(ran.out)
    assert summary["maps"] == 2
    assert summary["replay"]["blocks"] > 0
    assert summary["replay"]["late_max_s"] >= summary["replay"]["late_mean_s"] >= 0
    assert json.loads(Path("again/manifest.json").read_text())["command"] == "replay"
    ran = rig("replay", learned, "--clock", "x8", "--maps", 1, "--estimator", "argmax", "--out", "for-people")
    (line,) = (line for line in ran.out.splitlines() if line.startswith("clock"))
    assert re.match(r"clock +blocks late by \S+ \+- \S+ ms, at most \S+ ms", line)


def test_frames_without_a_plan_cannot_be_played(learned: Path, tmp_path: Path) -> None:
    for file in ("frames-000000.spb", "frames.idx"):
        shutil.copyfile(learned / file, tmp_path / file)
    with pytest.raises(UsageError, match=r"has no plan\.yaml, by which its frames are bound"):
        api.replay(tmp_path)


def test_a_wrong_option_is_the_users(learned: Path, rig: Rig) -> None:
    ran = rig("replay", learned, "--clock", "fast")
    assert ran.code == 2
    assert "realtime, max, step" in ran.problems[0]
    assert rig("replay", learned, "--threads", 0).problems[0].startswith("error: --threads is 0, it must be")
    assert rig("replay", learned, "--estimator", "x").problems[0].startswith("error: --estimator is 'x'; choose")
    assert not list(Path().iterdir())


def test_enter_lets_one_sweep_pass(lossy: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-c", "from rig.cli.main import main; main()", "replay", str(lossy), "--clock", "step"]
    out = ["--out", str(tmp_path / "again"), "--json"]
    ran = subprocess.run([*command, *out], input=b"\n\n", capture_output=True, timeout=120, check=False)
    assert ran.returncode == 1, ran.stderr  # gaps
    assert json.loads(ran.stdout)["maps"] == 3
