"""Columns that are lit together may take one and the same stripe for theirs: at most one of them is right.

An estimator looks at one column at a time. Where windows of several lines overlap it sees the others' stripes too, and
the brightest wins in each. So answers of one row and place of the mirror that coincide share what they are worth.
"""

from dataclasses import replace

import numpy as np

from rig.multi_line import LineGrid
from rig.stripes import StripeTable

SAME_PX = 1.5
"""Answers this close mean the same stripe: each may be off by a pixel, and stripes that meet cannot be told apart."""


def share_claims(stripes: StripeTable, grid: LineGrid) -> StripeTable:
    """The table with confidences c of coinciding answers times c over the sum of theirs: of two that are as sure, half.

    Positions stay as they are.
    """
    columns = grid.columns_at()
    x, confidence = stripes.x_px[:, columns], stripes.confidence[:, columns]  # (rows, places, lines)
    claimed = np.zeros_like(confidence)
    for other in range(grid.lines):
        with np.errstate(invalid="ignore"):
            same = np.abs(x - x[:, :, other, None]) <= SAME_PX
        claimed += np.where(same, confidence[:, :, other, None], np.float32(0))
    shared = np.array(stripes.confidence)
    shared[:, columns] = np.where(
        claimed > confidence, confidence * (confidence / np.maximum(claimed, 1e-9)), confidence
    )
    return replace(stripes, confidence=shared)
