"""What goes wrong between a SPAD's pixels and the maps: frames that come twice, and a clock that is off or wanders."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rig.api import RunResult, scan, verify
from tests.system.small_rig import config, write_rig

SCANNER_ERROR = 20e-6
"""Of the simulated scanner's crystal."""


def _scan(folder: Path, maps: int, *, record: bool = False, **spad: Any) -> RunResult:
    content = config()
    content["spad"] |= spad
    return scan(write_rig(folder, content), maps=maps, seed=3, out=folder / "run", record=record)


def test_a_frame_that_comes_twice_counts_once_and_the_one_it_replaces_is_lost(tmp_path: Path) -> None:
    twice = _scan(tmp_path / "twice", 2, record=True, duplicate_probability=0.02)
    gaps = json.loads((tmp_path / "twice" / "run" / "manifest.json").read_text())["gaps"]
    replaced = [frame for gap in gaps for frame in range(gap[-2], gap[-1] + 1)]
    assert twice.summary.verdict == "gaps"
    assert twice.summary.frames.lost == len(replaced) > 20
    lost = _scan(tmp_path / "lost", 2, lost_frames=replaced)
    assert lost.summary.frames == twice.summary.frames
    for file in sorted((tmp_path / "lost" / "run" / "stripe").iterdir()):
        ours, theirs = np.load(file), np.load(tmp_path / "twice" / "run" / "stripe" / file.name)
        for name in ours.files:
            np.testing.assert_array_equal(ours[name], theirs[name])
    assert any("the clock goes back within block" in line for line in verify(tmp_path / "twice" / "run").problems)


@pytest.mark.parametrize("error", [0.0, 200e-6])
def test_a_spad_clock_that_is_off_is_fitted_and_changes_no_map(tmp_path: Path, error: float) -> None:
    summary = _scan(tmp_path, 2, clock_error=f"{error * 1e6:g} ppm").summary.as_json()
    assert summary["verdict"] == "complete"
    # A marker's place is known to 1/256 of a frame, and a sweep has some 1000 frames.
    assert summary["sync"]["clock_error"] == pytest.approx((1 + SCANNER_ERROR) / (1 + error) - 1, abs=4e-6)
    assert summary["sync"]["residual_columns"] < 0.01
    assert summary["truth"]["stripe_error_px"]["within_1px"] > 0.8


def test_a_clock_that_wanders_is_followed_from_sweep_to_sweep(tmp_path: Path) -> None:
    run = _scan(tmp_path, 4, clock_error="50 ppm", clock_wander="500 ppm")
    assert run.summary.verdict == "complete"
    sweeps = json.loads((tmp_path / "run" / "manifest.json").read_text())["sweeps"]
    errors = np.array([sweep["clock_error"] for sweep in sweeps])
    assert np.abs(np.diff(errors)).max() > 10e-6
    assert np.abs(errors + 30e-6).max() < 400e-6
