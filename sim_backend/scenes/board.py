"""Calibration boards in front of a wall.

A pixel's albedo is the mean over its area, as a real pixel averages print finer than itself. A few rays are enough for
a pixel that contains no edge of the print; otherwise many rays are used, on a Fibonacci lattice that is placed
differently in every pixel. A pixel's depth is that of the ray through its centre. The wall is perpendicular to the
camera's axis.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.board.board import BUNDLED_BOARD, Board, load_board
from calibration.errors import CalibrationError
from calibration.views import BoardPose
from drivers.errors import DeviceError
from sim_backend.scenes.scene import SceneBoard
from sim_backend.scenes.surfaces import Array, Surfaces, checked

RAYS, TURNS = 233, 144
"""RAYS: number of rays through a pixel that sees an edge. TURNS, the Fibonacci number before it, places them so that no
two are in line with the pixel's row or column.

If the lattice were the same in all pixels, all edges of one direction would share its error: with 34 rays, all corners
of a picture would be off together by 0.0015 px, twice what the photons of a bright picture leave.
"""
LOOK = 21
"""Number of these rays, evenly chosen, that decide with the pixel's four corners whether it sees an edge."""
WALL_ALBEDO = 0.5
"""Albedo of a painted wall, neither white nor dark."""


@dataclass(frozen=True, slots=True, eq=False)
class BoardAtPose:
    """A board held at a pose. mirrored: whether it is printed the wrong way round."""

    board: Board
    pose: BoardPose
    mirrored: bool = False

    def trace(self, u: Array, v: Array) -> tuple[Array, Array]:
        """(z of the board's plane in m, albedo) where rays (u, v, 1) meet it. The albedo is NaN where a ray misses the
        board or meets its back; z means nothing there."""
        turn, position = self.pose.matrix, np.asarray(self.pose.position_m, np.float64)
        with np.errstate(all="ignore"):
            along = turn[0, 2] * u + turn[1, 2] * v + turn[2, 2]
            z = (turn[:, 2] @ position) / along
            at = np.stack([z * u, z * v, z], axis=-1) - position
            x, y = at @ turn[:, 0], at @ turn[:, 1]
            met = (z > 0) & (along > 0)
        x = self.board.size_m[0] - x if self.mirrored else x
        return z, self.board.albedo_at(np.where(met, x, np.nan), np.where(met, y, np.nan))


def load_boards(shown: Sequence[SceneBoard], folder: Path) -> list[BoardAtPose]:
    """The boards of a scene file. Relative paths start at `folder`. Raises DeviceError if a board's file cannot be
    used."""
    try:
        return [
            BoardAtPose(
                load_board(BUNDLED_BOARD if one.file is None else folder / os.path.expanduser(one.file)),
                BoardPose(np.array(one.rotation), np.array(one.position)),
                one.mirrored,
            )
            for one in shown
        ]
    except CalibrationError as error:
        raise DeviceError(f"scene's {error}") from error


def board_scene(u: Array, v: Array, boards: Sequence[BoardAtPose], wall_m: float) -> Surfaces:
    """The boards, nearer ones in front, and a wall `wall_m` away behind them, for a camera of rays (u, v), each (rows,
    width)."""
    depth, albedo = np.full(u.shape, wall_m), np.full(u.shape, WALL_ALBEDO)
    slopes = [(np.gradient(tangent, axis=1), np.gradient(tangent, axis=0)) for tangent in (u, v)]
    for shown in sorted(boards, key=lambda one: -float(one.pose.position_m[2])):
        z, centre = shown.trace(u, v)
        inside = ~np.isnan(centre) & (z < depth)
        depth[inside] = z[inside]
        near = cv2.dilate(inside.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0  # and the pixels around them
        share, light = _over_area(shown, u[near], v[near], [(along[near], down[near]) for along, down in slopes])
        albedo[near] = light + (1 - share) * albedo[near]
    return checked("board", depth, albedo, np.ones(u.shape, bool), u.shape)


def _over_area(shown: BoardAtPose, u: Array, v: Array, slopes: list[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Share of each pixel's area that the board covers, and the board's albedo times that share; all (n,)."""
    (u_x, u_y), (v_x, v_y) = ([np.nan_to_num(slope) for slope in pair] for pair in slopes)
    place = np.random.default_rng(0).random((2, u.size))  # of the lattice in each pixel; the same in every picture

    def albedo(at: NDArray[np.intp], along: Array, down: Array) -> Array:
        return shown.trace(u[at] + along * u_x[at] + down * u_y[at], v[at] + along * v_x[at] + down * v_y[at])[1]

    def ray(at: NDArray[np.intp], number: int) -> Array:
        along, down = (place[0, at] + number / RAYS) % 1 - 0.5, (place[1, at] + number * TURNS / RAYS) % 1 - 0.5
        return albedo(at, along, down)

    everywhere, halves = np.arange(u.size), (-0.5, 0.5)
    look = [albedo(everywhere, np.full(u.size, along), np.full(u.size, down)) for along in halves for down in halves]
    look += [ray(everywhere, number * RAYS // LOOK) for number in range(LOOK)]
    edge = np.flatnonzero(np.any(np.nan_to_num(look[1:]) != np.nan_to_num(look[0]), axis=0))
    share, light = (~np.isnan(look[-1])).astype(np.float64), np.nan_to_num(look[-1])
    share[edge], light[edge] = 0.0, 0.0
    for number in range(RAYS):
        there = ray(edge, number)
        share[edge] += ~np.isnan(there) / RAYS
        light[edge] += np.nan_to_num(there) / RAYS
    return share, light
