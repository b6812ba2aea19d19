"""The camera: raw pixels to rays and back, including lens distortion, without rectification.

A ray is (u, v, 1) in the camera frame (x right, y down, z forward). Pixel centres lie at integers. The lens model and
the order of its terms are OpenCV's, so a calibration made with OpenCV can be used as it is.

Forward model (OpenCV 'calib3d', projectPoints) on tangents (u, v) = (x/z, y/z), r2 = u^2 + v^2:

    g  = (1 + k1 r2 + k2 r2^2 + k3 r2^3) / (1 + k4 r2 + k5 r2^2 + k6 r2^3)
    u' = u g + 2 p1 u v + p2 (r2 + 2 u^2) + s1 r2 + s2 r2^2
    v' = v g + p1 (r2 + 2 v^2) + 2 p2 u v + s3 r2 + s4 r2^2

followed, with 14 terms, by the homography of a sensor tilted by (tau_x, tau_y). Order of the terms: k1 k2 p1 p2 [k3 [k4
k5 k6 [s1 s2 s3 s4 [tau_x tau_y]]]].

Beyond some radius the model folds back on itself. A tangent is valid if the Jacobian determinant stays positive on the
whole segment from the optical axis to it. Only there is the inverse unique; other tangents give NaN. If only k1 to k6
are used, the fold is a root of a polynomial in r2. Otherwise the segment is tested at several points, at least one of
them in every ring where k1 to k6 alone fold.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import ArrayLike, NDArray

from calibration.arrays import Array, set_frozen
from calibration.errors import CalibrationError

TERM_COUNTS = (4, 5, 8, 12, 14)
"""Numbers of distortion terms that OpenCV defines, besides none."""

_SEGMENT_SAMPLES = np.linspace(0.0, 1.0, 17)[1:]
"""Places on the segment from the axis to a tangent that are tested for a fold, as shares of it."""

_RESIDUAL_LIMIT = 1e-10
"""Largest accepted |forward(inverse) - target|, in tangents: 1e-7 px at f = 1000 px; relative to targets above 1."""

_HALVINGS = 60
"""Halvings that determine a radius of up to _MAX_TANGENT to its last bits."""

_RING = 1e-3
"""Step, in tangents, at which a fold is looked for."""

_MAX_TANGENT = 20.0
"""Largest tangent: rays steeper than 87 degrees are beyond any lens this model describes."""


class Forward(NamedTuple):
    """Distorted tangents and the Jacobian d(u', v') / d(u, v), all of the input's shape."""

    u: Array
    v: Array
    uu: Array
    uv: Array
    vu: Array
    vv: Array
    sound: NDArray[np.bool_]  # the radial factor and its denominator are positive

    @property
    def determinant(self) -> Array:
        """Determinant of the Jacobian; zero where the model folds."""
        return self.uu * self.vv - self.uv * self.vu


