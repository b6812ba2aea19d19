"""`rig quality`: the depth of a region of a run, judged without its truth."""

from pathlib import Path

import numpy as np
import pytest

from rig import api
from rig.errors import UsageError
from rig.run_folder.pictures import cloud, ply_bytes
from tests.system.conftest import Rig
from tests.system.run_files import strict


@pytest.fixture
def wall(tmp_path: Path) -> Path:
    """A run whose maps show a wall tilted by 30 degrees about the vertical, 4 m away, with noise of 3 mm along z."""
    v, u = np.mgrid[-20:20, -48:48] / 100.0
    flat_m = 4 / (np.cos(np.pi / 6) - u * np.sin(np.pi / 6))
    rng = np.random.default_rng(0)
    for number in range(6):
        depth_m = (flat_m + rng.normal(0, 0.003, flat_m.shape)).astype(np.float32)
        depth_m[:, :10] = np.nan
        depth_m[20:, 60:] += 1.0  # another thing before it
        for kind in ("depth", "cloud"):
            (tmp_path / "wall" / kind).mkdir(parents=True, exist_ok=True)
        np.save(tmp_path / f"wall/depth/{number:06d}.npy", depth_m)
        points = cloud(depth_m, u, v, np.ones(depth_m.shape, np.uint32))
        (tmp_path / f"wall/cloud/{number:06d}.ply").write_bytes(ply_bytes(points))
    return tmp_path / "wall"


def test_a_wall_comes_out_as_flat_as_it_was_made(rig: Rig, wall: Path) -> None:
    ran = rig("quality", wall, "--region", "0,0,60,40", "--json")
    assert ran.code == 0, ran.err
    found = strict(ran.out)
    assert (found["pixels"], found["maps"], found["planes"]) == (2400, 6, 6)
    assert found["fill_rate"] == pytest.approx(50 / 60)
    assert found["tilt_deg"] == pytest.approx(30, abs=0.05)
    assert found["plane_distance_m"] == pytest.approx(4, abs=1e-3)
    # A point moves along its ray, so its distance from the plane changes by less than its depth.
    u = (np.arange(10, 60) - 48) / 100
    share = np.cos(np.pi / 6) - u * np.sin(np.pi / 6)
    assert found["plane_rms_m"] == pytest.approx(0.003 * np.sqrt(np.mean(share**2)), rel=0.02)
    assert found["temporal_rms_m"] == pytest.approx(0.003, rel=0.03)
    assert found["repeated_pixels"] == 50 * 40
    assert api.quality(wall, (0, 0, 60, 40)).plane_rms_m == found["plane_rms_m"]
    shown = rig("quality", wall, "--region", "0,0,60,40").out
    assert "tilted by 30" in shown
    assert "83.3%" in shown


def test_a_thing_before_the_wall_is_left_out_of_its_plane(rig: Rig, wall: Path) -> None:
    found = strict(rig("quality", wall, "--json").out)
    assert found["plane_distance_m"] == pytest.approx(4, abs=1e-3)
    assert found["plane_outliers"] == pytest.approx(20 * 36 / (86 * 40), abs=1e-3)


def test_wrong_regions_and_folders_are_refused_in_one_line(rig: Rig, wall: Path, tmp_path: Path) -> None:
    for arguments, told in (
        ((wall, "--region", "1,2,3"), "write x0,y0,x1,y1 in pixels"),
        ((wall, "--region", "1,2,1,5"), "are 96 x 40 pixels"),
        ((wall, "--region", "0,0,97,40"), "are 96 x 40 pixels"),
        ((tmp_path, "--region", "0,0,9,9"), "holds no depth maps"),
        ((tmp_path / "none",), "does not exist"),
    ):
        ran = rig("quality", *arguments)
        assert (ran.code, len(ran.problems)) == (2, 1), ran.err
        assert told in ran.problems[0]
    with pytest.raises(UsageError, match="`region` is"):
        api.quality(wall, (0, 0, -1, 3))


def test_files_of_a_map_that_do_not_fit_are_damage(rig: Rig, wall: Path) -> None:
    (wall / "cloud/000001.ply").write_bytes((wall / "cloud/000001.ply").read_bytes()[:-16])
    ran = rig("quality", wall)
    assert (ran.code, len(ran.problems)) == (1, 1)
    assert "map 000001" in ran.problems[0]
    (wall / "cloud/000000.ply").unlink()
    ran = rig("quality", wall)
    assert (ran.code, len(ran.problems)) == (1, 1)


def test_a_scan_of_the_simulated_rig_is_judged(rig: Rig, scanned: Path) -> None:
    found = strict(rig("quality", scanned, "--json").out)
    depths = [np.load(file) for file in sorted((scanned / "depth").glob("*.npy"))]
    assert found["fill_rate"] == pytest.approx(np.mean([np.isfinite(depth).mean() for depth in depths]))
    both = np.isfinite(depths).all(axis=0)
    sd = np.std(np.array(depths, np.float64)[:, both], axis=0, ddof=1)
    assert found["temporal_sd_m"] == pytest.approx(np.median(sd))
