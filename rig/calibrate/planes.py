"""`rig calibrate planes`: calibrates the whole rig, camera, mirror and lag together, from views of a board.

In the guided mode (`Guide`) the rig is fitted after each view, and the pose is asked for that lowers the expected error
most.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from functools import partial
from typing import Any

import numpy as np

from calibration.board.board import Board
from calibration.depth_error import DepthErrors
from calibration.diagnosis.rig import Judged, judge_fit
from calibration.errors import CalibrationError, Degenerate, condition_text, mm
from calibration.files.camera_file import CORNERS, KnownCamera, corners_digest
from calibration.guide import Advice, Forecast, candidates, next_pose
from calibration.model.rig_model import Identity, RigModel
from calibration.rig_fit.fit import fit_rig
from calibration.rig_fit.result import RigFit
from calibration.verdict import AT_M
from calibration.views import View
from rig.calibrate.capture import Ask, Tell, require_live
from rig.calibrate.report import planes_report
from rig.calibrate.report_page import subject
from rig.calibrate.session import CalibrationResult, Session, named, true_errors, truth_content
from rig.calibrate.sources import CameraUse, ViewSources
from rig.calibrate.views import FixedPoses, Live, Taken, good_poses, refusal, require_poses, take_kept, take_live
from rig.config.models import RigConfig
from rig.progress import tell_stage
from rig.scan.run import OutFolder, versions

POSES = 12
SPEEDS = ((1.0, 1), (0.3, 2), (2.0, 4))
"""Exposures per column by turns: factors of the config's, and the least number for each.

The lags of both directions need several speeds, and hold between the lowest and the highest of them. One exposure shows
the line in bright light only, so that it is tried only where it is the config's own.
"""


@dataclass(frozen=True, slots=True)
class PlanesAsked:
    """Request for a calibration of the planes.

    poses: of a live rig; the most of them where guided.
    accuracy_m: standard deviation of depth at `at_m` that is good enough; None is what a tenth of a pixel costs there.
    stated_baseline_m: as somebody measured it; None where nobody has.
    exposures: per column, by turns; empty is SPEEDS times the config's.
    """

    poses: int = POSES
    guided: bool = False
    accuracy_m: float | None = None
    at_m: float = AT_M
    stated_baseline_m: float | None = None
    exposures: tuple[int, ...] = ()
    seed: int = 0
    arm: bool = False


def run_planes(
    sources: ViewSources,
    board: Board,
    asked: PlanesAsked,
    *,
    base: RigModel | None = None,
    camera: CameraUse | None = None,
    out: OutFolder = None,
    ask: Ask | None = None,
    tell: Tell | None = None,
) -> CalibrationResult:
    """Calibrate the planes from the sources.

    base: a model to start from, whose defective pixels are kept.
    camera: what other views say of the camera.
    ask: gets a person to move the board. tell: gets a line about each view.
    Raises Degenerate where the views make no calibration; its notes say why, root cause first.
    """
    live, known = sources.live, None if camera is None else camera.known
    require_live(live, ask, asked.arm)
    with Session(out, board) as session:
        taken = Taken(session, tell, () if known is None else known.views)
        defects = None if base is None else base.defects
        take_kept(taken, sources, board, defects)
        if live is not None:
            require_poses(taken, asked.poses)
            start = good_poses(live, board, asked.poses, asked.at_m, asked.seed, len(taken.views))
            fit_and_judge = partial(_fit, taken, board, base, known), partial(_judged, taken, asked)
            guide = Guide(start, board, live.scan.depth_range, taken, *fit_and_judge, tell)
            exposures = asked.exposures or speeds_of(live)
            choose = guide if asked.guided else start
            take_live(taken, Live(live, asked.poses, choose, ask, exposures, asked.seed, asked.arm, defects), board)
        fit = _fitted(taken, board, base, known)
        judged = _judged(taken, asked, fit)
        told = () if known is None else known.views
        digests = sorted({*told, *(corners_digest(view) for view in taken.views if view.name in fit.views)})
        model = _signed(fit, judged, taken.identity, digests, camera)
        tell_stage("writing the report")
        truth = None if live is None else true_errors(model, live, asked.at_m)
        line = judged.uncertainty.line()
        summary = {
            "command": "planes",
            **_summary(fit, judged, taken),
            **_accepted(camera),
            "truth": None if truth is None else truth_content(truth),
            "versions": versions(),
        }
        figures = tuple(_figures(fit, judged, truth, camera))
        about = subject(taken.identity, board, summary["versions"], datetime.now(UTC))
        report = planes_report(fit, taken.views, judged, line, figures, about)
        calibration = session.finish(summary, report, model)
        return CalibrationResult(judged.verdict, line, figures, summary, model, session.path, calibration)


def speeds_of(live: RigConfig) -> tuple[int, ...]:
    """Exposures per column for a rig's views, by turns."""
    return tuple(dict.fromkeys(max(least, round(times * live.scan.exposures)) for times, least in SPEEDS))


