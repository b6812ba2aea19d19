"""A calibration judged by boards that it was not made with: are they flat, as large and at the angle that they are?

A board at an unknown pose is scanned. The scanned points of each of its squares are averaged; the deviations of these
averages from their best plane are the flatness error. The board's corners, put on that plane along their rays, are as
far apart as the board says or not: the scale error. Two boards give the error of the angle between them. What the
model's covariance and the scan's noise let expect of each stands beside it. With m the deviations (cells,), C their
expected covariance and P what takes a plane off,

    chi2 = (P m)' (P C P)^+ (P m)    with cells - 3 degrees of freedom.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.board.board import Board
from calibration.check.board_cells import (
    BoardCells,
    cells_of,
    corner_pixels,
    inside_points,
    noise_m2,
    off_plane,
    points_of,
)
from calibration.depth.propagation import propagated
from calibration.model.rig_model import RigModel
from calibration.views import View

Array = NDArray[np.float64]


_PARALLEL = 1e-6
"""Sine of the angle between boards that are not tilted towards each other in any direction."""


@dataclass(frozen=True, slots=True, eq=False)
class CheckedBoard:
    """What the scan of one board gives; lengths in metres.

    distance_m: depth of its middle. flatness_rms_m, flatness_peak_m: of its squares' means off their plane; expected_m:
    the rms that covariance and noise let expect. chi2, freedom: of the deviations. scale: size scanned over size
    stated; scale_sd: as expected. cells_m: (squares down, across) deviations, NaN where a square was not scanned.
    point_rms_m: of single passages off the plane. normal: (3,) unit, towards the camera.
    """

    name: str
    distance_m: float
    flatness_rms_m: float
    flatness_peak_m: float
    expected_m: float
    chi2: float
    freedom: int
    scale: float
    scale_sd: float
    point_rms_m: float
    cells_m: Array
    normal: Array


@dataclass(frozen=True, slots=True)
class CheckedAngle:
    """Angle between two boards as scanned, its sd as expected; rad."""

    angle_rad: float
    sd_rad: float


def check_boards(model: RigModel, views: Sequence[View], board: Board) -> tuple[CheckedBoard, ...]:
    """Check every view's board. Raises Degenerate where a board or its passages are not there."""
    return tuple(_check(model, view, board) for view in views)


def check_angle(model: RigModel, first: View, second: View, board: Board) -> CheckedAngle:
    """The angle between the boards of two views, 0 to pi/2."""
    both = [(cells_of(model, view, board), view) for view in (first, second)]

    def measure(tried: RigModel) -> Array:
        one, other = (_plane(points_of(tried, cells))[0] for cells, _ in both)
        return np.array([math.acos(min(1.0, abs(float(one @ other))))])

    values, covariance = propagated(model, measure)
    noise = sum(_tilt_noise(model, both[at][0], both[1 - at][0]) for at in (0, 1))
    return CheckedAngle(float(values[0]), float(np.sqrt(covariance[0, 0] + noise)))


def _tilt_noise(model: RigModel, cells: BoardCells, other: BoardCells) -> float:
    """Variance (rad^2) by the noise of a board's scan of how far it is tilted towards another one."""
    points = points_of(model, cells)
    normal, _ = _plane(points)
    towards = _plane(points_of(model, other))[0]
    towards = towards - (towards @ normal) * normal
    around = points - points.mean(axis=0)
    around -= np.outer(around @ normal, normal)
    spread = np.linalg.pinv(around.T @ around, rcond=1e-9, hermitian=True)  # of the slopes in the board's plane
    length2 = float(towards @ towards)
    share = float(towards @ spread @ towards) / length2 if length2 > _PARALLEL**2 else float(np.linalg.norm(spread, 2))
    return noise_m2(model, cells, normal) * share


def _check(model: RigModel, view: View, board: Board) -> CheckedBoard:
    cells = cells_of(model, view, board)
    points = points_of(model, cells)
    corners = corner_pixels(view)
    count = len(cells.board_xy_m)

    def measure(tried: RigModel) -> Array:
        found = points_of(tried, cells)
        normal, offset = _plane(points)  # the same reference for all
        return np.append(found @ normal - offset, _scale(tried, found, view, board, corners))

    values, covariance = propagated(model, measure)
    deviations, scale = values[:count], float(values[count])
    normal, offset = _plane(points)
    noise = noise_m2(model, cells, normal)
    chi2, freedom = _chi2(deviations, covariance[:count, :count] + noise * np.eye(count), cells.board_xy_m)
    basis = off_plane(cells.board_xy_m)
    expected = basis.T @ (covariance[:count, :count] + noise * np.eye(count)) @ basis
    field = np.full((board.squares[1], board.squares[0]), np.nan)
    field[cells.at] = deviations
    of_points = inside_points(model, view, board) @ normal - offset
    return CheckedBoard(
        name=view.name,
        distance_m=float(points[:, 2].mean()),
        flatness_rms_m=float(np.sqrt(np.mean(deviations**2))),
        flatness_peak_m=float(np.abs(deviations).max()),
        expected_m=float(np.sqrt(np.trace(expected) / count)),
        chi2=chi2,
        freedom=freedom,
        scale=scale,
        scale_sd=float(np.sqrt(covariance[count, count] + noise / count / offset**2)),
        point_rms_m=float(np.sqrt(np.nanmean(of_points**2))),
        cells_m=field,
        normal=-normal if normal[2] > 0 else normal,
    )


def _scale(model: RigModel, points: Array, view: View, board: Board, corners: Array) -> float:
    """Size of the corners' pattern, put on the scanned plane along their rays, over its size on the board."""
    assert view.corners is not None, "checked with the corner's pixels"
    normal, offset = _plane(points)
    u, v = model.camera.tangents_at(corners[:, 0], corners[:, 1])
    rays = np.stack([u, v, np.ones_like(u)], axis=-1)
    placed = rays * (offset / (rays @ normal))[:, None]
    stated = board.corners_m[view.corners.ids]
    spread = [float(np.sum((points_ - points_.mean(axis=0)) ** 2)) for points_ in (placed, stated)]
    return math.sqrt(spread[0] / spread[1])


def _plane(points: Array) -> tuple[Array, float]:
    """n.X = d of the best plane through points (m, 3), |n| = 1, n_z > 0."""
    middle = points.mean(axis=0)
    normal = np.linalg.svd(points - middle, full_matrices=False)[2][2]
    normal = normal if normal[2] >= 0 else -normal
    return normal, float(normal @ middle)


def _chi2(deviations: Array, covariance: Array, xy: Array) -> tuple[float, int]:
    basis = off_plane(xy)
    rest = basis.T @ deviations
    return float(rest @ np.linalg.solve(basis.T @ covariance @ basis, rest)), basis.shape[1]
