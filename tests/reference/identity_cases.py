"""Files of the identity check: rigs of `identity_cases.yaml` and a bare cube; imports nothing of the program."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

Content = dict[str, Any]

SEED = 11


@dataclass(frozen=True, slots=True)
class Case:
    """A rig and the scan that is recorded with it. geometry: content of its calibration file.

    scene, board: contents of scene.yaml and board.yaml, where there are such. defect_share: of the pixels, called
    defects by the calibration. repeats: whether a second scan has the same frames: emulated devices run in the host's
    time.
    """

    config: Content
    geometry: Content
    scene: Content | None = None
    board: Content | None = None
    defect_share: float = 0.0
    maps: int = 1
    repeats: bool = True


def _changed(content: Content, changes: Mapping[str, Any]) -> Content:
    """The content with these keys added or replaced, those of mappings in it one by one."""
    merged = dict(content)
    for key, value in changes.items():
        merged[key] = _changed(merged.get(key, {}), value) if isinstance(value, dict) else value
    return merged


def _read_cases() -> dict[str, Case]:
    contents = yaml.safe_load(Path(__file__).with_name("identity_cases.yaml").read_text())
    base, cases = contents.pop("base"), {}
    for name, content in contents.items():
        parts = {part: _changed(base[part], content.get(part, {})) for part in base}
        cases[name] = Case(**(content | parts))
    return cases


CASES = _read_cases()
"""Scans that are recorded, by name."""
BOARD = CASES.pop("board")
"""The rig that looks at a board."""


def write_case(case: Case, folder: Path) -> Path:
    """Write the files of a case's rig; path of its config."""
    folder.mkdir(parents=True)
    _write(folder / "rig.yaml", case.geometry)
    if case.defect_share:
        size = case.geometry["camera"]["height"], case.geometry["camera"]["width"]
        np.save(folder / "defects.npy", np.random.default_rng(SEED).random(size) < case.defect_share)
        _write(folder / "known.yaml", case.geometry | {"defects": "defects.npy"})
    for name, content in (("scene.yaml", case.scene), ("board.yaml", case.board)):
        if content is not None:
            _write(folder / name, content)
    return _write(folder / "config.yaml", case.config)


def write_cube(folder: Path, *, maps: int = 3, columns: int = 90, exposures: int = 5) -> Path:
    """Write cube.npy with its plan.yaml and calibration.yaml: steps of a wall in haze; the cube's path."""
    folder.mkdir(parents=True)
    geometry = next(iter(CASES.values())).geometry
    camera, baseline_m = geometry["camera"], -geometry["source_m"][0]
    width, height, focal_px = camera["width"], camera["height"], camera["matrix"][0][0]
    tangents = np.linspace(-0.3, 0.5, columns)
    planes = np.stack([np.ones(columns), 0 * tangents, -tangents, np.full(columns, -baseline_m)], 1)
    np.save(folder / "planes.npy", planes)
    calibration = {key: geometry[key] for key in ("format", "version", "camera")} | {"planes": "planes.npy"}
    _write(folder / "calibration.yaml", calibration)
    plan = {"columns": columns, "exposures": exposures, "frame_rate": "100 kHz", "depth_range": ["1 m", "8 m"]}
    _write(folder / "plan.yaml", plan)
    rng = np.random.default_rng(SEED)
    u = (np.arange(width) - (width - 1) / 2) / focal_px
    depth_m = np.where(np.arange(height)[:, None] < 20, 2.5, 5.0) - 0.8 * u
    crossing = u + baseline_m / depth_m
    off_px = (crossing - tangents[:, None, None]) * focal_px
    flux = 0.004 + 0.5 * np.exp(-0.5 * (off_px / 0.7) ** 2) + 0.06 * (off_px > 0) * np.exp(-off_px / 40)
    flux[:, rng.random((height, width)) < 0.005] = 1.5
    seen = rng.random((maps, columns, exposures, height, width)) < -np.expm1(-flux)[None, :, None]
    cube = folder / "cube.npy"
    np.save(cube, np.packbits(seen, axis=-1).reshape(maps * columns * exposures, height, width // 8))
    return cube


def _write(file: Path, content: Content) -> Path:
    file.write_text(yaml.safe_dump(content, sort_keys=False))
    return file
