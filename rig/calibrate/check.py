"""`rig calibrate check`: judges a calibration by views of a flat board that it was not made from."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from calibration.board.board import load_board
from calibration.check import CheckedAngle, CheckedBoard, check_angle, check_board
from calibration.depth_error import DepthUncertainty, depth_uncertainty, sensitivity
from calibration.diagnosis.verdicts import goal, judge_check
from calibration.errors import Degenerate, mm
from calibration.files.rig_file import CORNERS, corners_digest, load_rig_model
from calibration.model.rig_model import RigModel
from calibration.verdict import AccuracyGoal
from calibration.views import View
from rig.calibrate.capture import AskPerson, TellLine, require_live
from rig.calibrate.report import check_report
from rig.calibrate.session import CalibrationResult, Session, true_errors, truth_content
from rig.calibrate.sources import SourcesLike, si_values, sort_sources
from rig.calibrate.views import good_poses, note_views, take_kept, take_live
from rig.devices.calibration_use import try_note
from rig.errors import UsageError
from rig.progress import tell_stage
from rig.requests import CheckRequest

_BOARD_KEYS = (
    "distance_m", "flatness_rms_m", "flatness_peak_m", "expected_m", "chi2", "freedom", "scale", "scale_sd",
    "point_rms_m",
)  # fmt: skip
"""Numbers of a checked board that are in the summary."""
NO_COVARIANCE = "the calibration has no covariance: nothing tells what depth error to expect"
SEED_APART = 1 << 20
"""Offset of a check's seeds from a calibration's: a simulated rig then shows other poses and other photons."""


def calibrate_check(
    sources: SourcesLike = (),
    request: CheckRequest | None = None,
    *,
    ask: AskPerson | None = None,
    tell: TellLine | None = None,
    **changes: Any,
) -> CalibrationResult:
    """Judge a calibration by views of a flat board that it was not made from (`rig calibrate check`).

    sources: a rig, recorded runs, or folders of earlier calibrations; empty: the bundled simulated rig.
    request, changes: options, as a `CheckRequest` or by the names of its fields.
    ask: asks a person to move the board; needed for a real rig. tell: gets a line on each view.

    If the calibration states its rig, the result is noted beside its file. Scans refuse a calibration with a note of a
    failed check.

    Raises Degenerate if the board cannot be used, CalibrationError if the calibration cannot, UsageError for a wrong
    request and for views that the calibration was made from.
    """
    request = replace(request or CheckRequest(), **changes)
    values = si_values(request)
    stated_rad = values.pop("angle_rad", None)
    found, board = sort_sources(sources, scene=request.scene), load_board(request.board)
    live = found.live
    file = Path(request.calibration) if request.calibration is not None else None if live is None else live.calibration
    if file is None:
        raise UsageError("there is no calibration to check; name one as `calibration`")
    model = load_rig_model(file)
    views_needed = 1 if stated_rad is None else 2
    require_live(live, ask, request.arm)
    wanted = goal(sensitivity(model, values["at_m"]), **values)
    with Session(request.out, board, tell) as session:
        take_kept(session, found, model.defects)
        _require_others(session.views, model)
        if live is not None:
            asked = replace(request, seed=request.seed + SEED_APART, poses=max(request.poses, views_needed))
            choose = good_poses(live, board, asked.poses, wanted.at_m, asked.seed)
            take_live(session, live, asked, choose, ask, defects=model.defects)
        views = _with_board(session, views_needed)
        model.check_sensor(*session.size)
        tell_stage("judging", len(views), unit="views")
        boards = [check_board(model, view, board) for view in views]
        angle = None if stated_rad is None else check_angle(model, views[0], views[1], board)
        verdict = judge_check(boards, wanted, board.size_m[0], angle, stated_rad)
        uncertainty = None if model.covariance is None else depth_uncertainty(model, wanted.at_m)
        line = NO_COVARIANCE if uncertainty is None else uncertainty.line()
        refused = not verdict.passed and model.identity is not None
        noted = model.identity is None or try_note(file, model, "check", passed=verdict.passed, reasons=verdict.codes)
        consequence = _consequence(file, noted=noted) if refused else []
        summary = {
            "verdict": verdict.as_json(),
            "calibration": str(file),
            **_summary(boards, wanted, uncertainty),
            "angle": None
            if angle is None
            else {"rad": angle.angle_rad, "sd_rad": angle.sd_rad, "stated_rad": stated_rad},
            "scans_refuse_it": refused and noted,
            "truth": truth_content(true_errors(model, live, wanted.at_m)),
        }
        tell_stage("writing the report")
        session.identity = session.identity or model.identity
        result = CalibrationResult(verdict, line, (*_figures(boards, angle), *consequence), summary)
        result = session.finish("check", result, check_report(boards, uncertainty))
        return replace(result, model=model)


def _require_others(views: Sequence[View], model: RigModel) -> None:
    """Raise UsageError for views that the model was made from: the model was fitted to their errors too."""
    made_of = model.provenance.get(CORNERS) or ()
    same = [view.name for view in views if corners_digest(view) in made_of]
    if same:
        raise UsageError(
            f"view{'s' if len(same) > 1 else ''} {', '.join(same)}: the calibration was made of the same, which is no "
            "check of it; name a rig, runs or views taken since"
        )


def _with_board(session: Session, least: int) -> list[View]:
    """The views that show the board. Raises Degenerate, with notes as by `note_views`, if fewer than `least` do."""
    views = [view for view in session.views if view.corners is not None]
    if len(views) < least:
        reason = next((why.reason for why in session.refused.values()), "no-board")
        few = "1 view shows" if len(views) == 1 else f"{len(views)} views show"
        error = Degenerate(reason, f"{reason}: {few} the board, at least {least} must; show it again")
        note_views(error, session)
        raise error
    return views


def _summary(
    boards: Sequence[CheckedBoard], wanted: AccuracyGoal, uncertainty: DepthUncertainty | None
) -> dict[str, Any]:
    return {
        "boards": [{"view": board.name, **{key: getattr(board, key) for key in _BOARD_KEYS}} for board in boards],
        "depth_error": {
            "at_m": wanted.at_m,
            "asked_m": wanted.accuracy_m,
            "median_m": None if uncertainty is None else float(np.nanmedian(uncertainty.sd_m)),
            "line": None if uncertainty is None else uncertainty.line(),
        },
    }


def _consequence(file: Path, *, noted: bool) -> list[tuple[str, str]]:
    """Line on what a failed check changes, and how to undo it. noted: whether it could be noted."""
    refused = (
        f"scan, replay and reconstruct refuse {file} (or take it with `accept_calibration=True`); a check of it that "
        "passes, with the right angle or board, takes that back"
    )
    return [("from now on", refused if noted else f"nothing refuses {file}: the check could not be noted beside it")]


def _figures(boards: Sequence[CheckedBoard], angle: CheckedAngle | None) -> list[tuple[str, str]]:
    rows = []
    for board in boards:
        said = (
            f"{board.distance_m:.2f} m away, flat to {mm(board.flatness_rms_m)} rms ({mm(board.expected_m)} expected), "
            f"{mm(board.flatness_peak_m)} peak, scale {board.scale - 1:+.3%} (sd {board.scale_sd:.2%})"
        )
        rows.append((f"view {board.name}", said))
    if angle is not None:
        rows.append(("angle", f"{math.degrees(angle.angle_rad):.3f} degrees, sd {math.degrees(angle.sd_rad):.2g}"))
    return rows
