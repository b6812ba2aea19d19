"""Settings by chance: a rig, a scene, exposures and an estimator; scans with them, and depth against the truth."""

import copy
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from rig.api import calibrate_pixels, reconstruct, scan
from rig.scan.run import RunResult
from tests.campaigns.wrong_inputs.recorded import Recording
from tests.reference.made_scenes import random_scene

Content = dict[str, Any]

EXPOSURES = (1, 2, 3, 5, 10, 20)
ESTIMATORS = ("likelihood", "joint")
SCENES = (
    "street", "street-clear", "street-light-fog", "street-smoke", "street-rain", "street-snow", "street-dense-fog",
    "made", "made in fog",
)  # fmt: skip
OFF = 0.02
"""Relative depth error at the median of a map beyond which it is wrong."""
WORSE = 2.0
"""Least ratio of a wrong map's error to that of the undisturbed one: in fog, few photons alone can be off by 2 %."""
FEWEST_PIXELS = 50
"""Fewest pixels with depth and truth for a map's depth to be judged."""


def geometry(name: str) -> Content:
    """The content of a calibration file: the bundled small rig, and three with more pixels."""
    right = name == "right"
    width, height, focal = (96, 40, 110) if name == "small" else (256, 48, 300)
    angles = [0.08, 0.38] if name == "small" else [0.06, 0.47]
    tilt = [0.05, 1.0, -0.03] if name == "turned" else [0.0, 1.0, 0.0]
    axis = np.array(tilt) / np.linalg.norm(tilt)
    zero = np.array([1.0, 0.0, 0.0])
    zero = (zero - zero @ axis * axis) / np.linalg.norm(zero - zero @ axis * axis)
    return {
        "format": "spadrig-calibration",
        "version": 1,
        "camera": {
            "width": width,
            "height": height,
            "matrix": [[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]],
            "distortion": [{"small": -0.1, "turned": -0.2}.get(name, 0.0), 0, 0, 0, 0],
        },
        "scanner": {
            "pivot": {
                "axis_point_m": [0.3 if right else -0.3, 0, 0],
                "axis_direction": axis.tolist(),
                "zero_normal": zero.tolist(),
                "angle_rad": [-angles[0], -angles[1]] if right else angles,
            }
        },
        "source_m": [0.3 if right else -0.3, 0, 0],
        "lag_s": {"forward": 2e-4, "backward": 2e-4},
    }


PIXEL_FRAMES = 3000
"""Dark frames for a map of pixels."""
RIGS = ("small", "left", "right", "turned")
COLUMNS = {"small": 150}
OTHER_COLUMNS = 200


