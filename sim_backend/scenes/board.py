"""Calibration boards in front of a wall.

A pixel's albedo is the mean over its area, taken at SAMPLES rays on a Fibonacci lattice, as a sensor's pixel sees print
finer than itself; its depth is that of the ray through its centre. The wall is square to the camera's axis.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.board import BUNDLED_BOARD, Board, load_board
from calibration.errors import CalibrationError
from calibration.views import BoardPose
from drivers.errors import DeviceError
from sim_backend.scene import BoardShown
from sim_backend.scenes.surfaces import Surfaces, checked

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

SAMPLES, TURNS = 34, 21
"""Rays through a pixel, neighbouring Fibonacci numbers: no two of them are in line with the row or the column, so that
an edge of the print lies within 1/68 pixel of where it is; on a square grid of as many, within 1/12."""
WALL_ALBEDO = 0.5
"""Of a wall that is painted, neither white nor dark."""


@dataclass(frozen=True, slots=True, eq=False)
class ShownBoard:
    """A board held at a pose. mirrored: printed the wrong way round."""

    board: Board
    pose: BoardPose
    mirrored: bool = False

    def seen(self, u: Array, v: Array) -> tuple[Array, Array]:
        """(depth in metres, albedo) along rays (u, v); albedo NaN where a ray misses the board or meets its back."""
        turn, position = self.pose.matrix, np.asarray(self.pose.position_m, np.float64)
        with np.errstate(all="ignore"):
            along = turn[0, 2] * u + turn[1, 2] * v + turn[2, 2]
            z = (turn[:, 2] @ position) / along
            at = np.stack([z * u, z * v, z], axis=-1) - position
            x, y = at @ turn[:, 0], at @ turn[:, 1]
            met = (z > 0) & (along > 0)
        x = self.board.size_m[0] - x if self.mirrored else x
        return z, self.board.albedo_at(np.where(met, x, np.nan), np.where(met, y, np.nan))


def load_boards(shown: Sequence[BoardShown], folder: Path) -> list[ShownBoard]:
    """The boards of a scene file whose paths start at `folder`. DeviceError where a board's file is no board's."""
    try:
        return [
            ShownBoard(
                load_board(BUNDLED_BOARD if one.file is None else folder / Path(one.file).expanduser()),
                BoardPose(np.array(one.rotation), np.array(one.position)),
                one.mirrored,
            )
            for one in shown
        ]
    except CalibrationError as error:
        raise DeviceError(f"scene's {error}") from error


def board_scene(u: Array, v: Array, boards: Sequence[ShownBoard], wall_m: float) -> Surfaces:
    """The boards, the nearer ones in front, before a wall `wall_m` away, for a camera of rays (u, v), (rows, width)."""
    depth, albedo = np.full(u.shape, wall_m), np.full(u.shape, WALL_ALBEDO)
    slopes = [(np.gradient(tangent, axis=1), np.gradient(tangent, axis=0)) for tangent in (u, v)]
    for shown in sorted(boards, key=lambda one: -float(one.pose.position_m[2])):
        z, centre = shown.seen(u, v)
        inside = ~np.isnan(centre) & (z < depth)
        depth[inside] = z[inside]
        near = _grown(inside)
        share, light = _over_area(shown, u[near], v[near], [(along[near], down[near]) for along, down in slopes])
        albedo[near] = light + (1 - share) * albedo[near]
    return checked("board", depth, albedo, np.ones(u.shape, bool), u.shape)


def _over_area(shown: ShownBoard, u: Array, v: Array, slopes: list[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Share of each pixel's area that the board covers, and the board's albedo times that share."""
    share, light = np.zeros_like(u), np.zeros_like(u)
    (u_x, u_y), (v_x, v_y) = ([np.nan_to_num(slope) for slope in pair] for pair in slopes)
    for i in range(SAMPLES):
        along, down = (i + 0.5) / SAMPLES - 0.5, (i * TURNS % SAMPLES + 0.5) / SAMPLES - 0.5
        _, there = shown.seen(u + along * u_x + down * u_y, v + along * v_x + down * v_y)
        share += ~np.isnan(there)
        light += np.nan_to_num(there)
    return share / SAMPLES, light / SAMPLES


def _grown(inside: Mask) -> Mask:
    """The pixels and those around them."""
    grown: Mask = cv2.dilate(inside.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return grown
