"""Bundle adjustment of a whole rig: camera, poses of the board, mirror and lag, from corners and passages together.

Start values come from linear fits (`start`), the best values from robust least squares (`solve`) whose noise is told
from the residuals themselves (`noise`). Terms of the mirror that the data call for are added one at a time (`rounds`,
`misfit`); a lag that the sweeps' speeds and directions cannot tell is not fitted. The covariance is that of all
parameters jointly.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calibration.board.board import Board
from calibration.camera_fit import CameraFit, fit_camera
from calibration.errors import CalibrationError, Degenerate
from calibration.model.camera import Camera
from calibration.model.parameters import lag_groups
from calibration.model.rig_model import Covariance, RigModel
from calibration.model.scanner import PivotScanner
from calibration.rig_fit.misfit import with_free
from calibration.rig_fit.noise import Noise, passage_noise, restated
from calibration.rig_fit.result import RigFit, result_of
from calibration.rig_fit.rounds import Rounds
from calibration.rig_fit.rows import ANGLE_TERMS, LENS_TERMS, OFFSET_TERMS, Terms
from calibration.rig_fit.solve import RigProblem, all_rows, camera_prior
from calibration.rig_fit.start import board_points, check_poses, check_views, first_pose, first_scanner, no_start
from calibration.rig_fit.state import RigState, Sighting, first_state, sighting, usable, with_terms_of
from calibration.views import BoardPose, View, robust_sd


def fit_rig(
    views: Sequence[View],
    board: Board,
    size: tuple[int, int],
    *,
    camera: Camera | CameraFit | None = None,
    hold_camera: bool = False,
    known: Covariance | None = None,
    start: RigModel | None = None,
) -> RigFit:
    """Fit a rig to views of a board; size: (width, height) of the picture.

    camera: to start from (None: `start`'s or OpenCV's); with hold_camera it is not fitted and counts as known exactly.
    known: how well that camera is known from other pictures than these, by the names of its parameters; what has no
    variance is not fitted.
    start: its mirror and lag are where the fit begins, its source, defects and command range are kept.
    Raises Degenerate where the views do not make a model, with the reason, and CalibrationError.
    """
    shown = usable(views)
    if not shown:
        check_views(views, ())
    camera = camera.camera if isinstance(camera, CameraFit) else camera
    camera = _first_camera(shown, board, size, camera, start)
    poses = [_pose_of(view, board, camera) for view in shown]
    sightings = tuple(sighting(view, board, camera, pose) for view, pose in zip(shown, poses, strict=True))
    check_views(views, sightings)
    free_camera = not hold_camera
    terms = Terms(camera.distortion.size if free_camera else 0)
    try:
        state = _first_state(camera, poses, sightings, start)
    except Degenerate:
        raise
    except (CalibrationError, np.linalg.LinAlgError) as error:
        raise no_start(error, poses) from error
    velocities = np.unique(np.concatenate([seen.velocity_per_s for seen in sightings]))
    exact = () if known is None else tuple(np.array(known.names)[np.diag(known.matrix) == 0])
    groups: list[tuple[str, ...]] = [(name,) for name in terms.camera if free_camera and name not in exact]
    groups += [(name,) for name in ("axis_turn_1", "axis_turn_2", "axis_shift_1", "axis_shift_2", "angle_0", "angle_1")]
    groups += lag_groups(velocities)
    state = with_terms_of(state, groups)
    prior = None if known is None or hold_camera else camera_prior(known, camera, terms)
    problem = with_free(RigProblem(sightings, terms, np.zeros((0, 0)), np.ones(len(shown), bool), prior), groups)
    problem, noise = _first_noise(problem, state)
    fit = Rounds(problem, tuple(groups), state, noise)
    try:
        fit.run()
    except np.linalg.LinAlgError as error:
        raise no_start(error, poses) from error
    left_out = tuple(view.name for view in views if view.name not in {used.name for used in shown})
    return result_of(fit, left_out, board, start, velocities)


def _first_camera(
    views: Sequence[View], board: Board, size: tuple[int, int], camera: Camera | None, start: RigModel | None
) -> Camera:
    if camera is None and start is not None:
        camera = start.camera
    if camera is None:
        camera = fit_camera(views, board, size).camera
    if (camera.width, camera.height) != size:
        raise CalibrationError(
            f"camera is one of {camera.width} x {camera.height} pixels, the pictures have {size[0]} x {size[1]}; give "
            "the camera of this sensor, or none"
        )
    if camera.distortion.size > len(LENS_TERMS):
        raise CalibrationError(
            f"camera's lens has {camera.distortion.size} terms, at most {len(LENS_TERMS)} can be fitted with a mirror; "
            "calibrate the camera without the tilt of the sensor"
        )
    return camera


def _pose_of(view: View, board: Board, camera: Camera) -> BoardPose:
    assert view.corners is not None
    return first_pose(camera, board.corners_m[view.corners.ids], np.asarray(view.corners.px, np.float64))


def _first_state(
    camera: Camera, poses: Sequence[BoardPose], sightings: Sequence[Sighting], start: RigModel | None
) -> RigState:
    points = board_points(camera, sightings, poses)
    check_poses(points.points_m, poses)
    low, high = _command_range(sightings, start)
    if start is not None and isinstance(start.scanner, PivotScanner):
        scanner, timing = start.scanner, np.array([*start.lag_s, start.row_delay_s])
    else:
        scanner, timing = first_scanner(points, (low, high))
    angle, offset = np.zeros(ANGLE_TERMS), np.zeros(OFFSET_TERMS)
    angle[: scanner.angle_rad.size] = scanner.angle_rad[:ANGLE_TERMS]
    offset[: scanner.offset_m.size] = scanner.offset_m[:OFFSET_TERMS]
    scanner = replace(scanner, angle_rad=angle, offset_m=offset, command_range=(low, high))
    source = None if start is None else start.source_m
    return first_state(RigModel(camera, scanner, source_m=source), timing, poses, sightings)


def _command_range(sightings: Sequence[Sighting], start: RigModel | None) -> tuple[float, float]:
    """The usual one, or the start's, made wide enough for what was seen."""
    low, high = (-1.0, 1.0) if start is None else start.scanner.command_range
    for seen in sightings:
        if seen.command.size:
            low, high = min(low, float(seen.command.min())), max(high, float(seen.command.max()))
    return low, high


def _first_noise(problem: RigProblem, state: RigState) -> tuple[RigProblem, Noise]:
    """The problem with the sd that the passages' errors speak for, and how noisy all is."""
    rows = all_rows(state, problem.sightings, problem.terms)
    corners, passages = ([pair[which].residual for pair in rows] for which in (0, 1))
    problem = replace(problem, sightings=restated(passages, problem.sightings))
    factor, jitter, reach = passage_noise(passages, problem.sightings)
    return problem, Noise(max(robust_sd(np.concatenate(corners)), 1e-4), factor, jitter, reach)
