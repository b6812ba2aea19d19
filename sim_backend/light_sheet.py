"""The light sheet of one mirror command in a scene: where on each row it is seen, and where it ends.

A world is 2.5-D: one depth per pixel, shadows along rows. Light that has gone behind a surface stays behind it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class LightSheet:
    """One plane n.X = d and what its light does on every row.

    normal: (3,) float64 unit vector; offset_m: d; inverse: (3,) float64 n/d, so that 1/z = inverse.(u, v, 1).
    x_stripe_px: (rows,) float64, sub-pixel stripe position, NaN = no stripe.
    x_end_px: (rows,) float64, end of the lit part, NaN = nothing lit.
    start_px, step: (rows,) int64, first pixel on the light's way and its direction along the row (+1, -1, 0 = not
    seen). time_s: of the bench, for what moves."""

    normal: Array
    offset_m: float
    inverse: Array
    x_stripe_px: Array
    x_end_px: Array
    start_px: NDArray[np.int64]
    step: NDArray[np.int64]
    time_s: float = 0.0


def empty_sheet(plane: Array, rows: int, time_s: float = 0.0) -> LightSheet:
    """A sheet of the plane (4,) = nx, ny, nz, d that has not been traced on any row yet."""
    offset = float(plane[3])
    inverse = plane[:3] / offset if offset != 0 else np.full(3, np.nan)  # through the camera: seen edge-on, no depth
    return LightSheet(
        normal=np.ascontiguousarray(plane[:3]),
        offset_m=offset,
        inverse=inverse,
        x_stripe_px=np.full(rows, np.nan),
        x_end_px=np.full(rows, np.nan),
        start_px=np.zeros(rows, np.int64),
        step=np.zeros(rows, np.int64),
        time_s=time_s,
    )
