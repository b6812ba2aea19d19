"""`rig calibrate planes`: calibrates the whole rig (camera, mirror and lag) in one fit, from views of a board.

In the guided mode (`guided`) the rig is fitted after each view, and the next pose is the one that lowers the expected
error most.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from calibration.board.board import Board, load_board
from calibration.depth_error import DepthErrors
from calibration.diagnosis.verdicts import JudgedRig, judge_fit
from calibration.errors import CalibrationError, Degenerate, condition_text, mm
from calibration.files.rig_file import CORNERS, KnownCamera, corners_digest, load_rig_model
from calibration.guide import Advice, Forecast, candidates, next_pose
from calibration.model.rig_model import Identity, RigModel
from calibration.rig_fit.fit import RigFit, fit_rig
from calibration.views import View
from rig.calibrate.capture import AskPerson, TellLine, require_live
from rig.calibrate.report import named, planes_report
from rig.calibrate.session import CalibrationResult, Session, true_errors, truth_content
from rig.calibrate.sources import SourcesLike, known_camera, si_values, sort_sources
from rig.calibrate.views import ChoosePose, good_poses, refusal, require_poses, take_kept, take_live
from rig.config.models import RigConfig
from rig.devices.calibration_use import Refusal, check_content
from rig.progress import tell_stage
from rig.requests import PlanesRequest

SPEEDS = ((1.0, 1), (0.3, 2), (2.0, 4))
"""(factor on the config's exposures per column, least number of exposures) of successive views, used in turn.

The lags of both directions need several speeds, and hold between the lowest and the highest of them. With one exposure
the line is visible in bright light only, so one exposure is used only if the config has it.
"""


def calibrate_planes(
    sources: SourcesLike = (),
    request: PlanesRequest | None = None,
    *,
    ask: AskPerson | None = None,
    tell: TellLine | None = None,
    **changes: Any,
) -> CalibrationResult:
    """Calibrate camera, light planes and lag together from views of a board (`rig calibrate planes`).

    sources: a rig, recorded runs, or folders of earlier calibrations; empty: the bundled simulated rig.
    request, changes: options, as a `PlanesRequest` or by the names of its fields.
    ask: asks a person to move the board; needed for a real rig. tell: gets a line on each view.

    The fit starts from the request's `calibration`, if there is one, and keeps its defects. Raises Degenerate, with
    notes on the causes, if the views give no model, CalibrationError if a file cannot be used or the line does not
    reach the distance `at`, UsageError for a wrong request.
    """
    request = replace(request or PlanesRequest(), **changes)
    values = si_values(request)
    found = sort_sources(sources, scene=request.scene)
    known, accepted = None, list[Refusal]()
    if request.camera is not None:
        known, accepted = known_camera(Path(request.camera), accept=request.accept_calibration)
    board = load_board(request.board)
    base = None if request.calibration is None else load_rig_model(request.calibration)
    live, told = found.live, frozenset[str]() if known is None else known.views
    require_live(live, ask, request.arm)
    with Session(request.out, board, tell, told) as session:
        defects = None if base is None else base.defects
        take_kept(session, found, defects)
        fit_all, judge = partial(_fit, session, board, base, known), partial(_judged, session, values)
        if live is not None:
            require_poses(session, request.poses)
            choose = good_poses(live, board, request.poses, values["at_m"], request.seed, len(session.views))
            if request.guided:
                choose = guided(choose, board, live.scan.depth_range, session, fit_all, judge)
            exposures = request.exposures or speeds_of(live)
            take_live(session, live, request, choose, ask, exposures=exposures, defects=defects)
        try:
            fit = fit_all()
        except CalibrationError as error:
            refused = error if isinstance(error, Degenerate) else Degenerate("no-model", str(error))
            raise refusal(refused, session, board) from refused
        judged = judge(fit)
        digests = sorted({*told, *(corners_digest(view) for view in session.views if view.name in fit.views)})
        model = _signed(fit, judged, session.identity, digests)
        if known is not None:
            used = check_content("unchecked" if known.verdict is None else "passed", tuple(accepted))
            model = replace(model, provenance={**model.provenance, "camera": used})
        tell_stage("writing the report")
        truth = true_errors(model, live, values["at_m"])
        summary = _summary(fit, judged, session)
        if accepted:  # in the form of a scan's summary
            summary["accepted_calibration"] = [str(each) for each in accepted]
        summary["truth"] = truth_content(truth)
        figures = _figures(fit, judged, truth, accepted)
        result = CalibrationResult(judged.verdict, judged.uncertainty.line(), tuple(figures), summary, model)
        return session.finish("planes", result, planes_report(fit, session.views, judged))


def speeds_of(live: RigConfig) -> tuple[int, ...]:
    """Numbers of exposures per column for a rig's views, used in turn, by `SPEEDS`."""
    return tuple(dict.fromkeys(max(least, round(times * live.scan.exposures)) for times, least in SPEEDS))


def _fit(session: Session, board: Board, base: RigModel | None, camera: KnownCamera | None) -> RigFit:
    """Fit the rig to the views so far, starting from `base` and with the known `camera`, if there are any."""
    tell_stage("fitting", len(session.views), unit="views")
    return fit_rig(
        session.views,
        board,
        session.size,
        camera=None if camera is None else camera.camera,
        known=None if camera is None else camera.covariance,
        start=base,
    )


def _judged(session: Session, values: Mapping[str, float], fit: RigFit) -> JudgedRig:
    """Judge the fit by the accuracy asked for. values: `si_values` of the request."""
    tell_stage("judging")
    return judge_fit(fit, session.views, **values)


def _signed(fit: RigFit, judged: JudgedRig, identity: Identity | None, digests: list[str]) -> RigModel:
    """The model with its verdict, its rig, and the digests of the corners it was made from: no check may use these."""
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
    return replace(fit.model, identity=identity, provenance=provenance)


def _summary(fit: RigFit, judged: JudgedRig, session: Session) -> dict[str, Any]:
    evidence, uncertainty = judged.evidence, judged.uncertainty
    return {
        "verdict": judged.verdict.as_json(),
        "views": {
            "shown": len(session.views),
            "used": len(fit.used),
            "without_board": list(fit.left_out),
            "without_line": list(fit.without_line),
            "outliers": list(fit.outliers),
            "refused": {name: str(why) for name, why in session.refused.items()},
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
    fit: RigFit, judged: JudgedRig, truth: DepthErrors | None, accepted: Sequence[Refusal]
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
    rows += [("camera file", f"accepted in spite of {each}") for each in accepted]
    if truth is not None:
        rows.append(("truth", f"median {mm(truth.median_m)}, worst {mm(truth.worst_m)} at "
                              f"{truth.depth_m:g} m, {truth.ratio:.2f} of the expected sd"))  # fmt: skip
    return rows


START_POSES = 3
"""Fewest views of a session before anything is fitted."""


def guided(
    start: ChoosePose, board: Board, depth_range_m: tuple[float, float], session: Session,
    fit: Callable[[], RigFit], judge: Callable[[RigFit], JudgedRig],
) -> ChoosePose:  # fmt: skip
    """Return a function that chooses the pose which lowers the expected error most, until the verdict passes or no
    pose is left.

    start: chooses the poses until a fit of the session's views can be judged. fit: makes such a fit; judge: judges it.
    Before each pose, `session` tells the expected error.
    """
    asked: set[tuple[float, tuple[int, int], tuple[int, int]]] = set()

    def choose(views: Sequence[View]) -> Advice | None:
        if len(session.views) < START_POSES:
            return start(views)
        try:
            found = fit()
            judged = judge(found)
        except CalibrationError:  # no model yet, or its line does not reach the distance asked for
            return start(views)
        at_m = judged.asked.at_m
        session.say(f"expected error {judged.uncertainty.line()}; asked {mm(judged.asked.accuracy_m)}")
        every = candidates(found.model.camera, board, depth_range_m)
        choices = [choice for choice in every if (choice.fill, choice.place, choice.tilt) not in asked]
        if judged.verdict.passed or not choices:
            return None
        advice = next_pose(choices, at_m, judged.evidence.expected_m, Forecast(found, at_m))
        chosen = advice.candidate
        asked.add((chosen.fill, chosen.place, chosen.tilt))  # never again, even if the board is not found there
        return advice

    return choose