@dataclass(frozen=True)
class Setting:
    """A rig before a scene. folder: for everything that is written. rng: for what a wrong input draws itself.
    knows_pixels: whether the calibration has a map of unusable pixels, made by `rig calibrate pixels`."""

    folder: Path
    rng: np.random.Generator
    rig: str
    scene: str
    exposures: int
    estimator: str
    seed: int
    maps: int = 1
    knows_pixels: bool = False
    geometry: Content = field(default_factory=dict)

    @classmethod
    def drawn(
        cls, rng: np.random.Generator, folder: Path, *, maps: int = 1, fewest: int = 1, pixels: bool = False
    ) -> "Setting":
        """A setting by chance. fewest: exposures per column. pixels: whether every other one has a map of pixels."""
        rig = str(rng.choice(RIGS))
        exposures = int(rng.choice([k for k in EXPOSURES if k >= fewest]))
        scene, estimator = str(rng.choice(SCENES)), str(rng.choice(ESTIMATORS))
        seed, knows_pixels = int(rng.integers(1 << 31)), pixels and bool(rng.random() < 0.5)
        return cls(folder, rng, rig, scene, exposures, estimator, seed, maps, knows_pixels, geometry(rig))

    def told(self) -> dict[str, Any]:
        """The setting in plain values."""
        return {
            name: getattr(self, name) for name in ("rig", "scene", "exposures", "estimator", "maps", "knows_pixels")
        }

    @property
    def rate_khz(self) -> int:
        """Frames per millisecond: fewer where the mirror would have to be too fast."""
        return 40 if self.exposures == 1 else 100

    def with_other_scene(self) -> "Setting":
        """The same rig before other surfaces."""
        return replace(self, scene="made in fog" if self.scene == "made in fog" else "made", seed=self.seed + 1)

    def scan(self, name: str, true: Content | None = None, power_mw: float = 50.0) -> Path:
        """Record a scan; the folder of the run. true: geometry of the rig as it is, if that is not its calibration."""
        here = self.folder / name
        here.mkdir()
        write_yaml(here / "calibration.yaml", self.geometry)
        write_yaml(here / "true.yaml", self.geometry if true is None else true)
        content = {
            "name": "drawn",
            "calibration": "./calibration.yaml",
            "world": {
                "kind": "simulated",
                "geometry": "./true.yaml",
                "scene": self._scene(here),
                # Shares as in public data of such an array; unmapped ones would be the wrong input.
                "sensor": {"hot_share": "1 %", "dead_share": "0.5 %"} if self.knows_pixels else {},
            },
            "spad": {"kind": "simulated"},
            "scanner": {"kind": "simulated"},
            "laser": {"kind": "simulated", "max_power": "100 mW"},
            "sync": {"kind": "simulated"},
            "scan": {
                "columns": COLUMNS.get(self.rig, OTHER_COLUMNS),
                "exposures": self.exposures,
                "frame_rate": f"{self.rate_khz} kHz",
                "depth_range": ["1 m", "15 m"],
                "command_range": [-0.8, 0.8],
                "power": f"{power_mw:g} mW",
            },
            "estimate": {"estimator": "argmax"},
        }
        write_yaml(here / "rig.yaml", content)
        if self.knows_pixels:
            calibrate_pixels(here / "rig.yaml", seed=self.seed + 1, frames=PIXEL_FRAMES, out=here / "pixels")
            write_yaml(here / "rig.yaml", content | {"calibration": "./pixels/calibration.yaml"})
        scan(here / "rig.yaml", record=True, maps=self.maps, seed=self.seed, out=here / "run")
        return here / "run"

    def _scene(self, here: Path) -> str:
        if not self.scene.startswith("made"):
            return self.scene
        camera = self.geometry["camera"]
        made = random_scene(self.seed % 400)
        y, x = (np.linspace(0, 511, camera[side]).astype(int) for side in ("height", "width"))
        surfaces = here / "surfaces"
        surfaces.mkdir()
        depth, albedo = made.depth_m[np.ix_(y, x)], made.albedo[np.ix_(y, x)]
        np.savez(surfaces / "world.npz", depth_m=depth, albedo=albedo)
        scene: Content = {"surfaces": "./surfaces", "ambient": {"illuminance": "5 lux"}}
        if self.scene == "made in fog":
            scene["medium"] = {"fog": {"visibility": "40 m"}}
        write_yaml(here / "scene.yaml", scene)
        return "./scene.yaml"

    def depth(self, run: Path, name: str, calibration: Path | None = None) -> RunResult:
        """The depth of a recording."""
        return reconstruct(run, None, calibration, estimator=self.estimator, out=self.folder / name)