def _fit(taken: Taken, board: Board, base: RigModel | None, camera: KnownCamera | None) -> RigFit:
    """Fit the rig to the views so far, with all that is known from elsewhere."""
    tell_stage("fitting", len(taken.views), unit="views")
    return fit_rig(
        taken.views,
        board,
        taken.size,
        camera=None if camera is None else camera.camera,
        known=None if camera is None else camera.covariance,
        start=base,
    )


def _judged(taken: Taken, asked: PlanesAsked, fit: RigFit) -> Judged:
    tell_stage("judging")
    return judge_fit(
        fit, taken.views, at_m=asked.at_m, accuracy_m=asked.accuracy_m, stated_baseline_m=asked.stated_baseline_m
    )


def _fitted(taken: Taken, board: Board, base: RigModel | None, camera: KnownCamera | None) -> RigFit:
    try:
        return _fit(taken, board, base, camera)
    except CalibrationError as error:
        refused = error if isinstance(error, Degenerate) else Degenerate("no-model", str(error))
        raise refusal(refused, taken, board) from refused


def _signed(
    fit: RigFit, judged: Judged, identity: Identity | None, digests: list[str], camera: CameraUse | None
) -> RigModel:
    """The model with its verdict, its rig, and the digests of its corners, which must not be used to check it."""
    verdict = judged.verdict
    created = datetime.now(UTC).isoformat(timespec="seconds")
    if identity is not None:
        identity = replace(identity, created=created, verdict=verdict.word, reasons=verdict.codes)
    provenance = {
        **fit.model.provenance,
        "by": "rig calibrate planes",
        "created": created,
        "views": len(fit.views),
        "corner_rms_px": fit.corner_rms_px,
        "depth_sd_m": judged.evidence.expected_m,
        "at_m": judged.asked.at_m,
        "asked_m": judged.asked.accuracy_m,
        "verdict": verdict.word,
        "reasons": [str(reason) for reason in verdict.reasons],
        CORNERS: digests,
    }
    if camera is not None:
        provenance["camera"] = camera.content()
    return replace(fit.model, identity=identity, provenance=provenance)


def _accepted(camera: CameraUse | None) -> dict[str, list[str]]:
    """Accepted reasons against the camera, in the form of a scan's summary."""
    return {"accepted_calibration": [str(each) for each in camera.accepted]} if camera and camera.accepted else {}


def _summary(fit: RigFit, judged: Judged, taken: Taken) -> dict[str, Any]:
    evidence, uncertainty = judged.evidence, judged.uncertainty
    return {
        "verdict": judged.verdict.as_json(),
        "views": {
            "shown": len(taken.views),
            "used": len(fit.used),
            "without_board": list(fit.left_out),
            "without_line": list(fit.without_line),
            "outliers": list(fit.outliers),
            "refused": {name: str(why) for name, why in taken.refused.items()},
        },
        "depth_error": {
            "at_m": judged.asked.at_m,
            "asked_m": judged.asked.accuracy_m,
            "median_m": evidence.expected_m,
            "worst_m": evidence.worst_m,
            "parts_m": {name: float(np.nanmedian(part)) for name, part in uncertainty.part_m.items()},
            "line": uncertainty.line(),
        },
        "corner_rms_px": fit.corner_rms_px,
        "passages": sum(len(sweep.residual) for sweeps in fit.sweeps for sweep in sweeps),
        "passage_factor": fit.noise.passage_factor,
        "jitter_sd": fit.noise.jitter_sd,
        "misfit": fit.misfit,
        "condition": fit.condition,
        "converged": fit.converged,
        "wave_m": evidence.wave_m,
        "shift_m": evidence.shift_m,
        "baseline_m": evidence.baseline_m,
        "baseline_sd_m": evidence.baseline_sd_m,
        "lag_s": fit.model.lag_s._asdict(),
        "row_delay_s": fit.model.row_delay_s,
        "speed_range_per_s": fit.model.speed_range_per_s,
        "decisions": [asdict(decision) for decision in fit.decisions],
    }


