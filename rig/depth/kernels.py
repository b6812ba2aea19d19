"""Compiled steps after the stripe table: the depth map on the camera grid, and the sums of the fog meter.

`fill_rows`: between the stripes xa and xb of columns a and b on one row, on one surface, a pixel at x has

    inverse depth = (1 - f) p_a.(u, v, 1) + f p_b.(u, v, 1),    f = (x - xa) / (xb - xa)

with planes p float64 (columns, 3) and rays u, v float32 (rows, width); inverse depth is float32 (rows, width). A stripe
that is off by 1 px along its row changes inverse depth by s = |p_a.(du, dv, 0)|, with (du, dv) the change of the ray
from one pixel to the next. So with the standard deviations of both stripes

    sd of inverse depth = s ((1 - f) sd_a + f sd_b)

if the errors of neighbouring stripes are equal. With the estimator `joint` they nearly are, so the stated error of the
depth is right if that of the stripes is. If the errors are independent of each other, the standard deviation is
smaller, down to 0.7 times this.
`depth_rows` turns inverse depth w into depth 1 / w, whose standard deviation is that of w over w^2.
`add_clear_rows` adds up counts, exposures and light (see `SUMS`) of pixels clearly before and clearly behind the
stripes of a sweep.
"""

from typing import Final

import numba
import numpy as np
from numpy.typing import NDArray

from rig.estimate.row.inputs import Lines, RowState, Sweep, row_buffers, row_fluxes
from rig.simd import Bools, Float32, Float64, Int32

MAX_COLUMN_GAP: Final = 2
"""Stripes of columns farther apart than this are not joined to one surface."""
SPACING_TOLERANCE_PX: Final = 1.0
SPACING_SIGMAS: Final = 3.0
"""Stripes lie on one surface if their spacing differs from that of equal depth by at most 1 px + 3 sd."""


@numba.njit(cache=True, nogil=True)
def fill_rows(
    x_px: Float32, confidence: Float32, x_sd_px: Float32, min_confidence: float, plane: Float64, u: Float32, v: Float32,
    inverse_depth: Float32, depth_confidence: Float32, inverse_depth_sd: Float32, commands: Float64, command: Float64,
) -> None:  # fmt: skip
    """Write inverse depth in 1/m, its confidence and its standard deviation (rows, width) for pixels between stripes of
    neighbouring columns. Other pixels keep what the arrays hold; `depth_confidence` must begin below 0.

    Also writes the mirror's command there, from the columns' `commands`, unless `command` is empty.

    Two stripes of one row lie on one surface if their columns are at most MAX_COLUMN_GAP apart and their spacing is
    that of equal depth within 1 px + 3 sd. Between them the column is linear in x. A pair's confidence is the lower one
    of its two stripes, and the more confident pair wins.
    """
    rows, columns = x_px.shape
    width = u.shape[1]
    for y in range(rows):
        for c in range(columns - 1):
            if not confidence[y, c] >= min_confidence or np.isnan(x_px[y, c]):
                continue
            for other in range(c + 1, min(c + MAX_COLUMN_GAP, columns - 1) + 1):
                if not confidence[y, other] >= min_confidence or np.isnan(x_px[y, other]):
                    continue
                xa, xb = np.float64(x_px[y, c]), np.float64(x_px[y, other])
                i = min(max(int(0.5 * (xa + xb)), 0), width - 2)
                ux, vx = u[y, i], v[y, i]
                slope = plane[c, 0] * (u[y, i + 1] - ux) + plane[c, 1] * (v[y, i + 1] - vx)
                turn = (
                    (plane[other, 0] - plane[c, 0]) * ux + (plane[other, 1] - plane[c, 1]) * vx
                    + plane[other, 2] - plane[c, 2]
                )  # fmt: skip
                if not abs(slope) > 1e-12:
                    continue
                sd = np.sqrt(x_sd_px[y, c] ** 2 + x_sd_px[y, other] ** 2)
                if not abs(xb - xa + turn / slope) <= SPACING_TOLERANCE_PX + SPACING_SIGMAS * sd:
                    continue
                sure = min(confidence[y, c], confidence[y, other])
                sd_a, sd_b = abs(slope) * x_sd_px[y, c], abs(slope) * x_sd_px[y, other]
                for x in range(max(int(np.ceil(min(xa, xb))), 0), min(int(np.floor(max(xa, xb))), width - 1) + 1):
                    if not sure > depth_confidence[y, x]:
                        continue
                    f = (x - xa) / (xb - xa) if xb != xa else 0.5
                    ux, vx = u[y, x], v[y, x]
                    wa = plane[c, 0] * ux + plane[c, 1] * vx + plane[c, 2]
                    wb = plane[other, 0] * ux + plane[other, 1] * vx + plane[other, 2]
                    w = (1.0 - f) * wa + f * wb
                    if w > 1e-6:
                        inverse_depth[y, x] = w
                        depth_confidence[y, x] = sure
                        inverse_depth_sd[y, x] = (1.0 - f) * sd_a + f * sd_b
                        if command.size:
                            command[y, x] = (1.0 - f) * commands[c] + f * commands[other]
                break


