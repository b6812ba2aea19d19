"""A board drawn for comparison with a picture of it, and a smooth map from the board to the picture.

The map is a homography and, if there are enough points, a polynomial for the distortion of the lens. It needs no camera
model. It is fitted to points whose board positions are known, and tells where corners should be and how the board looks
around each. The polynomial is a function of the position in the picture, not on the board. Lens distortion is a
polynomial there, whatever the board's tilt; on a tilted board it is not. Fitting it on the board moves corners by less
than 0.002 px, but equally in all pictures, which makes focal lengths wrong by 0.025 % at k1 = 0.2.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.arrays import Array
from calibration.board.board import MARGIN_SQUARES, Board

_PX_PER_SQUARE = (32, 256)
"""Least and most pixels of the drawing per square."""
_MOST_PX = 1 << 25
"""Most pixels of a drawing, 128 MB. Boards of more than 21 x 21 squares reach it; the largest there are get 57 pixels a
square. Fewer pixels cost precision: 30 x 29 squares, each 17 to 24 pixels in the picture, have corners off by 0.0018 px
when drawn 134 to a square, and by 0.0009 px at 256."""


@dataclass(frozen=True, slots=True)
class Drawing:
    """The board as drawn for the comparison: white is 1, black 0. margin_px: width of the margin around the squares."""

    board: Board
    picture: NDArray[np.float32]
    px_per_square: int
    margin_px: int

    @classmethod
    def of(cls, board: Board, px_per_square: float) -> "Drawing":
        """Draw the board at this resolution, or as near to it as is possible. Each pixel is exactly the white share of
        its area.
        """
        modules = board.modules
        down, across, side, _ = modules.shape
        least, most = _PX_PER_SQUARE
        squares = (down + 2 * MARGIN_SQUARES) * (across + 2 * MARGIN_SQUARES)
        fine = int(np.clip(np.nan_to_num(px_per_square), least, min(most, (_MOST_PX / squares) ** 0.5)))
        pad = round(MARGIN_SQUARES * fine)
        white = np.zeros((down, across, side + 2, side + 2), np.float32)
        white[np.add.outer(np.arange(down), np.arange(across)) % 2 == 1] = 1  # quiet zone of the markers and all
        white[:, :, 1:-1, 1:-1] -= modules
        share = 0.0 if board.marker_m is None else board.marker_m / board.square_m
        edges = np.concatenate([[0.0], 0.5 + share * (np.arange(side + 1) / max(side, 1) - 0.5), [1.0]])
        pixels = np.arange(fine + 1) / fine
        upper = np.minimum(pixels[1:, None], edges[1:])
        covered = np.maximum(upper - np.maximum(pixels[:-1, None], edges[:-1]), 0) * fine
        covered = covered.astype(np.float32)
        drawn = np.einsum("pi,rcij,qj->rpcq", covered, white, covered, optimize=True)
        size = (down * fine, across * fine)
        return cls(board, np.pad(drawn.reshape(size), pad, constant_values=1.0), fine, pad)


_BENDS = ((30, 3), (12, 2))
"""(least number of points, degree of the polynomial): three points to a term at least."""
_FEWEST_POINTS = 4
_KEPT_SHARES = (0.8, 0.8, 1.0)
"""Shares of the points, the closest ones, that the polynomial is fitted to in turn: one far off must not bend it."""
_OUTLIER_MEDIANS = 5.0
_LEAST_OUTLIER_PX = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class BoardMap:
    """Maps board positions (metres) to raw pixels.

    homography: (3, 3) float64, for positions scaled to -1..1 over the board. bend_px: (terms, 2) float64, coefficients
    of x^i y^j of the homography's result, scaled to -1..1 over the board's picture.
    """

    homography: Array
    bend_px: Array
    degree: int
    """Degree of the polynomial; 0: the homography alone."""
    half_m: Array
    """Half of the board's size (2,)."""
    centre_px: Array
    """Middle of the points that were fitted (2,)."""
    half_px: float
    """Largest distance of these points from the middle, along x or y."""

    def to_px(self, points_m: ArrayLike) -> Array:
        """Raw pixels (..., 2) of board positions (..., 2)."""
        flat = _projected(self.homography, (np.asarray(points_m, np.float64) - self.half_m) / self.half_m)
        return flat + _terms((flat - self.centre_px) / self.half_px, self.degree) @ self.bend_px


def fit_map(
    points_m: Array, px: Array, outlier_px: float, size_m: tuple[float, float]
) -> tuple[BoardMap, NDArray[np.bool_]] | None:
    """The map through points (n, 2) seen at px (n, 2), and which of them it fits within outlier_px; None if no four
    agree.
    """
    if len(points_m) < _FEWEST_POINTS:
        return None
    half = np.array(size_m) / 2
    at = (points_m - half) / half
    first, mask = cv2.findHomography(at, px, cv2.RANSAC, outlier_px, maxIters=2000, confidence=0.9999)
    if first is None or not np.isfinite(first).all():
        return None
    homography = np.asarray(first, np.float64)
    inside: NDArray[np.bool_] = mask.ravel() > 0
    if inside.sum() < _FEWEST_POINTS:
        return None
    degree = next((degree for fewest, degree in _BENDS if inside.sum() >= fewest), 0)
    flat = _projected(homography, at)
    centre = flat[inside].mean(axis=0)
    reach = max(float(np.abs(flat[inside] - centre).max()), 1e-9)
    terms, missed = _terms((flat - centre) / reach, degree), px - flat
    bend: Array = np.zeros((terms.shape[1], 2))
    for share in _KEPT_SHARES if degree else ():
        bend = np.asarray(np.linalg.lstsq(terms[inside], missed[inside], rcond=1e-6)[0], np.float64)
        off = np.hypot(*(missed - terms @ bend).T)
        usual = float(np.median(off[inside]))
        close = max(_OUTLIER_MEDIANS * usual, _LEAST_OUTLIER_PX)
        inside = off <= (close if share == 1 else max(float(np.quantile(off[inside], share)), _LEAST_OUTLIER_PX))
    if degree:
        bend = np.asarray(np.linalg.lstsq(terms[inside], missed[inside], rcond=1e-6)[0], np.float64)
    return BoardMap(homography, bend, degree, half, centre, reach), inside


def _projected(homography: Array, at: Array) -> Array:
    seen = np.concatenate([at, np.ones((*at.shape[:-1], 1))], axis=-1) @ homography.T
    return seen[..., :2] / seen[..., 2:]


def _terms(at: Array, degree: int) -> Array:
    across = np.polynomial.polynomial.polyvander(at[..., 0], degree)
    down = np.polynomial.polynomial.polyvander(at[..., 1], degree)
    i, j = np.array([(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]).T
    return across[..., i] * down[..., j]