def _figures(fit: RigFit, judged: Judged, truth: DepthErrors | None, camera: CameraUse | None) -> list[tuple[str, str]]:
    evidence, matrix = judged.evidence, fit.model.camera.matrix
    lag = fit.model.lag_s
    asked = judged.asked
    rows = [
        ("views", f"{len(fit.used)} used, {named(fit.outliers)} outliers, {named(fit.left_out)} without board, "
                  f"{named(fit.without_line)} without passages"),
        ("depth error", f"{mm(evidence.expected_m)} at {asked.at_m:g} m (95 % of the picture: "
                        f"{mm(evidence.worst_m)}), asked {mm(asked.accuracy_m)}"),
        ("camera", f"f {matrix[0, 0]:.2f}, {matrix[1, 1]:.2f} px, centre {matrix[0, 2]:.2f}, {matrix[1, 2]:.2f} px"),
        ("baseline", f"{evidence.baseline_m * 1e3:.2f} mm, sd {mm(evidence.baseline_sd_m)}"),
        ("lag", f"{lag.forward * 1e6:.1f} us forward, {lag.backward * 1e6:.1f} us backward"),
        ("residuals", f"corners {fit.corner_rms_px:.3f} px, planes wave by {mm(evidence.wave_m)} and views "
                      f"differ by {mm(evidence.shift_m)} at {asked.at_m:g} m"),
        ("condition", condition_text(fit.condition) + ("" if fit.converged else "; the fit did not come to rest")),
    ]  # fmt: skip
    if camera is not None:
        rows += [("camera file", f"accepted in spite of {each}") for each in camera.accepted]
    if truth is not None:
        rows.append(("truth", f"median {mm(truth.median_m)}, worst {mm(truth.worst_m)} at "
                              f"{truth.depth_m:g} m, {truth.ratio:.2f} of the expected sd"))  # fmt: skip
    return rows


START_POSES = 3
"""Number of poses that are shown before anything is fitted."""


class Guide:
    """Chooses poses by how much they lower the expected error, until the accuracy asked for is expected."""

    def __init__(
        self, start: FixedPoses, board: Board, depth_range_m: tuple[float, float], taken: Taken,
        fit: Callable[[], RigFit], judge: Callable[[RigFit], Judged], tell: Tell | None,
    ) -> None:  # fmt: skip
        """Prepare the guide.

        start: poses for as long as no fit can be judged. taken: all views so far, those kept earlier too. fit, judge:
        fit and judge these views as the calibration itself will be.
        """
        self._start = start
        self._board = board
        self._depth_range_m = depth_range_m
        self._taken = taken
        self._fitted = fit
        self._judged = judge
        self._tell = tell
        self._asked: set[tuple[float, tuple[int, int], tuple[int, int]]] = set()

    def next(self, views: Sequence[View]) -> Advice | None:
        """The next pose; None where the expected error is small enough."""
        known = self._taken.views
        told = self._told() if len(known) >= START_POSES else None
        if told is None:
            return self._start.next(views)
        fit, judged = told
        at_m = judged.asked.at_m
        now_m = judged.evidence.expected_m
        if self._tell is not None:
            self._tell(f"expected error {judged.uncertainty.line()}; asked {mm(judged.asked.accuracy_m)}")
        if judged.verdict.passed:
            return None
        choices = [
            choice
            for choice in candidates(fit.model.camera, self._board, self._depth_range_m)
            if (choice.fill, choice.place, choice.tilt) not in self._asked
        ]
        if not choices:
            return None
        advice = next_pose(len(known), choices, at_m, now_m, Forecast(fit, at_m))
        chosen = advice.candidate
        self._asked.add((chosen.fill, chosen.place, chosen.tilt))  # a board that was not found there will not be again
        return advice

    def _told(self) -> tuple[RigFit, Judged] | None:
        """Fit and judge the views so far; None where they make no model yet, or its line misses the distance asked."""
        try:
            fit = self._fitted()
            return fit, self._judged(fit)
        except CalibrationError:
            return None
