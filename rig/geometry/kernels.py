"""Compiled geometry: the pixel interval of a depth range on a row, and the depth of pixels on bowed sheets.

A pixel's ray is (u, v, 1); on a light plane p.X = 1 it has the inverse depth w = p.(u, v, 1) in 1/m. Along a row w is
monotone, so `row_windows` finds both ends of an interval of w by bisection. `bent_inverse_depth` takes Newton's steps,
starting from the plane, for the sheet of `calibration.model.light_sheet`; it computes in float64. u, v and inverse
depth are float32 (rows, width).
"""

from typing import Final

import numba
import numpy as np

from rig.simd import Float32, Float64, Int32


@numba.njit(cache=True, nogil=True)
def row_windows(u: Float32, v: Float32, plane: Float64, w_far: float, w_near: float) -> tuple[Int32, Int32]:
    """First and last pixel with inverse depth in [w_far, w_near], for each row and column: int32 (rows, columns) each.

    plane: p of each column, (columns, 3). Pixels at a row's ends without a ray (NaN) are outside. The interval is empty
    (first > last) where no pixel of the row has such an inverse depth, and on rows with fewer than two rays.
    """
    rows, width = u.shape
    columns = plane.shape[0]
    x_lo = np.zeros((rows, columns), np.int32)
    x_hi = np.full((rows, columns), -1, np.int32)
    for y in range(rows):
        first, last = with_rays(u, y, 0, width - 1)
        if first >= last:
            continue
        for c in range(columns):
            px, py, pz = plane[c, 0], plane[c, 1], plane[c, 2]
            w_first = px * u[y, first] + py * v[y, first] + pz
            w_last = px * u[y, last] + py * v[y, last] + pz
            falling = w_first > w_last
            # Lowest x at which w has reached the first limit, or passed the second, in the sense of travel.
            enter, leave = (w_near, w_far) if falling else (w_far, w_near)
            for passed, limit in ((False, enter), (True, leave)):
                lo, hi = first, last + 1
                while lo < hi:
                    mid = (lo + hi) // 2
                    w = px * u[y, mid] + py * v[y, mid] + pz
                    if (w < limit if falling else w > limit) or (w == limit and not passed):
                        hi = mid
                    else:
                        lo = mid + 1
                if passed:
                    x_hi[y, c] = lo - 1
                else:
                    x_lo[y, c] = lo
    return x_lo, x_hi


@numba.njit(inline="always")
def with_rays(u, y, first, last):  # type: ignore[no-untyped-def]
    """First and last pixel with a ray (u is not NaN) among the pixels `first` to `last` of row y; both are `last` if
    none of them has a ray."""
    while first < last and np.isnan(u[y, first]):
        first += 1
    while last > first and np.isnan(u[y, last]):
        last -= 1
    return first, last


NEWTON_STEPS: Final = 2
"""Newton's steps, starting from the plane. They leave no more error than float32's rounding, even if sheets bow ten
times as much as those of a bad lens."""


@numba.njit(cache=True, nogil=True)
def bent_inverse_depth(
    command: Float64, ahead: Float64, u: Float32, v: Float32, sheets: Float64, low: float, high: float, origin: Float64,
    bow: float, inverse_depth: Float32,
) -> None:  # fmt: skip
    """Write inverse depth (rows, width) of pixels seen at `command` (rows, width); NaN where the command is NaN.

    ahead: (rows,), change of the command from the first row's exposure to each row's. sheets: (samples, 10), n, d, f
    and t of `light_sheet` at even steps of the command from low to high, close enough to be interpolated linearly.
    origin: (3,), origin of the sheets' fan in metres. bow: per radian.
    """
    rows, width = command.shape
    per_command = (len(sheets) - 1) / (high - low)
    for y in range(rows):
        for x in range(width):
            at = command[y, x] + ahead[y]
            if np.isnan(at):
                inverse_depth[y, x] = np.nan
                continue
            place = min(max((at - low) * per_command, 0.0), len(sheets) - 1.0)
            i = min(int(place), len(sheets) - 2)
            f = place - i
            a, b = sheets[i], sheets[i + 1]
            ux, vx = np.float64(u[y, x]), np.float64(v[y, x])
            nx, ny, nz = a[0] + f * (b[0] - a[0]), a[1] + f * (b[1] - a[1]), a[2] + f * (b[2] - a[2])
            along, d = nx * ux + ny * vx + nz, a[3] + f * (b[3] - a[3])
            w = along / d
            if bow != 0.0:
                mx, my, mz = a[4] + f * (b[4] - a[4]), a[5] + f * (b[5] - a[5]), a[6] + f * (b[6] - a[6])
                tx, ty, tz = a[7] + f * (b[7] - a[7]), a[8] + f * (b[8] - a[8]), a[9] + f * (b[9] - a[9])
                dp = -(mx * origin[0] + my * origin[1] + mz * origin[2])
                dq = -(tx * origin[0] + ty * origin[1] + tz * origin[2])
                p0, q0 = mx * ux + my * vx + mz, tx * ux + ty * vx + tz
                for _ in range(NEWTON_STEPS):
                    p, q = p0 + w * dp, q0 + w * dq
                    reach, phi = np.sqrt(p * p + q * q), np.arctan2(q, p)
                    tangent = np.tan(bow * phi * phi)
                    turn = 2.0 * bow * phi * (p * dq - q * dp) / reach
                    slope = tangent * (p * dp + q * dq) / reach + (1.0 + tangent * tangent) * turn
                    w += (along - d * w - tangent * reach) / (d + slope)
            inverse_depth[y, x] = w
