"""Files that a lab writes or is sent: calibrations, configs, scenes, boards, arrays, and quantities with units."""

import json
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from calibration.board.board import BUNDLED_BOARD, load_board
from calibration.errors import CalibrationError
from calibration.files.npy_files import load_array, load_arrays
from calibration.files.rig_file import load_camera, load_rig_model
from calibration.files.sections import parse_yaml
from calibration.pixel_map import load_pixels
from drivers.errors import DeviceError
from drivers.units import DIMENSIONS, parse_quantity
from rig.calibrate.session import load_view, session_rig
from rig.config.bundled import BUNDLED
from rig.config.files import completed_text, load_config, load_cube_plan
from rig.devices.calibration_use import notes_on
from rig.errors import UsageError
from rig.study.definition import load_study
from rig.tradeoff.files import tradeoff_report
from sim_backend.scenes.board import load_boards
from sim_backend.scenes.scene import SCENE_FOLDER, load_folder, load_scene, load_surfaces
from tests.campaigns.inputs.changes import JSON, NPZ, YAML, Changes
from tests.campaigns.inputs.files import in_file, npy, npz, scratch
from tests.campaigns.inputs.fuzz import Target
from tests.system import small_rig

_YAML_WORDS = (
    b"*a", b"&a", b"<<: *a\n", b"- ", b": ", b"|\n", b"!!binary ", b"!!set ", b"!!float ", b"!!int ",
    b"!!python/tuple ", b"{", b"[", b"? ", b"---\n", b"...\n", b"%YAML 9.9\n", b"'", b'"', b'"\\e[2J"', b"\t", b"10 us",
    b"1e3 m", b"9/0 Hz", b"~nobody/x", b"a\\0b", b"surfaces: ",
)  # fmt: skip


def _text(content: Any) -> bytes:
    return yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=120).encode()


def _calibrations() -> list[bytes]:
    plain = small_rig.calibration()
    table = {"command": [-1.0, 0.0, 1.0], "planes": [[1, 0, 0, 0.1], [0.99, 0, 0.1, 0.1], [0.98, 0, 0.2, 0.1]]}
    full = plain | {
        "speed_range_per_s": [0.5, 2.0], "row_delay_s": 0.0, "gate_delay_s": 1e-6, "colour_skew_s": 0.0,
        "marker_rising": False, "provenance": {"velocities_per_s": [1.0], "corners": ["0" * 16], "note": "a note"},
        "identity": {"rig": "abc", "created": "2026-11-29", "name": "lab", "kinds": {"spad": "simulated"},
                     "serials": {"spad": "1"}, "verdict": "passed", "reasons": ["few"]},
        "defects": "defects.npy", "dark_rate": "dark.npy", "covariance": {"names": ["fx", "fy"], "file": "cov.npy"},
    }  # fmt: skip
    folder = scratch() / "calibration"
    folder.mkdir(exist_ok=True)
    size = (small_rig.HEIGHT, small_rig.WIDTH)
    (folder / "defects.npy").write_bytes(npy(np.zeros(size, bool)))
    (folder / "dark.npy").write_bytes(npy(np.zeros(size, np.float32)))
    (folder / "cov.npy").write_bytes(npy(np.eye(2)))
    bare = {key: value for key, value in plain.items() if key != "scanner"}
    planes = bare | {"planes": [[1, 0, 0, 0.1], [0.99, 0, 0.1, 0.1]]}
    return [_text(content) for content in (plain, full, plain | {"scanner": {"table": table}}, planes)]


def _cameras() -> list[bytes]:
    camera = small_rig.calibration()["camera"]
    covariance = {"names": ["fx", "fy"], "matrix": [[1.0, 0.0], [0.0, 1.0]]}
    content = {"format": "spadrig-camera", "version": 1, "camera": camera, "covariance": covariance}
    return [_text(content | {"views": ["0" * 16], "verdict": "failed", "reasons": ["too-few-poses"]})]


def _configs() -> list[bytes]:
    bundled = [BUNDLED / f"{name}.yaml" for name in ("simulated", "lab", "lab-nidaq-emulated", "simulated-4-lines")]
    return [*(file.read_bytes() for file in bundled), _text(small_rig.config())]


