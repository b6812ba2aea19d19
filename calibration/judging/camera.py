"""From a fit of the camera alone to its verdict: how well it knows where rays go, in pixels.

A camera whose rays are all turned by one angle is as good as before, since the mirror is calibrated with it. So the
error of a pixel is what is left of J C J' when the best common rotation of all rays is taken off J.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.board.board import Board
from calibration.camera_fit.fit import CameraFit
from calibration.digits import digits
from calibration.judging.data_lack import data_lack, hiding
from calibration.judging.evidence import pose_evidence, view_evidence
from calibration.model.camera import Camera
from calibration.model.covariance import Covariance
from calibration.model.parameters import changed_camera
from calibration.verdict import WORST_TIMES, Verdict, more_poses, unguided
from calibration.views import View

Array = NDArray[np.float64]

ACCURACY_PX = 0.1
"""Good enough: no estimator finds the stripe better in fog."""
_GRID = 16
_STEP = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class JudgedCamera:
    """A verdict and what it was made of: sd_px, worst_px: of a pixel's place along the row, median and 95 %. coverage:
    share of the picture within the outline of all corners.
    """

    verdict: Verdict
    sd_px: float
    worst_px: float
    coverage: float

    def line(self) -> str:
        """One line."""
        return f"rays are known to {_px(self.sd_px)} (95 % of the picture: {_px(self.worst_px)})"


def judge_camera(fit: CameraFit, views: Sequence[View], board: Board, *, photons: bool) -> JudgedCamera:
    """Judge a fit of `views`. photons: whether their pictures count photons; grey levels tell nothing of the light."""
    camera = fit.camera
    sd = ray_sd_px(camera, fit.covariance)
    median, worst = float(np.median(sd)), float(np.percentile(sd, 95))
    imprecise = not (median <= ACCURACY_PX and worst <= WORST_TIMES * ACCURACY_PX)
    pairs = zip(fit.views, fit.poses, strict=True)
    evidence = view_evidence(views, (camera.width, camera.height), len(fit.kept), fit.dropped)
    poses = pose_evidence([pose for name, pose in pairs if name in fit.kept], board)
    lacking = data_lack(evidence, poses, imprecise=imprecise, photons=photons)
    reasons = [*hiding(evidence, poses, photons=photons), *lacking]
    if imprecise and not reasons:
        found = median, worst
        reasons = [more_poses(len(fit.kept), "rays are known to", found, ACCURACY_PX, _px)]
    return JudgedCamera(unguided(Verdict(not reasons, tuple(reasons))), median, worst, evidence.coverage)


def _px(length_px: float) -> str:
    return f"{digits(length_px, 2)} px"


def ray_sd_px(camera: Camera, covariance: Covariance) -> Array:
    """(n,) sd along the row of where rays of a grid over the picture are seen, a common rotation taken off."""
    x, y = np.meshgrid(np.linspace(0, camera.width - 1, _GRID), np.linspace(0, camera.height - 1, _GRID))
    u, v = camera.tangents_at(x.ravel(), y.ravel())
    known = np.isfinite(u)
    rays = np.stack([u[known], v[known], np.ones(np.count_nonzero(known))], axis=-1)

    def seen(tried: Camera, points: Array) -> Array:
        return np.concatenate(tried.project(points))

    slopes = np.stack(
        [
            (seen(changed_camera(camera, {name: _STEP}), rays) - seen(changed_camera(camera, {name: -_STEP}), rays))
            / (2 * _STEP)
            for name in covariance.names
        ],
        axis=-1,
    )
    still = seen(camera, rays)
    turned = np.stack(
        [(seen(camera, rays + _STEP * np.cross(axis, rays)) - still) / _STEP for axis in np.eye(3)],
        axis=-1,
    )
    sound = np.isfinite(slopes).all(axis=1) & np.isfinite(turned).all(axis=1)
    basis = np.linalg.qr(turned[sound])[0]
    left = slopes[sound] - basis @ (basis.T @ slopes[sound])
    along_row = np.flatnonzero(sound) < len(rays)
    variance = np.einsum("ni,ij,nj->n", left, covariance.matrix, left)[along_row]
    result: Array = np.sqrt(np.maximum(variance, 0.0))
    return result
