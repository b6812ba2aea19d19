"""Depth on the camera grid: a pixel's column is interpolated between the stripes of neighbouring columns on its row."""

import numpy as np
from numpy.typing import NDArray

from rig.geometry import SweepGeometry
from rig.stripes import StripeTable


def depth_map(stripes: StripeTable, geometry: SweepGeometry, min_confidence: float) -> NDArray[np.float32]:
    """Depth z in metres (rows, width) float32, NaN where two confident neighbouring stripes do not enclose the pixel.

    Only stripes of at least `min_confidence` take part; nothing else is filled. Depth outside the depth range by more
    than a tenth is no estimate either.
    """
    from rig.depth_kernels import fill_rows

    shape = (geometry.rows, geometry.width)
    inverse_depth = np.full(shape, np.nan, np.float32)
    fill_rows(
        stripes.x_px, stripes.confidence, stripes.x_sd_px, min_confidence, geometry.plane, geometry.u, geometry.v,
        inverse_depth, np.full(shape, -1.0, np.float32),
    )  # fmt: skip
    near_m, far_m = geometry.depth_range_m
    with np.errstate(invalid="ignore"):
        inside = (inverse_depth <= 1.1 / near_m) & (inverse_depth >= 0.9 / far_m)
    depth = np.full(shape, np.nan, np.float32)
    depth[inside] = 1.0 / inverse_depth[inside]
    return depth
