"""`rig calibrate camera`: calibrates the camera alone, from views of a board or from picture files."""

from dataclasses import replace
from typing import Any

import numpy as np

from calibration.board.board import Board, load_board
from calibration.camera_fit import CameraFit, fit_camera
from calibration.diagnosis.verdicts import ACCURACY_PX, JudgedCamera, judge_camera
from calibration.errors import Degenerate, condition_text, digits
from calibration.files.rig_file import camera_content, camera_file_text, corners_digest
from calibration.model.camera import TERM_COUNTS
from calibration.verdict import AT_M
from rig.calibrate.capture import AskPerson, TellLine, require_live
from rig.calibrate.report import camera_report, named
from rig.calibrate.session import CalibrationResult, Session
from rig.calibrate.sources import SourcesLike, si_values, sort_sources
from rig.calibrate.views import good_poses, refusal, require_poses, take_kept, take_live
from rig.errors import UsageError
from rig.progress import tell_stage
from rig.requests import CameraRequest

CAMERA_FILE = "camera.yaml"
FEWEST_VIEWS = 3
"""Fewest views of a camera: with fewer, nothing contradicts a view that is wrong."""


def calibrate_camera(
    sources: SourcesLike = (),
    request: CameraRequest | None = None,
    *,
    ask: AskPerson | None = None,
    tell: TellLine | None = None,
    **changes: Any,
) -> CalibrationResult:
    """Calibrate the camera alone (`rig calibrate camera`).

    sources: rigs or folders of views, as for the other calibrations, or pictures, or folders of pictures.
    request, changes: options, as a `CameraRequest` or by the names of its fields.
    ask: asks a person to move the board; needed for a real rig. tell: gets a line on each view.

    Raises UsageError for a wrong request, and Degenerate if the views give no calibration: its message is the likeliest
    cause, its notes are other possible ones.
    """
    request = replace(request or CameraRequest(), **changes)
    si_values(request)
    if request.terms not in (0, *TERM_COUNTS):
        known = ", ".join(map(str, TERM_COUNTS))
        raise UsageError(f"terms is {request.terms}; OpenCV's lens models have 0, {known}")
    found, board = sort_sources(sources, pictures=True, scene=request.scene), load_board(request.board)
    live, photons = found.live, not found.pictures
    require_live(live, ask, request.arm)
    with Session(request.out, board, tell) as session:
        take_kept(session, found)
        if live is not None:
            require_poses(session, request.poses)
            choose = good_poses(live, board, request.poses, AT_M, request.seed, len(session.views))
            take_live(session, live, request, choose, ask, line=False)
        tell_stage("fitting", len(session.views), unit="views")
        try:
            fit = _fitted(session, board, request.terms)
        except Degenerate as refused:
            raise refusal(refused, session, board, photons=photons, line=False) from refused
        judged = judge_camera(fit, session.views, board, photons=photons)
        tell_stage("writing the report")
        figures, summary = _figures(fit, judged, session), _summary(fit, judged, session)
        result = CalibrationResult(judged.verdict, judged.line(), tuple(figures), summary)
        used = [view for view in session.views if view.name in fit.views]
        digests = [corners_digest(view) for view in used if view.name in fit.kept]
        session.write_text(CAMERA_FILE, camera_file_text(fit.camera, fit.covariance, digests, judged.verdict))
        return session.finish("camera", result, camera_report(fit, used, board))


def _fitted(session: Session, board: Board, terms: int) -> CameraFit:
    """Fit the camera. Raises Degenerate as `fit_camera` does, and if it could use fewer than FEWEST_VIEWS views."""
    fit = fit_camera(session.views, board, session.size, distortion_terms=terms)
    if len(fit.kept) < FEWEST_VIEWS:
        raise Degenerate(
            "too-few-poses",
            f"{len(fit.kept)} of {len(session.views)} views could be used (condition number "
            f"{condition_text(fit.condition)}): a camera takes {FEWEST_VIEWS} poses or more; show the board tilted to "
            "both sides, near and far",
        )
    return fit


def _summary(fit: CameraFit, judged: JudgedCamera, session: Session) -> dict[str, Any]:
    return {
        "verdict": judged.verdict.as_json(),
        "views": {
            "shown": len(session.views),
            "used": len(fit.kept),
            "outliers": list(fit.outliers),
            "refused": {name: str(why) for name, why in session.refused.items()},
            "rms_px": dict(zip(fit.views, fit.view_rms_px.tolist(), strict=True)),
        },
        "camera": camera_content(fit.camera),
        "sd": fit.sd,
        "rms_px": fit.rms_px,
        "ray_sd_px": {"median": judged.sd_px, "worst": judged.worst_px, "asked": ACCURACY_PX, "line": judged.line()},
        "coverage": judged.coverage,
        "condition": fit.condition,
    }


def _figures(fit: CameraFit, judged: JudgedCamera, session: Session) -> list[tuple[str, str]]:
    matrix, sd, refused = fit.camera.matrix, fit.sd, tuple(session.refused)
    terms = ", ".join(digits(term, 4) for term in fit.camera.distortion) or "none"
    return [
        ("views", f"{len(fit.kept)} of {len(session.views)} used, {named(fit.outliers)} outliers, {named(refused)} "
                  "refused"),
        ("rays", f"{digits(judged.sd_px, 2)} px, at the worst 5 % of the picture {digits(judged.worst_px, 2)} px, "
                 f"asked {ACCURACY_PX:g} px"),
        ("focal length", f"{matrix[0, 0]:.2f}, {matrix[1, 1]:.2f} px, sd {digits(sd['fx'], 2)}, {digits(sd['fy'], 2)}"),
        ("centre", f"{matrix[0, 2]:.2f}, {matrix[1, 2]:.2f} px, sd {digits(sd['cx'], 2)}, {digits(sd['cy'], 2)}"),
        ("distortion", terms),
        ("residuals", f"{fit.rms_px:.3f} px rms"),
        ("coverage", f"{judged.coverage:.0%} of the picture within the outline of all corners, boards up to "
                     f"{np.degrees(fit.spread_rad):.0f} degrees apart"),
        ("condition", condition_text(fit.condition)),
    ]  # fmt: skip
