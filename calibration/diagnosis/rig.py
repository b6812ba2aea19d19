"""The verdict on a fit of the rig: what was asked, what the fit tells, and the words of `calibration.verdict` for it.

Lag and row delay are judged by the depth error that their uncertainty makes.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from calibration.board.board import Board
from calibration.depth_error import DepthUncertainty, Sensitivity, depth_uncertainty, propagated, sensitivity
from calibration.diagnosis.contradictions import (
    SweepResidual,
    SweepWaves,
    ViewShift,
    common_shift,
    counted,
    last_before_move,
    shift_noise,
    sweep_waves,
    view_shifts,
)
from calibration.diagnosis.rules import (
    FitEvidence,
    baseline_m,
    judge,
    judge_refusal,
    lag_lack,
    pose_evidence,
    rough_poses,
    view_evidence,
)
from calibration.errors import Degenerate, digits, mm
from calibration.guide import rough_camera
from calibration.model.parameters import SWEPT
from calibration.model.rig_model import RigModel
from calibration.rig_fit.fit import RigFit
from calibration.rig_fit.state import shows_line, usable
from calibration.sync.lag_fit import SyncFit
from calibration.verdict import AT_M, AccuracyGoal, Reason, Verdict, unguided
from calibration.views import View

ACCURACY_PX: Final = 0.1
"""Error of the stripe, in pixels, whose depth error is asked for by default. No estimator does better in fog."""
_WORST_PERCENT = 95


@dataclass(frozen=True, slots=True, eq=False)
class JudgedRig:
    """A verdict and what it was made of."""

    verdict: Verdict
    asked: AccuracyGoal
    evidence: FitEvidence
    waves: SweepWaves
    residuals: tuple[SweepResidual, ...]
    shifts: tuple[ViewShift, ...]
    uncertainty: DepthUncertainty
    sensitivity: Sensitivity


def goal(
    worth: Sensitivity, accuracy_m: float | None = None, at_m: float = AT_M, stated_baseline_m: float | None = None
) -> AccuracyGoal:
    """The accuracy asked: sd of depth at `at_m`, for which `worth` is; None: that of ACCURACY_PX."""
    return AccuracyGoal(ACCURACY_PX * worth.per_pixel_m if accuracy_m is None else accuracy_m, at_m, stated_baseline_m)


def judge_fit(
    fit: RigFit,
    views: Sequence[View],
    *,
    at_m: float = AT_M,
    accuracy_m: float | None = None,
    stated_baseline_m: float | None = None,
) -> JudgedRig:
    """Judge a fit of `views`. accuracy_m: sd of depth at `at_m` that is good enough; None: that of ACCURACY_PX.

    Raises CalibrationError where the line does not reach that distance.
    """
    model = fit.model
    worth = sensitivity(model, at_m)
    asked = goal(worth, accuracy_m, at_m, stated_baseline_m)
    residuals = tuple(
        SweepResidual(name, sweep.direction, sweep.command, sweep.residual)
        for name, sweeps in zip(fit.views, fit.sweeps, strict=True)
        for sweep in sweeps
    )
    waves = sweep_waves(residuals)
    shifts = view_shifts(fit, {view.name: view for view in views})
    agreeing = counted(shifts, fit.outliers, fit.misfit)
    sweeps = max((len(of_view) for of_view in fit.sweeps), default=1)
    uncertainty = depth_uncertainty(model, at_m)
    baseline, baseline_sd = _baseline(model)
    known = uncertainty.sd_m[np.isfinite(uncertainty.sd_m)]
    said = [pose for name, pose in zip(fit.views, fit.poses, strict=True) if name not in fit.outliers]
    evidence = FitEvidence(
        poses=pose_evidence(said, fit.board),
        expected_m=float(np.median(known)) if known.size else np.nan,
        worst_m=float(np.percentile(known, _WORST_PERCENT)) if known.size else np.nan,
        wave_m=waves.rms * worth.per_command_m,
        wave_noise_m=waves.noise * worth.per_command_m,
        shift_m=common_shift(agreeing, waves.rms, sweeps) * worth.per_command_m,
        shift_noise_m=shift_noise(agreeing, waves.rms, sweeps) * worth.per_command_m,
        moved_after=last_before_move(agreeing),
        misfit=fit.misfit,
        baseline_m=baseline,
        baseline_sd_m=baseline_sd,
        velocities_per_s=tuple(model.provenance[SWEPT]),
    )
    seen = view_evidence(views, (model.camera.width, model.camera.height), len(fit.used), fit.outliers)
    return JudgedRig(judge(seen, evidence, asked), asked, evidence, waves, residuals, shifts, uncertainty, worth)


def judge_refused(
    refused: Degenerate,
    views: Sequence[View],
    board: Board,
    size: tuple[int, int],
    *,
    photons: bool = True,
    line: bool = True,
) -> Verdict:
    """Judge views of a picture of `size` (width, height) from which no model could be made. photons: `data_lack`. line:
    whether the line was to be seen in them, or a camera alone was asked for.
    """
    poses = rough_poses(views, board, rough_camera(size))
    evidence = pose_evidence(poses, board) if poses else None
    used = sum(not line or shows_line(view) for view in usable(views))
    verdict = judge_refusal(refused, view_evidence(views, size, used), evidence, photons=photons)
    return verdict if line else unguided(verdict)


def _baseline(model: RigModel) -> tuple[float, float]:
    """Distance of camera and mirror axis, and its sd, metres; NaN for a table of planes."""
    values, covariance = propagated(model, lambda tried: np.array([baseline_m(tried.scanner)]))
    return float(values[0]), float(np.sqrt(covariance[0, 0]))


_STILL = "check that nothing moved between the sweeps, or calibrate at the speed of your scans"


def judge_sync(
    fit: SyncFit, model: RigModel | None, asked: AccuracyGoal | None, changed: Reason | None = None
) -> Verdict:
    """Judge a fit; model, asked: None where nothing tells a lag's worth; changed: why the model is wrong with it."""
    found = []
    if not fit.steady:
        text = (
            f"the lag is not the same at all speeds: chi squared {fit.chi2:.1f} for {fit.dof} degrees of freedom; it "
            "holds for the speeds scanned only"
        )
        found.append(Reason("lag-by-speed", text, fit.chi2, float(fit.dof), _STILL))
    found += lag_lack(fit.velocities_per_s, mean_will_do=False)
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
