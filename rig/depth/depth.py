"""Depth on the camera grid: a pixel's column is interpolated between the stripes of neighbouring columns on its row.

Depth is z in metres, NaN where there is none (`depth_map`; the rule is in `rig.depth.kernels`).

With several lines, columns that are lit together may claim the same stripe. An estimator looks at one column at a time.
If search windows overlap it also sees the stripes of the other columns, and may take the brightest one for its own. At
most one of the claims is right. So coinciding answers of one row and place of the mirror share their confidence
(`share_claims`).
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rig.geometry.line_grid import LineGrid
from rig.geometry.stripe_table import StripeTable
from rig.geometry.windows import SweepGeometry
from rig.simd import Bools, Float32
from rig.threads import RowWorkers


class DepthMap(NamedTuple):
    """Depth on the camera grid, with its confidence and its error; all arrays float32 (rows, width).

    depth_m: z in metres, NaN where there is none. confidence: the lower confidence of the two stripes between which the
    pixel lies, 0 where there is no depth. depth_sd_m: standard deviation of the depth in metres, NaN where there is
    none. It follows from `x_sd_px` of these two stripes, provided that they are the right ones. The calibration's error
    is not in it.
    """

    depth_m: Float32
    confidence: Float32
    depth_sd_m: Float32

    @classmethod
    def empty(cls, rows: int, width: int) -> "DepthMap":
        """A map without any depth."""
        nan = np.full((rows, width), np.nan, np.float32)
        return cls(nan, np.zeros((rows, width), np.float32), nan.copy())

    def without(self, points: Bools) -> "DepthMap":
        """The map without the depths of these pixels, bool (rows, width)."""
        if not points.any():
            return self
        left = DepthMap(*(values.copy() for values in self))
        left.depth_m[points], left.confidence[points], left.depth_sd_m[points] = np.nan, 0.0, np.nan
        return left


def depth_map(
    stripes: StripeTable, geometry: SweepGeometry, min_confidence: float, workers: RowWorkers | None = None
) -> DepthMap:
    """Depth of the pixels that two neighbouring stripes of one surface enclose, with its confidence and its error.

    Only stripes with at least `min_confidence` are used. There is also no depth if 1/z is above 1.1 / near or below
    0.9 / far, with near and far the limits of the depth range.
    """
    from rig.depth.kernels import depth_rows, fill_rows

    near_m, far_m = geometry.depth_range_m
    lowest, highest = np.float32(0.9 / far_m), np.float32(1.1 / near_m)
    shape = geometry.rows, geometry.width
    depth = DepthMap(np.empty(shape, np.float32), np.full(shape, -1.0, np.float32), np.empty(shape, np.float32))
    light = geometry.light

    def work(first: int, last: int) -> None:
        rows = slice(first, last)
        inverse_depth = np.full((last - first, geometry.width), np.nan, np.float32)
        command = np.full(inverse_depth.shape if light is not None else (0, 0), np.nan)
        fill_rows(
            stripes.x_px[rows], stripes.confidence[rows], stripes.x_sd_px[rows], min_confidence, geometry.plane,
            geometry.u[rows], geometry.v[rows], inverse_depth, depth.confidence[rows], depth.depth_sd_m[rows],
            np.zeros(0) if light is None else light.commands, command,
        )  # fmt: skip
        if light is not None:
            inverse_depth = light.inverse_depth(command, first)
        depth_rows(inverse_depth, lowest, highest, depth.depth_m[rows], depth.confidence[rows], depth.depth_sd_m[rows])

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
