"""Frames of other programs, and maps of runs: raw files, photon cubes with what lies beside them, pictures, clouds."""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from rig.exchange.photoncube import open_photoncube
from rig.exchange.raw_files import open_pi_imaging, open_swissspad2
from rig.report.run_facts import read_run
from rig.requests import ImportRequest
from rig.run_folder.pictures import POINT, ply_bytes, png_bytes
from rig.view.run_source import read_map
from rig.view.shown import picture_of, ply_of, points, steady_limits
from tests.campaigns.inputs.changes import JSON, NPZ, Changes
from tests.campaigns.inputs.files import in_file, npy, npz, scratch
from tests.campaigns.inputs.fuzz import Target
from tests.unit.rig.exchange.foreign_files import pi_packed, pi_sparse, some_frames, swissspad2_half

_ROWS = 8


def _read(open_files, request: ImportRequest, file: Path) -> str:
    foreign = open_files([file], request)
    frames = sum(len(chunk) for chunk in foreign.chunks())
    assert frames == foreign.n_frames
    return f"{foreign.frame_rate} {len(foreign.ranges)}"


def _pi(form: str | None) -> Callable[[bytes], object]:
    return in_file("frames.bin", partial(_read, open_pi_imaging, ImportRequest(form=form, rows=_ROWS)))


SIDECAR = {
    "format": "spadrig-frames", "width": 13, "height": 4, "frames": 5, "ranges": [[1, 0, 3], [1, 5, 2]],
    "clock": {"tick_hz": [100000000, 1], "frame_period_ticks": 1000, "exposure_ticks": 900},
}  # fmt: skip
TRANSFORMS = {"file_path": "cube.npy", "bitpack": True, "bitpack_dim": 2, "w": 16, "h": 4}


def _cube() -> np.ndarray:
    return np.packbits(some_frames(5, 4, 13), axis=2)


def _sidecar(name: str, data: bytes) -> str:
    folder = scratch() / name
    folder.mkdir(exist_ok=True)
    (folder / "cube.npy").write_bytes(npy(_cube()))
    (folder / name).write_bytes(data)
    return _read(open_photoncube, ImportRequest(), folder / "cube.npy")


_STRIPE = ("x_px", "confidence", "signal", "haze")


def _clouds() -> list[bytes]:
    points = np.zeros(32, POINT)
    return [ply_bytes(points)]


def _map(name: str, data: bytes) -> None:
    folder = scratch() / f"map-{name.replace('/', '-')}"
    depth = np.full((4, 8), 2.0, np.float32)
    files = {
        "depth/000000.npy": npy(depth),
        "stripe/000000.npz": npz(**{key: np.ones((4, 20), np.float32) for key in _STRIPE}),
        "confidence/000000.npz": npz(confidence=depth, depth_sd_m=depth),
        "intensity/000000.png": png_bytes(np.zeros((4, 8), np.uint8)),
    }  # fmt: skip
    for each, content in (files | {name: data}).items():
        (folder / each).parent.mkdir(parents=True, exist_ok=True)
        (folder / each).write_bytes(content)
    shown = read_map(folder, 0, None, {"min_confidence": 0.5})
    for what in ("depth", "counts", "confidence"):
        picture_of(shown, what, 0.1, steady_limits(None, shown.depth_m))
        points(shown, what, 0.1, 10, steady_limits(None, shown.depth_m))
    column = shown.column_at(1, 3)
    shown.pixel(1, 3)
    if column is not None and shown.stripe:
        shown.stripe_at(1, column)
    ply_of(shown, 0.1)
    read_run(folder)


TARGETS = (
    Target(
        "swissspad2",
        lambda: [swissspad2_half(some_frames(2, 256, 512))],
        in_file("half.bin", partial(_read, open_swissspad2, ImportRequest())),
        changes=Changes(most_bytes=40000),
    ),
    Target(
        "pi-imaging",
        lambda: [pi_packed(some_frames(3, _ROWS, 512)), pi_sparse(some_frames(3, _ROWS, 512))],
        _pi(None),
        changes=Changes(most_bytes=16384),
    ),
    Target(
        "map-arrays",
        lambda: [npz(**{key: np.ones((4, 20), np.float32) for key in _STRIPE})],
        partial(_map, "stripe/000000.npz"),
        changes=Changes(tree=NPZ),
    ),
    Target("map-depth", lambda: [npy(np.full((4, 8), 2.0, np.float32))], partial(_map, "depth/000000.npy")),
    Target(
        "map-worth",
        lambda: [npz(confidence=np.ones((4, 8)), depth_sd_m=np.ones((4, 8)))],
        partial(_map, "confidence/000000.npz"),
        changes=Changes(tree=NPZ),
    ),
    Target("map-cloud", _clouds, partial(_map, "cloud/000000.ply")),
    Target("map-picture", lambda: [png_bytes(np.zeros((4, 8), np.uint8))], partial(_map, "intensity/000000.png")),
    Target(
        "photoncube", lambda: [npy(_cube())], in_file("cube/cube.npy", partial(_read, open_photoncube, ImportRequest()))
    ),
    Target(
        "photoncube-json",
        lambda: [json.dumps(SIDECAR).encode()],
        partial(_sidecar, "cube.json"),
        changes=Changes(tree=JSON),
    ),
    Target(
        "transforms-json",
        lambda: [json.dumps(TRANSFORMS).encode()],
        partial(_sidecar, "transforms.json"),
        changes=Changes(tree=JSON),
    ),
)
