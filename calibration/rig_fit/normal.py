"""Normal equations of a rig's fit: one view at a time, its pose eliminated.

Passages of one instant share the mirror's jitter s: V = D + s^2 11' for each bin. Its inverse is
D^-1 - k (D^-1 1)(D^-1 1)', k = s^2 / (1 + s^2 1'D^-1 1), so what a bin adds is the sum over its passages less k times a
product of sums. A view's pose only touches that view: with N = [[A, B'], [B, C]] (A shared, C the pose's own) the view
adds A - B'C^-1 B to the shared equations, and its pose follows from theirs.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.rig_fit.noise import Noise, bin_starts, tail_weight
from calibration.rig_fit.rows import Rows, Terms
from calibration.rig_fit.sightings import Sighting
from calibration.rig_fit.state import RigState

Array = NDArray[np.float64]

_USUAL_MISS = float(np.sqrt(np.log(2.0)))
"""Median of a distance in a plane (Rayleigh's distribution), its mean square 1."""


@dataclass(frozen=True, slots=True, eq=False)
class ViewNormal:
    """What a view adds, its pose eliminated. matrix (p, p), right (p,); pose_by_shared (6, p), pose_alone (6,) and
    pose_inverse (6, 6): the pose's change is pose_alone - pose_by_shared @ shared. chi2 of (corners, passages).
    corner_part, passage_part: (p + 6, p + 6) what each adds before the elimination; corner_right: (p + 6,).
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
        """(p + 6, p + 6) covariance of the shared parameters, which have (p, p), and of this view's pose."""
        across = -covariance @ self.pose_by_shared.T
        own = self.pose_inverse - self.pose_by_shared @ across
        return np.block([[covariance, across], [across.T, own]])


@dataclass(frozen=True, slots=True, eq=False)
class Weights:
    """Per view: of the corners' coordinates (2 n,), of the passages (m,), where bins of shared jitter start, and its
    variance.
    """

    corners: tuple[Array, ...]
    passages: tuple[Array, ...]
    starts: tuple[NDArray[np.int64], ...]
    jitter: float


def weights(rows: Sequence[tuple[Rows, Rows]], sightings: Sequence[Sighting], noise: Noise) -> Weights:
    """Inverse variances, less for what lies in the tails."""
    corners, passages, starts = [], [], []
    for (corner, passage), seen in zip(rows, sightings, strict=True):
        sd_px = noise.corner_sd_px * seen.corner_scale
        corners.append(np.tile(corner_weights(corner.residual.reshape(2, -1), sd_px), 2))
        own = (noise.passage_factor * seen.sd) ** 2
        away = passage.residual / np.sqrt(own + noise.jitter_sd**2)
        passages.append(np.concatenate([np.zeros(0), *(tail_weight(away[sweep]) for sweep in seen.sweeps)]) / own)
        starts.append(bin_starts(seen, noise.reach))
    return Weights(tuple(corners), tuple(passages), tuple(starts), noise.jitter_sd**2)


def corner_weights(residual_px: Array, sd_px: Array) -> Array:
    """(n,) of either coordinate of corners that are off by (2, n); sd_px: (n,) of a coordinate."""
    miss = np.hypot(*residual_px) / (sd_px * np.sqrt(2.0))
    weight: Array = tail_weight(miss, _USUAL_MISS) / sd_px**2
    return weight


def all_rows(state: RigState, sightings: Sequence[Sighting], terms: Terms) -> list[tuple[Rows, Rows]]:
    """Residuals and derivatives of all views."""
    return [state.rows(view, seen, terms) for view, seen in enumerate(sightings)]


def normals(rows: Sequence[tuple[Rows, Rows]], weight: Weights) -> list[ViewNormal]:
    """The normal equations of each view."""
    return [
        view_normal(corner, passage, weight.corners[view], weight.passages[view], weight.starts[view], weight.jitter)
        for view, (corner, passage) in enumerate(rows)
    ]


def view_normal(
    corners: Rows, passages: Rows, corner_weight: Array, weight: Array, starts: NDArray[np.int64], jitter: float
) -> ViewNormal:
    """The normal equations of one view, its pose eliminated."""
    of_corners, corner_right, corner_chi2 = _products(corners, corner_weight)
    of_passages, passage_right, passage_chi2 = _products(passages, weight)
    if jitter and starts.size:
        whole = np.hstack([passages.shared, passages.pose, passages.residual[:, None]])
        sums = np.add.reduceat(whole * weight[:, None], starts)
        share = jitter / (1 + jitter * np.add.reduceat(weight, starts))
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
