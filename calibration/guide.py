"""Advises on the board's next pose: the one after which the expected depth error is smallest.

Candidates form a grid of distance, place in the picture and tilt. `Forecast` predicts the gain of each from the fit of
the views so far. Before there is a fit, and throughout a calibration without guidance, the poses of `sequence` are
shown, which differ as much as possible.

A pose that has not been shown has no data, but the normal equations need none: they need derivatives and noise. The fit
so far gives the places of corners and passages at the new pose and their derivatives by the parameters; the other views
give their noise. Added to the information already there, these equations give the expected covariance.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.arrays import Array
from calibration.board.board import Board
from calibration.depth_error import command_at, depth_jacobian
from calibration.errors import Degenerate, mm
from calibration.model.camera import Camera
from calibration.model.rig_model import RigModel
from calibration.rig_fit.fit import RigFit
from calibration.rig_fit.noise import bin_starts
from calibration.rig_fit.rig_state import Sighting, first_state
from calibration.rig_fit.rows import Terms
from calibration.rig_fit.solve import Weights, scaled_inverse, view_normal
from calibration.views import FEWEST_CORNERS, BoardPose

FILLS = (0.6, 0.45, 0.32, 0.22)
"""Shares of the picture's width or height, whichever is reached first, that boards fill; they set the distances."""
PLACES = {
    (0, 0): "in the middle of the picture",
    (-1, 0): "at the left border",
    (1, 0): "at the right border",
    (0, -1): "at the upper border",
    (0, 1): "at the lower border",
    (-1, -1): "in the upper left corner",
    (1, -1): "in the upper right corner",
    (-1, 1): "in the lower left corner",
    (1, 1): "in the lower right corner",
}
TILT_RAD = math.radians(35)
"""Tilt of a tilted board: enough for a strong perspective, little enough for corners to be found."""
TILTS = {
    (0, 0): "facing the camera",
    (0, 1): "its left side turned away",
    (0, -1): "its right side turned away",
    (1, 0): "its lower side turned away",
    (-1, 0): "its upper side turned away",
}
"""Rotations about (x, y) in units of TILT_RAD."""
LEAST_MODULE_PX = 2.0
"""Side of a marker's module in the picture; smaller ones are not read when tilted and noisy."""
_BORDER_SHARE = 0.03
"""Share of the picture's width and height left free on each side of the board."""

