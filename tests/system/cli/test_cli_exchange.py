"""`rig import` and `rig export` as a user calls them: a recorded scan goes out, comes back and gives the same depth."""

import json
from pathlib import Path

import cv2
import numpy as np

from tests.system.conftest import Rig


def test_every_kind_of_export_of_a_scan(rig: Rig, run: Path) -> None:
    wanted = {
        "npy": ["frames.json", "frames.npy", "transforms.json"],
        "hdf5": ["run.h5"],
        "ply": ["000000.ply", "000001.ply"],
        "png": ["depth-000000.png", "depth-000001.png"],
        "mp4": ["depth.mp4"],
    }
    for kind, files in wanted.items():
        ran = rig("export", run, kind, "--json")
        assert (ran.code, ran.err) == (0, "")
        assert json.loads(ran.out)["files"] == files
        assert sorted(file.name for file in run.with_name(f"run-{kind}").iterdir()) == files
    exported = cv2.imread(str(run / "../run-png/depth-000001.png"))
    own = [cv2.imread(str(run / name / "000001.png")) for name in ("depth", "confidence")]
    assert own[0] is not None
    # Confidence is written with three digits only, so its colours may differ by one level.
    assert np.array_equal(exported[:, : own[0].shape[1]], own[0])
    assert np.abs(exported.astype(int) - np.hstack(own)).max() < 8


def test_the_camera_goes_with_the_cube(rig: Rig, scanned: Path, tmp_path: Path) -> None:
    assert rig("export", scanned, "npy", "--out", tmp_path / "cube").code == 0
    frames = np.load(tmp_path / "cube" / "frames.npy")
    described = json.loads((tmp_path / "cube" / "transforms.json").read_text())
    assert (described["w"], described["h"], described["bitpack_dim"]) == (96, 40, 2)
    assert (described["fl_x"], described["cx"]) == (110, 47.5)
    assert len(described["frames"]) == len(frames)
