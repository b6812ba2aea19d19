"""Checks a calibration with boards that were not used for it: do they come out flat, and of the right size and angle?

A board at an unknown pose is scanned. The scanned points of each of its squares are averaged; the deviations of these
averages from their best plane are the flatness error. The board's corners are put on that plane along their rays; the
size of their pattern, divided by its size on the board, is the scale. Two boards give the angle between them. Each
result comes with the error expected from the model's covariance and the scan's noise. With m the deviations (cells,), C
their expected covariance, P the projection that removes a plane, and ^+ the pseudo-inverse,

    chi2 = (P m)' (P C P)^+ (P m)    with cells - 3 degrees of freedom.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.arrays import Array
from calibration.board.board import Board
from calibration.depth_error import propagated
from calibration.errors import Degenerate
from calibration.model.rig_model import RigModel
from calibration.views import FEWEST_CORNERS, Corners, Passages, View

_FEWEST_CELLS = 8
"""Fewest scanned squares of a board; three of them only determine its plane."""
_FEWEST_IN_CELL = 5


@dataclass(frozen=True, slots=True, eq=False)
class BoardCells:
    """A board's squares as the sweeps crossed them: mean pixel and mean command of each square and sweep."""

    board_xy_m: Array  # (cells, 2)
    x_px: Array  # (sweeps, cells)
    y_px: Array
    command: Array
    velocity_per_s: Array  # (sweeps, 1)
    sd: Array  # (sweeps, cells), of the mean command
    at: tuple[NDArray[np.intp], NDArray[np.intp]]  # row and column of each cell on the board


def cells_of(model: RigModel, view: View, board: Board) -> BoardCells:
    """Means over the squares with enough passages in every sweep. Raises Degenerate for a view without passages or with
    too few corners, and if too few squares remain."""
    if not view.passages:
        raise Degenerate("no-board", f"view {view.name} has no passages of the line; scan the board with the laser on")
    shape = (board.squares[1], board.squares[0])
    sums = []
    for sweep, xy, points in _scanned(model, view, board):
        inside = np.isfinite(xy).all(axis=1) & np.isfinite(points[:, 2])
        column, row = (np.floor(xy[inside] / board.square_m)).astype(np.intp).T
        index = row * shape[1] + column
        columns = [xy[inside, 0], xy[inside, 1], sweep.x_px[inside], sweep.y_px[inside], sweep.command[inside]]
        columns += [sweep.sd[inside] ** 2, np.ones(index.size)]
        sums.append(np.array([np.bincount(index, values, shape[0] * shape[1]) for values in columns]))
    stacked = np.array(sums)  # (sweeps, 7, squares)
    number = stacked[:, 6]
    known = np.flatnonzero((number >= _FEWEST_IN_CELL).all(axis=0))
    if known.size < _FEWEST_CELLS:
        raise Degenerate(
            "no-board",
            f"view {view.name}: the line was found on {known.size} of the board's {shape[0] * shape[1]} squares, "
            f"{_FEWEST_CELLS} are needed; show the whole board, in the depth range, and use more laser power",
        )
    mean = stacked[:, :, known] / number[:, None, known]
    return BoardCells(
        board_xy_m=mean[:, :2].mean(axis=0).T,
        x_px=mean[:, 2],
        y_px=mean[:, 3],
        command=mean[:, 4],
        velocity_per_s=np.array([[sweep.velocity_per_s] for sweep in view.passages]),
        sd=np.sqrt(mean[:, 5] / number[:, known]),
        at=np.unravel_index(known, shape),  # type: ignore[arg-type]
    )


def _points_of(model: RigModel, cells: BoardCells) -> Array:
    """(cells, 3): each square's point, averaged over the sweeps."""
    return np.asarray(_triangulated(model, cells.x_px, cells.y_px, cells.command, cells.velocity_per_s).mean(axis=0))


