"""Recordings as a user makes them: a folder in place from the start, and depth from it that is the same to the bit."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from calibration.errors import digits
from rig.scan.acquisition import Acquisition
from tests.system.conftest import Rig
from tests.system.run_files import assert_same

OPTIONS = ("--exposures", 3, "--maps", 3, "--seed", 5)


def summary(folder: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((folder / "summary.json").read_text())
    return content


@pytest.mark.parametrize("estimator", ["likelihood", "joint", "argmax"])
def test_a_recording_gives_the_depth_of_its_scan_to_the_bit_alone(rig: Rig, small: Path, estimator: str) -> None:
    taken = rig("scan", small, "--estimator", estimator, *OPTIONS, "--record", "--out", "lab/run")
    assert taken.code == 0, taken.err
    shutil.move("lab/run", "elsewhere")
    shutil.rmtree(small.parent)  # neither the rig's files nor its name are there any more
    again = rig("reconstruct", "elsewhere", "--out", "again")
    assert again.code == 0, again.err
    assert_same(Path("elsewhere"), Path("again"))
    live, replayed = summary(Path("elsewhere")), summary(Path("again"))
    same = "maps", "frames", "sensor_time_s", "valid_fraction", "floating_points", "fog", "truth", "verdict", "sync"
    for key in same:
        assert live[key] == replayed[key], key


def test_a_recording_can_be_reconstructed_otherwise(rig: Rig, small: Path) -> None:
    assert rig("scan", small, "--maps", 1, "--record", "--out", "run").code == 0
    plain = rig("scan", small, "--maps", 1, "--estimator", "edge", "--filter", "median", "--out", "edge")
    assert plain.code == 0
    assert rig("reconstruct", "run", "--estimator", "edge", "--filter", "median", "--out", "other").code == 0
    assert_same(Path("edge"), Path("other"))
    nearer = yaml.safe_load(Path("run/calibration.yaml").read_text())
    nearer["scanner"]["pivot"]["axis_point_m"] = [-0.15, 0, 0]  # half the base line
    Path("nearer.yaml").write_text(yaml.safe_dump(nearer))
    assert rig("reconstruct", "run", "--calibration", "run/calibration.yaml", "--out", "same").code == 0
    assert_same(Path("run"), Path("same"))
    arguments = ("reconstruct", "run", "--calibration", "nearer.yaml", "--out", "near")
    refused = rig(*arguments)
    assert (refused.code, "its depths are 0.5 times those of the calibration with which" in refused.err) == (2, True)
    assert rig(*arguments, "--accept-calibration").code == 0
    depth, near = (np.load(f"{name}/depth/000000.npy") for name in ("run", "near"))
    assert np.nanmedian(near) == pytest.approx(np.nanmedian(depth) / 2, rel=0.1)


def test_segments_of_another_recording_in_more_or_fewer_blocks_are_said(rig: Rig, small: Path) -> None:
    for name, maps in (("short", 1), ("long", 6)):
        assert rig("scan", small, "--maps", maps, "--seed", maps, "--record", "--out", name).code == 0
        shutil.copytree(name, f"{name} as it was")
    for mine, other in (("short", "long"), ("long", "short")):
        for name in ("frames-000000.spb", "frames.idx"):
            shutil.copy(f"{other} as it was/{name}", f"{mine}/{name}")
    refused = rig("reconstruct", "short", "--out", "depth")
    assert (refused.code, "bring its own segments back" in refused.err) == (1, True), refused.err
    assert "the run recorded" in refused.err
    assert not Path("depth").exists()
    assert rig("reconstruct", "long", "--out", "depth").code == 1
    assert summary(Path("depth"))["verdict"] == "gaps"


def test_the_folder_of_a_recording_says_what_it_is_before_the_first_frame(
    rig: Rig, small: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    start, seen = Acquisition._arm_laser, []

    def look(self: Acquisition) -> None:
        seen.append(json.loads(Path("run/manifest.json").read_text()))
        assert {file.name for file in Path("run").iterdir()} >= {"plan.yaml", "calibration.yaml", "frames.idx"}
        start(self)

    monkeypatch.setattr(Acquisition, "_arm_laser", look)
    assert rig("scan", small, "--record", "--out", "run").code == 0
    (begun,) = seen
    ended = json.loads(Path("run/manifest.json").read_text())
    assert (begun["verdict"], ended["verdict"]) == ("recording", "complete")
    assert begun["recording"]["sync_interval_s"] == 0.2
    for key in ("versions", "config", "plan", "calibration", "devices", "seed", "maps"):
        assert begun[key] == ended[key], key
    assert ended["devices"]["spad"]["info"]["serial"]
    assert ended["counters"]["delivered"] >= ended["sweeps"][-1]["end_frame"]


def test_a_disk_with_too_little_room_is_refused_before_the_start(
    rig: Rig, small: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = shutil.disk_usage(".")
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: usage._replace(free=1000))
    for more in ((), ("--dry-run",)):
        ran = rig("scan", small, "--record", "--maps", 50, "--out", "deep/run", *more)
        assert (ran.code, ran.out, len(ran.problems)) == (2, "", 1)
        assert "the recording will take at most" in ran.problems[0]
        assert "has 0.000001 GB free; free some" in ran.problems[0]
        assert not Path("deep").exists()


def test_a_recording_says_before_it_starts_what_it_takes_at_most(
    rig: Rig, small: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = shutil.disk_usage(".")._replace(free=12_300_000_000)
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: usage)
    arguments = ("scan", small, "--record", "--maps", 3, "--out", "deep/run")
    tried = rig(*arguments, "--dry-run", "--json")
    told = json.loads(tried.out)["recording"]
    assert tried.code == 0, tried.err
    assert not Path("deep").exists()
    assert told["free_bytes"] == 12_300_000_000
    frames_gb, maps_gb = (digits(told[name] / 1e9) for name in ("recording_bytes", "map_bytes"))
    said = f"at most {frames_gb} GB of frames and {maps_gb} GB of maps"
    assert said in rig(*arguments, "--dry-run").out
    ran = rig(*arguments)
    assert (ran.code, said in ran.err, "has 12.3 GB free" in ran.err) == (0, True, True)
    files = [file for file in Path("deep/run").rglob("*") if file.is_file()]
    frames = sum(file.stat().st_size for file in files if file.suffix == ".spb")
    assert 0 < frames <= told["recording_bytes"]
    assert sum(file.stat().st_size for file in files) <= told["recording_bytes"] + told["map_bytes"]


def test_frames_of_another_recording_of_the_same_plan_are_refused(rig: Rig, small: Path) -> None:
    blocks: dict[int, int] = {}  # of the recordings with this many; how long one goes on behind its map is by chance
    for seed in range(5, 15):
        assert rig("scan", small, "--maps", 1, "--seed", seed, "--record", "--out", f"run{seed}").code == 0
        count = json.loads(Path(f"run{seed}", "manifest.json").read_text())["recording"]["blocks"]
        if count in blocks:
            Path(f"run{blocks[count]}").rename("own")
            Path(f"run{seed}").rename("other")
            break
        blocks[count] = seed
    for name in ("frames-000000.spb", "frames.idx"):
        shutil.copy(f"other/{name}", f"own/{name}")
    told = "the frames are not those that this run recorded"
    verified = rig("verify", "own")
    assert verified.code == 1
    assert told in verified.err
    for command in (("reconstruct", "own"), ("cut", "own", "--maps", "0:1")):
        refused = rig(*command, "--out", "depth")
        assert refused.code == 1, refused.err
        assert told in refused.err
        assert not Path("depth").exists()
    assert rig("repair", "own").code == 0
    taken = rig("reconstruct", "own", "--out", "depth")
    assert taken.code == 0, taken.err
    assert_same(Path("other"), Path("depth"))
