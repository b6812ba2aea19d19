"""Scores an answer against the truth, by the same rules for every way to measure depth.

A pixel is scored if camera and source both see its surface, if the surface is within the depth range, and if the
scene's depth was measured there and not guessed. The error in pixels is that of the disparity, b f |1/z - 1/z_true|:
the same unit for all strategies, those by triangulation and those by time of flight. A missing answer counts as
`MISSING_PX`, and so does a larger error. So it is no advantage to leave out answers.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from drivers.interfaces import SweepTruth
from rig.geometry.stripe_table import MISSING_PX
from rig.simd import Bools
from rig.strategies.strategy import GOOD, Answer, ColumnGeometry

CONFIDENT: Final = 0.9
"""Least confidence of a confident answer."""
SAME_PX: Final = 1.5
"""Largest distance of a pixel from the true stripe of the nearest columns if the source sees the pixel's surface."""


@dataclass(frozen=True, slots=True)
class Score:
    """Score of an answer.

    pixels: number of scored pixels. mean_px: mean error of all of them; a missing answer and a larger error count as
    MISSING_PX. median_px, median_m: median error of the pixels with an answer, in pixels of disparity and in metres;
    None if no pixel has one. good, valid, confident_wrong: shares of the scored pixels with an answer within 2 % of the
    depth, with any answer, and with an answer of confidence 0.9 or more that is not within 2 %.
    """

    pixels: int
    mean_px: float
    median_px: float | None
    median_m: float | None
    good: float
    valid: float
    confident_wrong: float


def scored_pixels(truth: SweepTruth, geometry: ColumnGeometry) -> Bools:
    """Mask (rows, width) of the pixels that are scored, of the measured rows. truth: truth of all image rows, for the
    geometry's columns."""
    depth_m, stripes = truth.depth_m[geometry.rows], truth.x_px[geometry.rows]
    near_m, far_m = geometry.depth_range_m
    with np.errstate(invalid="ignore"):
        inside = (depth_m >= near_m) & (depth_m <= far_m) & ~geometry.defects
    column = geometry.column_of(depth_m)
    nearest = np.rint(np.nan_to_num(column)).astype(np.int64)
    x, row = np.arange(depth_m.shape[1]), np.arange(len(depth_m))[:, None]
    off = np.full(depth_m.shape, np.inf)
    for step in (-1, 0, 1):
        stripe = stripes[row, np.clip(nearest + step, 0, geometry.columns - 1)]
        off = np.fmin(off, np.abs(stripe - x))
    lit = np.isfinite(column) & (off <= SAME_PX)
    return inside & lit if truth.trusted is None else inside & lit & truth.trusted[geometry.rows]


def score(answer: Answer, truth: SweepTruth, geometry: ColumnGeometry, scored: Bools) -> Score:
    """Score an answer. scored: from `scored_pixels`. Raises ValueError if no pixel is scored."""
    if not scored.any():
        raise ValueError("no pixel can be scored: the source lights nothing that the camera sees and knows")
    true_m = truth.depth_m[geometry.rows][scored].astype(np.float64)
    depth_m = answer.depth_m[scored].astype(np.float64)
    given = np.isfinite(depth_m)
    off_m = np.abs(depth_m - true_m)
    off_px = geometry.px_per_inverse_depth * np.abs(1 / np.where(given, depth_m, 1.0) - 1 / true_m)
    good = given & (np.where(given, off_m, np.inf) <= GOOD * true_m)
    sure = given & (answer.confidence[scored] >= CONFIDENT)
    return Score(
        pixels=len(true_m),
        mean_px=float(np.where(given, np.minimum(off_px, MISSING_PX), MISSING_PX).mean()),
        median_px=float(np.median(off_px[given])) if given.any() else None,
        median_m=float(np.median(off_m[given])) if given.any() else None,
        good=float(good.mean()),
        valid=float(given.mean()),
        confident_wrong=float((sure & ~good).mean()),
    )