ExpectedError = Callable[[BoardPose], float]
"""The expected depth error (m) once this pose has been shown too; NaN if unknown."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """A pose to show. fill: one of FILLS. distance_m: depth of the board's middle. place, tilt: keys of PLACES and
    TILTS."""

    fill: float
    distance_m: float
    place: tuple[int, int]
    tilt: tuple[int, int]
    pose: BoardPose

    def __str__(self) -> str:
        """Instruction to the person who holds the board."""
        if self.tilt == (0, 0):
            what = "hold the board facing the camera"
        else:
            axis = "vertical" if self.tilt[1] else "horizontal"
            what = f"tilt the board {math.degrees(TILT_RAD):.0f} degrees about the {axis} ({TILTS[self.tilt]})"
        return f"{what}, {self.distance_m:.2g} m away, {PLACES[self.place]}"


@dataclass(frozen=True, slots=True)
class Advice:
    """The next pose. before_m, after_m: expected depth error at `at_m` before and after this pose; NaN if unknown, as
    before there is a fit."""

    candidate: Candidate
    at_m: float
    before_m: float = math.nan
    after_m: float = math.nan

    def __str__(self) -> str:
        """Instruction to the person who holds the board, and the reason for it."""
        if not math.isfinite(self.after_m):
            return str(self.candidate)
        before = f"from {mm(self.before_m)} " if math.isfinite(self.before_m) else ""
        return f"{self.candidate}: expected error at {self.at_m:g} m falls {before}to {mm(self.after_m)}"


def candidates(camera: Camera, board: Board, depth_range_m: tuple[float, float]) -> tuple[Candidate, ...]:
    """All poses of the grid that show the whole board with readable markers, within the range of depth."""
    readable_m = np.inf
    if board.marker_m is not None:
        module_m = board.marker_m / (board.charuco().getDictionary().markerSize + 2)
        readable_m = camera.matrix[0, 0] * module_m * math.cos(TILT_RAD) / LEAST_MODULE_PX
    nearest_m, farthest_m = depth_range_m[0], min(depth_range_m[1], readable_m)
    found = (_candidate(camera, board, *choice) for choice in product(FILLS, PLACES, TILTS))
    return tuple(one for one in found if one is not None and nearest_m <= one.distance_m <= farthest_m)


def next_pose(choices: Sequence[Candidate], at_m: float, now_m: float, forecast: ExpectedError) -> Advice:
    """The best of the given poses (at least one) by the forecast, as the next pose; the first one if all are NaN.

    now_m: the expected depth error at `at_m` without another pose.
    """
    errors = [forecast(candidate.pose) for candidate in choices]
    best = int(np.nanargmin(errors)) if np.isfinite(errors).any() else 0
    return Advice(choices[best], at_m, now_m, float(errors[best]))


def sequence(choices: Sequence[Candidate], poses: int, seed: int = 0) -> tuple[Candidate, ...]:
    """The requested number of poses, which differ from one another as much as possible: near and far, in all places and
    tilts. They repeat once all `choices` (at least one) are used.

    Each is the one farthest from those before it; the first is the nearest tilted one. seed: chooses among equal ones.
    """
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(choices)) if seed else np.arange(len(choices))
    # Coordinates of poses among others: distance, place, tilt, in steps that matter about as much.
    shown = [choices[i] for i in order]
    traits = np.array([[1.5 * math.log(one.distance_m), *(0.7 * np.array(one.place)), *one.tilt] for one in shown])
    tilted = [i for i, one in enumerate(shown) if one.tilt != (0, 0)]
    chosen = [min(tilted or [0], key=lambda i: traits[i, 0])]
    nearest = np.full(len(order), np.inf)
    while len(chosen) < poses:
        away = np.sum((traits - traits[chosen[-1]]) ** 2, axis=1)
        nearest = np.minimum(nearest, away)
        if nearest.max() == 0:  # all were shown: from the beginning
            nearest = away
        chosen.append(int(np.argmax(nearest)))
    return tuple(shown[i] for i in chosen[:poses])


def rough_camera(size: tuple[int, int]) -> Camera:
    """A camera for placing boards if none is known: 45 degrees across, no distortion."""
    width, height = size
    focal = 1.2 * width
    matrix = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    return Camera(width, height, matrix, np.zeros(0))


def _candidate(
    camera: Camera, board: Board, fill: float, place: tuple[int, int], tilt: tuple[int, int]
) -> Candidate | None:
    """The pose that puts the board at `place` in the picture, with _BORDER_SHARE of the picture free around it.

    None if the board does not fit, or if at `place` it would be off the middle by less than an eighth of its size.
    """
    rotation = TILT_RAD * np.array([tilt[0], tilt[1], 0.0])
    turn = cv2.Rodrigues(rotation)[0]
    width, height = camera.width - 1, camera.height - 1
    focal = camera.matrix[0, 0], camera.matrix[1, 1]
    distance = max(focal[0] * board.size_m[0] / (fill * width), focal[1] * board.size_m[1] / (fill * height))
    middle = np.array([board.size_m[0] / 2, board.size_m[1] / 2, 0.0])
    outline = np.array([(x, y, 0.0) for x in (0, board.size_m[0]) for y in (0, board.size_m[1])])
    spread = (outline - middle) @ turn.T
    seen = spread[:, :2] / (distance + spread[:, 2:]) * focal
    half = np.abs(seen).max(axis=0)
    room = np.array([width, height]) * (0.5 - _BORDER_SHARE) - half
    if np.any(room < 0) or (any(place) and np.any(room[np.array(place) != 0] < half[np.array(place) != 0] / 4)):
        return None
    centre = np.array([width, height]) / 2 + np.array(place) * room
    u, v = camera.tangents_at(centre[0], centre[1])
    at = distance * np.array([float(u), float(v), 1.0])
    pose = BoardPose(rotation, at - turn @ middle)
    x, y = camera.project(pose.to_camera(outline))
    inside = (x >= 0) & (x <= width) & (y >= 0) & (y <= height)
    return Candidate(fill, float(distance), place, tilt, pose) if inside.all() else None


BOARD_POINTS = 14
"""Points along each side of the board at which passages are forecast; each stands for its share of all passages."""
_CELLS = (9, 7)
"""Cells of the picture, across and down, in whose middles the depth error is computed."""
BORDER_PX = 2.0
"""Distance from the picture's border within which corners are not found."""


