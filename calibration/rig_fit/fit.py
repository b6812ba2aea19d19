"""Bundle adjustment of a whole rig: camera, poses of the board, mirror and lag are fitted together.

The data are corners of the board in pictures, and passages: mirror commands at which the line crosses a pixel. Start
values come from linear fits (`rig_state`), the best values from robust least squares (`solve`) with a noise estimated
from the residuals themselves (`noise`). Each round (`Rounds`) fits, examines the residuals, and ends with at most one
decision (`misfit`): a mirror term that the data require is added, a lag below 0 is fixed at 0, or a view that does not
fit the others is no longer used. A lag more than 5 standard deviations below 0 raises Degenerate. A lag that the
sweeps' speeds and directions do not determine is not fitted. The covariance covers all fitted parameters jointly.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from calibration.arrays import Array
from calibration.board.board import Board
from calibration.camera_fit import fit_camera, rms
from calibration.errors import CalibrationError, Degenerate, digits
from calibration.model.camera import Camera
from calibration.model.parameters import AXIS, SWEPT, lag_groups, speed_range
from calibration.model.rig_model import Covariance, Lag, RigModel
from calibration.model.scanner import PivotScanner
from calibration.rig_fit import misfit, rig_state
from calibration.rig_fit.misfit import TermDecision
from calibration.rig_fit.noise import Noise, passage_noise, restated
from calibration.rig_fit.rows import ANGLE_TERMS, LENS_TERMS, OFFSET_TERMS, Terms, mirror_command
from calibration.rig_fit.solve import RigProblem, RigSolution, all_rows, camera_prior, solved
from calibration.views import BoardPose, View, robust_sd

MOST_ROUNDS = 16
"""Most rounds of fitting and deciding; all but the last add a term, fix a lag, drop a view or settle noise."""
MOST_IDLE_ROUNDS = 4
"""Most rounds in a row without a decision: contradictory data may keep a fit from ever converging."""
SETTLED_SHARE = 0.02
"""Relative change of the noise that is still allowed in the last round."""
MOST_ODD_SHARE = 1 / 3
"""Largest share of the views with passages that may be dropped; if more do not fit, the fault is elsewhere."""


@dataclass
class Rounds:
    """The state of a fit that alternates between fitting and deciding.

    base: groups of parameters, with one value each, that are free at the beginning; free: those free now. decisions:
    the latest ones about terms; kept: those that changed the model.
    """

    problem: RigProblem
    base: tuple[tuple[str, ...], ...]
    state: rig_state.RigState
    noise: Noise
    free: list[tuple[str, ...]] = field(init=False)
    solution: RigSolution = field(init=False)
    decisions: tuple[TermDecision, ...] = ()
    kept: tuple[TermDecision, ...] = ()

    def __post_init__(self) -> None:
        """Begin with the smallest model."""
        self.free = list(self.base)

    def run(self) -> None:
        """Fit and decide until nothing changes, or for MOST_ROUNDS. Raises Degenerate or LinAlgError as `solved` does,
        and Degenerate for a lag clearly below 0."""
        idle = 0
        for _ in range(MOST_ROUNDS):
            self.solution = solved(self.problem, self.state, self.noise, roughly=idle == 0)
            self.state = self.solution.state
            residuals = [rows.residual for _, rows in self.solution.rows]
            corner_sd_px = misfit.corner_noise(self.problem, self.solution, self.noise)
            before, self.noise = self.noise, Noise(corner_sd_px, *passage_noise(residuals, self.problem.sightings))
            there = self.solution.converged and idle > 0
            last = idle + 1 == MOST_IDLE_ROUNDS
            if self._with_new_term() or ((there or last) and self._without_negative_lag()) or self._without_odd_view():
                idle = 0
                continue
            idle += 1
            if last or (there and _settled(before, self.noise)):
                return

    def _without_odd_view(self) -> bool:
        if np.count_nonzero(~self.problem.counted) + 1 > MOST_ODD_SHARE * np.count_nonzero(
            misfit.with_passages(self.problem)
        ):
            return False
        odd = misfit.odd_view(self.problem, self.solution, misfit.of_fit(self.problem, self.solution))
        if odd is None:
            return False
        counted = self.problem.counted.copy()
        counted[odd] = False
        # Terms that were added because of this view are decided again without the view.
        self.free, self.kept = list(self.base), ()
        self.problem = replace(self.problem, tie=self.problem.terms.tied(self.free), counted=counted)
        self.state = rig_state.with_terms_of(self.state, self.base)
        return True

    def _without_negative_lag(self) -> bool:
        spread = np.sqrt(np.diag(self.solution.covariance(self.problem.tie)))
        for group in self.free:
            at = self.problem.terms.at(group)[0] - len(self.problem.terms.names)
            if not group[0].startswith("lag") or self.state.timing[at] >= 0:
                continue
            value, sd = float(self.state.timing[at]), float(spread[at])
            if value < -5 * sd:
                raise Degenerate(
                    "negative-lag",
                    f"mirror would run {digits(-value * 1e6)} us +- {digits(sd * 1e6, 2)} us ahead of its command, "
                    "limit 0; check the polarity and the delay of the scan marker",
                )
            timing = self.state.timing.copy()
            timing[[self.problem.terms.at([name])[0] - len(self.problem.terms.names) for name in group]] = 0.0
            self.state = replace(self.state, timing=timing)
            self.free.remove(group)
            self.problem = replace(self.problem, tie=self.problem.terms.tied(self.free))
            self.kept += (TermDecision("/".join(group), False, value, sd, "not below 0 for any mirror: held at 0"),)
            return True
        return False

    def _with_new_term(self) -> bool:
        timed = any(group[0].startswith("lag") for group in self.free)
        tries = misfit.candidates(self.free, row_delay=timed)
        left_over = misfit.of_fit(self.problem, self.solution).without
        self.decisions = tuple(misfit.tried(self.problem, self.solution, new, left_over) for new in tries)
        chosen = misfit.best(self.decisions)
        if chosen is None:
            return False
        self.free += [(name,) for name in tries[chosen]]
        self.problem = replace(self.problem, tie=self.problem.terms.tied(self.free))
        self.kept += (self.decisions[chosen],)
        return True


def _settled(before: Noise, after: Noise) -> bool:
    sizes = ((n.corner_sd_px, float(np.hypot(n.passage_factor, n.jitter_sd))) for n in (before, after))
    return all(abs(a - b) <= SETTLED_SHARE * max(a, b) for a, b in zip(*sizes, strict=True))


@dataclass(frozen=True, slots=True, eq=False)
class SweepFit:
    """The residuals of the passages of one sweep of a view, in the order of its `Sighting`; arrays are (m,) float64.

    command: the mirror's position, that is the command corrected for lags. residual, sd: in command units.
    """

    view: str
    direction: int
    speed_per_s: float
    x_px: Array
    y_px: Array
    command: Array
    residual: Array
    sd: Array


def sweep_fits(seen: rig_state.Sighting, residual: Array, timing: Array) -> tuple[SweepFit, ...]:
    """The fits of a view's sweeps, from the residuals of its passages. timing: (3,) as in `RigState`."""
    command = mirror_command(timing, seen.command, seen.y_px, seen.velocity_per_s)
    found = []
    for sweep in seen.sweeps:
        velocity = float(seen.velocity_per_s[sweep.start])
        arrays = (values[sweep] for values in (seen.x_px, seen.y_px, command, residual, seen.sd))
        found.append(SweepFit(seen.name, 1 if velocity > 0 else -1, abs(velocity), *arrays))
    return tuple(found)


