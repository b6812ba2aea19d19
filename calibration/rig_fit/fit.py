"""Bundle adjustment of a whole rig: camera, poses of the board, mirror and lag, from corners and passages together.

Start values come from linear fits (`rig_start`), the best values from robust least squares (`rig_solve`) whose noise is
told from the residuals themselves (`rig_noise`). Terms of the mirror that the data call for are added one at a time
(`rig_select`); what speeds and directions cannot tell is not fitted. The covariance is that of all parameters jointly.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.board.board import Board
from calibration.camera_fit.fit import CameraFit, fit_camera
from calibration.errors import CalibrationError, Degenerate
from calibration.model.camera import Camera
from calibration.model.covariance import Covariance
from calibration.model.lag_speeds import SWEPT, lag_groups, speed_range
from calibration.model.rig_model import Lag, RigModel
from calibration.model.scanner import PivotScanner
from calibration.rig_fit.degenerate import check_depth, check_poses, check_views, no_start
from calibration.rig_fit.misfit import misfit, widening
from calibration.rig_fit.noise import Noise, passage_noise, restated
from calibration.rig_fit.normal import all_rows
from calibration.rig_fit.rounds import Rounds
from calibration.rig_fit.rows import ANGLE_TERMS, LENS_TERMS, OFFSET_TERMS, Terms
from calibration.rig_fit.select import Decision, lag_decisions, with_free
from calibration.rig_fit.sightings import Sighting, sighting, usable
from calibration.rig_fit.solve import Problem, camera_prior
from calibration.rig_fit.start import board_points, first_pose, first_scanner
from calibration.rig_fit.state import RigState, first_state, with_terms_of
from calibration.rig_fit.sweeps import SweepFit, sweep_fits
from calibration.robust import robust_sd
from calibration.views import BoardPose, View

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class RigFit:
    """A fitted rig. Per view, in the order of `views`: poses, corner_residual_px (n, 2) predicted less seen, sweeps.

    left_out: names of views without corners; outliers: of views that do not fit the others, which had no say.
    noise: what the residuals speak for; corner_scale: of the usual corner, by which its sd is the noise's. misfit: by
    which variances were multiplied, 1 where the model describes all. condition: of the scaled equations of the shared
    parameters. converged: False where data that contradict each other keep the fit from coming to rest. decisions:
    about terms and lags. free: what was fitted, names of one group having one value; information: (free, free) about
    it, the inverse of its covariance.
    """

    model: RigModel
    views: tuple[str, ...]
    poses: tuple[BoardPose, ...]
    corner_residual_px: tuple[Array, ...]
    sweeps: tuple[tuple[SweepFit, ...], ...]
    left_out: tuple[str, ...]
    outliers: tuple[str, ...]
    noise: Noise
    corner_scale: float
    misfit: float
    condition: float
    converged: bool
    decisions: tuple[Decision, ...]
    board: Board
    free: tuple[tuple[str, ...], ...]
    information: Array

    @property
    def used(self) -> tuple[str, ...]:
        """Names of the views whose passages had a say."""
        pairs = zip(self.views, self.sweeps, strict=True)
        return tuple(name for name, sweeps in pairs if sweeps and name not in self.outliers)

    @property
    def without_line(self) -> tuple[str, ...]:
        """Names of the views with corners, but too few passages on the board."""
        return tuple(name for name, sweeps in zip(self.views, self.sweeps, strict=True) if not sweeps)

    @property
    def corner_rms_px(self) -> float:
        """Root mean square of all corners' distances."""
        squares = np.concatenate([np.sum(left**2, axis=1) for left in self.corner_residual_px])
        return float(np.sqrt(squares.mean()))