class Forecast:
    """The expected depth error after one more pose: call it with the pose. now_m: the error without another pose."""

    def __init__(self, fit: RigFit, at_m: float) -> None:
        """Prepare forecasts from a fit, for the depth error at `at_m`."""
        self._fit = fit
        self._terms = Terms(fit.model.camera.distortion.size)
        self._tie = self._terms.tied(fit.free)
        self._jacobian = _depth_by_free(fit, at_m)
        sweeps = fit.every_sweep
        self._velocities = _next_velocities(fit)
        self._sd = float(np.median(np.concatenate([sweep.sd for sweep in sweeps])))
        self._count = float(np.median([sweep.sd.size for sweep in sweeps]))
        self.now_m = self._expected(fit.information)

    def __call__(self, pose: BoardPose) -> float:
        """The median over the picture of the depth's expected sd in metres; NaN if the pose shows too little."""
        seen = self._seen(pose)
        if seen is None:
            return math.nan
        fit = self._fit
        timing = np.array([*fit.model.lag_s, fit.model.row_delay_s])
        corners, passages = first_state(fit.model, timing, [pose], [seen]).rows(0, seen, self._terms)
        corner_weight = np.full(corners.residual.size, 1 / (fit.corner_scale * fit.noise.corner_sd_px) ** 2)
        each = self._count * len(seen.sweeps) / max(seen.sd.size, 1)
        weight = each / (fit.noise.passage_factor * seen.sd) ** 2
        weights = Weights(corner_weight, weight, bin_starts(seen, fit.noise.reach))
        normal = view_normal(corners, passages, weights, fit.noise.jitter_sd**2)
        return self._expected(fit.information + self._tie.T @ normal.matrix @ self._tie / fit.misfit)

    def _expected(self, information: Array) -> float:
        try:
            covariance, _ = scaled_inverse(information)
        except Degenerate:
            return math.nan
        variance = np.einsum("ij,jk,ik->i", self._jacobian, covariance, self._jacobian)
        return float(np.sqrt(np.median(variance))) if variance.size else math.nan

    def _seen(self, pose: BoardPose) -> Sighting | None:
        """The corners and passages that a board at `pose` would give, without errors; None if they are too few."""
        model, board = self._fit.model, self._fit.board
        corners_m = board.corners_m
        x, y, found = _inside(model, pose.to_camera(corners_m))
        if found.sum() < FEWEST_CORNERS:
            return None
        along = (np.arange(BOARD_POINTS) + 0.5) / BOARD_POINTS
        places = np.stack(np.meshgrid(along * board.size_m[0], along * board.size_m[1], [0.0]), axis=-1).reshape(-1, 3)
        points = pose.to_camera(places)
        px, py, inside = _inside(model, points)
        mirror = np.full(len(places), np.nan)
        mirror[inside] = command_at(model, px[inside], py[inside], points[inside, 2])
        lit = np.flatnonzero(np.isfinite(mirror))
        lit = lit[np.argsort(mirror[lit])]
        repeats = len(self._velocities)
        velocity = np.repeat(self._velocities, lit.size)
        lag = np.where(velocity > 0, model.lag_s.forward, model.lag_s.backward)
        row_y = np.tile(py[lit], repeats)
        return Sighting(
            name="",
            corners_m=corners_m[found],
            corner_px=np.stack([x[found], y[found]], axis=-1),
            corner_scale=np.ones(int(found.sum())),
            x_px=np.tile(px[lit], repeats),
            y_px=row_y,
            command=np.tile(mirror[lit], repeats) + velocity * (lag - model.row_delay_s * row_y),
            sd=np.full(velocity.size, self._sd),
            velocity_per_s=velocity,
            starts=np.arange(repeats + 1) * lit.size if lit.size else np.zeros(1, np.int64),
        )


def _next_velocities(fit: RigFit) -> tuple[float, ...]:
    """The velocities of the next view's sweeps. Views use a few sets in turn; the set used longest ago is next."""
    shown = [tuple(sweep.direction * sweep.speed_per_s for sweep in view) for view in fit.sweeps if view]
    last = {velocities: turn for turn, velocities in enumerate(shown)}
    return min(last, key=last.__getitem__)


def _inside(model: RigModel, points: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """(x, y) of points in the picture, and whether they lie within it, by more than BORDER_PX."""
    x, y = model.camera.project(points)
    with np.errstate(invalid="ignore"):
        inside: NDArray[np.bool_] = (x > BORDER_PX) & (x < model.camera.width - 1 - BORDER_PX)
        inside &= (y > BORDER_PX) & (y < model.camera.height - 1 - BORDER_PX)
    return x, y, inside


def _depth_by_free(fit: RigFit, at_m: float) -> Array:
    """(points, free parameters): derivatives of the depth at `at_m`, all over the picture, by what was fitted."""
    model = fit.model
    assert model.covariance is not None, "a fit has one"
    names = model.covariance.names
    across, down = ((np.arange(n) + 0.5) / n for n in _CELLS)
    x, y = np.meshgrid(across * model.camera.width - 0.5, down * model.camera.height - 0.5)
    command = command_at(model, x, y, at_m)
    velocity = max((sweep.speed_per_s for sweep in fit.every_sweep), default=0.0)
    by_name = depth_jacobian(model, x, y, command, velocity)
    by_name = by_name[np.isfinite(by_name).all(axis=-1)]
    columns = [np.sum([by_name[:, names.index(name)] for name in group], axis=0) for group in fit.free]
    return np.stack(columns, axis=-1)