def _config(file: Path) -> None:
    (file.parent / "rig.yaml").write_bytes(_calibrations()[0])
    load_config(file)
    completed_text(file)


def _scene(file: Path) -> None:
    """A scene, the boards and surfaces in it, and the file's words as the name of another one."""
    try:
        scene, folder = load_scene(str(file))
        load_boards(scene.boards, folder)
        if scene.surfaces not in ("street", "board"):
            load_surfaces(scene, folder, np.zeros((2, 2)), np.zeros((2, 2)))
        with suppress(DeviceError):
            load_scene(scene.surfaces)
    except DeviceError as error:  # of several lines, one for each problem
        raise UsageError(str(error)) from error


def _studies() -> list[bytes]:
    study = {"do": "scan", "vary": {"scene": ["street", "./street.yaml"], "exposures": [1, 3]}, "repeat": 2, "seed": 1}
    study |= {"set": {"scan.columns": 100}, "also": [{"scene": "board"}], "omit": [{"exposures": 3}]}
    return [_text(study | {"time_limit": "90 s", "memory_limit": "2 GB"})]


def _study(file: Path) -> None:
    made = load_study(file)
    for _ in zip(made.combinations(), range(100), strict=False):
        pass


def _each_of(files: Path) -> Callable[[], list[bytes]]:
    return lambda: [file.read_bytes() for file in sorted(files.glob("*.yaml"))]


def _arrays() -> list[bytes]:
    record = np.zeros(3, [("a", "<u4"), ("b", "<f8", (2,))])
    each = np.arange(12).reshape(3, 4), np.zeros((2, 3), np.float32, "F"), np.array("text"), record, np.array(1.5)
    return [npy(array) for array in each]


def _archives() -> list[bytes]:
    arrays = {"a": np.arange(12), "b": np.zeros((20, 20), np.float32), "c": np.array("name")}
    return [npz(**arrays), npz(packed=True, **arrays)]


def _pixels() -> list[bytes]:
    arrays: dict[str, Any] = dict.fromkeys(
        ("rate_per_s", "rate_sd_per_s", "jump_per_s", "limit_per_s"), np.ones((4, 8))
    )
    arrays |= dict.fromkeys(("hot", "noisy", "defects", "dead"), np.zeros((4, 8), bool))
    about = {"format": "spadrig-pixels", "version": 1, "created": "2026-11-29", "parent": None, "sensor": "s"}
    about |= {"frames": 10, "judged": 0.9, "lit_judged": 0.5, "exposure_s": 1e-5, "ordinary_per_s": 100.0}
    return [npz(about=np.array(json.dumps(about)), **arrays)]


def _views() -> list[bytes]:
    arrays = {
        "format_version": np.array(1), "name": np.array("view"), "picture": np.zeros((4, 8), np.float32),
        "corner_ids": np.arange(4, dtype=np.int32), "corner_px": np.zeros((4, 2)), "corner_sd_px": np.ones((4, 2)),
        "passages_0": np.zeros((4, 5)), "sweep_0": np.array([1.0, 2.0]),
    }  # fmt: skip
    return [npz(**arrays)]


def _world(file: Path) -> None:
    load_folder(file.parent, (4, 8))


def _worlds() -> list[bytes]:
    return [npz(depth_m=np.full((4, 8), 2.0, np.float32), albedo=np.full((4, 8), 0.5, np.float32))]


def _quantity(data: bytes) -> None:
    text = data.decode("utf-8", "replace")
    refused = 0
    for dimension in DIMENSIONS:
        try:
            value = parse_quantity(text, dimension)
            assert np.isfinite(value)
        except ValueError as error:
            refused += 1
            if len(str(error)) > 500 or not str(error).isprintable():
                raise AssertionError(str(error)) from error
    if refused == len(DIMENSIONS):
        raise CalibrationError("no quantity")


def _yaml(data: bytes) -> None:
    parse_yaml(data.decode("utf-8", "replace"), "a file", "a: 1", "file")


def _identity() -> list[bytes]:
    return [
        json.dumps({"rig": "abc", "created": "2026", "name": "n", "kinds": {}, "serials": {}, "reasons": []}).encode()
    ]


