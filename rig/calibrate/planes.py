"""`rig calibrate planes`: calibrates the whole rig, camera, mirror and lag together, from views of a board.

In the guided mode (`PoseGuide`) the rig is fitted after each view, and the pose that lowers the expected error most is
asked for next.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from calibration.board.board import Board
from calibration.depth_error import DepthErrors
from calibration.diagnosis.verdicts import JudgedRig, judge_fit
from calibration.errors import CalibrationError, Degenerate, condition_text, mm
from calibration.files.rig_file import CORNERS, KnownCamera, corners_digest, load_rig_model
from calibration.guide import Advice, Forecast, candidates, next_pose
from calibration.model.rig_model import Identity, RigModel
from calibration.rig_fit.fit import RigFit, fit_rig
from calibration.views import View
from rig.calibrate.capture import AskPerson, TellLine, require_live
from rig.calibrate.report import planes_report, subject
from rig.calibrate.session import CalibrationResult, Session, named, true_errors, truth_content
from rig.calibrate.sources import CameraUse, SourcesLike, camera_use, read_board, si_values, sort_sources
from rig.calibrate.views import (
    ChoosePose,
    LiveViewOptions,
    ViewCollection,
    good_poses,
    in_order,
    refusal,
    require_poses,
    take_kept,
    take_live,
)
from rig.config.models import RigConfig
from rig.progress import tell_stage
from rig.requests import PlanesRequest
from rig.scan.run import versions

SPEEDS = ((1.0, 1), (0.3, 2), (2.0, 4))
"""Exposures per column by turns: factors of the config's, and the least number for each.

The lags of both directions need several speeds, and hold between the lowest and the highest of them. One exposure shows
the line in bright light only, so that it is tried only where it is the config's own.
"""


def run_planes(
    sources: SourcesLike, request: PlanesRequest, *, ask: AskPerson | None = None, tell: TellLine | None = None
) -> CalibrationResult:
    """Calibrate the planes; the defects of the base calibration are kept. Raises Degenerate, with notes why, if the
    views give none.
    """
    values = si_values(request)
    found = sort_sources(sources, scene=request.scene)
    camera = None if request.camera is None else camera_use(Path(request.camera), accept=request.accept_calibration)
    board = read_board(request.board)
    base = None if request.calibration is None else load_rig_model(request.calibration)
    live, known = found.live, None if camera is None else camera.known
    require_live(live, ask, request.arm)
    with Session(request.out, board) as session:
        taken = ViewCollection(session, tell, () if known is None else known.views)
        defects = None if base is None else base.defects
        take_kept(taken, found, board, defects)
        if live is not None:
            require_poses(taken, request.poses)
            start = in_order(good_poses(live, board, request.poses, values["at_m"], request.seed, len(taken.views)))
            fit_and_judge = partial(_fit, taken, board, base, known), partial(_judged, taken, values)
            guide = PoseGuide(start, board, live.scan.depth_range, taken, *fit_and_judge)
            options = LiveViewOptions(
                live,
                request.poses,
                guide.next if request.guided else start,
                ask,
                exposures=request.exposures or speeds_of(live),
                seed=request.seed,
                arm=request.arm,
                defects=defects,
            )
            take_live(taken, options, board)
        fit = _fitted(taken, board, base, known)
        judged = _judged(taken, values, fit)
        told = () if known is None else known.views
        digests = sorted({*told, *(corners_digest(view) for view in taken.views if view.name in fit.views)})
        model = _signed(fit, judged, taken.identity, digests, camera)
        tell_stage("writing the report")
        truth = None if live is None else true_errors(model, live, values["at_m"])
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
    """Numbers of exposures per column for a rig's views, to be used in turn."""
    return tuple(dict.fromkeys(max(least, round(times * live.scan.exposures)) for times, least in SPEEDS))


def _fit(taken: ViewCollection, board: Board, base: RigModel | None, camera: KnownCamera | None) -> RigFit:
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


def _judged(taken: ViewCollection, values: Mapping[str, float], fit: RigFit) -> JudgedRig:
    """Judge the fit by the accuracy asked for. values: `si_values` of the request."""
    tell_stage("judging")
    return judge_fit(fit, taken.views, **values)


def _fitted(taken: ViewCollection, board: Board, base: RigModel | None, camera: KnownCamera | None) -> RigFit:
    try:
        return _fit(taken, board, base, camera)
    except CalibrationError as error:
        refused = error if isinstance(error, Degenerate) else Degenerate("no-model", str(error))
        raise refusal(refused, taken, board) from refused


def _signed(
    fit: RigFit, judged: JudgedRig, identity: Identity | None, digests: list[str], camera: CameraUse | None
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


def _summary(fit: RigFit, judged: JudgedRig, taken: ViewCollection) -> dict[str, Any]:
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
        "passages": sum(len(sweep.residual) for sweep in fit.every_sweep),
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


def _figures(
    fit: RigFit, judged: JudgedRig, truth: DepthErrors | None, camera: CameraUse | None
) -> list[tuple[str, str]]:
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


class PoseGuide:
    """Chooses poses by how much they lower the expected error, until that reaches the required accuracy."""

    def __init__(
        self, start: ChoosePose, board: Board, depth_range_m: tuple[float, float], taken: ViewCollection,
        fit: Callable[[], RigFit], judge: Callable[[RigFit], JudgedRig],
    ) -> None:  # fmt: skip
        """Take poses for as long as no fit can be judged, all views so far, how they will be fitted and judged."""
        self._start = start
        self._board = board
        self._depth_range_m = depth_range_m
        self._taken = taken
        self._fitted = fit
        self._judged = judge
        self._asked: set[tuple[float, tuple[int, int], tuple[int, int]]] = set()

    def next(self, views: Sequence[View]) -> Advice | None:
        """The next pose; None once the expected error is small enough."""
        known = self._taken.views
        told = self._told() if len(known) >= START_POSES else None
        if told is None:
            return self._start(views)
        fit, judged = told
        at_m = judged.asked.at_m
        now_m = judged.evidence.expected_m
        self._taken.say(f"expected error {judged.uncertainty.line()}; asked {mm(judged.asked.accuracy_m)}")
        if judged.verdict.passed:
            return None
        choices = [
            choice
            for choice in candidates(fit.model.camera, self._board, self._depth_range_m)
            if (choice.fill, choice.place, choice.tilt) not in self._asked
        ]
        if not choices:
            return None
        advice = next_pose(choices, at_m, now_m, Forecast(fit, at_m))
        chosen = advice.candidate
        self._asked.add((chosen.fill, chosen.place, chosen.tilt))  # a board that was not found there will not be again
        return advice

    def _told(self) -> tuple[RigFit, JudgedRig] | None:
        """Fit and judge the views so far; None if they make no model yet, or its line misses the distance asked."""
        try:
            fit = self._fitted()
            return fit, self._judged(fit)
        except CalibrationError:
            return None
