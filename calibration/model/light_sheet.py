"""The sheet of light at one mirror command, flat or bowed, and the depth at which a pixel's ray meets it.

A line lens spreads the beam into a fan of directions from an origin O. Let f be the fan's middle, t the direction in
the plane across f (along the mirror's axis), n the plane's normal. Light leaves at an angle phi within the plane and,
if the sheet is bowed, at the angle bow phi^2 out of it towards n. A point X with p = (X - O).f, q = (X - O).t lies on
the sheet if

    n.X = d + tan(bow phi^2) hypot(p, q),    phi = atan2(q, p),

even if O itself lies slightly off the plane. O is the model's `source_m`; if that is unknown, the point of the mirror's
axis nearest to the camera.

Ray r = (u, v, 1), plane n.X = d:  z = d / (n.r). Along an image row dz/dx = -(z^2 / d) (n . dr/dx), whose sign tells on
which side of the stripe the near points lie. All arguments broadcast. NaN means 'no depth'; there are no infinities and
no warnings. n.r loses digits where ray and plane are nearly parallel: `NEARLY_PARALLEL` keeps z accurate to 1e-9.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.arrays import Array
from calibration.model.camera import Camera
from calibration.model.scanner import PivotScanner, Scanner

NEARLY_PARALLEL: Final = 1e-6
"""Sine of the angle between ray and plane below which there is no depth: 1e-3 px at f = 1000 px."""
LEAST_OFFSET_M: Final = 1e-6
"""Least distance of a plane from the camera: a plane that passes closer is seen edge-on and gives no depth."""


def inverse_depth(u: ArrayLike, v: ArrayLike, planes: ArrayLike) -> Array:
    """1/z (1/m) of rays (u, v) on planes (..., 4), |n| = 1. Negative behind the camera, 0 if parallel, NaN for
    planes within LEAST_OFFSET_M of the camera.
    """
    p = np.asarray(planes, np.float64)
    offset = p[..., 3]
    with np.errstate(all="ignore"):
        result: Array = _along(u, v, p) / np.where(np.abs(offset) < LEAST_OFFSET_M, np.nan, offset)
    return np.where(np.isfinite(result), result, np.nan)


def depth(u: ArrayLike, v: ArrayLike, planes: ArrayLike) -> Array:
    """Depth z (m) of rays (u, v) on planes (..., 4), |n| = 1. NaN where z is not positive, where ray and plane are
    nearly parallel, and for planes within LEAST_OFFSET_M of the camera."""
    return _met(u, v, inverse_depth(u, v, planes), _along(u, v, planes))


def _met(u: ArrayLike, v: ArrayLike, inverse: Array, along: Array) -> Array:
    """Depth z (m) of rays from 1/z and from n.r on the plane that they meet, with the rules of `depth`."""
    with np.errstate(all="ignore"):
        length = np.sqrt(np.square(np.asarray(u, np.float64)) + np.square(np.asarray(v, np.float64)) + 1)
        met = (inverse > 0) & (np.abs(along) >= NEARLY_PARALLEL * length)
        z: Array = 1.0 / np.where(met, inverse, np.nan)
    return z


def _along(u: ArrayLike, v: ArrayLike, planes: ArrayLike) -> Array:
    """n.r, the component of the rays along the normals."""
    p = np.asarray(planes, np.float64)
    return p[..., 0] * np.asarray(u, np.float64) + p[..., 1] * np.asarray(v, np.float64) + p[..., 2]


def depth_slope(u: ArrayLike, v: ArrayLike, planes: ArrayLike, camera: Camera) -> Array:
    """dz/dx in metres per raw pixel along the row; NaN where there is no depth."""
    p = np.asarray(planes, np.float64)
    z = depth(u, v, p)
    du, dv = camera.tangent_slopes(u, v)
    with np.errstate(all="ignore"):
        slope = -(z * z) / p[..., 3] * (p[..., 0] * du + p[..., 1] * dv)
    return np.where(np.isfinite(slope), slope, np.nan)


def near_side(u: ArrayLike, v: ArrayLike, planes: ArrayLike, camera: Camera) -> NDArray[np.int8]:
    """The side of the stripe on which nearer points appear: -1 smaller x, +1 larger x, 0 undefined."""
    p = np.asarray(planes, np.float64)
    du, dv = camera.tangent_slopes(u, v)
    offset = np.where(np.abs(p[..., 3]) < LEAST_OFFSET_M, 0.0, p[..., 3])
    with np.errstate(all="ignore"):
        sign = np.sign(offset) * np.sign(p[..., 0] * du + p[..., 1] * dv)
    side: NDArray[np.int8] = np.nan_to_num(sign).astype(np.int8)
    return side


_MOST_STEPS = 12
_CONVERGED = 1e-12
"""Relative step at which Newton's method has converged; sheets are nearly flat, so three steps are enough."""


