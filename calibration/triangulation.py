"""Depth where a pixel's ray meets a light plane, and how it changes along an image row.

Ray r = (u, v, 1), plane n.X = d:  z = d / (n.r). Along an image row dz/dx = -(z^2 / d) (n . dr/dx), whose sign says on
which side of the stripe the near points lie. Everything broadcasts; NaN is 'no depth', never inf, never a warning.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.camera import Camera

Array = NDArray[np.float64]


def inverse_depth(u: ArrayLike, v: ArrayLike, planes: ArrayLike) -> Array:
    """1/z (1/m) of rays (u, v) on planes (..., 4); negative behind the camera, 0 for parallel rays, NaN for d = 0."""
    p = np.asarray(planes, np.float64)
    with np.errstate(all="ignore"):
        along = p[..., 0] * np.asarray(u, np.float64) + p[..., 1] * np.asarray(v, np.float64) + p[..., 2]
        # A plane through the camera centre sees every one of its points on one line: no depth.
        result: Array = along / np.where(p[..., 3] == 0, np.nan, p[..., 3])
    return np.where(np.isfinite(result), result, np.nan)


def depth(u: ArrayLike, v: ArrayLike, planes: ArrayLike) -> Array:
    """Depth z (m) of rays (u, v) on planes (..., 4); NaN where they do not meet in front of the camera."""
    inverse = inverse_depth(u, v, planes)
    with np.errstate(all="ignore"):
        z = 1.0 / np.where(inverse > 0, inverse, np.nan)
    return np.where(np.isfinite(z), z, np.nan)


def depth_slope(u: ArrayLike, v: ArrayLike, planes: ArrayLike, camera: Camera) -> Array:
    """dz/dx in metres per raw pixel along the row; NaN where there is no depth."""
    p = np.asarray(planes, np.float64)
    z = depth(u, v, p)
    du, dv = camera.tangent_slopes(u, v)
    with np.errstate(all="ignore"):
        slope = -(z * z) / p[..., 3] * (p[..., 0] * du + p[..., 1] * dv)
    return np.where(np.isfinite(slope), slope, np.nan)


def near_side(u: ArrayLike, v: ArrayLike, planes: ArrayLike, camera: Camera) -> NDArray[np.int8]:
    """Side of the stripe on which nearer points of the same plane are seen: -1 smaller x, +1 larger x, 0 undefined.

    A scanner left of the camera gives -1, one on the right +1.
    """
    p = np.asarray(planes, np.float64)
    du, dv = camera.tangent_slopes(u, v)
    with np.errstate(all="ignore"):
        sign = np.sign(p[..., 3] * (p[..., 0] * du + p[..., 1] * dv))
    return np.nan_to_num(sign).astype(np.int8)
