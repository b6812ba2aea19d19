"""Times of day of a run: noted by a scan, kept by a recording and its parts, shown by a replay and by `rig info`."""

import json
import time
from pathlib import Path
from typing import Any

import pytest

from rig.run_folder.time_of_day import NS, utc_ns
from tests.system import small_rig
from tests.system.conftest import Rig
from tests.system.run_files import strict


def manifest_of(run: Path | str) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((Path(run) / "manifest.json").read_text())
    return content


def test_a_simulated_scan_says_that_its_times_are_its_own_and_a_replay_shows_them(rig: Rig, small: Path) -> None:
    before = time.time_ns()
    ran = rig("scan", small, "--maps", 3, "--record", "--out", "run", "--json")
    assert ran.code == 0
    manifest = manifest_of("run")
    told, sweeps = manifest["time"], manifest["sweeps"]
    assert (told["scale"], [start["uncertainty_s"] for start in told["starts"]]) == ("virtual", [None])
    assert before - 10**6 <= utc_ns(told["starts"][0]["utc"]) <= time.time_ns() + 10**6
    # The maps follow one another in the SPAD's own time.
    period_s = told["starts"][0]["period_s"]
    for sweep in sweeps:
        apart_s = (utc_ns(sweep["utc"][1]) - utc_ns(sweep["utc"][0])) / NS
        assert apart_s == pytest.approx((sweep["end_frame"] - 1 - sweep["first_frame"]) * period_s, abs=3e-6)
    summary = strict(ran.out)
    assert summary["time"] == {
        "scale": "virtual",
        "first_frame_utc": sweeps[0]["utc"][0],
        "last_frame_utc": sweeps[2]["utc"][1],
        "uncertainty_s": None,
    }

    assert rig("cut", "run", "--maps", "1:3", "--out", "part").code == 0
    for source, first in (("run", 0), ("part", 1)):
        ran = rig("replay", source, "--clock", "max", "--out", f"again-{source}")
        assert ran.code == 0
        assert "when it was recorded" in ran.out
        again = manifest_of(f"again-{source}")
        assert (again["time"]["scale"], again["time"]["recorded_scale"]) == ("recorded", "virtual")
        assert [sweep["utc"] for sweep in again["sweeps"]] == [sweep["utc"] for sweep in sweeps[first:]]
    shown = rig("info", "part").out
    begun = strict(rig("info", "part", "--json").out)["runs"][0]["first_frame_utc"]  # type: ignore[index]
    assert f"start 0: {begun} (simulated time), frames" in shown
    assert abs(utc_ns(begun) - utc_ns(sweeps[1]["utc"][0])) <= 3000


def test_a_manifest_that_was_written_before_a_kill_tells_when_each_start_was_asked_for(
    rig: Rig, small: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from rig.run_folder.folder import RunFolder

    written: list[dict[str, Any]] = []
    write = RunFolder.write_json

    def noting(self: RunFolder, name: str, content: Any) -> None:
        if name == "manifest.json":
            written.append(dict(content))
        write(self, name, content)

    monkeypatch.setattr(RunFolder, "write_json", noting)
    assert rig("scan", small, "--record", "--out", "run").code == 0
    first = written[-2]["time"]["starts"]
    assert [set(start) for start in first] == [{"asked_utc", "first_map"}]


def test_a_recording_of_before_there_were_times_is_played_without(rig: Rig, run: Path) -> None:
    from rig.run_folder.manifest import sealed_text

    content = manifest_of(run)
    del content["time"], content["crc32"]
    for sweep in content["sweeps"]:
        del sweep["utc"], sweep["utc_uncertainty_s"]
    (run / "manifest.json").write_text(sealed_text(json.dumps(content)))
    ran = rig("replay", run, "--clock", "max", "--out", "again", "--json")
    assert ran.code == 0
    assert "time" not in strict(ran.out)
    assert "time" not in manifest_of("again")
    assert rig("info", run).code == 0


@pytest.mark.long
@pytest.mark.slow
def test_on_real_drivers_the_uncertainty_is_measured_and_the_frames_lie_within_the_run(
    rig: Rig, tmp_path: Path
) -> None:
    config = small_rig.write_rig(tmp_path / "emulated", small_rig.emulated())
    before = time.time_ns()
    ran = rig("scan", config, "--maps", 2, "--record", "--out", "run", "--json")
    after = time.time_ns()
    assert ran.code == 0, ran.err
    manifest = manifest_of("run")
    assert manifest["time"]["scale"] == "host"
    for start in manifest["time"]["starts"]:
        assert 0 < start["uncertainty_s"] < 1.0
        # Not before it was asked for, by the very definition of the uncertainty.
        asked_s = (utc_ns(start["utc"]) - utc_ns(start["asked_utc"])) / NS
        assert asked_s == pytest.approx(start["uncertainty_s"], abs=1e-3)
        assert start["pairs"] >= 1
    for sweep in manifest["sweeps"]:
        first, last = map(utc_ns, sweep["utc"])
        assert before < first < last < after
    assert "+- " in rig("info", "run").out
