"""Scans in passes on a small simulated rig: frames and times add up, and a recording gives the same maps again."""

import json
from pathlib import Path

import numpy as np
import pytest

from tests.system.conftest import Rig
from tests.system.small_rig import config, write_rig


@pytest.fixture
def foggy(tmp_path: Path) -> Path:
    """A small rig that looks into dense fog."""
    content = config()
    content["world"]["scene"] = "street-dense-fog"
    content["scan"] |= {"columns": 120, "exposures": 12, "adaptive": {"first_exposures": 3, "passes": 3}}
    content["estimate"] = {"estimator": "edge", "threads": 1}
    return write_rig(tmp_path / "foggy", content)


@pytest.fixture
def recorded(rig: Rig, foggy: Path, tmp_path: Path) -> Path:
    out = tmp_path / "run"
    ran = rig("scan", foggy, "--maps", 2, "--record", "--out", out)
    assert ran.code == 0, ran.err
    return out


def test_frames_and_times_are_those_of_all_passes(recorded: Path) -> None:
    manifest, summary = (json.loads((recorded / f"{name}.json").read_text()) for name in ("manifest", "summary"))
    passes, sweeps = manifest["passes"], manifest["sweeps"]
    assert (summary["maps"], summary["verdict"]) == (2, "complete")
    assert {one["map"] for one in passes} == {0, 1}
    assert 3 <= len(passes) == len(sweeps) == summary["adaptive"]["passes"] <= 6
    for one in passes:
        assert 0 <= one["first_column"] < one["first_column"] + one["columns"] <= 120
    assert (passes[0]["columns"], passes[0]["exposures"]) == (120, 3)
    expected = sum(sweep["end_frame"] - sweep["first_frame"] for sweep in sweeps)
    assert summary["frames"]["expected"] == summary["frames"]["received"] == expected
    assert summary["sensor_time_s"] == pytest.approx(expected / 1e5)
    planned = sum(one["columns"] * one["exposures"] for one in passes)
    assert summary["frames"]["lit"] == pytest.approx(planned, abs=4 * len(passes))
    assert summary["exposures"] == pytest.approx(planned / 240, rel=0.02)
    assert summary["sensor_time_s"] <= 2 * manifest["plan"]["sweep_s"] * 1.001  # no more than plain sweeps would take
    assert summary["adaptive"]["wall_s"] >= summary["adaptive"]["rest_s"] > 0


def test_a_recording_gives_the_same_maps_again(rig: Rig, recorded: Path, tmp_path: Path) -> None:
    again = tmp_path / "again"
    ran = rig("reconstruct", recorded, "--out", again, "--json")
    assert ran.code == 0, ran.err
    assert json.loads(ran.out)["maps"] == 2
    for name in ("depth/000000.npy", "depth/000001.npy"):
        np.testing.assert_array_equal(np.load(recorded / name), np.load(again / name))
    assert rig("verify", recorded).code == 0


def test_a_part_of_a_scan_in_passes_is_refused(rig: Rig, recorded: Path, tmp_path: Path) -> None:
    ran = rig("cut", recorded, "--maps", "0", "--out", tmp_path / "part")
    assert ran.code == 2
    assert "passes" in ran.err


def test_what_does_not_fit_is_said_before_anything_moves(rig: Rig, foggy: Path) -> None:
    ran = rig("scan", foggy, "--time-budget", "2 ms", "--dry-run")
    assert ran.code == 2
    assert ran.problems[0].startswith("error: scan.adaptive: the first pass takes")
    assert "raise time_budget or lower first_exposures" in ran.err
    for options, next_step in (
        (["--exposures", "3"], "raise scan.exposures"),
        (["--time-budget", "6.5 ms"], "raise time_budget"),
    ):
        ran = rig("scan", foggy, *options)
        assert (ran.code, len(ran.problems)) == (2, 1)
        assert "would be a plain sweep; " + next_step in ran.problems[0]
    text = foggy.read_text()
    foggy.write_text(text.replace("command_range:", "bidirectional: true\n  command_range:"))
    ran = rig("scan", foggy)
    assert ran.code == 2
    assert "adaptive and bidirectional" in ran.err
    foggy.write_text(text.replace("first_exposures: 3", "first_exposures: 1"))
    ran = rig("scan", foggy)
    assert ran.code == 2
    assert "first_exposures" in ran.err


def test_a_dry_run_says_what_passes_there_will_be(rig: Rig, foggy: Path) -> None:
    ran = rig("scan", foggy, "--time-budget", "9 ms", "--dry-run")
    assert ran.code == 0, ran.err
    assert "passes      at most 3 a map in 9.0 ms of sensor time; first 3 exposures of all columns" in ran.out
    told = json.loads(rig("scan", foggy, "--dry-run", "--json").out)
    assert told["adaptive"]["most_passes"] == told["adaptive"]["first_exposures"] == 3
    assert told["adaptive"]["time_budget_s"] == told["plan"]["sweep_s"]
