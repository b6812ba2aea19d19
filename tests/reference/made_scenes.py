"""Scenes made for one question each: are thin objects found, how good is the sub-pixel place, is a pane seen twice."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tests.reference.geometry import FOCAL_PX
from tests.reference.scene import Pane, Scene, away_from_steps

POLE_PX = (150, 154)
"""First pixel of the pole, and the one after its last."""
BAR_STEP_PX = 20
THIN_ALBEDO, WALL_ALBEDO = 0.2, 0.5


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


def _rays(height: int, width: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    y, x = np.mgrid[0:height, 0:width]
    return (x - (width - 1) / 2) / FOCAL_PX, (y - (height - 1) / 2) / FOCAL_PX


def _scene(name: str, depth: NDArray[np.float64], albedo: NDArray[np.float64]) -> Scene:
    return Scene(name, depth.astype(np.float32), albedo.astype(np.float32), away_from_steps(depth))
