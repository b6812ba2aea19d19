"""Where a picture is even along its rows: away from edges of print that the line crosses.

A pixel's passage is that of the light it gets. Where a lens or the pixel itself mixes white from one side with black
from the other, that is the white's: up to a quarter of a pixel off. Edges along the row do no harm: the line runs
across them, and lights both sides at once.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.board.board import PAPER_SQUARES, Board
from calibration.views import Corners

BLUR_PX = 1.0
LEAST_SLOPE = 0.1
"""Relative change of the flux per pixel that counts as an edge, and least multiple of the picture's noise."""
NOISE_TIMES = 4.0
AWAY_PX = 2
"""Pixels kept clear of an edge."""


def even_pixels(picture: NDArray[np.float32]) -> NDArray[np.bool_]:
    """True (height, width) where the flux of a picture changes little along the row; noise is no edge."""
    known = np.isfinite(picture)
    filled = np.where(known, np.maximum(picture, 0), 0).astype(np.float32)
    smooth = cv2.GaussianBlur(filled, (0, 0), BLUR_PX)
    slope = np.abs(cv2.Sobel(smooth, cv2.CV_32F, 1, 0)) / 8
    relative = slope / np.maximum(smooth, 1e-3 * float(smooth.max()) + 1e-12)
    edge = relative > max(LEAST_SLOPE, NOISE_TIMES * float(np.median(relative[known])) if known.any() else 0.0)
    kernel = np.ones((1, 2 * AWAY_PX + 1), np.uint8)
    near = cv2.dilate((edge | ~known).astype(np.uint8), kernel) > 0
    result: NDArray[np.bool_] = ~near
    return result


def board_pixels(corners: Corners, board: Board, size: tuple[int, int]) -> NDArray[np.bool_]:
    """True (height, width) on the squares of a board whose corners were found, and on the paper around them."""
    at_m = board.corners_m[corners.ids][:, :2]
    homography, _ = cv2.findHomography(at_m, corners.px, method=0)
    mask = np.zeros(size, np.uint8)
    if homography is None:
        return mask > 0
    paper = PAPER_SQUARES * board.square_m
    right, bottom = board.size_m[0] + paper, board.size_m[1] + paper
    outline = np.array([[[-paper, -paper], [right, -paper], [right, bottom], [-paper, bottom]]], np.float64)
    outline_px = cv2.perspectiveTransform(outline, homography)[0]
    cv2.fillPoly(mask, [np.rint(outline_px).astype(np.int32)], 1)
    return mask > 0