class LensModel:
    """Distortion with 4, 5, 8, 12 or 14 terms (none: an ideal lens), forward and inverse, vectorised."""

    def __init__(self, terms: Sequence[float] | Array) -> None:
        """Take the terms in OpenCV's order. Raises CalibrationError for a number of terms that OpenCV does not define,
        a term that is not finite, and a tilt of 90 degrees or more."""
        values = np.asarray(terms, dtype=np.float64).ravel()
        if values.size not in (0, *TERM_COUNTS):
            allowed = ", ".join(map(str, TERM_COUNTS))
            raise CalibrationError(f"distortion has {values.size} terms; OpenCV defines {allowed}")
        if not np.all(np.isfinite(values)):
            raise CalibrationError(f"distortion holds a value that is not a number: {values.tolist()}")
        full: Array = np.zeros(14)
        full[: values.size] = values
        self._terms = full
        self._ideal = not np.any(full[:12])
        self._radial = not np.any(full[[2, 3, 8, 9, 10, 11]])
        with np.errstate(all="ignore"):
            self._fold_r2, self._folded_r2 = _folds(full)
        self._tilt = _tilt_homography(full[12], full[13])
        self._untilt: Array = np.asarray(np.linalg.inv(self._tilt), dtype=np.float64)

    def forward(self, u: Array, v: Array) -> Forward:
        """Lens distortion of tangents, without the sensor's tilt, and its Jacobian."""
        k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = self._terms[:12]
        r2 = u * u + v * v
        numerator = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        denominator = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
        g = numerator / denominator
        # dg/dr2, then the chain rule with d(r2)/du = 2u
        slope = (k1 + r2 * (2 * k2 + r2 * 3 * k3) - g * (k4 + r2 * (2 * k5 + r2 * 3 * k6))) / denominator
        return Forward(
            u=u * g + 2 * p1 * u * v + p2 * (r2 + 2 * u * u) + r2 * (s1 + s2 * r2),
            v=v * g + p1 * (r2 + 2 * v * v) + 2 * p2 * u * v + r2 * (s3 + s4 * r2),
            uu=g + 2 * u * u * slope + 2 * p1 * v + 6 * p2 * u + 2 * u * (s1 + 2 * s2 * r2),
            uv=2 * u * v * slope + 2 * p1 * u + 2 * p2 * v + 2 * v * (s1 + 2 * s2 * r2),
            vu=2 * u * v * slope + 2 * p1 * u + 2 * p2 * v + 2 * u * (s3 + 2 * s4 * r2),
            vv=g + 2 * v * v * slope + 6 * p1 * v + 2 * p2 * u + 2 * v * (s3 + 2 * s4 * r2),
            sound=(numerator > 0) & (denominator > 0),
        )

    def distort(self, u: Array, v: Array) -> tuple[Array, Array]:
        """Tangents as the tilted sensor sees them; NaN outside the valid region."""
        with np.errstate(all="ignore"):
            seen = self.forward(u, v)
            x, y, _ = _homography(self._tilt, seen.u, seen.v)
            keep = self.valid(u, v)
        return np.where(keep, x, np.nan), np.where(keep, y, np.nan)

    def undistort(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Inverse of `distort`; NaN where no valid tangent maps to (x, y)."""
        with np.errstate(all="ignore"):
            target_u, target_v, _ = _homography(self._untilt, x, y)
            if self._ideal:
                return target_u, target_v
            u, v, good = self._solve(target_u, target_v, target_u, target_v)
            if not np.all(good):
                # Rare: far from the axis or past the fold, where the target itself is a bad start.
                hard = ~good
                u_hard, v_hard = target_u[hard], target_v[hard]
                u[hard], v[hard], good[hard] = self._solve(*self._across_radius(u_hard, v_hard), u_hard, v_hard)
        u[~good] = np.nan
        v[~good] = np.nan
        return u, v

    def undistort_slope(self, u: Array, v: Array) -> tuple[Array, Array, Array, Array]:
        """(du/dx, du/dy, dv/dx, dv/dy) of `undistort` at undistorted tangents (u, v); NaN where folded."""
        with np.errstate(all="ignore"):
            at = self.forward(u, v)
            x, y, w = _homography(self._tilt, at.u, at.v)
            t = self._tilt
            # d(x, y)/d(at.u, at.v) of the tilt homography, chained with the lens Jacobian
            a, b = (t[0, 0] - x * t[2, 0]) / w, (t[0, 1] - x * t[2, 1]) / w
            c, d = (t[1, 0] - y * t[2, 0]) / w, (t[1, 1] - y * t[2, 1]) / w
            xu, xv = a * at.uu + b * at.vu, a * at.uv + b * at.vv
            yu, yv = c * at.uu + d * at.vu, c * at.uv + d * at.vv
            det = xu * yv - xv * yu
            det = np.where(det > 0, det, np.nan)
            return yv / det, -xv / det, -yu / det, xu / det

    def valid(self, u: Array, v: Array) -> NDArray[np.bool_]:
        """True where the lens does not fold between the optical axis and (u, v), and |(u, v)| is below _MAX_TANGENT;
        for an ideal lens, where (u, v) is finite."""
        good: NDArray[np.bool_] = np.isfinite(u) & np.isfinite(v)
        if self._ideal:
            return good
        with np.errstate(all="ignore"):
            r2 = u * u + v * v
            good &= r2 < _MAX_TANGENT**2
            if self._radial:
                return good & (r2 < self._fold_r2)
            in_rings = [np.sqrt(np.minimum(folded_r2 / r2, 1.0)) for folded_r2 in self._folded_r2]
            for share in (*_SEGMENT_SAMPLES, *in_rings):
                at = self.forward(share * u, share * v)
                good &= at.sound & (at.determinant > 0)
        return good

    def newton(self, u: Array, v: Array, target_u: Array, target_v: Array, steps: int) -> tuple[Array, Array]:
        """Tangents that `forward` maps to the targets, by at most `steps` steps of Newton's method from (u, v)."""
        for _ in range(steps):
            at = self.forward(u, v)
            miss_u, miss_v = at.u - target_u, at.v - target_v
            det = at.determinant
            step_u = (at.vv * miss_u - at.uv * miss_v) / det
            step_v = (at.uu * miss_v - at.vu * miss_u) / det
            u, v = u - step_u, v - step_v
            if np.fmax.reduce(np.abs(step_u) + np.abs(step_v), axis=None, initial=0.0) < 1e-14:
                break
        return u, v

    def _solve(self, u: Array, v: Array, target_u: Array, target_v: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        u, v = self.newton(u, v, target_u, target_v, steps=10)
        at = self.forward(u, v)
        miss = np.abs(at.u - target_u) + np.abs(at.v - target_v)
        limit = _RESIDUAL_LIMIT * np.maximum(1, np.abs(target_u) + np.abs(target_v))
        return u, v, (miss < limit) & self.valid(u, v)

    def _across_radius(self, target_u: Array, target_v: Array) -> tuple[Array, Array]:
        """The tangents that k1 to k6 alone map to the targets, by bisection up to the first fold."""
        seen = np.hypot(target_u, target_v)
        low, high = np.zeros_like(seen), np.full_like(seen, min(np.sqrt(self._fold_r2), _MAX_TANGENT))
        k1, k2, _, _, k3, k4, k5, k6 = self._terms[:8]
        for _ in range(_HALVINGS):
            r = (low + high) / 2
            r2 = r * r
            g = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
            beyond = r * g > seen
            low, high = np.where(beyond, low, r), np.where(beyond, r, high)
        share = low / seen
        return target_u * share, target_v * share


def _folds(terms: Array) -> tuple[float, list[float]]:
    """r2 of the first fold of k1 to k6 alone, inf if there is none, and an r2 within each ring that is folded.

    With g = n / d a ring is folded where n, d or the slope of r g, n d + 2 r2 (n' d - n d'), is not positive. Folded
    rings narrower than _RING may be missed; no lens has them.
    """
    k1, k2, _, _, k3, k4, k5, k6 = terms[:8]
    n, d = Polynomial([1, k1, k2, k3]), Polynomial([1, k4, k5, k6])
    slope = n * d + Polynomial([0, 2]) * (n.deriv() * d - n * d.deriv())

    def folded(r: Array) -> NDArray[np.bool_]:
        return np.asarray(~np.all([p(r * r) > 0 for p in (n, d, slope)], axis=0))

    radii = np.arange(0, _MAX_TANGENT, _RING)
    inside = folded(radii)
    if not inside.any():
        return np.inf, []
    high = radii[np.argmax(inside)]
    low = high - _RING
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        low, high = (low, middle) if folded(np.array(middle)) else (middle, high)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], inside, [False]]))).reshape(-1, 2)
    return float(low) ** 2, [float(radii[(a + b) // 2]) ** 2 for a, b in edges]


def _tilt_homography(tau_x: float, tau_y: float) -> Array:
    """Homography of a sensor tilted about x, then y, scaled as OpenCV's computeTiltProjectionMatrix."""
    cx, sx, cy, sy = np.cos(tau_x), np.sin(tau_x), np.cos(tau_y), np.sin(tau_y)
    about_x = np.array([[1, 0, 0], [0, cx, sx], [0, -sx, cx]])
    about_y = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]])
    rotation = about_y @ about_x
    flatten = np.array([[rotation[2, 2], 0, -rotation[0, 2]], [0, rotation[2, 2], -rotation[1, 2]], [0, 0, 1]])
    if rotation[2, 2] <= 0:
        raise CalibrationError(f"sensor tilt ({tau_x:g}, {tau_y:g}) rad reaches 90 degrees; it must stay well below")
    return np.asarray(flatten @ rotation)


