"""The light sheet of one mirror command in a scene: where on each row it is seen, and where it ends.

A world is 2.5-D: one depth per pixel, shadows along rows. Light that has gone behind a surface stays behind it. A row
sees its sheet as a plane: all rows the same one, or, where the sheet bows or rows are exposed one after the other, each
its own: that of the mirror at its time, and the tangent of the bowed sheet where the row sees it.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.model.light_sheet import LightSheets

Array = NDArray[np.float64]

_TANGENT_STEP_M = 1e-4
"""To either side of a point: sheets bend over metres."""


@dataclass(frozen=True, slots=True, eq=False)
class LightSheet:
    """The planes n.X = d of a sheet, k = 1 for all rows or one for each, and what their light does on every row.

    normal: (k, 3) float64 unit vectors; offset_m: (k,) d; inverse: (k, 3) n/d, so that 1/z = inverse.(u, v, 1).
    x_stripe_px: (rows,) float64, sub-pixel stripe position, NaN = no stripe.
    x_end_px: (rows,) float64, end of the lit part, NaN = nothing lit.
    start_px, step: (rows,) int64, first pixel on the light's way and its direction along the row (+1, -1, 0 = not
    seen). time_s: of the bench, for what moves. bowed: what the planes are made to touch; None: they are the sheet."""

    normal: Array
    offset_m: Array
    inverse: Array
    x_stripe_px: Array
    x_end_px: Array
    start_px: NDArray[np.int64]
    step: NDArray[np.int64]
    time_s: float = 0.0
    bowed: LightSheets | None = None

    def touch(self, u: Array, v: Array, first_row: int, last_row: int) -> None:
        """Make the planes of rows first_row..last_row-1 touch the bowed sheet where the rays u, v (rows,) meet it.

        A row whose ray does not meet it keeps its plane.
        """
        assert self.bowed is not None, "a flat sheet is its own plane"
        rows = slice(first_row, last_row)
        bowed = replace(
            self.bowed, planes=self.bowed.planes[rows], middle=self.bowed.middle[rows], across=self.bowed.across[rows]
        )
        ray = np.stack([u, v, np.ones_like(u)], axis=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            # Where the ray meets the plane: so near the sheet that the tangent there and here are one.
            points = ray / np.sum(self.inverse[rows] * ray, axis=-1, keepdims=True)
            aside = _TANGENT_STEP_M * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])[:, None]
            off_m, *around = bowed.distance_m(points + aside)
            normal = (np.array(around[:3]) - around[3:]).T / (2 * _TANGENT_STEP_M)
            offset_m = np.sum(normal * points, axis=-1) - off_m
            length = np.linalg.norm(normal, axis=-1, keepdims=True)
            normal, offset_m = normal / length, offset_m / length[:, 0]
            inverse = normal / np.where(offset_m != 0, offset_m, np.nan)[:, None]
        met = np.isfinite(offset_m)
        self.normal[rows][met], self.offset_m[rows][met], self.inverse[rows][met] = (
            normal[met], offset_m[met], inverse[met],
        )  # fmt: skip


def empty_sheet(planes: Array, rows: int, time_s: float = 0.0, bowed: LightSheets | None = None) -> LightSheet:
    """A sheet that has not been traced on any row yet. planes: (4,) nx, ny, nz, d of all rows, or (rows, 4).

    bowed: (rows,) sheets whose planes these are, None where they are flat.
    """
    planes = np.array(planes if planes.ndim == 2 else planes[None])
    offset = planes[:, 3]
    with np.errstate(divide="ignore", invalid="ignore"):  # through the camera: seen edge-on, no depth
        inverse = np.where(offset[:, None] != 0, planes[:, :3] / offset[:, None], np.nan)
    return LightSheet(
        normal=np.ascontiguousarray(planes[:, :3]),
        offset_m=offset.copy(),
        inverse=inverse,
        x_stripe_px=np.full(rows, np.nan),
        x_end_px=np.full(rows, np.nan),
        start_px=np.zeros(rows, np.int64),
        step=np.zeros(rows, np.int64),
        time_s=time_s,
        bowed=bowed,
    )
