"""The camera: raw pixels to rays and back, lens distortion included, no rectification.

A ray is (u, v, 1) in the camera frame (x right, y down, z forward). Pixel centres lie at integers. The lens model and
the order of its terms are OpenCV's, so a calibration made with OpenCV is used as it is.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.errors import CalibrationError
from calibration.model.distortion import LensModel

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera with OpenCV distortion.

    matrix: (3, 3) float64, [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels.
    distortion: (0, 4, 5, 8, 12 or 14) float64, OpenCV order k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 tau_x tau_y.
    Raises CalibrationError on a size, matrix or number of terms that describes no camera.
    """

    width: int
    height: int
    matrix: Array
    distortion: Array
    _lens: LensModel = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Check the numbers and freeze the arrays."""
        if self.width < 1 or self.height < 1:
            raise CalibrationError(f"camera size is {self.width} x {self.height}; both must be at least 1 pixel")
        matrix = np.array(self.matrix, dtype=np.float64)
        if matrix.shape != (3, 3):
            raise CalibrationError(f"camera matrix has shape {matrix.shape}; it must be 3 x 3")
        if not np.all(np.isfinite(matrix)) or matrix[0, 0] <= 0 or matrix[1, 1] <= 0:
            raise CalibrationError(f"camera matrix {matrix.tolist()} must be finite with positive focal lengths")
        rest = matrix[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]]
        if not np.array_equal(rest, [0, 0, 0, 0, 1]):
            raise CalibrationError(
                f"camera matrix {matrix.tolist()} must read [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]; "
                "OpenCV's model has no skew"
            )
        distortion = np.array(self.distortion, dtype=np.float64).ravel()
        lens = LensModel(distortion)
        matrix.flags.writeable = False
        distortion.flags.writeable = False
        object.__setattr__(self, "matrix", matrix)
        object.__setattr__(self, "distortion", distortion)
        object.__setattr__(self, "_lens", lens)

    @property
    def lens(self) -> LensModel:
        """The distortion, on tangents."""
        return self._lens

    def tangents(self) -> tuple[Array, Array]:
        """(u, v) of every raw pixel, each (height, width) float64; NaN where the lens model has no inverse."""
        y, x = np.mgrid[0 : self.height, 0 : self.width]
        return self.tangents_at(x, y)

    def tangents_at(self, x_px: ArrayLike, y_px: ArrayLike) -> tuple[Array, Array]:
        """(u, v) seen at raw pixel positions (broadcast together); NaN where the lens has no inverse."""
        x, y = np.broadcast_arrays(np.asarray(x_px, np.float64), np.asarray(y_px, np.float64))
        m = self.matrix
        with np.errstate(all="ignore"):
            at_x, at_y = (x - m[0, 2]) / m[0, 0], (y - m[1, 2]) / m[1, 1]
        u, v = self._lens.undistort(np.atleast_1d(at_x), np.atleast_1d(at_y))
        return u.reshape(x.shape), v.reshape(x.shape)

    def tangent_slopes(self, u: ArrayLike, v: ArrayLike) -> tuple[Array, Array]:
        """(du/dx, dv/dx) per raw pixel along the row, at the rays (u, v)."""
        u_, v_ = np.broadcast_arrays(np.asarray(u, np.float64), np.asarray(v, np.float64))
        du, _, dv, _ = self._lens.undistort_slope(u_, v_)
        fx = self.matrix[0, 0]
        return du / fx, dv / fx

    def project(self, points_m: ArrayLike) -> tuple[Array, Array]:
        """Raw pixel (x_px, y_px) of points (..., 3) in metres; NaN behind the camera and past the lens model's fold."""
        points = np.asarray(points_m, np.float64)
        with np.errstate(all="ignore"):
            z = np.where(points[..., 2] > 0, points[..., 2], np.nan)
            u, v = self._lens.distort(points[..., 0] / z, points[..., 1] / z)
            m = self.matrix
            x, y = m[0, 0] * u + m[0, 2], m[1, 1] * v + m[1, 2]
            seen = np.isfinite(x) & np.isfinite(y)
        return np.where(seen, x, np.nan), np.where(seen, y, np.nan)
