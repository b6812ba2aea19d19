"""`rig verify`, `repair`, `info`, `cut` and `compress` on a recorded scan, as a user calls them."""

import copy
import json
import re
import shutil
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from drivers.recorded import RunRecording
from rig import api
from rig.errors import RigError
from rig.run_folder.manifest import read_manifest, sealed_text
from tests.system.conftest import Rig
from tests.system.small_rig import config, write_rig
from tests.unit.rig.recording.recorded import flip


def test_a_recorded_scan_is_intact_until_it_is_damaged_and_whole_once_repaired(rig: Rig, run: Path) -> None:
    found = json.loads(rig("verify", run, "--json").out)
    assert (found["verdict"], found["problems"], found["run"]) == ("intact", [], "complete")
    summary = json.loads((run / "summary.json").read_text())
    assert found["frames"] >= summary["frames"]["received"]
    assert found["blocks"] == summary["stages"]["recorder_blocks"]
    assert found["bytes"] == summary["stages"]["recorder_bytes"] == (run / "frames-000000.spb").stat().st_size
    damage(run, (run / "frames-000000.spb").stat().st_size // 2)
    ran = rig("verify", run)
    assert (ran.code, "damaged: " in ran.out) == (1, True)
    assert "frames-000000.spb, bytes " in ran.err
    ran = rig("repair", run)
    assert (ran.code, "gaps: " in ran.out) == (1, True)  # there is a gap now
    assert json.loads(rig("verify", run, "--json").out)["verdict"] == "gaps"
    assert json.loads(rig("repair", run, "--json").out)["done"] == []


def test_parts_and_compressed_recordings_are_recordings(rig: Rig, run: Path, tmp_path: Path) -> None:
    pytest.importorskip("zstandard", reason="pip install '.[compress]'")
    assert rig("compress", run).code == 0
    assert rig("cut", run, "--maps", "1", "--out", tmp_path / "part").code == 0
    for folder, maps in ((run, 2), (tmp_path / "part", 1)):
        told = json.loads(rig("info", folder, "--json").out)
        assert (told["maps"], told["verdict"], told["problems"]) == (maps, "complete", [])
        assert rig("verify", folder).code == 0
    assert re.search(r"^start 0: .*frames \d", rig("info", tmp_path / "part").out, re.MULTILINE)
    assert rig("cut", run, "--frames", "0:9", "--out", tmp_path / "few").out.rstrip().endswith("blocks, no whole map")


@pytest.mark.parametrize("estimator", ["likelihood", "joint"])
def test_the_maps_of_a_part_come_out_as_in_the_whole(rig: Rig, tmp_path: Path, estimator: str) -> None:
    content = config()
    content["scan"] |= {"bidirectional": True}
    content["scanner"]["clock_error"] = "300 ppm"
    small = write_rig(tmp_path / "rig", content)
    whole, part, again = tmp_path / "whole", tmp_path / "part", tmp_path / "again"
    assert rig("scan", small, "--maps", 4, "--estimator", estimator, "--record", "--out", whole).code == 0
    assert rig("cut", whole, "--maps", "1:3", "--out", part).code == 0
    assert rig("reconstruct", part, "--out", again).code == 0
    for made, was in ((0, 1), (1, 2)):
        for name in ("depth/{:06d}.npy", "stripe/{:06d}.npz"):
            assert (again / name.format(made)).read_bytes() == (whole / name.format(was)).read_bytes()


def test_a_folder_without_a_recording_is_called_what_it_is_by_every_command(rig: Rig, run: Path) -> None:
    for file in run.glob("frames*"):
        file.unlink()
    shutil.rmtree(run / "cloud")
    commands = "reconstruct R --out new", "reconstruct R --plan R/plan.yaml --out new", "replay R", "verify R", "info R"
    for command in (*commands, "repair R", "cut R --maps 0:1 --out new", "export R npy", "export R ply"):
        ran = rig(*(word.replace("R", str(run), 1) if word[0] == "R" else word for word in command.split()))
        assert (ran.code, len(ran.problems), ran.err.count("\n")) == (2, 1, 1), (command, ran.err)
        assert f"{run} holds no recording (frames-*.spb): the frames of this run were not recorded" in ran.err
    assert not list(Path().iterdir())


def test_a_plan_that_cannot_be_is_told_by_its_checksum_where_there_is_one(rig: Rig, run: Path) -> None:
    plan = run / "plan.yaml"
    plan.write_text(re.sub(r"columns: \d+", "columns: 0", plan.read_text()))
    ran = rig("reconstruct", run, "--out", "new")
    assert (ran.code, "plan.yaml is not as it was written, its checksum does not fit" in ran.err) == (2, True), ran.err
    (run / "manifest.json").write_text("{")
    ran = rig("reconstruct", run, "--out", "new")
    assert ran.err.count("\n") == 1, ran.err
    assert ran.code in (2, 3)


@pytest.mark.parametrize(("block", "kept"), [(0, (1, 2)), (-1, (0, 1))], ids=["first", "last"])
@pytest.mark.parametrize("repaired", [True, False], ids=["repaired", "as it is"])
def test_a_part_that_lacks_an_end_gives_the_maps_that_are_whole(
    rig: Rig, small: Path, tmp_path: Path, block: int, kept: tuple[int, int], repaired: bool
) -> None:
    whole, part, again = tmp_path / "whole", tmp_path / "part", tmp_path / "again"
    assert rig("scan", small, "--maps", 4, "--record", "--out", whole).code == 0
    assert rig("cut", whole, "--maps", "1:4", "--out", part).code == 0
    entry = RunRecording(part).runs[0].entries[block]
    damage(part, int(entry["offset"]) + 300)
    lost = int(entry["n_frames"])
    if repaired:
        ran = rig("repair", part)
        assert (ran.code, "gaps: whole with gaps" in ran.out) == (1, True)
        assert json.loads(rig("info", part, "--json").out)["maps"] == 2
    ran = rig("reconstruct", part, "--out", again, "--json")
    assert (ran.code, "marker line" in ran.err) == (1, False), ran.err
    summary = json.loads(ran.out)
    assert (summary["verdict"], summary["maps"], summary["frames"]["lost"]) == ("gaps", 2, lost)
    for made, was in enumerate(kept):
        for name in ("depth/{:06d}.npy", "stripe/{:06d}.npz"):
            assert (again / name.format(made)).read_bytes() == (whole / name.format(was + 1)).read_bytes()


def test_a_part_without_a_whole_map_says_so(rig: Rig, run: Path, tmp_path: Path) -> None:
    assert rig("cut", run, "--maps", "1", "--out", tmp_path / "part").code == 0
    damage(tmp_path / "part", int(RunRecording(tmp_path / "part").runs[0].entries[-1]["offset"]) + 300)
    assert rig("repair", tmp_path / "part").code == 1
    ran = rig("reconstruct", tmp_path / "part", "--out", tmp_path / "again")
    assert ran.code == 2
    assert "holds no whole sweep (" in ran.problems[0]


def damage(folder: Path, at: int) -> None:
    flip(folder / "frames-000000.spb", at)


@pytest.mark.parametrize(
    "key",
    [
        "verdict", "maps", "config", "config.scan", "calibration.accepted", "rig.kinds", "inputs.plan.yaml",
        "counters.delivered", "recording", "recording.starts", "recording.blocks", "sweeps", "sweeps.0.first_frame",
        "sweeps.0.clock_error", "cut", "cut.maps", "missing", "repaired", "gaps", "devices.spad", "plan", "versions",
    ],
)  # fmt: skip
def test_a_sealed_manifest_of_wrong_types_is_damaged_or_harmless(run: Path, tmp_path: Path, key: str) -> None:
    manifest = read_manifest(run)
    assert manifest is not None
    for value in (-1, "much", [[]]):
        changed = copy.deepcopy(manifest)
        place: Any = changed
        *parents, last = ["inputs", "plan.yaml"] if key == "inputs.plan.yaml" else key.split(".")
        for parent in parents:
            place = place[int(parent)] if isinstance(place, list) else place.setdefault(parent, {})
        place[int(last) if isinstance(place, list) else last] = value
        (run / "manifest.json").write_text(sealed_text(json.dumps(changed)))
        api.verify(run)
        for act in (
            lambda: api.recording_info(run),
            lambda: api.cut(run, tmp_path / "part", maps="0"),
            lambda: api.reconstruct(run, estimator="argmax"),
        ):
            with suppress(RigError):
                act()
        shutil.rmtree(tmp_path / "part", ignore_errors=True)
    api.repair(run)
    assert api.verify(run).problems == []
