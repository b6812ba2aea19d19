"""Depth where a pixel's ray meets a light plane, and how it changes along an image row.

Ray r = (u, v, 1), plane n.X = d:  z = d / (n.r). Along an image row dz/dx = -(z^2 / d) (n . dr/dx), whose sign says on
which side of the stripe the near points lie. Everything broadcasts; NaN is 'no depth', never inf, never a warning.
n.r cancels where ray and plane are nearly parallel: `NEARLY_PARALLEL` keeps 1e-9 of z at the least.
Light that bows out of its plane is in `light_sheet`.
"""

from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.model.camera import Camera

Array = NDArray[np.float64]

NEARLY_PARALLEL: Final = 1e-6
"""Sine of the angle between ray and plane below which there is no depth: 1e-3 px, finer than any calibration."""
LEAST_OFFSET_M: Final = 1e-6
"""A plane that passes the camera closer than this gives no depth: all its points are seen on one line."""


def inverse_depth(u: ArrayLike, v: ArrayLike, planes: ArrayLike) -> Array:
    """1/z (1/m) of rays (u, v) on planes (..., 4), |n| = 1; negative behind the camera, 0 for parallel rays.

    NaN for planes through the camera (LEAST_OFFSET_M).
    """
    p = np.asarray(planes, np.float64)
    offset = p[..., 3]
    with np.errstate(all="ignore"):
        result: Array = _along(u, v, p) / np.where(np.abs(offset) < LEAST_OFFSET_M, np.nan, offset)
    return np.where(np.isfinite(result), result, np.nan)


def depth(u: ArrayLike, v: ArrayLike, planes: ArrayLike) -> Array:
    """Depth z (m) of rays (u, v) on planes (..., 4), |n| = 1; NaN where they do not meet in front of the camera.

    Nor do they where they are nearly parallel: z is at most 1 / NEARLY_PARALLEL times the plane's distance.
    """
    inverse = inverse_depth(u, v, planes)
    with np.errstate(all="ignore"):
        length = np.sqrt(np.square(np.asarray(u, np.float64)) + np.square(np.asarray(v, np.float64)) + 1)
        met = (inverse > 0) & (np.abs(_along(u, v, planes)) >= NEARLY_PARALLEL * length)
        z: Array = 1.0 / np.where(met, inverse, np.nan)
    return z


def _along(u: ArrayLike, v: ArrayLike, planes: ArrayLike) -> Array:
    """n.r, the ray's way along the plane's normal."""
    p = np.asarray(planes, np.float64)
    result: Array = p[..., 0] * np.asarray(u, np.float64) + p[..., 1] * np.asarray(v, np.float64) + p[..., 2]
    return result


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
    offset = np.where(np.abs(p[..., 3]) < LEAST_OFFSET_M, 0.0, p[..., 3])
    with np.errstate(all="ignore"):
        sign = np.sign(offset) * np.sign(p[..., 0] * du + p[..., 1] * dv)
    side: NDArray[np.int8] = np.nan_to_num(sign).astype(np.int8)
    return side