@dataclass(frozen=True)
class Cube:
    """A cube and its files' content. frames: packed (maps x columns x exposures, rows, row bytes)."""

    frames: NDArray[np.uint8]
    columns: int
    exposures: int
    planes: NDArray[np.float64]
    camera: Mapping[str, Any]

    @classmethod
    def of(cls, recording: Recording, geometry: Content) -> "Cube":
        """The frames of a recording's maps, with the light planes at which the first map's were taken."""
        plan, maps = recording.plan, recording.maps()
        column = recording.columns()[maps[0]].reshape(plan.columns, -1).mean(axis=1)
        slope = (plan.commands[-1] - plan.commands[0]) / (plan.columns - 1)
        planes = np.array([_plane(geometry, plan.commands[0] + slope * each) for each in column])
        frames = recording.pixels[np.concatenate(maps), :, : -(-recording.width // 8)]
        return cls(frames.copy(), plan.columns, plan.exposures, planes, geometry["camera"])

    def bits(self) -> NDArray[np.bool_]:
        """Unpacked frames (frames, rows, width)."""
        return np.unpackbits(self.frames, axis=2)[:, :, : self.camera["width"]].astype(np.bool_)

    def depth(self, setting: Setting, name: str) -> RunResult:
        """Its depth, by files in a folder of this name."""
        here = setting.folder / f"{name}-cube"
        here.mkdir()
        np.save(here / "cube.npy", self.frames)
        plan = {"columns": self.columns, "exposures": self.exposures, "frame_rate": f"{setting.rate_khz} kHz"}
        write_yaml(here / "plan.yaml", plan | {"depth_range": ["1 m", "15 m"]})
        calibration = {"format": "spadrig-calibration", "version": 1, "camera": dict(self.camera)}
        write_yaml(here / "calibration.yaml", calibration | {"planes": self.planes.tolist()})
        files = here / "cube.npy", here / "plan.yaml", here / "calibration.yaml"
        return reconstruct(*files, estimator=setting.estimator, out=setting.folder / name)


def _plane(content: Content, command: float) -> NDArray[np.float64]:
    """Light plane (nx, ny, nz, d) of a mirror command, by Rodrigues' formula."""
    pivot = content["scanner"]["pivot"]
    axis, zero, point = (np.array(pivot[name]) for name in ("axis_direction", "zero_normal", "axis_point_m"))
    angle = pivot["angle_rad"][0] + pivot["angle_rad"][1] * command
    normal = zero * np.cos(angle) + np.cross(axis, zero) * np.sin(angle) + axis * (axis @ zero) * (1 - np.cos(angle))
    return np.append(normal, normal @ point)


def changed(content: Content, **values: Any) -> Content:
    """A geometry with some values changed: focal (factor), baseline (factor), right_px, down_px, mirror (factor)."""
    out = copy.deepcopy(content)
    camera, pivot = out["camera"]["matrix"], out["scanner"]["pivot"]
    for axis, name in enumerate(("right_px", "down_px")):
        camera[axis][2] += values.get(name, 0.0)
        camera[axis][axis] *= values.get("focal", 1.0)
    for key in ("axis_point_m", "source_m"):
        where = pivot if key in pivot else out
        where[key] = [values.get("baseline", 1.0) * each for each in where[key]]
    pivot["angle_rad"][1] *= values.get("mirror", 1.0)
    return out


def truths(run: Path) -> list[NDArray[np.float32]]:
    """True depth of each map of a run, (rows, width)."""
    return [np.load(file)["depth_m"] for file in sorted((run / "truth").glob("*.npz"))]


def depths(out: Path) -> list[NDArray[np.float32]]:
    """Depth of each map of a run, (rows, width)."""
    return [np.load(file) for file in sorted((out / "depth").glob("*.npy"))]


def off(found: list[NDArray[np.float32]], *true: list[NDArray[np.float32]]) -> float | None:
    """Largest median of a map's relative depth error; None if no map has pixels enough to be judged.

    true: of the maps; where there are two, a pixel may agree with either, since something changed in between. A map
    beyond the last with a truth is compared with that one.
    """
    medians = []
    for index, depth in enumerate(found):
        relative = [np.abs(depth / each[min(index, len(each) - 1)] - 1) for each in true]
        least = np.min(relative, axis=0)
        least = least[np.isfinite(least)]
        if len(least) >= FEWEST_PIXELS:
            medians.append(float(np.median(least)))
    return max(medians, default=None)


def write_yaml(file: Path, content: Content) -> None:
    """Write a file as a user would."""
    file.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