def noise_m2(model: RigModel, cells: BoardCells, normal: Array) -> float:
    """Variance (m^2) of a square's mean along the board's unit normal, from the differences between sweeps. If there is
    only one sweep, it follows from the sd of the passages."""
    found = _triangulated(model, cells.x_px, cells.y_px, cells.command, cells.velocity_per_s) @ normal
    sweeps = len(found)
    if sweeps > 1:
        apart = (found - found.mean(axis=0)) @ off_plane(cells.board_xy_m)
        return float(np.sum(apart**2) / ((sweeps - 1) * apart.shape[1] * sweeps))
    ahead = _triangulated(model, cells.x_px, cells.y_px, cells.command + cells.sd, cells.velocity_per_s) @ normal
    return float(np.nanmean((ahead - found) ** 2))


def _triangulated(model: RigModel, x_px: Array, y_px: Array, command: Array, velocity_per_s: Array | float) -> Array:
    u, v = model.camera.tangents_at(x_px, y_px)
    mirror = np.asarray(model.mirror_command(command, y_px, velocity_per_s))
    low, high = model.scanner.command_range
    inside = (mirror >= low) & (mirror <= high)
    z = np.where(inside, model.sheets(np.where(inside, mirror, (low + high) / 2)).depth(u, v), np.nan)
    return np.stack([u * z, v * z, z], axis=-1)


def _scanned(model: RigModel, view: View, board: Board) -> Iterator[tuple[Passages, Array, Array]]:
    """Yield each sweep of a view; where its pixels lie on the board (m, 2), metres, NaN off its squares; and its points
    (m, 3) in the camera's frame, NaN where there is no depth or the command lies outside the model's range.

    A homography maps rays to the board. Raises Degenerate if the corners are too few to locate the board.
    """
    found = 0 if view.corners is None else len(view.corners.ids)
    if view.corners is None or found < FEWEST_CORNERS:
        raise Degenerate(
            "no-board",
            f"view {view.name}: {found} corners of the board were found, {FEWEST_CORNERS} are needed; show the whole "
            "board, lit evenly",
        )
    seen = np.stack(model.camera.tangents_at(*view.corners.px.T), axis=-1)
    to_board, _ = cv2.findHomography(seen, board.corners_m[view.corners.ids, :2])
    if to_board is None:
        raise Degenerate("no-board", f"view {view.name}: the corners found do not span the board; show it from nearer")
    for sweep in view.passages:
        rays = np.stack([*model.camera.tangents_at(sweep.x_px, sweep.y_px), np.ones(len(sweep.x_px))], axis=-1)
        rays = rays @ to_board.T
        xy = rays[:, :2] / rays[:, 2:]
        inside = np.all((xy >= 0) & (xy < np.array(board.size_m)), axis=1)
        points = _triangulated(model, sweep.x_px, sweep.y_px, sweep.command, sweep.velocity_per_s)
        yield sweep, np.where(inside[:, None], xy, np.nan), points


def off_plane(xy: Array) -> Array:
    """(cells, cells - 3) orthonormal basis of the deviations that remain after a plane is removed."""
    full = np.linalg.qr(np.column_stack([np.ones(len(xy)), xy]), mode="complete")[0]
    return full[:, 3:]


_PARALLEL = 1e-6
"""Sine of the angle up to which two boards count as parallel."""