def _homography(matrix: Array, u: Array, v: Array) -> tuple[Array, Array, Array]:
    w = matrix[2, 0] * u + matrix[2, 1] * v + matrix[2, 2]
    x = (matrix[0, 0] * u + matrix[0, 1] * v + matrix[0, 2]) / w
    y = (matrix[1, 0] * u + matrix[1, 1] * v + matrix[1, 2]) / w
    keep = w > 0
    return np.where(keep, x, np.nan), np.where(keep, y, np.nan), w


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera with OpenCV distortion.

    matrix: (3, 3) float64, [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels.
    distortion: (0, 4, 5, 8, 12 or 14) float64, OpenCV order k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 tau_x tau_y.
    Raises CalibrationError for a size, matrix or distortion that describes no camera.
    """

    width: int
    height: int
    matrix: Array
    distortion: Array
    lens: LensModel = field(init=False, repr=False)

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
        set_frozen(self, matrix=matrix, distortion=distortion, lens=LensModel(distortion))

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
        u, v = self.lens.undistort(np.atleast_1d(at_x), np.atleast_1d(at_y))
        return u.reshape(x.shape), v.reshape(x.shape)

    def tangent_slopes(self, u: ArrayLike, v: ArrayLike) -> tuple[Array, Array]:
        """(du/dx, dv/dx) per raw pixel along the row, for the rays (u, v); NaN where the lens folds."""
        u_, v_ = np.broadcast_arrays(np.asarray(u, np.float64), np.asarray(v, np.float64))
        du, _, dv, _ = self.lens.undistort_slope(u_, v_)
        fx = self.matrix[0, 0]
        return du / fx, dv / fx

    def project(self, points_m: ArrayLike) -> tuple[Array, Array]:
        """Raw pixel (x_px, y_px) of points (..., 3) in metres, even outside the picture; NaN behind the camera and
        beyond the lens model's fold."""
        points = np.asarray(points_m, np.float64)
        with np.errstate(all="ignore"):
            z = np.where(points[..., 2] > 0, points[..., 2], np.nan)
            u, v = self.lens.distort(points[..., 0] / z, points[..., 1] / z)
            m = self.matrix
            x, y = m[0, 0] * u + m[0, 2], m[1, 1] * v + m[1, 2]
            seen = np.isfinite(x) & np.isfinite(y)
        return np.where(seen, x, np.nan), np.where(seen, y, np.nan)
