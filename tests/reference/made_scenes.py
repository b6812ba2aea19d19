"""Made scenes: some for one question each, and cluttered ones of chance.

The questions are whether thin objects are found, how good the sub-pixel place is, and whether a pane is seen twice. The
cluttered ones are what numbers are fitted to that the prepared scenes are then to confirm: a wavy wall, often a floor,
and 3 to 29 boxes, balls, poles and fences between 1.5 and 5.5 m, each with an albedo of its own between 0.025 and 0.9
under a texture of three sizes. Maps of their numbers 0 to 10 taught `joint` its confidence.
"""

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from tests.reference.geometry import FOCAL_PX
from tests.reference.scene import Pane, Scene, away_from_steps

POLE_PX = (150, 154)
"""First pixel of the pole, and the one after its last."""
BAR_STEP_PX = 20
THIN_ALBEDO, WALL_ALBEDO = 0.2, 0.5

NEAREST_M, FARTHEST_M = 1.5, 6.5
ALBEDO = (0.02, 0.95)
KINDS = ("box", "ball", "pole", "fence")
HOW_OFTEN = (0.4, 0.3, 0.2, 0.1)
"""Limits and objects of the cluttered scenes."""

Array = NDArray[np.float64]


def thin_scene(height: int = 512, width: int = 512) -> tuple[Scene, dict[str, NDArray[np.bool_]]]:
    """A pole 4 px wide, a fence with bars of 3 and 4 px every 20 px, a wall at 5 m and slanted ground.

    Pole and bars are dark enough for their stripes to be about as bright as the wall's. Second: the pixels (H, W) of
    `pole` and `fence`; `trusted` is of the rest, since no pixel of theirs is 2 px from an edge.
    """
    u, v = _rays(height, width)
    depth = 5.0 - 0.4 * u
    with np.errstate(divide="ignore"):
        depth = np.minimum(depth, np.where(v > 0, 1.2 / np.maximum(v, 1e-6), np.inf))
    x, y = np.arange(width), np.arange(height)
    in_bar = (x - width // 2 + BAR_STEP_PX) % BAR_STEP_PX < np.where((x // BAR_STEP_PX) % 2, 3, 4)
    along = in_bar & (x >= 0.45 * width) & (x < 0.9 * width)
    thin = {
        "pole": np.broadcast_to((x >= POLE_PX[0]) & (x < POLE_PX[1]), depth.shape),
        "fence": along[None, :] & ((y >= 0.15 * height) & (y < 0.85 * height))[:, None],
    }
    albedo = np.full(depth.shape, WALL_ALBEDO)
    for name, at_m in (("pole", 2.4), ("fence", 3.0)):
        depth = np.where(thin[name], np.minimum(depth, at_m), depth)
        albedo[thin[name]] = THIN_ALBEDO
    return _scene("thin", depth, albedo), thin


def smooth_scene(height: int = 512, width: int = 512) -> Scene:
    """A gently waved wall of even albedo at 2.7 to 3.7 m: the place of the stripe changes slowly, without any step."""
    u, v = _rays(height, width)
    depth = 3.2 + 0.3 * u + 0.2 * v + 0.15 * np.cos(6 * u) * np.cos(5 * v)
    return _scene("smooth", depth, np.full(depth.shape, WALL_ALBEDO))


def pane_scene(height: int = 512, width: int = 512) -> Scene:
    """A wall at about 4.5 m, over its middle a pane at 2.5 m that sends back little and lets 80 % of the light pass."""
    u, v = _rays(height, width)
    inside = (np.abs(u) < 0.25) & (np.abs(v) < 0.3)
    pane = Pane(np.where(inside, 2.5 + 0.2 * u, np.inf).astype(np.float32), albedo=0.1, passes=0.8)
    depth = 4.5 + 0.5 * u
    return replace(_scene("pane", depth, np.full(depth.shape, WALL_ALBEDO)), pane=pane)


def speck_scene(size: int, *, opaque: bool, height: int = 48, width: int = 512) -> Scene:
    """A wall at about 4.5 m and before it, at 2.5 m, squares of `size` px: boards, or flakes that let half the light
    pass."""
    u, _ = _rays(height, width)
    y, x = np.mgrid[0:height, 0:width]
    there = (y % 16 < size) & (x % 24 < size) & (y > size)
    wall, albedo = 4.5 + 0.5 * u, np.full(there.shape, WALL_ALBEDO)
    if opaque:
        return _scene("boards", np.where(there, 2.5, wall), albedo)
    flakes = Pane(np.where(there, 2.5, np.inf).astype(np.float32), albedo=1.0, passes=0.5)
    return replace(_scene("flakes", wall, albedo), pane=flakes)


def random_scene(number: int, height: int = 512, width: int = 512) -> Scene:
    """The scene of this number, always the same one."""
    rng = np.random.default_rng([number, 77])
    y, x = np.mgrid[0:height, 0:width].astype(np.float64)
    depth = _background(rng, x, y)
    tone, contrast = np.log(rng.uniform(0.1, 0.6)), rng.uniform(0.2, 0.9)
    albedo = _texture(rng, tone, contrast, depth.shape)
    for _ in range(int(rng.integers(3, 30))):
        there, at_m = _object(rng, x, y)
        there &= at_m < depth
        depth = np.where(there, at_m, depth)
        tone = rng.uniform(np.log(0.025), np.log(0.9))
        albedo = np.where(there, _texture(rng, tone, contrast, depth.shape), albedo)
    depth = np.clip(depth, NEAREST_M, FARTHEST_M)
    surface = np.clip(albedo, *ALBEDO).astype(np.float32)
    return Scene(f"random-{number}", depth.astype(np.float32), surface, away_from_steps(depth))


def _rays(height: int, width: int) -> tuple[Array, Array]:
    y, x = np.mgrid[0:height, 0:width]
    return (x - (width - 1) / 2) / FOCAL_PX, (y - (height - 1) / 2) / FOCAL_PX


def _scene(name: str, depth: Array, albedo: Array) -> Scene:
    return Scene(name, depth.astype(np.float32), albedo.astype(np.float32), away_from_steps(depth))


def _background(rng: np.random.Generator, x: Array, y: Array) -> Array:
    u, v = _rays(*x.shape)
    inverse = 1 / rng.uniform(3.5, 6.0) * (1 + rng.uniform(-0.5, 0.5) * u + rng.uniform(-0.3, 0.3) * v)
    depth = 1 / np.clip(inverse, 1 / FARTHEST_M, 1) * (1 + rng.uniform(0, 0.03) * noise(rng, x.shape, 64))
    if rng.random() < 0.6:
        down = np.maximum(v, 1e-6)
        depth = np.minimum(depth, np.where(v > 0, rng.uniform(0.6, 1.4) / down, np.inf))
    return depth


def _object(rng: np.random.Generator, x: Array, y: Array) -> tuple[NDArray[np.bool_], Array]:
    """Mask of an object, and its depth in metres everywhere."""
    height, width = x.shape
    centre_x, centre_y = rng.uniform(0, width), rng.uniform(0, height)
    size = np.exp(rng.uniform(np.log(8), np.log(130), 2))
    kind, angle = rng.choice(KINDS, p=HOW_OFTEN), rng.uniform(-0.6, 0.6)
    across = (x - centre_x) * np.cos(angle) + (y - centre_y) * np.sin(angle)
    along = (y - centre_y) * np.cos(angle) - (x - centre_x) * np.sin(angle)
    at_m = np.full(x.shape, 1 / rng.uniform(1 / 5.5, 1 / NEAREST_M))
    if kind == "box":
        there = (np.abs(across) < size[0]) & (np.abs(along) < size[1])
        slant = rng.uniform(-0.6, 0.6) * across + rng.uniform(-0.6, 0.6) * along
        return there, at_m * (1 + slant / FOCAL_PX)
    if kind == "ball":
        off = (across / size[0]) ** 2 + (along / size[1]) ** 2
        return off < 1, at_m - rng.uniform(0, 0.4) * np.sqrt(np.maximum(1 - off, 0))
    if kind == "pole":
        return (np.abs(across) < rng.uniform(1.5, 6)) & (np.abs(along) < 4 * size[1]), at_m
    bars = np.mod(across, rng.uniform(12, 40)) < rng.uniform(2.5, 6)
    return bars & (np.abs(across) < 1.5 * size[0]) & (np.abs(along) < 1.5 * size[1]), at_m


def _texture(rng: np.random.Generator, tone: float, contrast: float, shape: tuple[int, ...]) -> Array:
    parts = sum(share * noise(rng, shape, cell) for share, cell in ((0.6, 48), (0.5, 12), (0.3, 4)))
    return np.asarray(np.exp(tone + contrast * parts))


def noise(rng: np.random.Generator, shape: tuple[int, ...], cell_px: int) -> Array:
    """Smooth normal noise (height, width) of so many pixels a cell."""
    height, width = shape
    coarse = rng.standard_normal((height // cell_px + 2, width // cell_px + 2)).astype(np.float32)
    return cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC).astype(np.float64)