@dataclass(frozen=True, slots=True, eq=False)
class CheckedBoard:
    """The result of the scan of one board; lengths in metres.

    distance_m: the board's mean depth. flatness_rms_m, flatness_peak_m: deviations of its squares' means from their
    plane; expected_m: the rms expected from covariance and noise. chi2, freedom: chi squared of the deviations and its
    degrees of freedom. scale: scanned size over stated size; scale_sd: its expected sd. point_rms_m: rms deviation of
    single passages from the plane. cells_m: (squares down, across) deviations, NaN where a square was not scanned.
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


@dataclass(frozen=True, slots=True)
class CheckedAngle:
    """Scanned angle between two boards and its expected sd, in rad."""

    angle_rad: float
    sd_rad: float


def check_angle(model: RigModel, first: View, second: View, board: Board) -> CheckedAngle:
    """The angle between the boards of two views, 0 to pi/2. Raises Degenerate as `check_board` does."""
    both = [(cells_of(model, view, board), view) for view in (first, second)]

    def measure(tried: RigModel) -> Array:
        one, other = (_plane(_points_of(tried, cells))[0] for cells, _ in both)
        return np.array([math.acos(min(1.0, abs(float(one @ other))))])

    values, covariance = propagated(model, measure)
    noise = sum(_tilt_noise(model, both[at][0], both[1 - at][0]) for at in (0, 1))
    return CheckedAngle(float(values[0]), float(np.sqrt(covariance[0, 0] + noise)))


def _tilt_noise(model: RigModel, cells: BoardCells, other: BoardCells) -> float:
    """Variance (rad^2) of the tilt of the board of `cells` towards the `other` one, from the noise of its own scan."""
    points = _points_of(model, cells)
    normal, _ = _plane(points)
    towards = _plane(_points_of(model, other))[0]
    towards = towards - (towards @ normal) * normal
    around = points - points.mean(axis=0)
    around -= np.outer(around @ normal, normal)
    spread = np.linalg.pinv(around.T @ around, rcond=1e-9, hermitian=True)  # of the slopes in the board's plane
    length2 = float(towards @ towards)
    share = float(towards @ spread @ towards) / length2 if length2 > _PARALLEL**2 else float(np.linalg.norm(spread, 2))
    return noise_m2(model, cells, normal) * share


def check_board(model: RigModel, view: View, board: Board) -> CheckedBoard:
    """Check a view's board. Raises Degenerate if too few of its corners or squares were found."""
    cells = cells_of(model, view, board)
    points = _points_of(model, cells)
    corners = view.corners
    assert corners is not None, "its squares were found by them"
    count = len(cells.board_xy_m)

    def measure(tried: RigModel) -> Array:
        found = _points_of(tried, cells)
        normal, offset = _plane(points)  # of the unchanged model: the same reference for every changed one
        return np.append(found @ normal - offset, _scale(tried, found, corners, board))

    values, covariance = propagated(model, measure)
    deviations, scale = values[:count], float(values[count])
    normal, offset = _plane(points)
    noise = noise_m2(model, cells, normal)
    basis = off_plane(cells.board_xy_m)
    expected = basis.T @ (covariance[:count, :count] + noise * np.eye(count)) @ basis
    rest = basis.T @ deviations
    field = np.full((board.squares[1], board.squares[0]), np.nan)
    field[cells.at] = deviations
    on_board = [points[np.isfinite(xy).all(axis=1)] for _, xy, points in _scanned(model, view, board)]
    of_points = np.concatenate(on_board) @ normal - offset
    return CheckedBoard(
        name=view.name,
        distance_m=float(points[:, 2].mean()),
        flatness_rms_m=float(np.sqrt(np.mean(deviations**2))),
        flatness_peak_m=float(np.abs(deviations).max()),
        expected_m=float(np.sqrt(np.trace(expected) / count)),
        chi2=float(rest @ np.linalg.solve(expected, rest)),
        freedom=basis.shape[1],
        scale=scale,
        scale_sd=float(np.sqrt(covariance[count, count] + noise / count / offset**2)),
        point_rms_m=float(np.sqrt(np.nanmean(of_points**2))),
        cells_m=field,
    )


def _scale(model: RigModel, points: Array, corners: Corners, board: Board) -> float:
    """Size of the pattern of corners, put on the scanned plane along their rays, divided by its size on the board."""
    normal, offset = _plane(points)
    u, v = model.camera.tangents_at(*corners.px.T)
    rays = np.stack([u, v, np.ones_like(u)], axis=-1)
    placed = rays * (offset / (rays @ normal))[:, None]
    of_placed, of_stated = (float(np.sum((at - at.mean(axis=0)) ** 2)) for at in (placed, board.corners_m[corners.ids]))
    return math.sqrt(of_placed / of_stated)


def _plane(points: Array) -> tuple[Array, float]:
    """(n, d) of the best plane n.X = d through points (m, 3), |n| = 1, n_z >= 0."""
    middle = points.mean(axis=0)
    normal = np.linalg.svd(points - middle, full_matrices=False)[2][2]
    normal = normal if normal[2] >= 0 else -normal
    return normal, float(normal @ middle)
