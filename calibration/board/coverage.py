"""How much of the picture, of the angles and of the distances a set of views has shown the camera."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.board.board import Board
from calibration.views import BoardPose, View

Array = NDArray[np.float64]

CELLS = 8
"""Along each side of the picture."""


@dataclass(frozen=True, slots=True, eq=False)
class Coverage:
    """cells: (8, 8) int64, corners in each cell of the picture. tilt_rad, distance_m: (views,) float64.

    tilt: between the board's normal and the line of sight to its middle. spread_rad: largest angle between the normals
    of two views: what tells the focal length from the distance.
    """

    cells: NDArray[np.int64]
    tilt_rad: Array
    distance_m: Array
    spread_rad: float

    @property
    def share(self) -> float:
        """Of the cells, those that hold a corner."""
        return float(np.count_nonzero(self.cells) / self.cells.size)


def coverage_of(views: Sequence[View], poses: Sequence[BoardPose], board: Board, size: tuple[int, int]) -> Coverage:
    """What the corners of `views`, whose boards stand at `poses`, cover of a picture of size (width, height)."""
    px = np.concatenate([view.corners.px for view in views if view.corners is not None])
    edges = [np.linspace(-0.5, length - 0.5, CELLS + 1) for length in (size[1], size[0])]
    cells = np.histogram2d(px[:, 1], px[:, 0], bins=edges)[0].astype(np.int64)
    middle = np.array([*board.size_m, 0.0]) / 2
    middles = np.stack([pose.to_camera(middle) for pose in poses])
    distance = np.linalg.norm(middles, axis=1)
    normals = np.stack([pose.matrix[:, 2] for pose in poses])
    tilt = np.arccos(np.clip(np.sum(normals * middles, axis=1) / distance, -1, 1))
    return Coverage(cells, tilt, distance, spread_rad(poses))


def spread_rad(poses: Sequence[BoardPose]) -> float:
    """The largest angle between the normals of two boards."""
    normals = np.stack([pose.matrix[:, 2] for pose in poses])
    return float(np.arccos(np.clip(normals @ normals.T, -1, 1)).max())
