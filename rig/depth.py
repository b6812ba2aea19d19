"""Depth on the camera grid: a pixel's column is interpolated between the stripes of neighbouring columns on its row."""

import numpy as np
from numpy.typing import NDArray

from rig.geometry import SweepGeometry
from rig.row_threads import RowWorkers
from rig.stripes import StripeTable


def depth_map(
    stripes: StripeTable, geometry: SweepGeometry, min_confidence: float, workers: RowWorkers | None = None
) -> NDArray[np.float32]:
    """Depth z in metres (rows, width) float32, NaN where two confident neighbouring stripes do not enclose the pixel.

    Only stripes of at least `min_confidence` take part; nothing else is filled. Depth outside the depth range by more
    than a tenth is no estimate either.
    """
    from rig.depth_kernels import fill_rows

    near_m, far_m = geometry.depth_range_m
    depth = np.full((geometry.rows, geometry.width), np.nan, np.float32)
    light = geometry.light

    def work(first: int, last: int) -> None:
        rows = slice(first, last)
        inverse_depth = np.full((last - first, geometry.width), np.nan, np.float32)
        command = np.full(inverse_depth.shape if light is not None else (0, 0), np.nan)
        fill_rows(
            stripes.x_px[rows], stripes.confidence[rows], stripes.x_sd_px[rows], min_confidence, geometry.plane,
            geometry.u[rows], geometry.v[rows], inverse_depth, np.full(inverse_depth.shape, -1.0, np.float32),
            np.zeros(0) if light is None else light.commands, command,
        )  # fmt: skip
        if light is not None:
            inverse_depth = light.inverse_depth(command, first)
        with np.errstate(invalid="ignore"):
            inside = (inverse_depth <= 1.1 / near_m) & (inverse_depth >= 0.9 / far_m)
        depth[rows][inside] = 1.0 / inverse_depth[inside]

    (workers or RowWorkers(1)).over(geometry.rows, work)
    return depth
