"""`rig import` and `rig export` as a user calls them: a recorded scan goes out, comes back and gives the same depth."""

import json
from pathlib import Path

import cv2
import numpy as np

from tests.system.conftest import Rig
from tests.unit.rig.exchange.foreign_files import pi_packed, some_frames, swissspad2_full


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
    depths = [cv2.imread(str(run / name)) for name in ("../run-png/depth-000001.png", "depth/000001.png")]
    assert depths[0] is not None
    assert np.array_equal(*depths)


def test_the_camera_goes_with_the_cube(rig: Rig, scanned: Path, tmp_path: Path) -> None:
    assert rig("export", scanned, "npy", "--out", tmp_path / "cube").code == 0
    frames = np.load(tmp_path / "cube" / "frames.npy")
    described = json.loads((tmp_path / "cube" / "transforms.json").read_text())
    assert (described["w"], described["h"], described["bitpack_dim"]) == (96, 40, 2)
    assert (described["fl_x"], described["cx"]) == (110, 47.5)
    assert len(described["frames"]) == len(frames)


def test_foreign_frames_become_a_recording_that_verifies(rig: Rig, tmp_path: Path) -> None:
    (tmp_path / "acq").mkdir()
    (tmp_path / "acq" / "RAW00000.bin").write_bytes(pi_packed(some_frames(3, 512, 512)) + b"DONE")
    (tmp_path / "full.bin").write_bytes(swissspad2_full(some_frames(2, 512, 512)))
    ran = rig("import", "pi-imaging", tmp_path / "acq", "--out", "pi", "--frame-rate", "97.7 kHz", "--json")
    assert (ran.code, ran.err) == (0, "")
    assert json.loads(ran.out)["frame_rate_hz"] == 97_700
    assert rig("import", "swissspad2", tmp_path / "full.bin", "--form", "full", "--out", "swiss").code == 0
    for run in ("pi", "swiss"):
        verified = rig("verify", run)
        assert verified.code == 0, verified.out + verified.err
    assert rig("export", "pi", "npy").code == 0
    assert np.load("pi-npy/frames.npy").shape == (3, 512, 64)
