"""Scenes of the yardstick: depth, albedo and the pixels where the truth may be trusted.

Prepared scenes lie outside the repository (`../shared/scenes/NAME/world.npz`); where they are absent, the
procedural one stands in for a smaller test.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

SCENES_FOLDER = Path(__file__).resolve().parents[3] / "shared" / "scenes"
TRUSTED_STEP = 0.02  # relative depth step within 2 px that makes the truth untrusted, as in the prepared scenes
TRUSTED_REACH_PX = 2


@dataclass(frozen=True, slots=True)
class Pane:
    """A surface in front that sends back some light and lets the share `passes` through, each way.

    depth_m: float32 (H, W), inf where there is none.
    """

    depth_m: NDArray[np.float32]
    albedo: float
    passes: float


@dataclass(frozen=True, slots=True)
class Scene:
    """A 2.5-D world on the camera's raw pixel grid: `depth_m` and `albedo` float32 (H, W), `trusted` bool (H, W)."""

    name: str
    depth_m: NDArray[np.float32]
    albedo: NDArray[np.float32]
    trusted: NDArray[np.bool_]
    pane: Pane | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width in pixels."""
        height, width = self.depth_m.shape
        return height, width

    def crop(self, height: int, width: int) -> Scene:
        """The middle `height` x `width` pixels."""
        top, left = (self.shape[0] - height) // 2, (self.shape[1] - width) // 2
        if min(top, left) < 0:
            raise ValueError(f"crop {height} x {width} is larger than the scene {self.shape}")
        return self.part(slice(top, top + height), slice(left, left + width))

    def part(self, rows: slice, columns: slice = slice(None)) -> Scene:
        """These pixels."""
        at = rows, columns
        pane = None if self.pane is None else replace(self.pane, depth_m=self.pane.depth_m[at])
        arrays = {name: np.ascontiguousarray(getattr(self, name)[at]) for name in ("depth_m", "albedo", "trusted")}
        return replace(self, pane=pane, **arrays)


def scene_names() -> tuple[str, ...]:
    """Names of the prepared scenes; empty where the folder is absent."""
    return tuple(sorted(p.parent.name for p in SCENES_FOLDER.glob("*/world.npz")))


def load_scene(name: str) -> Scene | None:
    """The prepared scene `name`; None where it is absent."""
    path = SCENES_FOLDER / name / "world.npz"
    if not path.exists():
        return None
    with np.load(path, allow_pickle=False) as world:
        return Scene(
            name,
            world["depth_m"].astype(np.float32),
            world["albedo"].astype(np.float32),
            world["trusted"].astype(np.bool_),
        )


def procedural_scene(height: int = 512, width: int = 512, seed: int = 0) -> Scene:
    """Floor, back wall, slanted board, pole and ball between 1.6 and 5.5 m with a patchy albedo of 0.03 to 0.9."""
    y, x = np.mgrid[0:height, 0:width]
    u, v = (x - (width - 1) / 2) / 600.0, (y - (height - 1) / 2) / 600.0
    with np.errstate(divide="ignore"):
        floor = np.where(v > 0, 0.75 / np.maximum(v, 1e-6), np.inf)
    depth = np.minimum(5.5 - 0.8 * u, floor)
    depth = np.where((u > -0.33) & (u < -0.12) & (v > -0.25) & (v < 0.2), 3.2 + 1.5 * (u + 0.2) + 0.5 * v, depth)
    depth = np.where(np.abs(u - 0.06) < 0.012, np.minimum(depth, 2.4), depth)
    off = (u - 0.24) ** 2 + (v - 0.02) ** 2
    depth = np.where(off < 0.014, np.minimum(depth, 1.95 - np.sqrt(np.maximum(0.014 - off, 0)) * 1.5), depth)
    rng = np.random.default_rng(seed)
    patches = rng.uniform(np.log(0.03), np.log(0.9), (height // 24 + 1, width // 24 + 1))
    albedo = np.exp(np.kron(patches, np.ones((24, 24)))[:height, :width])
    return Scene("procedural", depth.astype(np.float32), albedo.astype(np.float32), away_from_steps(depth))


def away_from_steps(depth_m: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Mask (H, W) of the pixels without a depth step within 2 px."""
    around = surroundings(depth_m)
    # a slope may change the depth over 5 px by more than one step of 2 %
    return np.asarray(around.max(axis=(2, 3)) / around.min(axis=(2, 3)) - 1 < TRUSTED_STEP * around.shape[2])


def surroundings(values: NDArray[Any]) -> NDArray[Any]:
    """Values (H, W, 5, 5) within 2 px of each pixel; beyond the border it repeats."""
    reach = TRUSTED_REACH_PX
    side = 2 * reach + 1
    return np.lib.stride_tricks.sliding_window_view(np.pad(values, reach, mode="edge"), (side, side))