def _notes(file: Path) -> None:
    class Model:
        @staticmethod
        def fingerprint() -> str:
            return "id"

    notes_on(file.with_name("calibration.yaml"), Model)  # type: ignore[arg-type]


def _tradeoffs() -> list[bytes]:
    row = {
        "scene": "street", "fog": None, "estimator": "joint", "filter": "none", "exposures": 5, "lines": 1,
        "sensor_ms": 5.0,
        "compute_ms": 3.0, "mean_abs_px": 0.1, "ci95": [0.09, 0.11], "within_1px": 0.9, "missing": 0.0, "depth_mm": 5.0,
        "pareto": True, "pareto_compute": False,
    }  # fmt: skip
    return [
        json.dumps(
            {
                "verdict": "complete",
                "advice": "take joint",
                "ci95_by": "blocks",
                "answer": "a",
                "versions": {"spadrig": "1"},
                "rows": [row] * 2,
            }
        ).encode()
    ]


TARGETS = (
    Target(
        "yaml",
        lambda: [*_calibrations(), b"a: &a [1, 2]\nb: *a\nc: {<<: {d: 1}}\n"],
        _yaml,
        changes=Changes(words=_YAML_WORDS, text=True),
    ),
    Target(
        "calibration",
        _calibrations,
        in_file("calibration/calibration.yaml", load_rig_model),
        (CalibrationError,),
        changes=Changes(words=_YAML_WORDS, tree=YAML),
    ),
    Target(
        "camera",
        _cameras,
        in_file("camera.yaml", load_camera),
        (CalibrationError,),
        changes=Changes(words=_YAML_WORDS, tree=YAML),
    ),
    Target("config", _configs, in_file("config/config.yaml", _config), changes=Changes(words=_YAML_WORDS, tree=YAML)),
    Target(
        "scene", _each_of(SCENE_FOLDER), in_file("scene.yaml", _scene), changes=Changes(words=_YAML_WORDS, tree=YAML)
    ),
    Target("study", _studies, in_file("study.yaml", _study), changes=Changes(words=_YAML_WORDS, tree=YAML)),
    Target(
        "board",
        lambda: [BUNDLED_BOARD.read_bytes()],
        in_file("board.yaml", load_board),
        (CalibrationError,),
        changes=Changes(tree=YAML),
    ),
    Target(
        "cube-plan",
        lambda: [b"columns: 500\nexposures: 10\nframe_rate: 100 kHz\ndepth_range: [1 m, 8 m]\n"],
        in_file("cube-plan.yaml", load_cube_plan),
        changes=Changes(words=_YAML_WORDS, tree=YAML),
    ),
    Target(
        "npy",
        _arrays,
        in_file("array.npy", load_array),
        (ValueError,),
        changes=Changes(words=(b"\x93NUMPY", b"|O", b"'descr'", b"True")),
    ),
    Target(
        "npz",
        _archives,
        in_file("arrays.npz", load_arrays),
        (ValueError,),
        changes=Changes(words=(b"PK\x03\x04", b"PK\x01\x02", b"PK\x05\x06"), tree=NPZ),
    ),
    Target("pixels", _pixels, in_file("pixels.npz", load_pixels), (CalibrationError,), changes=Changes(tree=NPZ)),
    Target("view", _views, in_file("view.npz", load_view), changes=Changes(tree=NPZ)),
    Target("world", _worlds, in_file("world/world.npz", _world), (DeviceError,), changes=Changes(tree=NPZ)),
    Target(
        "quantity",
        lambda: [b"10 us", b"100000/3 Hz", b"-1.5e3 m", b"0.05 /m", b"20 ppm"],
        _quantity,
        (CalibrationError,),
        changes=Changes(text=True),
    ),
    Target(
        "session",
        _identity,
        in_file("session/rig.json", lambda file: session_rig(file.parent)),
        changes=Changes(tree=JSON),
    ),
    Target(
        "notes",
        lambda: [b'{"check": {"calibration": "id", "passed": false, "reasons": ["a"]}}'],
        in_file("notes/calibration-checks.json", _notes),
        changes=Changes(tree=JSON),
    ),
    Target(
        "tradeoff",
        _tradeoffs,
        in_file("tradeoff/tradeoff.json", lambda file: tradeoff_report(file.parent)),
        changes=Changes(tree=JSON),
    ),
)
