"""The result of a fit of a whole rig: model with covariance, residuals of each sweep's passages, and what had a say."""

from dataclasses import dataclass, replace

import numpy as np

from calibration.arrays import Array
from calibration.board.board import Board
from calibration.model.parameters import SWEPT, speed_range
from calibration.model.rig_model import Covariance, Lag, RigModel
from calibration.rig_fit.misfit import TermDecision, lag_decisions, misfit, widening
from calibration.rig_fit.noise import Noise
from calibration.rig_fit.rounds import Rounds
from calibration.rig_fit.rows import mirror_command, sheet_rows
from calibration.rig_fit.solve import RigProblem
from calibration.rig_fit.start import board_points, check_depth
from calibration.rig_fit.state import RigState, Sighting
from calibration.views import BoardPose


@dataclass(frozen=True, slots=True, eq=False)
class SweepFit:
    """The residuals of the passages of one sweep of a view; all float64 (m,), sorted by command.

    command: the mirror's, as the model has it. residual, sd: in command units. distance_m: how far the point on the
    board lies off the light.
    """

    direction: int
    speed_per_s: float
    x_px: Array
    y_px: Array
    command: Array
    residual: Array
    distance_m: Array
    sd: Array


def sweep_fits(seen: Sighting, residual: Array, state: RigState, view: int) -> tuple[SweepFit, ...]:
    """The fits of a view's sweeps, from the residuals of its passages."""
    command = mirror_command(state.timing, seen.command, seen.y_px, seen.velocity_per_s)
    points = board_points(state.model.camera, [seen], [state.poses[view]]).points_m
    per_command_m = sheet_rows(
        state.scanner, state.model.source_m, points, command, seen.y_px, seen.velocity_per_s
    ).per_command
    found = []
    for sweep in seen.sweeps:
        velocity = seen.velocity_per_s[sweep]
        found.append(
            SweepFit(
                direction=1 if velocity[0] > 0 else -1,
                speed_per_s=float(abs(velocity[0])),
                x_px=seen.x_px[sweep],
                y_px=seen.y_px[sweep],
                command=command[sweep],
                residual=residual[sweep],
                distance_m=residual[sweep] * per_command_m[sweep],
                sd=seen.sd[sweep],
            )
        )
    return tuple(found)


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
    decisions: tuple[TermDecision, ...]
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


def result_of(
    fit: Rounds, left_out: tuple[str, ...], board: Board, start: RigModel | None, velocities: Array
) -> RigFit:
    """The result of rounds that have run.

    left_out: names of views without corners. start: the model whose source, defects and command range are kept, None
    for none. velocities: (sweeps,) of all sweeps, per second. Raises Degenerate where depth is next to unknown.
    """
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


def _swept(problem: RigProblem) -> list[float]:
    """Signed velocities of the sweeps that had a say."""
    shown = [seen.velocity_per_s for seen, counts in zip(problem.sightings, problem.counted, strict=True) if counts]
    swept: list[float] = np.unique(np.concatenate(shown)).tolist()
    return swept


def _trimmed(terms: Array, least: int) -> Array:
    """The terms without the zeros at the end."""
    used = np.flatnonzero(terms)
    return terms[: max(least, int(used[-1]) + 1 if used.size else 0)]
