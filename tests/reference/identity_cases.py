"""Rigs, scenes and a bare cube of the identity check, as the content of their files; imports nothing of the program.

The rigs are small, so that a map takes a second. Changing anything here makes other recordings: make the folder anew.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

Content = dict[str, Any]

WIDTH, HEIGHT, FOCAL_PX, BASELINE_M = 128, 48, 120.0, 0.3


def geometry(width: int = WIDTH, height: int = HEIGHT, focal_px: float = FOCAL_PX, **changes: Any) -> Content:
    """Content of a calibration file: the mirror on the left turns about an upright axis, the lens distorts a little.

    changes: keys of the file that are added or replaced; those of `pivot` change the mirror's.
    """
    pivot = {
        "axis_point_m": [-BASELINE_M, 0, 0],
        "axis_direction": [0, 1, 0],
        "zero_normal": [1, 0, 0],
        "angle_rad": [0.08, 0.45],
    } | changes.pop("pivot", {})
    camera = {
        "width": width,
        "height": height,
        "matrix": [[focal_px, 0, (width - 1) / 2], [0, focal_px, (height - 1) / 2], [0, 0, 1]],
        "distortion": [-0.1, 0, 0, 0, 0],
    } | changes.pop("camera", {})
    return {
        "format": "spadrig-calibration",
        "version": 1,
        "camera": camera,
        "scanner": {"pivot": pivot},
        "source_m": [-BASELINE_M, 0, 0],
        "lag_s": {"forward": 2e-4, "backward": 2e-4},
    } | changes


def config(scene: str, columns: int, exposures: int, **changes: Any) -> Content:
    """Content of the config file of a simulated rig; changes are merged into its parts."""
    content: Content = {
        "name": "identity",
        "calibration": "rig.yaml",
        "world": {"kind": "simulated", "geometry": "./rig.yaml", "scene": scene},
        "spad": {"kind": "simulated"},
        "scanner": {"kind": "simulated"},
        "laser": {"kind": "simulated"},
        "sync": {"kind": "simulated"},
        "scan": {
            "columns": columns,
            "exposures": exposures,
            "frame_rate": "100 kHz",
            "depth_range": ["1 m", "15 m"],
            "command_range": [-0.8, 0.8],
            "power": "50 mW",
        },
        "estimate": {"estimator": "argmax"},
    }
    for key, value in changes.items():
        content[key] = {**content.get(key, {}), **value} if isinstance(value, dict) else value
    return content


@dataclass(frozen=True, slots=True)
class Case:
    """A rig and the scan that is recorded with it."""

    config: Content
    geometry: Content = field(default_factory=geometry)
    scene: Content | None = None
    """Content of scene.yaml, where the config's scene is that file."""
    defect_share: float = 0.0
    """Share of the pixels that the calibration calls defects."""
    maps: int = 1
    options: tuple[str, ...] = ()
    repeats: bool = True
    """Whether a second scan has the same frames: emulated devices run in the host's time."""


TILTED = geometry(
    camera={
        "matrix": [[122.5, 0, 60.25], [0, 119.0, 26.75], [0, 0, 1]],
        "distortion": [-0.22, 0.06, 2e-3, -1.5e-3, 0.01],
    },
    pivot={
        "axis_point_m": [-0.31, 0.02, 0.03],
        "axis_direction": [0.09, 0.99, 0.06],
        "zero_normal": [0.99, -0.09, 0.02],
        "offset_m": [1e-3, -2e-4],
        "cone_rad": 4e-3,
    },
    source_m=[-0.31, 0.02, 0.03],
)
"""Camera rolled against the planes, lens that is not centred."""

DIRTY = {
    "dark_rate": "400 cps",
    "pixel_seed": 7,
    "dead_share": "1 %",
    "hot_share": "1 %",
    "crosstalk": "0.3 %",
    "afterpulsing": "0.5 %",
    "dead_time": "50 ns",
    "bit_error_rate": "5 ppm",
}

MOVING_FOG: Content = {
    "surfaces": "street",
    "medium": {"fog": {"visibility": "25 m"}, "backscatter": "0.05 /sr", "multiple_scattering": True},
    "ambient": {"illuminance": "10 lux"},
    "motion": {"velocity": ["0.5 m/s", "0 m/s", "-1 m/s"]},
}

SPAD512S = config(
    "street",
    60,
    10,
    world={"kind": "emulated", "laser": "cobolt", "spad": "spad512s"},
    spad={"kind": "spad512s", "port": "emulated:spad", "burst_frames": 10000},
    scanner={
        "kind": "helios",
        "port": "emulated:scanner",
        "max_point_rate": "40 kHz",
        "frame": "0.1 s",
        "max_velocity": "4000 /s",
        "max_acceleration": "4e6 /s2",
        "rms_duty": 1.0,
    },
    laser={"kind": "cobolt", "port": "emulated:laser", "max_power": "50 mW"},
    sync={"kind": "prawndo", "port": "emulated:gate"},
    scan={"frame_rate": "25 kHz", "command_range": [-0.3, 0.4]},
)