@dataclass(frozen=True, slots=True, eq=False)
class RigFit:
    """A fitted rig. poses, corner_residual_px and sweeps have one entry for each view, in the order of `views`.
    corner_residual_px: (n, 2), predicted minus seen.

    left_out: names of views without enough corners; outliers: names of views that do not fit the others and were not
    used. noise: estimated from the residuals; corner_scale: median sd of the corners as a multiple of
    `noise.corner_sd_px`. misfit: factor by which variances were multiplied, 1 if the model describes everything.
    condition: condition number of the scaled equations of the free parameters. converged: False if the last fit did
    not converge, as with contradictory data. decisions: about terms and lags. free: the fitted parameters; the names of
    one group share a value. information: (groups, groups), the inverse of the covariance of the groups in `free`. This
    covariance includes the factor `misfit`, but not what `calibration.rig_fit.misfit.widening` adds.
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
    decisions: tuple[TermDecision, ...]
    board: Board
    free: tuple[tuple[str, ...], ...]
    information: Array

    @property
    def every_sweep(self) -> list[SweepFit]:
        """The sweeps of all views."""
        return [sweep for sweeps in self.sweeps for sweep in sweeps]

    @property
    def used(self) -> tuple[str, ...]:
        """Names of the views whose passages were used."""
        pairs = zip(self.views, self.sweeps, strict=True)
        return tuple(name for name, sweeps in pairs if sweeps and name not in self.outliers)

    @property
    def without_line(self) -> tuple[str, ...]:
        """Names of the views with corners, but too few passages on the board."""
        return tuple(name for name, sweeps in zip(self.views, self.sweeps, strict=True) if not sweeps)

    @property
    def corner_rms_px(self) -> float:
        """Root mean square distance, in pixels, of all corners from where the fit puts them."""
        return rms(np.concatenate(self.corner_residual_px))


def result_of(
    fit: Rounds, left_out: tuple[str, ...], board: Board, start: RigModel | None, velocities: Array
) -> RigFit:
    """The result of finished rounds. Properties that were not fitted are taken from `start`, if there is one.

    left_out: names of views without enough corners. velocities: the signed velocities of all sweeps. Raises Degenerate
    if depth is almost unknown.
    """
    problem, solution, state = fit.problem, fit.solution, fit.state
    lags = misfit.lag_decisions(solution, problem, fit.free, state.timing, bool(lag_groups(velocities)))
    names = np.array(problem.terms.names)
    unexplained = misfit.of_fit(problem, solution).factor
    matrix = unexplained * solution.covariance(problem.tie) + misfit.widening(problem, solution, fit.decisions)
    fitted = np.flatnonzero(np.diag(matrix) > 0)
    covariance = Covariance(tuple(names[fitted].tolist()), matrix[np.ix_(fitted, fitted)])
    shown = [seen.velocity_per_s for seen, counts in zip(problem.sightings, problem.counted, strict=True) if counts]
    scanner = state.scanner
    scanner = replace(scanner, angle_rad=_trimmed(scanner.angle_rad, 2), offset_m=_trimmed(scanner.offset_m, 0))
    model = replace(
        RigModel(state.model.camera, scanner) if start is None else start,
        camera=state.model.camera,
        scanner=scanner,
        covariance=covariance,
        lag_s=Lag(*(max(float(lag), 0.0) for lag in state.timing[:2])),
        row_delay_s=float(state.timing[2]),
        provenance={SWEPT: np.unique(np.concatenate(shown)).tolist()},
        speed_range_per_s=speed_range(np.abs(velocities)),
    )
    counted = problem.counted
    fastest = float(velocities[np.argmax(np.abs(velocities))])
    outliers = tuple(seen.name for seen, counts in zip(problem.sightings, counted, strict=True) if not counts)
    said = [pose for pose, counts in zip(state.poses, counted, strict=True) if counts]
    rig_state.check_depth(model, said, solution.condition, fastest, unexplained, outliers)
    return RigFit(
        model=model,
        views=tuple(seen.name for seen in problem.sightings),
        poses=state.poses,
        corner_residual_px=tuple(rows.residual.reshape(2, -1).T for rows, _ in solution.rows),
        sweeps=tuple(
            sweep_fits(seen, rows.residual, state.timing)
            for seen, (_, rows) in zip(problem.sightings, solution.rows, strict=True)
        ),
        left_out=left_out,
        outliers=outliers,
        noise=fit.noise,
        corner_scale=float(np.median(np.concatenate([seen.corner_scale for seen in problem.sightings]))),
        misfit=unexplained,
        condition=solution.condition,
        converged=solution.converged,
        decisions=(*fit.kept, *fit.decisions, *lags),
        board=board,
        free=tuple(fit.free),
        information=problem.tie.T @ solution.matrix @ problem.tie / unexplained,
    )


def _trimmed(terms: Array, least: int) -> Array:
    """The terms without the zeros at the end, but at least `least` of them."""
    used = np.flatnonzero(terms)
    return terms[: max(least, int(used[-1]) + 1 if used.size else 0)]


def fit_rig(
    views: Sequence[View],
    board: Board,
    size: tuple[int, int],
    *,
    camera: Camera | None = None,
    known: Covariance | None = None,
    start: RigModel | None = None,
) -> RigFit:
    """Fit a rig to views of a board; size: (width, height) of the picture.

    camera: the start value of the camera (None: `start`'s or OpenCV's).
    known: covariance of that camera from pictures other than these, by the names of its parameters. Parameters with a
    variance of 0 are known exactly and not fitted.
    start: its mirror and times are the start values of the fit, unless it holds a table of planes. What is not fitted
    is kept, such as source and defects; its command range grows if passages lie outside.
    Raises Degenerate, with the reason, if the views do not determine a model, and CalibrationError if the camera's
    sensor has another size or is tilted.
    """
    shown = rig_state.usable(views)
    if not shown:
        rig_state.check_views(views, ())
    camera = _first_camera(shown, board, size, camera, start)
    seen = [view.corners for view in shown if view.corners is not None]
    poses = [rig_state.first_pose(camera, board.corners_m[one.ids], np.asarray(one.px, np.float64)) for one in seen]
    sightings = tuple(rig_state.sighting(view, board, camera, pose) for view, pose in zip(shown, poses, strict=True))
    rig_state.check_views(views, sightings)
    terms = Terms(camera.distortion.size)
    try:
        state = _first_state(camera, poses, sightings, start)
    except Degenerate:
        raise
    except (CalibrationError, np.linalg.LinAlgError) as error:
        raise rig_state.no_start(error, poses) from error
    velocities = np.unique(np.concatenate([seen.velocity_per_s for seen in sightings]))
    exact = () if known is None else tuple(np.array(known.names)[np.diag(known.matrix) == 0])
    groups: list[tuple[str, ...]] = [(name,) for name in terms.camera if name not in exact]
    groups += [(name,) for name in (*AXIS, "angle_0", "angle_1")]
    groups += lag_groups(velocities)
    state = rig_state.with_terms_of(state, groups)
    prior = None if known is None else camera_prior(known, camera, terms)
    problem = RigProblem(sightings, terms, terms.tied(groups), np.ones(len(shown), bool), prior)
    problem, noise = _first_noise(problem, state)
    fit = Rounds(problem, tuple(groups), state, noise)
    try:
        fit.run()
    except np.linalg.LinAlgError as error:
        raise rig_state.no_start(error, poses) from error
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


def _first_state(
    camera: Camera, poses: Sequence[BoardPose], sightings: Sequence[rig_state.Sighting], start: RigModel | None
) -> rig_state.RigState:
    points = rig_state.board_points(camera, sightings, poses)
    rig_state.check_poses(points.points_m, poses)
    low, high = (-1.0, 1.0) if start is None else start.scanner.command_range
    low, high = min(low, float(points.command.min())), max(high, float(points.command.max()))
    if start is not None and isinstance(start.scanner, PivotScanner):
        scanner, timing = start.scanner, np.array([*start.lag_s, start.row_delay_s])
    else:
        scanner, timing = rig_state.first_scanner(points, (low, high))
    angle, offset = np.zeros(ANGLE_TERMS), np.zeros(OFFSET_TERMS)
    angle[: scanner.angle_rad.size] = scanner.angle_rad[:ANGLE_TERMS]
    offset[: scanner.offset_m.size] = scanner.offset_m[:OFFSET_TERMS]
    scanner = replace(scanner, angle_rad=angle, offset_m=offset, command_range=(low, high))
    source = None if start is None else start.source_m
    return rig_state.first_state(RigModel(camera, scanner, source_m=source), timing, poses, sightings)


def _first_noise(problem: RigProblem, state: rig_state.RigState) -> tuple[RigProblem, Noise]:
    """The problem with passages' sd restated from their errors, and a first estimate of the noise."""
    rows = all_rows(state, problem.sightings, problem.terms)
    corners, passages = ([pair[which].residual for pair in rows] for which in (0, 1))
    problem = replace(problem, sightings=restated(passages, problem.sightings))
    factor, jitter, reach = passage_noise(passages, problem.sightings)
    return problem, Noise(max(robust_sd(np.concatenate(corners)), 1e-4), factor, jitter, reach)
