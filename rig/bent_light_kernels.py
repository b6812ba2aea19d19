"""Compiled depth of pixels on bowed sheets of light, see `calibration.model.light_sheet` for the formula."""

from typing import Final

import numba
import numpy as np
from numpy.typing import NDArray

NEWTON_STEPS: Final = 2
"""From the plane on: they leave the rounding of float32, also where sheets bow ten times as much as a bad lens's."""


@numba.njit(cache=True, nogil=True)
def bent_inverse_depth(
    command: NDArray[np.float64],
    ahead: NDArray[np.float64],
    u: NDArray[np.float32],
    v: NDArray[np.float32],
    sheets: NDArray[np.float64],
    low: float,
    high: float,
    origin: NDArray[np.float64],
    bow: float,
    inverse_depth: NDArray[np.float32],
) -> None:
    """Write inverse depth (rows, width) where the mirror was bound to `command`; NaN where there is none.

    ahead: (rows,) by how much the command is past that. sheets: (samples, 10) float64, n, d, middle and across of the
    sheets at even steps of the command from low to high; in between they are linear, for closely enough spaced ones.
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
