"""The normal equations of a camera and its boards' poses: how well corners determine the camera, poses left free."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.model.covariance import Covariance
from calibration.model.parameters import DISTORTION, MATRIX
from calibration.views import BoardPose

Array = NDArray[np.float64]

_POSE = 6
"""OpenCV's columns: rotation, position, then fx fy cx cy and the distortion."""


@dataclass(frozen=True, slots=True, eq=False)
class Normal:
    """matrix: (p, p) float64, J^T J of the camera's parameters with every pose free; pixels and natural units."""

    names: tuple[str, ...]
    matrix: Array

    @property
    def condition(self) -> float:
        """Of the matrix scaled to a unit diagonal: what it would be in the parameters' best units; inf if singular."""
        scale = np.sqrt(np.diag(self.matrix))
        if not np.all(np.isfinite(scale)) or not np.all(scale > 0):
            return float("inf")
        eigen = np.linalg.eigvalsh(self.matrix / np.outer(scale, scale))
        return float(eigen[-1] / eigen[0]) if eigen[0] > 0 else float("inf")

    def first(self, count: int) -> "Normal":
        """Of the first parameters alone, the others taken as known."""
        return Normal(self.names[:count], self.matrix[:count, :count])

    def covariance(self, variance_px2: float) -> Covariance:
        """For corners of this variance. CalibrationError or LinAlgError where the matrix is singular."""
        scale = np.sqrt(np.diag(self.matrix))
        inverse = np.linalg.inv(self.matrix / np.outer(scale, scale)) / np.outer(scale, scale)
        return Covariance(self.names, variance_px2 * (inverse + inverse.T) / 2)


def camera_normal(
    points_m: Sequence[Array], poses: Sequence[BoardPose], matrix: Array, distortion: Array, terms: int
) -> Normal:
    """Of points (n, 3) of the board seen at each of the poses, by a camera with `terms` free terms of distortion."""
    total = np.zeros((4 + terms, 4 + terms))
    given = np.zeros(max(len(distortion), 5)) if terms <= 5 else np.zeros(14 if terms > 8 else 8)
    given[: len(distortion)] = distortion
    for points, pose in zip(points_m, poses, strict=True):
        _, slopes = cv2.projectPoints(points, pose.rotation, pose.position_m, matrix, given)
        pose_part, camera_part = slopes[:, :_POSE], slopes[:, _POSE : _POSE + 4 + terms]
        # What a change of the camera does that no change of the pose undoes (Schur complement by QR).
        basis, _ = np.linalg.qr(pose_part)
        rest = camera_part - basis @ (basis.T @ camera_part)
        total += rest.T @ rest
    return Normal((*MATRIX, *DISTORTION[:terms]), total)
