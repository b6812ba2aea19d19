"""Depth on the camera grid: a pixel's column is interpolated between the stripes of neighbouring columns on its row.

Depth is z in metres, float32 (rows, width), NaN where there is none (`depth_map`; the rule is in `rig.depth.kernels`).

With several lines, columns that are lit together may claim the same stripe. An estimator looks at one column at a time.
If search windows overlap it also sees the stripes of the other columns, and may take the brightest one for its own. At
most one of the claims is right. So coinciding answers of one row and place of the mirror share their confidence
(`share_claims`).
"""

from dataclasses import replace

import numpy as np

from rig.geometry.line_grid import LineGrid
from rig.geometry.stripe_table import StripeTable
from rig.geometry.windows import SweepGeometry
from rig.simd import Float32
from rig.threads import RowWorkers


def depth_map(
    stripes: StripeTable, geometry: SweepGeometry, min_confidence: float, workers: RowWorkers | None = None
) -> Float32:
    """Depth z in metres (rows, width) float32, NaN where no two neighbouring stripes of one surface enclose the pixel.

    Only stripes of at least `min_confidence` are used. Depth is also NaN if 1/z is above 1.1 / near or below 0.9 / far,
    with near and far the limits of the depth range.
    """
    from rig.depth.kernels import fill_rows

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
        inside = (inverse_depth <= 1.1 / near_m) & (inverse_depth >= 0.9 / far_m)
        depth[rows][inside] = 1.0 / inverse_depth[inside]

    (workers or RowWorkers(1)).over(geometry.rows, work)
    return depth


SAME_PX = 1.5
"""Answers this close mean the same stripe: each may be off by a pixel, and closer stripes cannot be separated."""


def share_claims(stripes: StripeTable, grid: LineGrid) -> StripeTable:
    """The table with the confidences of coinciding answers lowered: c becomes c^2 / s, with s the sum of the
    confidences of the answers that coincide. Two equal confidences are halved.

    Positions stay as they are.
    """
    columns = grid.columns_at()
    x, confidence = stripes.x_px[:, columns], stripes.confidence[:, columns]  # (rows, places, lines)
    claimed = np.zeros_like(confidence)
    for other in range(grid.lines):
        same = np.abs(x - x[:, :, other, None]) <= SAME_PX
        claimed += np.where(same, confidence[:, :, other, None], np.float32(0))
    shared = np.array(stripes.confidence)
    shared[:, columns] = np.where(
        claimed > confidence, confidence * (confidence / np.maximum(claimed, 1e-9)), confidence
    )
    return replace(stripes, confidence=shared)