@numba.njit(cache=True, nogil=True)
def depth_rows(
    inverse_depth: Float32, lowest: np.float32, highest: np.float32, depth_m: Float32, confidence: Float32,
    sd_m: Float32,
) -> None:  # fmt: skip
    """Write the depth (rows, width) in metres for inverse depths in 1/m from `lowest` to `highest`; elsewhere NaN, with
    confidence 0. sd_m: holds the standard deviation of inverse depth, and becomes that of depth."""
    for y in range(inverse_depth.shape[0]):
        for x in range(inverse_depth.shape[1]):
            w = inverse_depth[y, x]
            if lowest <= w <= highest:
                z = np.float32(1.0) / w
                depth_m[y, x] = z
                sd_m[y, x] *= z * z
            else:
                depth_m[y, x] = np.nan
                confidence[y, x] = 0.0
                sd_m[y, x] = np.nan


SUMS: Final = 4
"""Sums for each block, side and bin: ones (detections), exposures, exposures weighted with the geometry factor, and
exposures weighted with the flux that is no haze."""


@numba.njit(cache=True, nogil=True)
def add_clear_rows(
    sweep: Sweep, state: RowState, lines: Lines, x_px: Float32, clear: Bools, block: Int32, clear_px: float,
    hot_flux: float, sums: Float64, at_stripe: Float64,
) -> None:  # fmt: skip
    """Add the pixels that are clear_px or more before or behind the stripe at x_px, for each clear row of a column.

    lines: the rows with their columns; x_px, clear and block have one entry for each. clear: whether the row's stripe
    is beyond doubt; other rows are skipped. block: number of the block of rows and columns that the row belongs to.
    sums: (blocks, 2, bins, SUMS), before and behind the stripe. at_stripe (lines, 2): path in metres and geometry
    factor of the haze at the stripe, unchanged for skipped rows. Pixels with more ambient flux than hot_flux are left
    out.
    """
    row = row_buffers(sweep.window, state.amplitude.shape[0])
    step = 1 if sweep.near_is_left else -1
    for i in range(lines.row.shape[0]):
        y, c, k = lines.row[i], lines.column[i], lines.exposures[i]
        if not clear[i] or k == 0:
            continue
        length, _, _, start = row_fluxes(sweep, state, row, y, c)
        for t in range(length):
            x = start + step * t
            ahead_px = (x_px[i] - x) * step
            if abs(ahead_px) <= 0.5:
                at_stripe[i, 0] = 1.0 / (state.w_lo + row.cell[t] / state.per_w)
                at_stripe[i, 1] = row.gain[t]
            ambient = state.ambient[y, x]
            if ambient > hot_flux or abs(ahead_px) < clear_px:
                continue
            cell = sums[block[i], 0 if ahead_px > 0 else 1, row.cell[t]]
            cell[0] += lines.counts[i, x - sweep.x0[c]]
            cell[1] += k
            cell[2] += k * row.gain[t]
            cell[3] += k * (ambient + row.others[t])


@numba.njit(cache=True, nogil=True)
def sum_dark(
    dark_counts: NDArray[np.uint32], dark_frames: Int32, ambient: Float32, hot_flux: float
) -> tuple[float, float, float]:
    """Sums over all dark frames: ones (detections), exposures, and exposures weighted with the flux `ambient`.

    ambient, dark_counts: (rows, width); dark_frames: (width,), number of dark frames in which a pixel was used. Pixels
    with more ambient flux than hot_flux are left out.
    """
    ones, exposures, light = 0.0, 0.0, 0.0
    for y in range(ambient.shape[0]):
        for x in range(ambient.shape[1]):
            if ambient[y, x] <= hot_flux:
                ones += dark_counts[y, x]
                exposures += dark_frames[x]
                light += np.float64(ambient[y, x]) * dark_frames[x]
    return ones, exposures, light