@dataclass(frozen=True, slots=True, eq=False)
class LightSheets:
    """Sheets (...): planes (..., 4), |n| = 1; O (3,); unit vectors f, t (..., 3); bow. With bow 0, O, f and t are 0."""

    planes: Array
    origin_m: Array
    middle: Array
    across: Array
    bow_per_rad: float

    def distance_m(self, points_m: ArrayLike) -> Array:
        """Distance of points (..., 3) from their sheets along n, metres; 0 on the sheet."""
        points = np.asarray(points_m, np.float64)
        off: Array = np.sum(self.planes[..., :3] * points, axis=-1) - self.planes[..., 3]
        if self.bow_per_rad:
            off = off - self._bowed(points - self.origin_m)[0]
        return off

    def inverse_depth(self, u: ArrayLike, v: ArrayLike) -> Array:
        """1/z (1/m) of rays (u, v). For planes this is the module's `inverse_depth`; sheets follow the same rules.

        With w = 1/z, the ray r satisfies n.r - d w = tan(bow phi^2) hypot(p, q), with p and q taken from r - w O. This
        is nearly linear in w, and regular for rays that never meet the sheet. Newton's method starts from the plane. A
        bowed sheet also gives NaN behind the fan's origin, and where the method does not converge.
        """
        w = inverse_depth(u, v, self.planes)
        if not self.bow_per_rad:
            return w
        u_, v_, _ = np.broadcast_arrays(np.asarray(u, np.float64), np.asarray(v, np.float64), w)
        ray = np.stack([u_, v_, np.ones_like(w)], axis=-1)
        offset = self.planes[..., 3]
        with np.errstate(all="ignore"):
            along = np.sum(self.planes[..., :3] * ray, axis=-1)
            for _ in range(_MOST_STEPS):
                bowed, slope, ahead = self._bowed(ray - w[..., None] * self.origin_m)
                step = (along - offset * w - bowed) / (offset + slope)
                w = w + step
                moved = np.abs(step) > _CONVERGED * np.abs(w)
                if not moved.any():
                    break
            found = np.isfinite(w) & ahead & ~moved
        return np.where(found, w, np.nan)

    def depth(self, u: ArrayLike, v: ArrayLike) -> Array:
        """Depth z (m) of rays (u, v). For planes this is the module's `depth`; sheets follow the same rules."""
        if not self.bow_per_rad:
            return depth(u, v, self.planes)
        w = self.inverse_depth(u, v)
        return _met(u, v, w, self.planes[..., 3] * w)

    def _bowed(self, seen: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """For X - O, or (X - O) / z: the bow's distance off the plane, slope by w = 1/z, whether X is ahead of O."""
        p, q = np.sum(seen * self.middle, axis=-1), np.sum(seen * self.across, axis=-1)
        dp, dq = -(self.middle @ self.origin_m), -(self.across @ self.origin_m)
        reach = np.hypot(p, q)
        phi = np.arctan2(q, p)
        tangent = np.tan(self.bow_per_rad * phi * phi)
        turn = 2 * self.bow_per_rad * phi * (p * dq - q * dp) / reach
        slope = tangent * (p * dp + q * dq) / reach + (1 + tangent * tangent) * turn
        return tangent * reach, slope, p > 0


def light_sheets(scanner: Scanner, source_m: ArrayLike | None, commands: ArrayLike) -> LightSheets:
    """The sheets (...) at commands (...). A table of planes has no bow. Raises CalibrationError outside the command
    range.
    """
    if not isinstance(scanner, PivotScanner) or scanner.bow_per_rad == 0:
        planes = scanner.planes(commands)
        nothing = np.zeros_like(planes[..., :3])
        return LightSheets(planes, np.zeros(3), nothing, nothing, 0.0)
    planes = scanner.turned(commands)
    normal = planes[..., :3]
    across = scanner.axis_direction - np.sum(normal * scanner.axis_direction, axis=-1, keepdims=True) * normal
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    middle = np.cross(across, normal)
    middle = np.where(middle[..., 2:] < 0, -middle, middle)  # the light goes towards the scene
    return LightSheets(planes, fan_origin(scanner, source_m), middle, across, scanner.bow_per_rad)


def fan_origin(scanner: Scanner, source_m: ArrayLike | None) -> Array:
    """The point (3,) from which the light spreads: the source; if unknown, the point of the mirror's axis nearest to
    the camera, or for a table of planes the camera itself."""
    if source_m is not None:
        return np.asarray(source_m, np.float64)
    if not isinstance(scanner, PivotScanner):
        return np.zeros(3)
    point, axis = scanner.axis_point_m, scanner.axis_direction
    return point - (point @ axis) * axis