CASES: Mapping[str, Case] = {
    "clear-K1": Case(config("street-clear", 240, 1, scan={"command_range": [-0.7, 0.7]})),
    "light-fog-K2": Case(config("street-light-fog", 200, 2), maps=2),
    "windows-K3": Case(
        config(
            "street",
            200,
            3,
            spad={"link": "100 MB/s"},
            scan={"depth_range": ["2 m", "15 m"], "command_range": [0.8, -0.8]},
        ),
        geometry(320, 40, 300.0),
        maps=2,
    ),
    "both-ways-dense-fog-K5": Case(config("street-dense-fog", 160, 5, scan={"bidirectional": True}), maps=4),
    "tilted-K10": Case(config("street", 160, 10), TILTED),
    "dirty-sensor-K20": Case(
        config("street", 100, 20, calibration="known.yaml", world={"sensor": DIRTY, "line": {"speckle": True}}),
        defect_share=0.01,
    ),
    "two-lines-K5": Case(
        config(
            "street-light-fog",
            160,
            5,
            scan={"command_range": [-0.4, 0.4], "bidirectional": True},
            line_offsets=[-0.4, 0.4],
            line_power="shared",
        ),
        maps=3,
    ),
    "spad512s-K10": Case(SPAD512S, geometry(512, 512, 600.0, pivot={"angle_rad": [0.0872, 0.5315]}), repeats=False),
    "learning-K10": Case(
        config("./scene.yaml", 120, 10, estimate={"estimator": "joint", "temporal_prior": True}),
        scene=MOVING_FOG,
        maps=5,
    ),
    "gaps-K5": Case(
        config(
            "street",
            160,
            5,
            spad={
                "lost_frames": [*range(400, 431), 900, 901],
                "loss_probability": 0.01,
                "duplicate_probability": 0.005,
                "clock_error": "50 ppm",
                "clock_wander": "1 ppm",
            },
            scanner={"jitter": 3e-4},
        ),
        maps=3,
    ),
    "bent-weather-K3": Case(
        config("street-everything", 180, 3, scan={"bidirectional": True}),
        geometry(pivot={"bow_per_rad": 0.02}, row_delay_s=2e-7),
        maps=2,
    ),
}
"""Scans that are recorded, by name."""

SEED = 11


def write_case(case: Case, folder: Path) -> Path:
    """Write the files of a case's rig; path of its config."""
    folder.mkdir(parents=True)
    _write(folder / "rig.yaml", case.geometry)
    if case.defect_share:
        size = case.geometry["camera"]["height"], case.geometry["camera"]["width"]
        np.save(folder / "defects.npy", np.random.default_rng(SEED).random(size) < case.defect_share)
        _write(folder / "known.yaml", case.geometry | {"defects": "defects.npy"})
    if case.scene is not None:
        _write(folder / "scene.yaml", case.scene)
    return _write(folder / "config.yaml", case.config)


def write_cube(folder: Path, *, maps: int = 3, columns: int = 90, exposures: int = 5) -> Path:
    """Write cube.npy with its plan.yaml and calibration.yaml: steps of a wall in haze; the cube's path."""
    folder.mkdir(parents=True)
    content = geometry()
    tangents = np.linspace(-0.3, 0.5, columns)
    planes = np.stack([np.ones(columns), 0 * tangents, -tangents, np.full(columns, -BASELINE_M)], 1)
    np.save(folder / "planes.npy", planes)
    _write(
        folder / "calibration.yaml",
        {key: content[key] for key in ("format", "version", "camera")} | {"planes": "planes.npy"},
    )
    plan = {"columns": columns, "exposures": exposures, "frame_rate": "100 kHz", "depth_range": ["1 m", "8 m"]}
    _write(folder / "plan.yaml", plan)
    rng = np.random.default_rng(SEED)
    u = (np.arange(WIDTH) - (WIDTH - 1) / 2) / FOCAL_PX
    depth_m = np.where(np.arange(HEIGHT)[:, None] < 20, 2.5, 5.0) - 0.8 * u
    crossing = u + BASELINE_M / depth_m
    off_px = (crossing - tangents[:, None, None]) * FOCAL_PX
    flux = 0.004 + 0.5 * np.exp(-0.5 * (off_px / 0.7) ** 2) + 0.06 * (off_px > 0) * np.exp(-off_px / 40)
    flux[:, rng.random((HEIGHT, WIDTH)) < 0.005] = 1.5
    seen = rng.random((maps, columns, exposures, HEIGHT, WIDTH)) < -np.expm1(-flux)[None, :, None]
    cube = folder / "cube.npy"
    np.save(cube, np.packbits(seen, axis=-1).reshape(maps * columns * exposures, HEIGHT, WIDTH // 8))
    return cube


def write_board_rig(folder: Path) -> Path:
    """Write a rig that looks at a board of few, large squares, its board.yaml and scene.yaml; path of its config."""
    board = {"kind": "charuco", "squares": [6, 5], "square": "100 mm", "marker": "80 mm", "dictionary": "DICT_4X4_50"}
    scene = {
        "surfaces": "board",
        "board": {
            "file": "board.yaml",
            "rotation": ["0 deg", "20 deg", "0 deg"],
            "position": ["-30 cm", "-25 cm", "1.3 m"],
        },
        "wall": "3 m",
        "ambient": {"illuminance": "30 lux"},
    }
    content = config(
        "./scene.yaml",
        300,
        3,
        scan={"depth_range": ["0.5 m", "8 m"], "command_range": [-0.9, 0.9]},
    )
    size = 256
    matrix = [[300.0, 0, 127.0], [0, 300.0, 128.5], [0, 0, 1]]
    rig = geometry(size, size, camera={"matrix": matrix}, pivot={"angle_rad": [0.08, 0.6]})
    file = write_case(Case(content, rig, scene), folder)
    _write(folder / "board.yaml", board)
    return file


def _write(file: Path, content: Content) -> Path:
    file.write_text(yaml.safe_dump(content, sort_keys=False))
    return file
