"""Search windows of a column's stripe on every image row, from the depth range, and the geometry of each pixel.

A light plane n.X = d meets the ray r = (u, v, 1) of a pixel at inverse depth w = (n.r)/d. Along a row w is monotone in
x, so the depth range becomes one interval of pixels, int32 (rows, columns). No rectification is assumed; with
distortion, roll or tilted planes the interval moves from row to row.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibration.model.light_sheet import LEAST_OFFSET_M, near_side
from calibration.model.rig_model import RigModel
from rig.errors import UsageError
from rig.geometry.bent_light import BentLight, bent_light, bent_u, beside_px, is_bent
from rig.simd import Bools, Float32, Float64, Int32

WORD_PX: Final = 64
"""Windows start and end at multiples of one 64-bit word, so that counting runs on whole words."""
MARGIN_PX = 10
"""Pixels kept on both sides of the search interval, since they show where the haze ends."""
_GOLDEN: Final = 0.6180339887
"""Fractional part of the golden ratio. Its multiples cover rows and columns without beating against either."""


@dataclass(frozen=True, slots=True)
class SweepGeometry:
    """Rays, planes and search windows of one sweep.

    u, v: float32 (rows, width) ray tangents of every raw pixel, NaN where the camera model is not invertible; if the
    light is bent, those that meet the planes nearly where the true rays meet the light.
    plane: float64 (columns, 3), the plane as p.X = 1 (p = n/d), so that inverse depth is p.(u, v, 1).
    planes: float64 (columns, 4) as (n, d), |n| = 1.
    x_lo, x_hi: int32 (rows, columns), first and last pixel of the search window; empty if x_lo > x_hi.
    x0: int32 (columns,) first stored pixel; window: stored pixels per row, a multiple of 64.
    near_is_left: True if near points lie at smaller x than far ones (scanner on the left).
    depth_range_m: nearest and farthest depth. defects: bool (rows, width), True for pixels that must not be used.
    others: float64 (columns, lines - 1, 3), `plane` of the columns that other lines light together with each column;
    None if there is only one line. light: gives the exact depths if the light is bent; None if it is not.
    """

    u: Float32
    v: Float32
    plane: Float64
    planes: Float64
    x_lo: Int32
    x_hi: Int32
    x0: Int32
    window: int
    near_is_left: bool
    depth_range_m: tuple[float, float]
    defects: Bools
    others: Float64 | None = None
    light: BentLight | None = None

    @property
    def rays(self) -> tuple[Float32, Float32]:
        """True rays (u, v), each (rows, width)."""
        return (self.u, self.v) if self.light is None else (self.light.u, self.light.v)

    def bound_to(self, model: RigModel, commands: Float64, velocity_per_s: float) -> "SweepGeometry":
        """This geometry with the light of a sweep whose columns were taken at `commands` (columns,), with the command
        moving at this velocity. Rays, windows and `others` stay as they are. Raises CalibrationError for commands
        outside the calibration's."""
        planes = model.planes(commands)
        light = None if self.light is None else replace(self.light, commands=commands, velocity_per_s=velocity_per_s)
        return replace(self, planes=planes, plane=planes[:, :3] / planes[:, 3:], light=light)

    @property
    def rows(self) -> int:
        """Number of image rows."""
        return int(self.u.shape[0])

    @property
    def width(self) -> int:
        """Sensor width in pixels."""
        return int(self.u.shape[1])

    @property
    def columns(self) -> int:
        """Number of laser line positions of the sweep."""
        return int(self.plane.shape[0])

    def reference_px(self) -> Float64:
        """Position of each column's line at the middle inverse depth, (rows, columns) px, without lens distortion.

        Only differences between neighbouring rows and columns matter. Positions may lie outside the picture. 0
        everywhere if no row has two pixels with a ray.
        """
        near_m, far_m = self.depth_range_m
        w = 0.5 * (1.0 / near_m + 1.0 / far_m)
        left, right, u_left, px_per_tangent = self._scale()
        if not px_per_tangent:
            return np.zeros((self.rows, self.columns))
        row = np.nan_to_num(self.v[:, (left + right) // 2].astype(np.float64))
        u = (w - self.plane[None, :, 2] - self.plane[None, :, 1] * row[:, None]) / self.plane[None, :, 0]
        return np.asarray(left + px_per_tangent * (u - u_left))

    def px_per_inverse_depth(self) -> float:
        """Motion of a stripe along its row, in px per 1/m of inverse depth, without sign: the median of the columns.

        0 if no row has two pixels with a ray.
        """
        return float(np.median(np.abs(self._scale()[3] / self.plane[:, 0])))

    def _scale(self) -> tuple[int, int, float, float]:
        """First and last pixel with a ray on the row that has most, u at the first one, and px per unit of u.

        The latter is 0 if no row has two such pixels.
        """
        fullest = int(np.isfinite(self.u).sum(axis=1).argmax())
        valid = np.flatnonzero(np.isfinite(self.u[fullest]))
        if len(valid) < 2:
            return 0, 0, 0.0, 0.0
        left, right = int(valid[0]), int(valid[-1])
        u_left = float(self.u[fullest, left])
        return left, right, u_left, (right - left) / (float(self.u[fullest, right]) - u_left)


def sweep_geometry(model: RigModel, commands: Float64, depth_range_m: tuple[float, float]) -> SweepGeometry:
    """Rays, planes and search windows of a sweep. commands: (columns,), of the mirror. depth_range_m: near and far end.

    `others` is None, even with several lines. Raises UsageError if a plane passes within LEAST_OFFSET_M of the camera,
    or if no column can be seen within the depth range, and CalibrationError for commands outside the calibration's.
    """
    from rig.geometry.kernels import row_windows

    u64, v64 = model.camera.tangents()
    u, v = np.ascontiguousarray(u64, dtype=np.float32), np.ascontiguousarray(v64, dtype=np.float32)
    planes = np.ascontiguousarray(model.planes(commands))
    offset = planes[:, 3]
    if np.any(np.abs(offset) < LEAST_OFFSET_M):
        worst = int(np.argmin(np.abs(offset)))
        raise UsageError(
            f"light plane of column {worst} passes {abs(offset[worst]):.1e} m from the camera, less than "
            f"{LEAST_OFFSET_M:g} m: depth is not determined; check the baseline in the calibration"
        )
    plane = planes[:, :3] / offset[:, None]
    near_is_left = bool(near_side(0.0, 0.0, planes[len(planes) // 2], model.camera) < 0)
    near_m, far_m = depth_range_m
    light, beside = None, 0
    if is_bent(model):
        light = bent_light(model, u, v, commands)
        bent = bent_u(model, u64, v64, 2.0 / (1.0 / near_m + 1.0 / far_m))
        beside = beside_px(model, (u64, v64), bent, commands, depth_range_m)
        u = bent.astype(np.float32)
    x_lo, x_hi = row_windows(u, v, plane, 1.0 / far_m, 1.0 / near_m)
    seen = x_lo <= x_hi
    if not seen.any():
        raise UsageError(
            f"no column meets the picture between {near_m:g} m and {far_m:g} m; "
            "widen depth_range or check the calibration"
        )
    width = u.shape[1]
    if beside:
        x_lo = np.where(seen, np.maximum(x_lo - np.int32(beside), 0), x_lo)
        x_hi = np.where(seen, np.minimum(x_hi + np.int32(beside), width - 1), x_hi)
    padded = -(-width // WORD_PX) * WORD_PX
    first = np.where(seen, x_lo, np.int32(padded)).min(axis=0) - MARGIN_PX
    last = np.where(seen, x_hi, -1).max(axis=0) + MARGIN_PX
    empty = ~seen.any(axis=0)
    first = np.where(empty, 0, np.clip(first, 0, width - 1)) // WORD_PX * WORD_PX
    last = np.where(empty, 0, np.clip(last, 0, width - 1))
    window = int(-(-(last - first + 1).max() // WORD_PX) * WORD_PX)
    # Columns that see nothing get their neighbour's window, so that moving windows need not jump for them.
    some = np.flatnonzero(~empty)
    nearest = some[np.searchsorted(some, np.arange(x_lo.shape[1])).clip(max=len(some) - 1)]
    x0 = np.minimum(first, padded - window).astype(np.int32)[nearest]
    defects = np.zeros(u.shape, np.bool_) if model.defects is None else model.defects
    return SweepGeometry(
        u, v, plane, planes, x_lo, x_hi, x0, window, near_is_left, (near_m, far_m), defects, light=light
    )


def uncalibrated_geometry(rows: int, width: int, columns: int) -> SweepGeometry:
    """Geometry of a rig without a model. The whole row is searched, and near points are assumed to lie on the left.

    Depth has no meaning. Inverse depth falls linearly from 1.5 to 0.5 across the picture, so that the estimators' haze
    profile has a scale.
    """
    u = np.broadcast_to(np.linspace(-0.5, 0.5, width, dtype=np.float32), (rows, width)).copy()
    plane = np.tile(np.array([-1.0, 0.0, 1.0]), (columns, 1))
    padded = -(-width // WORD_PX) * WORD_PX
    return SweepGeometry(
        u, np.zeros_like(u), plane, np.column_stack([plane, np.ones(columns)]),
        np.zeros((rows, columns), np.int32), np.full((rows, columns), width - 1, np.int32),
        np.zeros(columns, np.int32), padded, True, (1 / 1.5, 1 / 0.5),
        np.zeros((rows, width), np.bool_),
    )  # fmt: skip


def evenly_spread(n: int, most: int) -> NDArray[np.int64]:
    """At most `most` of the indices 0 to n - 1, spread evenly in a fixed pattern; all of them if n is not larger."""
    if n <= most:
        return np.arange(n)
    i, step = np.arange(most), n / most
    return np.unique((i * step + (i * _GOLDEN) % 1 * step).astype(np.int64))
