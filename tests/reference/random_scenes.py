"""Cluttered scenes of chance: what numbers are fitted to that the prepared scenes are then to confirm.

A wavy wall, often a floor, and 3 to 29 boxes, balls, poles and fences between 1.5 and 5.5 m, each with an albedo of its
own between 0.025 and 0.9 under a texture of three sizes. Maps of numbers 0 to 10 taught `joint` its confidence.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from tests.reference.geometry import FOCAL_PX
from tests.reference.scene import Scene, away_from_steps

NEAREST_M, FARTHEST_M = 1.5, 6.5
ALBEDO = (0.02, 0.95)
KINDS = ("box", "ball", "pole", "fence")
HOW_OFTEN = (0.4, 0.3, 0.2, 0.1)

Array = NDArray[np.float64]


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


def _background(rng: np.random.Generator, x: Array, y: Array) -> Array:
    u, v = ((a - (n - 1) / 2) / FOCAL_PX for a, n in ((x, x.shape[1]), (y, x.shape[0])))
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
