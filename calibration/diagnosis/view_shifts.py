"""Shifts of views against each other: their passages as seen from the pose that their corners alone give.

A fit of everything may move a board by a millimetre to please the light. With every pose from the corners alone, and
camera and mirror as fitted, passages lie off the light by what the views disagree: nothing but the noise of the poses
where one rig saw them all, a shift of each view where camera or mirror moved in between.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np

from calibration.arrays import Array
from calibration.diagnosis.sweep_waves import NOISE_SIGMAS
from calibration.model.rig_model import RigModel
from calibration.rig_fit.result import RigFit, SweepFit
from calibration.rig_fit.solve import corner_weights
from calibration.rig_fit.state import corner_scale
from calibration.views import FEWEST_CORNERS, BoardPose, View

_STEP = 1e-6
"""Change for differences: of the command as a share of its range, of a pose in rad and m."""
_ROUNDS = 8
"""Rounds in which a pose settles with the weights of its corners."""
_FEWEST_TO_SPLIT = 4
MOST_MISFIT = 3.0
"""Factor on the variances up to which the views are taken to agree."""
MOST_UNEXPLAINED = 0.35
"""Share of the shifts' variance that a single move may leave."""


@dataclass(frozen=True, slots=True, eq=False)
class ViewShift:
    """Shift of one view in command units: median of its passages off the light, and the sd that the pose's noise
    gives.
    """

    name: str
    shift: float
    sd: float


def view_shifts(fit: RigFit, views: dict[str, View]) -> tuple[ViewShift, ...]:
    """The shifts of all views of a fit that have passages; `views` by name."""
    model = fit.model
    posed = []
    for name, pose, sweeps in zip(fit.views, fit.poses, fit.sweeps, strict=True):
        found = _corner_pose(model, fit, views[name], pose)
        if found is not None and sweeps:
            posed.append((name, *found, sweeps))
    return tuple(_shift(model, *of_view) for of_view in posed)


def common_shift(shifts: tuple[ViewShift, ...], wave: float, sweeps: int) -> float:
    """Root mean square of views against each other, without the noise of poses and of waves (rms `wave`, in command
    units, each of `sweeps` sweeps of a view on its own); NaN for fewer than two views.
    """
    if len(shifts) < 2:
        return np.nan
    square = float(np.mean([one.shift**2 for one in shifts])) - float(np.mean(_variances(shifts, wave, sweeps)))
    return math.sqrt(max(square, 0.0))


def shift_noise(shifts: tuple[ViewShift, ...], wave: float, sweeps: int) -> float:
    """Value up to which a `common_shift` of these may be noise of poses and waves; NaN for fewer than two views."""
    if len(shifts) < 2:
        return np.nan
    chance = float(np.sqrt(2 * np.sum(_variances(shifts, wave, sweeps) ** 2))) / len(shifts)
    return math.sqrt(NOISE_SIGMAS * chance)


def _variances(shifts: tuple[ViewShift, ...], wave: float, sweeps: int) -> Array:
    """Variances of the views' shifts (views,) from the noise of the poses and from waves."""
    return np.array([one.sd**2 for one in shifts]) + (wave**2 / max(sweeps, 1) if np.isfinite(wave) else 0.0)


def counted(shifts: tuple[ViewShift, ...], outliers: tuple[str, ...], misfit: float = 1.0) -> tuple[ViewShift, ...]:
    """The shifts that have to agree: all, but for a single outlier, which had no say in the fit.

    An outlier that is the last view counts, since the rig may be another since then; it also counts where the others do
    not fit either.
    """
    if len(outliers) != 1 or not shifts or shifts[-1].name in outliers or misfit > MOST_MISFIT:
        return shifts
    return tuple(one for one in shifts if one.name not in outliers)


def last_before_move(shifts: tuple[ViewShift, ...]) -> str | None:
    """The view after which the rig moved, where one move between two views explains most of the shifts; else None."""
    values = np.array([one.shift for one in shifts])
    if len(values) < _FEWEST_TO_SPLIT:
        return None
    spread = float(np.sum((values - values.mean()) ** 2))
    parts = [values[:at].var() * at + values[at:].var() * (len(values) - at) for at in range(1, len(values))]
    best = int(np.argmin(parts))
    return shifts[best].name if parts[best] < MOST_UNEXPLAINED * spread else None


def _corner_pose(model: RigModel, fit: RigFit, view: View, start: BoardPose) -> tuple[BoardPose, Array] | None:
    """Pose by the corners alone, which count as they do in the fit, and its covariance (6, 6)."""
    if view.corners is None:
        return None
    px = np.asarray(view.corners.px, np.float64)
    known = np.isfinite(px).all(axis=1)
    if np.count_nonzero(known) < FEWEST_CORNERS:
        return None
    points, px, camera = fit.board.corners_m[view.corners.ids[known]], px[known], model.camera
    sd_px = fit.noise.corner_sd_px * corner_scale(view.corners)[known]
    pose = np.concatenate([start.rotation, start.position_m]).astype(np.float64)
    for _ in range(_ROUNDS):
        seen, slopes = cv2.projectPoints(points, pose[:3], pose[3:], camera.matrix, camera.distortion)
        left = seen.reshape(-1, 2) - px
        weighted = slopes[:, :6] * np.repeat(corner_weights(left.T, sd_px), 2)[:, None]
        covariance = np.asarray(np.linalg.pinv(weighted.T @ slopes[:, :6]), np.float64)
        pose -= covariance @ (weighted.T @ left.ravel())
    return BoardPose(pose[:3], pose[3:]), covariance


def _shift(model: RigModel, name: str, pose: BoardPose, covariance: Array, sweeps: tuple[SweepFit, ...]) -> ViewShift:
    residuals = [_residual(model, pose, sweep) for sweep in sweeps]
    slope = np.zeros(6)
    for i in range(6):
        step = np.zeros(6)
        step[i] = _STEP
        moved = BoardPose(pose.rotation + step[:3], pose.position_m + step[3:])
        change = [_residual(model, moved, sweep) - at for sweep, at in zip(sweeps, residuals, strict=True)]
        slope[i] = float(np.median(np.concatenate(change))) / _STEP
    return ViewShift(name, float(np.median(np.concatenate(residuals))), float(np.sqrt(slope @ covariance @ slope)))


def _residual(model: RigModel, pose: BoardPose, sweep: SweepFit) -> Array:
    """(m,) by how much the mirror's command is above the one whose light goes through the board's point."""
    u, v = model.camera.tangents_at(sweep.x_px, sweep.y_px)
    ray = np.stack([u, v, np.ones_like(u)], axis=-1)
    normal = pose.matrix[:, 2]
    points = ray * ((normal @ pose.position_m) / (ray @ normal))[:, None]
    low, high = model.scanner.command_range
    step = _STEP * (high - low)
    at = np.clip(sweep.command, low + step, high - step)
    off = model.sheets(at).distance_m(points)
    by_command = (model.sheets(at + step).distance_m(points) - model.sheets(at - step).distance_m(points)) / (2 * step)
    return off / by_command
