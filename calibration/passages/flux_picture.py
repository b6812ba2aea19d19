"""The picture of a scene that a sweep saw, photons per pixel and exposure, from the counts of its columns.

The response of one-bit pixels is inverted, flux = -ln(1 - share of 1s). A pixel that is lit in every frame is treated
as if half a frame were not. If room light alone gives a picture, the columns in which the line lit a pixel are left
out, because the line saturates white and black alike on near boards and leaves stripes if columns are wide. In the dark
the line's own light makes the picture, summed over columns. 512 x 512 pixels of 500 columns take about 0.4 s.

`even_pixels` finds where a picture is even along its rows, away from edges of print that the line crosses. A pixel's
passage is that of the light it receives. If a lens or the pixel itself mixes white from one side with black from the
other, the white dominates and the passage is up to a quarter of a pixel off. Edges along the row do no harm, since the
line crosses them and lights both sides at once.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.arrays import Array
from calibration.board.board import PAPER_SQUARES, Board
from calibration.passages.find import SweepCounts
from calibration.views import Corners

LEFT_OUT = 10
"""Columns on either side of the line's brightest, and at most the following share of all."""
MOST_LEFT_OUT = 1 / 12
LEAST_COUNTS = 30.0
"""Detections per pixel that make a picture: the median over its brighter half."""


def flux_picture(sweeps: tuple[SweepCounts, ...]) -> NDArray[np.float32]:
    """Flux (rows, width) of the lit frames of sweeps over one scene, including dark counts; NaN outside all windows."""
    off = [_off_the_line(sweep) for sweep in sweeps]
    ones: Array = np.sum([part[0] for part in off], axis=0)
    frames: Array = np.sum([part[1] for part in off], axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        if float(np.median(ones[ones >= np.median(ones)])) >= LEAST_COUNTS:
            flux: Array = -np.log1p(-np.minimum(ones, frames - 0.5) / frames)
        else:
            parts = [_by_column(sweep) for sweep in sweeps]
            flux = np.sum([part[0] for part in parts], axis=0) / np.sum([part[1] for part in parts], axis=0)
        picture: NDArray[np.float32] = np.where(np.isfinite(flux), flux, np.nan).astype(np.float32)
    return picture


def _off_the_line(sweep: SweepCounts) -> tuple[Array, Array]:
    """1s and frames (rows, width) of the columns in which the line was elsewhere."""
    columns = len(sweep.counts)
    ones, frames = _everything(sweep)
    middle = _brightest_column(sweep)[:, : sweep.width]
    pixel_y, pixel_x = np.arange(middle.shape[0])[:, None], np.arange(middle.shape[1])[None, :]
    left_out = min(LEFT_OUT, int(columns * MOST_LEFT_OUT))
    for shift in range(-left_out, left_out + 1):
        at = middle + shift
        inside = (at >= 0) & (at < columns)
        at = np.clip(at, 0, columns - 1)
        x = pixel_x - sweep.x0[at]
        inside &= (x >= 0) & (x < sweep.counts.shape[2])
        ones -= np.where(inside, sweep.counts[at, pixel_y, np.where(inside, x, 0)], 0)
        frames -= np.where(inside, sweep.n_frames[at], 0)
    return ones, frames


def _everything(sweep: SweepCounts) -> tuple[Array, Array]:
    """1s and frames (rows, width) of all columns."""
    columns, rows, window = sweep.counts.shape
    size = (rows, int(sweep.x0.max(initial=0)) + window)
    ones, frames = np.zeros(size), np.zeros(size)
    changes = np.flatnonzero(np.diff(sweep.x0)) + 1
    for first, last in zip((0, *changes), (*changes, columns), strict=True):  # columns that have the same window
        x = slice(int(sweep.x0[first]), int(sweep.x0[first]) + window)
        ones[:, x] += sweep.counts[first:last].sum(axis=0, dtype=np.uint32)
        frames[:, x] += sweep.n_frames[first:last].sum()
    return ones[:, : sweep.width], frames[:, : sweep.width]


def _brightest_column(sweep: SweepCounts) -> NDArray[np.int32]:
    """Column (rows, width) in which a pixel and its neighbours' columns had most 1s."""
    columns, rows, window = sweep.counts.shape
    size = (rows, int(sweep.x0.max(initial=0)) + window)
    most, at = np.zeros(size, np.uint32), np.zeros(size, np.int32)
    for k in range(columns):
        x = slice(int(sweep.x0[k]), int(sweep.x0[k]) + window)
        three = sweep.counts[k].astype(np.uint32)
        for other in (k - 1, k + 1):
            if 0 <= other < columns and sweep.x0[other] == sweep.x0[k]:
                three += sweep.counts[other]
        better = three > most[:, x]
        np.copyto(most[:, x], three, where=better)
        np.copyto(at[:, x], k, where=better)
    return at


def _by_column(sweep: SweepCounts) -> tuple[Array, Array]:
    """Flux times frames, summed over the columns, and frames (rows, width)."""
    columns, rows, window = sweep.counts.shape
    flux = np.zeros((rows, int(sweep.x0.max(initial=0)) + window))
    for k in range(columns):
        n = int(sweep.n_frames[k])
        # Nearly unbiased and finite where all are lit (docs/explanation/physics.md, Counts and flux).
        inverse = n * np.log((n + 0.5) / (n - np.arange(n + 1) + 0.5))
        flux[:, int(sweep.x0[k]) : int(sweep.x0[k]) + window] += inverse.take(sweep.counts[k])
    return flux[:, : sweep.width], _everything(sweep)[1]


BLUR_PX = 1.0
LEAST_SLOPE = 0.1
"""Relative change of the flux per pixel that counts as an edge, and least multiple of the picture's noise."""
NOISE_TIMES = 4.0
AWAY_PX = 2
"""Pixels kept clear of an edge."""


def even_pixels(picture: NDArray[np.float32]) -> NDArray[np.bool_]:
    """True (height, width) where the flux of a picture changes little along the row; noise does not count as a
    change."""
    known = np.isfinite(picture)
    filled = np.where(known, np.maximum(picture, 0), 0).astype(np.float32)
    smooth = cv2.GaussianBlur(filled, (0, 0), BLUR_PX)
    slope = np.abs(cv2.Sobel(smooth, cv2.CV_32F, 1, 0)) / 8
    relative = slope / np.maximum(smooth, 1e-3 * float(smooth.max()) + 1e-12)
    edge = relative > max(LEAST_SLOPE, NOISE_TIMES * float(np.median(relative[known])) if known.any() else 0.0)
    kernel = np.ones((1, 2 * AWAY_PX + 1), np.uint8)
    near = cv2.dilate((edge | ~known).astype(np.uint8), kernel) > 0
    return ~near


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
