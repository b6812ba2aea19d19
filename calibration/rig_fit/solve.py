"""The least squares of a rig's fit: Gauss-Newton steps, damped where they do not help, in scaled parameters."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.digits import condition_text
from calibration.errors import CalibrationError, Degenerate
from calibration.model.camera import Camera
from calibration.model.covariance import Covariance
from calibration.rig_fit.noise import Noise
from calibration.rig_fit.normal import ViewNormal, Weights, all_rows, normals, weights
from calibration.rig_fit.rows import Rows, Terms
from calibration.rig_fit.sightings import Sighting
from calibration.rig_fit.state import RigState

Array = NDArray[np.float64]

MOST_STEPS = 12
WEIGHED_STEPS = 6
"""After these, who is an outlier stays one: weights that follow every step never come to rest."""
CONVERGED_CHI2 = 1e-3
"""Promised by the next step: 0.03 of a standard deviation along any parameter."""
ROUGH_SHARE = 1e-4
"""Of chi2, that the next step may promise where a term is only looked for."""
WORSE_CHI2 = 0.1
"""A step may do harm by this: derivatives are exact but for how a bow changes along the line."""
MOST_DAMPING = 1e8
MOST_CONDITION = 1e12
"""Of the scaled equations; beyond it float64 leaves no digits of the worst direction."""


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """What is known of the camera from elsewhere. matrix: (p, p) information, 0 for the rest, at the values (p,)."""

    matrix: Array
    values: Array


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """What is fitted to what. tie: (p, q), shared parameters by free ones. counted: (views,), False where a view has
    a pose of its own but no say in what all share. prior: on the camera's terms, or None.
    """

    sightings: tuple[Sighting, ...]
    terms: Terms
    tie: Array
    counted: NDArray[np.bool_]
    prior: Prior | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """A state with its residuals, its equations (matrix (p, p), right (p,): of the shared parameters, whether free or
    not) and the condition of the free ones.
    """

    state: RigState
    rows: list[tuple[Rows, Rows]]
    weight: Weights
    views: list[ViewNormal]
    matrix: Array
    right: Array
    condition: float
    converged: bool

    def covariance(self, tie: Array) -> Array:
        """(p, p) of the shared parameters, 0 where they are not free."""
        inverse, _ = scaled_inverse(tie.T @ self.matrix @ tie)
        result: Array = tie @ inverse @ tie.T
        return result


def solved(problem: Problem, state: RigState, noise: Noise, *, roughly: bool = False) -> Solution:
    """The best state under this noise, or as near to it as a few steps lead; roughly: as near as decisions need.

    Raises Degenerate where the equations have no single solution.
    """
    rows = all_rows(state, problem.sightings, problem.terms)
    damping = 0.0
    for step in range(MOST_STEPS):
        if step < WEIGHED_STEPS:
            weight = weights(rows, problem.sightings, noise)
        views = normals(rows, weight)
        chi2 = _chi2(views, problem, state)
        matrix, right = equations(views, problem, state)
        inverse, condition = scaled_inverse(problem.tie.T @ matrix @ problem.tie)
        free = problem.tie.T @ right
        promised = float(free @ inverse @ free) + sum(_own_promise(view) for view in _counted(views, problem))
        there = promised < (1 + ROUGH_SHARE * chi2 if roughly else CONVERGED_CHI2)
        solution = Solution(state, rows, weight, views, matrix, right, condition, there)
        if there:
            break
        tried = None
        while tried is None and damping < MOST_DAMPING:
            shared = problem.tie @ _damped(problem.tie.T @ matrix @ problem.tie, free, damping)
            tried = _tried(problem, state, shared, views)
            if tried is not None:
                rows = all_rows(tried, problem.sightings, problem.terms)
                if _chi2(normals(rows, weight), problem, tried) > chi2 + WORSE_CHI2:
                    tried = None
            damping = max(10 * damping, 1e-4) if tried is None else damping / 10 if damping > 1e-5 else 0.0
        if tried is None:
            break
        state = tried
    return solution


def equations(views: Sequence[ViewNormal], problem: Problem, state: RigState) -> tuple[Array, Array]:
    """(matrix, right) of the shared parameters: all views and what was known before."""
    counted = _counted(views, problem)
    matrix: Array = np.sum([view.matrix for view in counted], axis=0)
    right: Array = np.sum([view.right for view in counted], axis=0)
    if problem.prior is not None:
        matrix = matrix + problem.prior.matrix
        right = right + problem.prior.matrix @ _off(problem.prior, problem.terms, state)
    return matrix, right


def scaled_inverse(matrix: Array) -> tuple[Array, float]:
    """(inverse, condition number) of an information matrix, its parameters scaled to the same weight.

    Raises Degenerate where it has no inverse worth the name.
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
    inverse: Array = (vectors / values) @ vectors.T * scale[:, None] * scale
    return inverse, condition


def _damped(matrix: Array, right: Array, damping: float) -> Array:
    """Step of the free parameters."""
    scale = 1 / np.sqrt(np.diag(matrix))
    scaled = matrix * scale[:, None] * scale + damping * np.eye(len(scale))
    result: Array = scale * np.linalg.solve(scaled, scale * right)
    return result


def _tried(problem: Problem, state: RigState, shared: Array, views: Sequence[ViewNormal]) -> RigState | None:
    poses = [view.pose_alone - view.pose_by_shared @ shared for view in views]
    try:
        return state.stepped(problem.terms, shared, poses, problem.sightings)
    except CalibrationError:  # a step too far, past any real rig
        return None


def _own_promise(view: ViewNormal) -> float:
    return float(view.pose_alone @ np.linalg.solve(view.pose_inverse, view.pose_alone))


def _chi2(views: Sequence[ViewNormal], problem: Problem, state: RigState) -> float:
    """Chi2; inf where it or its slopes are no numbers, as where a lens folds within the picture."""
    if not all(np.isfinite(view.matrix).all() for view in views):
        return np.inf
    total = sum(sum(view.chi2) for view in _counted(views, problem))
    if problem.prior is not None:
        off = _off(problem.prior, problem.terms, state)
        total += float(off @ problem.prior.matrix @ off)
    return total if np.isfinite(total) else np.inf


def _counted(views: Sequence[ViewNormal], problem: Problem) -> list[ViewNormal]:
    return [view for view, counts in zip(views, problem.counted, strict=True) if counts]


def camera_prior(known: Covariance, camera: Camera, terms: Terms) -> Prior:
    """What other pictures told of the camera."""
    variance = dict(zip(known.names, np.diag(known.matrix), strict=True))
    names = [name for name in known.names if name in terms.camera and variance[name] > 0]
    at = terms.at(names)
    matrix: Array = np.zeros((len(terms.names), len(terms.names)))
    matrix[np.ix_(at, at)] = scaled_inverse(known.of(names))[0]
    return Prior(matrix, _camera_values(camera, terms))


def _off(prior: Prior, terms: Terms, state: RigState) -> Array:
    """What the prior's values are more than those of the state."""
    off: Array = prior.values - _camera_values(state.model.camera, terms)
    return off


def _camera_values(camera: Camera, terms: Terms) -> Array:
    """(p,), 0 for what is not the camera's."""
    values: Array = np.zeros(len(terms.names))
    (fx, _, cx), (_, fy, cy) = camera.matrix[:2]
    values[: 4 + terms.lens] = [fx, fy, cx, cy, *camera.distortion[: terms.lens]]
    return values
