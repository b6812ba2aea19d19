"""The least squares of a rig's fit: Gauss-Newton steps in scaled parameters, damped if they do not help.

The normal equations take one view at a time and eliminate its pose.

Passages of one instant share the mirror's jitter, of sd s. With V the covariance of the passages in one bin of
instants, and D the diagonal of their own variances,

    V = D + s^2 11',    V^-1 = D^-1 - k (D^-1 1)(D^-1 1)',    k = s^2 / (1 + s^2 1'D^-1 1)

where 1 is a column of ones. So a bin contributes the sum over its passages minus k times a product of sums. A view's
pose affects only that view: with its equations N = [[A, B'], [B, C]] (A of shared parameters, C of the pose) the view
adds A - B'C^-1 B to the shared equations, and its pose follows from their solution.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibration.arrays import Array
from calibration.errors import CalibrationError, Degenerate, condition_text
from calibration.model.camera import Camera
from calibration.model.rig_model import Covariance
from calibration.rig_fit.noise import Noise, bin_starts, tail_weight
from calibration.rig_fit.rig_state import RigState, Sighting
from calibration.rig_fit.rows import Rows, Terms

_USUAL_MISS = float(np.sqrt(np.log(2.0)))
"""Median of a distance in a plane whose mean square is 1 (Rayleigh's distribution)."""


@dataclass(frozen=True, slots=True, eq=False)
class ViewNormal:
    """The normal equations of a view after elimination of its pose.

    matrix (p, p), right (p,); pose_by_shared (6, p), pose_alone (6,) and pose_inverse (6, 6): the pose's change is
    pose_alone - pose_by_shared @ shared. chi2 of (corners, passages). corner_part, passage_part: (p + 6, p + 6), their
    contributions before the elimination; corner_right: (p + 6,).
    """

    matrix: Array
    right: Array
    pose_by_shared: Array
    pose_alone: Array
    pose_inverse: Array
    chi2: tuple[float, float]
    corner_part: Array
    corner_right: Array
    passage_part: Array

    def joint(self, covariance: Array) -> Array:
        """(p + 6, p + 6) covariance of the shared parameters together with this view's pose.

        covariance: (p, p), that of the shared parameters.
        """
        across = -covariance @ self.pose_by_shared.T
        own = self.pose_inverse - self.pose_by_shared @ across
        return np.block([[covariance, across], [across.T, own]])


class Weights(NamedTuple):
    """Weights in a view: of corners' coordinates (2 n,), of passages (m,); and the starts of bins that share jitter."""

    corners: Array
    passages: Array
    starts: NDArray[np.int64]


def weights(rows: Sequence[tuple[Rows, Rows]], sightings: Sequence[Sighting], noise: Noise) -> list[Weights]:
    """Inverse variances in each view, reduced for residuals in the tails."""
    found = []
    for (corner, passage), seen in zip(rows, sightings, strict=True):
        corners = np.tile(corner_weights(corner.residual.reshape(2, -1), noise.corner_sd_px * seen.corner_scale), 2)
        own = (noise.passage_factor * seen.sd) ** 2
        away = passage.residual / np.sqrt(own + noise.jitter_sd**2)
        passages = np.concatenate([np.zeros(0), *(tail_weight(away[sweep]) for sweep in seen.sweeps)]) / own
        found.append(Weights(corners, passages, bin_starts(seen, noise.reach)))
    return found


def corner_weights(residual_px: Array, sd_px: Array) -> Array:
    """(n,) weights of either coordinate, for corners with residuals (2, n). sd_px: (n,) of a coordinate."""
    miss = np.hypot(*residual_px) / (sd_px * np.sqrt(2.0))
    return tail_weight(miss, _USUAL_MISS) / sd_px**2


def all_rows(state: RigState, sightings: Sequence[Sighting], terms: Terms) -> list[tuple[Rows, Rows]]:
    """Residuals and derivatives of all views."""
    return [state.rows(view, seen, terms) for view, seen in enumerate(sightings)]


def normals(rows: Sequence[tuple[Rows, Rows]], weight: Sequence[Weights], jitter: float) -> list[ViewNormal]:
    """The normal equations of each view. jitter: variance of the mirror's jitter, in squared command units."""
    return [view_normal(*pair, of_view, jitter) for pair, of_view in zip(rows, weight, strict=True)]


def view_normal(corners: Rows, passages: Rows, weight: Weights, jitter: float) -> ViewNormal:
    """The normal equations of one view after elimination of its pose.

    jitter: variance of the mirror's jitter, in squared command units. Raises LinAlgError if the equations do not
    determine the pose."""
    of_corners, corner_right, corner_chi2 = _products(corners, weight.corners)
    of_passages, passage_right, passage_chi2 = _products(passages, weight.passages)
    if jitter and weight.starts.size:
        whole = np.hstack([passages.shared, passages.pose, passages.residual[:, None]])
        sums = np.add.reduceat(whole * weight.passages[:, None], weight.starts)
        share = jitter / (1 + jitter * np.add.reduceat(weight.passages, weight.starts))
        less = (sums * share[:, None]).T @ sums
        of_passages, passage_right = of_passages - less[:-1, :-1], passage_right - less[:-1, -1]
        passage_chi2 -= float(less[-1, -1])
    matrix, right = of_corners + of_passages, corner_right + passage_right
    p = corners.shared.shape[1]
    inverse: Array = np.asarray(np.linalg.inv(matrix[p:, p:]), np.float64)
    by_shared = inverse @ matrix[p:, :p]
    return ViewNormal(
        matrix=matrix[:p, :p] - matrix[:p, p:] @ by_shared,
        right=-(right[:p] - by_shared.T @ right[p:]),
        pose_by_shared=by_shared,
        pose_alone=-inverse @ right[p:],
        pose_inverse=inverse,
        chi2=(corner_chi2, passage_chi2),
        corner_part=of_corners,
        corner_right=-corner_right,
        passage_part=of_passages,
    )


def _products(rows: Rows, weight: Array) -> tuple[Array, Array, float]:
    whole = np.hstack([rows.shared, rows.pose])
    weighted = whole * weight[:, None]
    return weighted.T @ whole, weighted.T @ rows.residual, float(weight @ rows.residual**2)


MOST_STEPS = 12
WEIGHED_STEPS = 6
"""Steps after which the weights of outliers are kept: with new weights in every step a fit may never converge."""
CONVERGED_CHI2 = 1e-3
"""A fit has converged if the next step promises less gain in chi2 than this: 0.03 sd along any parameter."""
ROUGH_SHARE = 1e-4
"""A rough fit, good enough for decisions, ends if the next step promises a gain in chi2 below 1 plus this share of
it."""
WORSE_CHI2 = 0.1
"""Amount by which a step may raise chi2: derivatives are exact except for how a bow changes along the line."""
MOST_DAMPING = 1e8
MOST_CONDITION = 1e12
"""Largest condition number of the scaled equations; beyond it float64 leaves no digits of the worst direction."""


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """Knowledge about the camera from elsewhere. matrix: information (inverse covariance) of all p parameters, zero
    for those that are not the camera's. values: (p,), the values expected.
    """

    matrix: Array
    values: Array


@dataclass(frozen=True, slots=True, eq=False)
class RigProblem:
    """The data and the parameters of a fit.

    tie: (p, q) maps free parameters to shared ones. counted: (views,), False if a view has its own pose but does not
    influence the shared parameters. prior: knowledge about the camera's terms, or None.
    """

    sightings: tuple[Sighting, ...]
    terms: Terms
    tie: Array
    counted: NDArray[np.bool_]
    prior: Prior | None = None


@dataclass(frozen=True, slots=True, eq=False)
class RigSolution:
    """A state with its residuals and equations. jitter: variance of the mirror's jitter. matrix, right: equations of
    all shared parameters, (p, p) and (p,). condition: condition number of the free parameters' equations. converged:
    whether the next step promises too little to be worth taking."""

    state: RigState
    rows: list[tuple[Rows, Rows]]
    weight: list[Weights]
    jitter: float
    views: list[ViewNormal]
    matrix: Array
    right: Array
    condition: float
    converged: bool

    def covariance(self, tie: Array) -> Array:
        """(p, p) covariance of the shared parameters, 0 for those that are not free."""
        inverse, _ = scaled_inverse(tie.T @ self.matrix @ tie)
        return tie @ inverse @ tie.T


def solved(problem: RigProblem, state: RigState, noise: Noise, *, roughly: bool = False) -> RigSolution:
    """The best state for this noise; `converged` is False if no step helps or MOST_STEPS are over before it is reached.

    roughly: whether to stop once the state is accurate enough for decisions. Raises Degenerate if the equations do not
    determine the free parameters, LinAlgError if they do not determine a view's pose.
    """
    rows = all_rows(state, problem.sightings, problem.terms)
    damping, jitter = 0.0, noise.jitter_sd**2
    for step in range(MOST_STEPS):
        if step < WEIGHED_STEPS:
            weight = weights(rows, problem.sightings, noise)
        views = normals(rows, weight, jitter)
        chi2 = _chi2(views, problem, state)
        counted = _counted(views, problem)
        matrix: Array = np.sum([view.matrix for view in counted], axis=0)
        right: Array = np.sum([view.right for view in counted], axis=0)
        if problem.prior is not None:
            matrix = matrix + problem.prior.matrix
            right = right + problem.prior.matrix @ _off(problem.prior, problem.terms, state)
        inverse, condition = scaled_inverse(problem.tie.T @ matrix @ problem.tie)
        free = problem.tie.T @ right
        promised = float(free @ inverse @ free) + sum(_own_promise(view) for view in counted)
        there = promised < (1 + ROUGH_SHARE * chi2 if roughly else CONVERGED_CHI2)
        solution = RigSolution(state, rows, weight, jitter, views, matrix, right, condition, there)
        if there:
            break
        tried = None
        while tried is None and damping < MOST_DAMPING:
            shared = problem.tie @ _damped(problem.tie.T @ matrix @ problem.tie, free, damping)
            tried = _tried(problem, state, shared, views)
            if tried is not None:
                rows = all_rows(tried, problem.sightings, problem.terms)
                if _chi2(normals(rows, weight, jitter), problem, tried) > chi2 + WORSE_CHI2:
                    tried = None
            damping = max(10 * damping, 1e-4) if tried is None else damping / 10 if damping > 1e-5 else 0.0
        if tried is None:
            break
        state = tried
    return solution


def scaled_inverse(matrix: Array) -> tuple[Array, float]:
    """(inverse, condition number at unit diagonal) of an information matrix. Raises Degenerate if this is practically
    singular.
    """
    weight = np.diag(matrix)
    if not np.all(np.isfinite(matrix)) or np.any(weight <= 0):
        raise Degenerate(
            "no-tilt",
            "some parameters of the rig change nothing that is seen (condition number inf); show the board at more "
            "poses, tilted differently",
        )
    scale = 1 / np.sqrt(weight)
    values, vectors = np.linalg.eigh(matrix * scale[:, None] * scale)
    condition = float(values[-1] / values[0]) if values[0] > 0 else np.inf
    if condition > MOST_CONDITION:
        raise Degenerate(
            "no-tilt",
            f"views do not fix all parameters of the rig: condition number {condition_text(condition)}, limit "
            f"{condition_text(MOST_CONDITION)}; show the board at more poses, at other distances and tilted "
            "differently",
        )
    return (vectors / values) @ vectors.T * scale[:, None] * scale, condition


def _damped(matrix: Array, right: Array, damping: float) -> Array:
    """The damped step of the free parameters."""
    scale = 1 / np.sqrt(np.diag(matrix))
    scaled = matrix * scale[:, None] * scale + damping * np.eye(len(scale))
    return scale * np.linalg.solve(scaled, scale * right)


def _tried(problem: RigProblem, state: RigState, shared: Array, views: Sequence[ViewNormal]) -> RigState | None:
    poses = [view.pose_alone - view.pose_by_shared @ shared for view in views]
    try:
        return state.stepped(problem.terms, shared, poses, problem.sightings)
    except CalibrationError:  # a step too far, past any real rig
        return None


def _own_promise(view: ViewNormal) -> float:
    return float(view.pose_alone @ np.linalg.solve(view.pose_inverse, view.pose_alone))


def _chi2(views: Sequence[ViewNormal], problem: RigProblem, state: RigState) -> float:
    """Chi2; inf if chi2 or a derivative is no finite number, as when a lens folds within the picture."""
    if not all(np.isfinite(view.matrix).all() for view in views):
        return np.inf
    total = sum(sum(view.chi2) for view in _counted(views, problem))
    if problem.prior is not None:
        off = _off(problem.prior, problem.terms, state)
        total += float(off @ problem.prior.matrix @ off)
    return total if np.isfinite(total) else np.inf


def _counted(views: Sequence[ViewNormal], problem: RigProblem) -> list[ViewNormal]:
    return [view for view, counts in zip(views, problem.counted, strict=True) if counts]


def camera_prior(known: Covariance, camera: Camera, terms: Terms) -> Prior | None:
    """The prior from a camera and its covariance, from other pictures; None if no parameter to fit has a variance."""
    variance = dict(zip(known.names, np.diag(known.matrix), strict=True))
    names = [name for name in known.names if name in terms.camera and variance[name] > 0]
    if not names:
        return None
    at = terms.at(names)
    matrix: Array = np.zeros((len(terms.names), len(terms.names)))
    matrix[np.ix_(at, at)] = scaled_inverse(known.of(names))[0]
    return Prior(matrix, _camera_values(camera, terms))


def _off(prior: Prior, terms: Terms, state: RigState) -> Array:
    """The prior's values less those of the state."""
    return prior.values - _camera_values(state.model.camera, terms)


def _camera_values(camera: Camera, terms: Terms) -> Array:
    """The camera's values (p,), 0 for the other parameters."""
    values: Array = np.zeros(len(terms.names))
    (fx, _, cx), (_, fy, cy) = camera.matrix[:2]
    values[: 4 + terms.lens] = [fx, fy, cx, cy, *camera.distortion[: terms.lens]]
    return values
