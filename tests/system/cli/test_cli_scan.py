"""`rig scan` on a small simulated rig: what it prints and what it writes."""

import re
from pathlib import Path

import numpy as np
import pytest

from tests.system.conftest import Rig
from tests.system.run_files import FILES, files, strict
from tests.system.small_rig import HEIGHT, WIDTH

KEYS = {
    "maps", "map_rate_hz", "columns", "exposures", "estimator", "filter", "frames", "sensor_time_s", "compute_time_s",
    "realtime_factor", "valid_fraction", "floating_points", "fog", "truth", "verdict", "stages", "sync",
    "time",
}  # fmt: skip


def test_a_scan_prints_its_summary_and_writes_one_folder(rig: Rig, small: Path) -> None:
    ran = rig("scan", small, "--json", "--out", "run", "--seed", 1)
    summary = strict(ran.out)
    assert ran.code == 0
    assert ran.err == ""
    assert set(summary) == KEYS
    assert summary["verdict"] == "complete"
    frames = summary["frames"]
    assert isinstance(frames, dict)
    assert set(frames) == {"expected", "received", "lost", "crc_errors", "lit"}
    assert frames["expected"] == frames["received"] + frames["lost"]
    assert frames["lit"] == pytest.approx(800, abs=4)
    assert files(Path("run")) == FILES
    assert strict(Path("run/summary.json").read_text()) == summary
    depth = np.load("run/depth/000000.npy")
    assert (depth.dtype, depth.shape) == (np.float32, (HEIGHT, WIDTH))
    assert summary["valid_fraction"] == pytest.approx(np.isfinite(depth).mean())
    with np.load("run/stripe/000000.npz") as table:
        stripe = dict(table)
    assert set(stripe) >= {"x_px", "confidence", "x_sd_px", "signal", "haze"}
    assert all(stripe[key].shape == (HEIGHT, 200) for key in stripe)
    manifest = strict(Path("run/manifest.json").read_text())
    assert set(manifest) >= {"versions", "config", "plan", "calibration", "seed", "gaps"}
    assert not list(Path().glob(".*"))


def test_the_same_seed_gives_the_same_depth_however_it_is_taken_and_another_one_another(rig: Rig, small: Path) -> None:
    depth = []
    for seed, options in ((5, ()), (5, ("--record", "--on-overload", "block")), (6, ())):
        ran = rig("scan", small, "--out", f"run{len(depth)}", "--seed", seed, *options)
        depth.append(np.load(f"run{len(depth)}/depth/000000.npy"))
    assert np.array_equal(depth[0], depth[1], equal_nan=True)
    assert not np.array_equal(depth[0], depth[2], equal_nan=True)
    # People are told the errors, the verdict, and where the pictures lie.
    assert re.search(r"clock -?[0-9.]+ ppm", ran.out)
    assert not re.search(r"\de[+-]\d", ran.out), "a power of ten"
    assert "stripe error" in ran.out
    assert "complete" in ran.out
    assert str(Path("run2/depth/000000.png").absolute()) in ran.out


@pytest.mark.parametrize(("save", "kept"), [(["last"], [2]), (["every", "2"], [0, 2])])
def test_save_says_which_maps_are_written(rig: Rig, small: Path, save: list[str], kept: list[int]) -> None:
    ran = rig("scan", small, "--maps", 3, "--save", *save, "--out", "run", "--json")
    assert strict(ran.out)["maps"] == 3
    assert sorted(file.name for file in Path("run/depth").glob("*.npy")) == [f"{i:06d}.npy" for i in kept]


def test_a_dry_run_prints_the_plan_and_writes_nothing(rig: Rig, small: Path) -> None:
    people = rig("scan", small, "--dry-run", "--estimator", "auto")
    programs = rig("scan", small, "--dry-run", "--json")
    assert people.code == programs.code == 0
    assert "sweep" in people.out
    assert "estimator   auto: joint, no frame waits for its maps" in people.out
    assert strict(programs.out)["plan"]["columns"] == 200  # type: ignore[index]
    assert not list(Path().iterdir())


def test_options_change_the_config_and_confidence_decides_what_enters_the_depth_map(rig: Rig, small: Path) -> None:
    options = ("--exposures", 2, "--estimator", "edge", "--filter", "median", "--json")
    all_in, sure = (
        strict(rig("scan", small, *options, "--min-confidence", limit, "--out", f"run{limit}").out) for limit in (0, 1)
    )
    assert (sure["exposures"], sure["estimator"], sure["filter"]) == (2, "edge", "median")
    assert all_in["valid_fraction"] > sure["valid_fraction"]  # type: ignore[operator]
    assert all_in["floating_points"] >= 0  # type: ignore[operator]