def fit_rig(
    views: Sequence[View],
    board: Board,
    size: tuple[int, int],
    *,
    camera: Camera | CameraFit | None = None,
    hold_camera: bool = False,
    known: Covariance | None = None,
    start: RigModel | None = None,
    distortion_terms: int = 5,
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
    camera = _first_camera(shown, board, size, camera, start, distortion_terms)
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
    problem = with_free(Problem(sightings, terms, np.zeros((0, 0)), np.ones(len(shown), bool), prior), groups)
    problem, noise = _first_noise(problem, state)
    fit = Rounds(problem, tuple(groups), state, noise)
    try:
        fit.run()
    except np.linalg.LinAlgError as error:
        raise no_start(error, poses) from error
    left_out = tuple(view.name for view in views if view.name not in {used.name for used in shown})
    return _result(fit, left_out, board, start, velocities)


def _first_camera(
    views: Sequence[View],
    board: Board,
    size: tuple[int, int],
    camera: Camera | None,
    start: RigModel | None,
    terms: int,
) -> Camera:
    if camera is None and start is not None:
        camera = start.camera
    if camera is None:
        camera = fit_camera(views, board, size, distortion_terms=terms).camera
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


def _first_noise(problem: Problem, state: RigState) -> tuple[Problem, Noise]:
    """The problem with the sd that the passages' errors speak for, and how noisy all is."""
    rows = all_rows(state, problem.sightings, problem.terms)
    corners, passages = ([pair[which].residual for pair in rows] for which in (0, 1))
    problem = replace(problem, sightings=restated(passages, problem.sightings))
    factor, jitter, reach = passage_noise(passages, problem.sightings)
    return problem, Noise(max(robust_sd(np.concatenate(corners)), 1e-4), factor, jitter, reach)


def _result(fit: Rounds, left_out: tuple[str, ...], board: Board, start: RigModel | None, velocities: Array) -> RigFit:
    assert fit.solution is not None
    problem, solution, state = fit.problem, fit.solution, fit.state
    names = np.array(problem.terms.names)
    unexplained = misfit(problem, solution).factor
    matrix = unexplained * solution.covariance(problem.tie) + widening(problem, solution, fit.decisions)
    fitted = np.flatnonzero(np.diag(matrix) > 0)
    covariance = Covariance(tuple(names[fitted].tolist()), matrix[np.ix_(fitted, fitted)])
    scanner = state.scanner
    scanner = replace(scanner, angle_rad=_trimmed(scanner.angle_rad, 2), offset_m=_trimmed(scanner.offset_m, 0))
    model = replace(
        RigModel(state.model.camera, scanner) if start is None else start,
        camera=state.model.camera,
        scanner=scanner,
        covariance=covariance,
        lag_s=Lag(*(max(float(lag), 0.0) for lag in state.timing[:2])),
        row_delay_s=float(state.timing[2]),
        provenance={SWEPT: _swept(problem)},
        speed_range_per_s=speed_range(np.abs(velocities)),
    )
    counted = problem.counted
    fastest = float(velocities[np.argmax(np.abs(velocities))])
    outliers = tuple(seen.name for seen, counts in zip(problem.sightings, counted, strict=True) if not counts)
    said = [pose for pose, counts in zip(state.poses, counted, strict=True) if counts]
    check_depth(model, said, solution.condition, fastest, unexplained, outliers)
    return RigFit(
        model=model,
        views=tuple(seen.name for seen in problem.sightings),
        poses=state.poses,
        corner_residual_px=tuple(rows.residual.reshape(2, -1).T for rows, _ in solution.rows),
        sweeps=tuple(
            sweep_fits(seen, rows.residual, state, view)
            for view, (seen, (_, rows)) in enumerate(zip(problem.sightings, solution.rows, strict=True))
        ),
        left_out=left_out,
        outliers=outliers,
        noise=fit.noise,
        corner_scale=float(np.median(np.concatenate([seen.corner_scale for seen in problem.sightings]))),
        misfit=unexplained,
        condition=solution.condition,
        converged=solution.converged,
        decisions=(*fit.kept, *fit.decisions, *lag_decisions(solution, problem, fit.free, state.timing)),
        board=board,
        free=tuple(fit.free),
        information=problem.tie.T @ solution.matrix @ problem.tie / unexplained,
    )


def _swept(problem: Problem) -> list[float]:
    """Signed velocities of the sweeps that had a say."""
    shown = [seen.velocity_per_s for seen, counts in zip(problem.sightings, problem.counted, strict=True) if counts]
    swept: list[float] = np.unique(np.concatenate(shown)).tolist()
    return swept


def _trimmed(terms: Array, least: int) -> Array:
    """Without the zeros at the end."""
    used = np.flatnonzero(terms)
    return terms[: max(least, int(used[-1]) + 1 if used.size else 0)]
