"""What one more pose of the board would bring: the depth error expected once it has been shown.

A pose that nobody has shown yet has no data, but its equations need none: where its corners and passages would lie, and
how they change with the parameters, follows from the fit so far; how noisy they would be, from the noise of the others.
Added to the information that there is, they give the covariance to expect.
"""

import math

import numpy as np
from numpy.typing import NDArray

from calibration.depth.uncertainty import command_at, depth_jacobian
from calibration.errors import CalibrationError, Degenerate
from calibration.model.rig_model import RigModel
from calibration.rig_fit.noise import bin_starts
from calibration.rig_fit.normal import view_normal
from calibration.rig_fit.result import RigFit
from calibration.rig_fit.rows import Terms
from calibration.rig_fit.sightings import Sighting
from calibration.rig_fit.solve import scaled_inverse
from calibration.rig_fit.state import first_state
from calibration.views import FEWEST_CORNERS, BoardPose

Array = NDArray[np.float64]

PLACES = 14
"""Along either side of the board, where passages are looked at; each stands for as many as there will be."""
_CELLS = (9, 7)
"""Of the picture, across and down, in whose middles the depth error is looked at."""
BORDER_PX = 2.0
"""Corners nearer to the picture's border are not found."""


class Forecast:
    """The depth error to expect after one more pose: call it with the pose. now_m: without it."""

    def __init__(self, fit: RigFit, at_m: float) -> None:
        """Of a fit, for a depth."""
        self._fit = fit
        self._terms = Terms(fit.model.camera.distortion.size)
        self._tie = np.zeros((len(self._terms.names), len(fit.free)))
        for column, group in enumerate(fit.free):
            self._tie[self._terms.at(group), column] = 1.0
        self._jacobian = _depth_by_free(fit, at_m)
        sweeps = [sweep for view in fit.sweeps for sweep in view]
        self._velocities = _next_velocities(fit)
        self._sd = float(np.median(np.concatenate([sweep.sd for sweep in sweeps])))
        self._count = float(np.median([sweep.sd.size for sweep in sweeps]))
        self.now_m = self._expected(fit.information)

    def __call__(self, pose: BoardPose) -> float:
        """The median over the picture of the depth's expected sd in metres; NaN where the pose shows too little."""
        seen = self._seen(pose)
        if seen is None:
            return math.nan
        fit = self._fit
        timing = np.array([*fit.model.lag_s, fit.model.row_delay_s])
        corners, passages = first_state(fit.model, timing, [pose], [seen]).rows(0, seen, self._terms)
        corner_weight = np.full(corners.residual.size, 1 / (fit.corner_scale * fit.noise.corner_sd_px) ** 2)
        each = self._count * len(seen.sweeps) / max(seen.sd.size, 1)
        weight = each / (fit.noise.passage_factor * seen.sd) ** 2
        starts = bin_starts(seen, fit.noise.reach)
        normal = view_normal(corners, passages, corner_weight, weight, starts, fit.noise.jitter_sd**2)
        return self._expected(fit.information + self._tie.T @ normal.matrix @ self._tie / fit.misfit)

    def _expected(self, information: Array) -> float:
        try:
            covariance, _ = scaled_inverse(information)
        except Degenerate:
            return math.nan
        variance = np.einsum("ij,jk,ik->i", self._jacobian, covariance, self._jacobian)
        return float(np.sqrt(np.median(variance))) if variance.size else math.nan

    def _seen(self, pose: BoardPose) -> Sighting | None:
        """What would be seen of the board there, without errors; None for too little."""
        model, board = self._fit.model, self._fit.board
        corners_m = board.corners_m
        x, y, found = _inside(model, pose.to_camera(corners_m))
        if found.sum() < FEWEST_CORNERS:
            return None
        along = (np.arange(PLACES) + 0.5) / PLACES
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
    """At which the next pose will be swept: poses take turns at the speeds, so as the one that had its turn first."""
    shown = [tuple(sweep.direction * sweep.speed_per_s for sweep in view) for view in fit.sweeps if view]
    last = {velocities: turn for turn, velocities in enumerate(shown)}
    return min(last, key=lambda velocities: last[velocities])


def _inside(model: RigModel, points: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """(x, y) of points in the picture and whether they are in it."""
    x, y = model.camera.project(points)
    with np.errstate(invalid="ignore"):
        inside: NDArray[np.bool_] = (x > BORDER_PX) & (x < model.camera.width - 1 - BORDER_PX)
        inside &= (y > BORDER_PX) & (y < model.camera.height - 1 - BORDER_PX)
    return x, y, inside


def _depth_by_free(fit: RigFit, at_m: float) -> Array:
    """(points, free parameters): how the depth at places all over the picture changes with what was fitted."""
    model = fit.model
    if model.covariance is None:
        raise CalibrationError("the fit has no covariance; fit the rig again")
    names = model.covariance.names
    across, down = ((np.arange(n) + 0.5) / n for n in _CELLS)
    x, y = np.meshgrid(across * model.camera.width - 0.5, down * model.camera.height - 0.5)
    command = command_at(model, x, y, at_m)
    velocity = max((sweep.speed_per_s for view in fit.sweeps for sweep in view), default=0.0)
    by_name = depth_jacobian(model, x, y, command, velocity)
    by_name = by_name[np.isfinite(by_name).all(axis=-1)]
    columns = [np.sum([by_name[:, names.index(name)] for name in group], axis=0) for group in fit.free]
    return np.stack(columns, axis=-1)
