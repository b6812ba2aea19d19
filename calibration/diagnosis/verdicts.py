"""The verdicts on a fit of the camera alone, on a fit of the rig, on lags, and on a check.

A camera is judged by how accurately the directions of its rays are known, in pixels. A camera whose rays are all turned
by one angle is as good as before, since the mirror is calibrated with it. So the variance of a pixel is J C J', with C
the covariance and J the derivatives of the pixels by the parameters, from which the best common rotation of all rays is
removed.

Lag and row delay are judged by the depth error that their uncertainty causes. A check fails if its errors are larger
than expected from the covariance and larger than the accuracy asked for allows.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from calibration.arrays import Array
from calibration.board.board import Board
from calibration.camera_fit import CameraFit
from calibration.check import CheckedAngle, CheckedBoard
from calibration.depth_error import DepthUncertainty, Sensitivity, depth_uncertainty, propagated, sensitivity
from calibration.diagnosis import contradictions, rules
from calibration.errors import Degenerate, digits, mm
from calibration.guide import rough_camera
from calibration.model.camera import Camera
from calibration.model.parameters import SWEPT, changed_camera
from calibration.model.rig_model import Covariance, RigModel
from calibration.rig_fit.fit import RigFit
from calibration.rig_fit.rig_state import shows_line, usable
from calibration.sync.lag_fit import SyncFit
from calibration.verdict import AT_M, SIGMAS, WORST_TIMES, AccuracyGoal, Reason, Verdict, more_poses, unguided
from calibration.views import View

ACCURACY_PX = 0.1
"""Error of a pixel's ray, and of the stripe's position, that is good enough: no estimator does better in fog."""
_GRID = 16
_STEP = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class JudgedCamera:
    """The verdict on a camera. sd_px, worst_px: median and 95th percentile over the picture of the sd of a pixel's ray
    along the row. coverage: share of the picture within the outline of all corners.
    """

    verdict: Verdict
    sd_px: float
    worst_px: float
    coverage: float

    def line(self) -> str:
        """The result in one line."""
        return f"rays are known to {_px(self.sd_px)} (95 % of the picture: {_px(self.worst_px)})"


def judge_camera(fit: CameraFit, views: Sequence[View], board: Board, *, photons: bool) -> JudgedCamera:
    """Judge a fit of `views`. photons: whether their pictures count photons; grey levels do not measure the light."""
    camera = fit.camera
    sd = ray_sd_px(camera, fit.covariance)
    median, worst = float(np.median(sd)), float(np.percentile(sd, 95))
    imprecise = not (median <= ACCURACY_PX and worst <= WORST_TIMES * ACCURACY_PX)
    pairs = zip(fit.views, fit.poses, strict=True)
    evidence = rules.view_evidence(views, (camera.width, camera.height), len(fit.kept), fit.dropped)
    poses = rules.pose_evidence([pose for name, pose in pairs if name in fit.kept], board)
    lacking = rules.data_lack(evidence, poses, imprecise=imprecise, photons=photons)
    reasons = [*rules.hiding(evidence, poses, photons=photons), *lacking]
    if imprecise and not reasons:
        found = median, worst
        reasons = [more_poses(len(fit.kept), "rays are known to", found, ACCURACY_PX, _px)]
    return JudgedCamera(unguided(Verdict(not reasons, tuple(reasons))), median, worst, evidence.coverage)


def _px(length_px: float) -> str:
    return f"{digits(length_px, 2)} px"


def ray_sd_px(camera: Camera, covariance: Covariance) -> Array:
    """(n,) sd in pixels along the row of the rays of a grid over the picture, after a common rotation is removed."""
    x, y = np.meshgrid(np.linspace(0, camera.width - 1, _GRID), np.linspace(0, camera.height - 1, _GRID))
    u, v = camera.tangents_at(x.ravel(), y.ravel())
    known = np.isfinite(u)
    rays = np.stack([u[known], v[known], np.ones(np.count_nonzero(known))], axis=-1)

    def seen(tried: Camera, points: Array) -> Array:
        return np.concatenate(tried.project(points))

    changes = []
    for name in covariance.names:
        more, less = (seen(changed_camera(camera, {name: step}), rays) for step in (_STEP, -_STEP))
        changes.append((more - less) / (2 * _STEP))
    still, slopes = seen(camera, rays), np.stack(changes, axis=-1)
    turned = [(seen(camera, rays + _STEP * np.cross(axis, rays)) - still) / _STEP for axis in np.eye(3)]
    turns = np.stack(turned, axis=-1)
    sound = np.isfinite(slopes).all(axis=1) & np.isfinite(turns).all(axis=1)
    basis = np.linalg.qr(turns[sound])[0]
    left = slopes[sound] - basis @ (basis.T @ slopes[sound])
    along_row = np.flatnonzero(sound) < len(rays)
    variance = np.einsum("ni,ij,nj->n", left, covariance.matrix, left)[along_row]
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


UNLIKELY_SDS: Final = 4.0
"""Distance of chi2 above its degrees of freedom, in sds of chi2, beyond which deviations are no longer chance."""

_AGAIN = "calibrate again"


def judge_check(
    boards: Sequence[CheckedBoard],
    asked: AccuracyGoal,
    board_width_m: float,
    angle: CheckedAngle | None = None,
    stated_angle_rad: float | None = None,
) -> Verdict:
    """Judge checked boards.

    asked: the required depth error at one distance. For flatness and angle the error allowed at another distance grows
    with the square of the distance; the size of a board may be wrong by the share accuracy_m / at_m at any distance.
    board_width_m: width of the boards. angle, stated_angle_rad: the angle between two boards as scanned, and as
    measured by hand.
    """
    found: list[Reason] = []
    for board in boards:
        bearable_m = asked.accuracy_m * (board.distance_m / asked.at_m) ** 2
        found += _flatness(board, bearable_m)
        found += _scale(board, asked)
    if angle is not None and stated_angle_rad is not None and boards:
        bearable_m = asked.accuracy_m * (boards[0].distance_m / asked.at_m) ** 2
        limit = max(SIGMAS * angle.sd_rad, 2 * bearable_m / board_width_m)
        error = angle.angle_rad - stated_angle_rad
        if not abs(error) <= limit:
            text = (
                f"the angle between the boards is scanned as {math.degrees(angle.angle_rad):.2f} degrees, stated are "
                f"{math.degrees(stated_angle_rad):.2f}; the limit is {math.degrees(limit):.2f} off"
            )
            step = f"measure the angle and check with it once more; where it stays so, {_AGAIN}"
            found.append(Reason("wrong-angle", text, error, limit, step))
    return Verdict(not found, tuple(found))


def _flatness(board: CheckedBoard, bearable_m: float) -> list[Reason]:
    likely = board.freedom + UNLIKELY_SDS * math.sqrt(2 * board.freedom)
    if board.chi2 <= likely or board.flatness_rms_m <= bearable_m:
        return []
    text = (
        f"view {board.name}: the board's squares lie {mm(board.flatness_rms_m)} (rms) off a plane, expected "
        f"are {mm(board.expected_m)}, the limit at {board.distance_m:.2g} m is {mm(bearable_m)}"
    )
    step = f"check that the board is flat, then {_AGAIN}"
    return [Reason("not-flat", text, board.flatness_rms_m, max(bearable_m, board.expected_m), step)]


def _scale(board: CheckedBoard, asked: AccuracyGoal) -> list[Reason]:
    limit = max(SIGMAS * board.scale_sd, asked.accuracy_m / asked.at_m)
    if abs(board.scale - 1) <= limit:
        return []
    text = (
        f"view {board.name}: the board is scanned {board.scale - 1:+.2%} larger than stated, the limit is {limit:.2%}"
    )
    return [Reason("wrong-scale", text, board.scale - 1, limit, f"measure the board's squares, then {_AGAIN}")]


_WORST_PERCENT = 95


@dataclass(frozen=True, slots=True, eq=False)
class JudgedRig:
    """A verdict on a rig and what it was based on."""

    verdict: Verdict
    asked: AccuracyGoal
    evidence: rules.FitEvidence
    waves: contradictions.SweepWaves
    shifts: tuple[contradictions.ViewShift, ...]
    uncertainty: DepthUncertainty
    sensitivity: Sensitivity


def goal(
    worth: Sensitivity, accuracy_m: float | None = None, at_m: float = AT_M, stated_baseline_m: float | None = None
) -> AccuracyGoal:
    """The accuracy asked for, as sd of depth at `at_m`. worth: the sensitivity there. accuracy_m None: the depth error
    that ACCURACY_PX causes.
    """
    return AccuracyGoal(ACCURACY_PX * worth.per_pixel_m if accuracy_m is None else accuracy_m, at_m, stated_baseline_m)


def judge_fit(
    fit: RigFit,
    views: Sequence[View],
    *,
    at_m: float = AT_M,
    accuracy_m: float | None = None,
    stated_baseline_m: float | None = None,
) -> JudgedRig:
    """Judge a fit by its sd of depth at `at_m`. accuracy_m: as in `goal`. Raises CalibrationError if the line does not
    reach `at_m`.
    """
    model = fit.model
    worth = sensitivity(model, at_m)
    asked = goal(worth, accuracy_m, at_m, stated_baseline_m)
    waves = contradictions.sweep_waves(fit.every_sweep)
    shifts = contradictions.view_shifts(fit, {view.name: view for view in views})
    agreeing = contradictions.counted(shifts, fit.outliers, fit.misfit)
    sweeps = max((len(of_view) for of_view in fit.sweeps), default=1)
    shift, shift_noise = contradictions.common_shift(agreeing, waves.rms, sweeps)
    uncertainty = depth_uncertainty(model, at_m)
    baselines, variance = propagated(model, lambda tried: np.array([rules.baseline_m(tried.scanner)]))
    known = uncertainty.sd_m[np.isfinite(uncertainty.sd_m)]
    said = [pose for name, pose in zip(fit.views, fit.poses, strict=True) if name not in fit.outliers]
    evidence = rules.FitEvidence(
        poses=rules.pose_evidence(said, fit.board),
        expected_m=float(np.median(known)) if known.size else np.nan,
        worst_m=float(np.percentile(known, _WORST_PERCENT)) if known.size else np.nan,
        wave_m=waves.rms * worth.per_command_m,
        wave_noise_m=waves.noise * worth.per_command_m,
        shift_m=shift * worth.per_command_m,
        shift_noise_m=shift_noise * worth.per_command_m,
        moved_after=contradictions.last_before_move(agreeing),
        misfit=fit.misfit,
        baseline_m=float(baselines[0]),
        baseline_sd_m=float(np.sqrt(variance[0, 0])),
        velocities_per_s=tuple(model.provenance[SWEPT]),
    )
    seen = rules.view_evidence(views, (model.camera.width, model.camera.height), len(fit.used), fit.outliers)
    return JudgedRig(rules.judge(seen, evidence, asked), asked, evidence, waves, shifts, uncertainty, worth)


def judge_refused(
    refused: Degenerate,
    views: Sequence[View],
    board: Board,
    size: tuple[int, int],
    *,
    photons: bool = True,
    line: bool = True,
) -> Verdict:
    """Judge views of a picture of `size` (width, height) from which no model could be made.

    photons: as in `judge_camera`. line: whether the views should show the line; False if only a camera was asked for.
    """
    poses = rules.rough_poses(views, board, rough_camera(size))
    evidence = rules.pose_evidence(poses, board) if poses else None
    used = sum(not line or shows_line(view) for view in usable(views))
    verdict = rules.judge_refusal(refused, rules.view_evidence(views, size, used), evidence, photons=photons)
    return verdict if line else unguided(verdict)


_STILL = "check that nothing moved between the sweeps, or calibrate at the speed of your scans"


def judge_sync(
    fit: SyncFit, model: RigModel | None, asked: AccuracyGoal | None, changed: Reason | None = None
) -> Verdict:
    """Judge a fit of lags. model, asked: None if the lag's effect on depth is unknown. changed: why the model is wrong
    with these lags, or None. Raises CalibrationError if the line does not reach `asked.at_m`."""
    found = []
    if not fit.steady:
        text = (
            f"the lag is not the same at all speeds: chi squared {fit.chi2:.1f} for {fit.dof} degrees of freedom; it "
            "holds for the speeds scanned only"
        )
        found.append(Reason("lag-by-speed", text, fit.chi2, float(fit.dof), _STILL))
    found += rules.lag_lack(fit.velocities_per_s, mean_will_do=False)
    if model is not None and asked is not None:
        worth_m = sensitivity(model, asked.at_m).per_command_m * fit.speed_range_per_s[1]
        error_m = worth_m * float(max(fit.sd_s[:2][fit.sd_s[:2] >= 0], default=0.0))
        if not error_m <= asked.accuracy_m:
            text = (
                f"the lags are known to {digits(error_m / worth_m * 1e6, 2)} us, at {asked.at_m:g} m and the highest "
                f"speed {mm(error_m)} of depth, asked for are {mm(asked.accuracy_m)}"
            )
            found.append(
                Reason("imprecise-lag", text, error_m, asked.accuracy_m, "raise scan.power, or scan more sweeps")
            )
    if changed is not None:
        found.append(changed)
    return Verdict(not found, tuple(found))
