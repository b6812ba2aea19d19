"""A smooth map from board to picture: a homography and, with points enough, what a lens bends on top of it.

It needs no camera: the bend is a polynomial over the board, fitted to points whose board positions are known. It says
where corners should be and how the board is drawn around one.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_BENDS = ((30, 3), (12, 2))
"""(least number of points, degree of the polynomial): three points to a term at least."""
_FEWEST_POINTS = 4
_KEPT_SHARES = (0.8, 0.8, 1.0)
"""Of the points, the closest ones, on which the polynomial is fitted again: a point far off must not bend it."""
_OUTLIER_MEDIANS = 5.0
_LEAST_OUTLIER_PX = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class BoardMap:
    """Board positions (metres) to raw pixels. homography: (3, 3) float64. bend_px: (terms, 2) float64, x^i y^j."""

    homography: Array
    bend_px: Array
    degree: int
    centre_m: Array
    half_m: Array

    def to_px(self, points_m: ArrayLike) -> Array:
        """Raw pixels (..., 2) of board positions (..., 2)."""
        points = np.asarray(points_m, np.float64)
        at = (points - self.centre_m) / self.half_m
        seen = np.concatenate([at, np.ones((*at.shape[:-1], 1))], axis=-1) @ self.homography.T
        mapped: Array = seen[..., :2] / seen[..., 2:] + _terms(at, self.degree) @ self.bend_px
        return mapped


def fit_map(
    points_m: Array, px: Array, outlier_px: float, size_m: tuple[float, float]
) -> tuple[BoardMap, NDArray[np.bool_]] | None:
    """The map through points (n, 2) seen at px (n, 2), and which of them lie on it within outlier_px.

    size_m: the board's, over which the polynomial runs from -1 to 1. None where no four points agree.
    """
    if len(points_m) < _FEWEST_POINTS:
        return None
    half = np.array(size_m) / 2
    at = (points_m - half) / half
    homography, mask = cv2.findHomography(at, px, cv2.RANSAC, outlier_px, maxIters=2000, confidence=0.9999)
    if homography is None or not np.isfinite(homography).all():
        return None
    inside: NDArray[np.bool_] = mask.ravel() > 0
    if inside.sum() < _FEWEST_POINTS:
        return None
    degree = next((degree for fewest, degree in _BENDS if inside.sum() >= fewest), 0)
    flat = BoardMap(np.asarray(homography, np.float64), np.zeros((len(_powers(degree)), 2)), degree, half, half)
    if degree == 0:
        return flat, inside
    terms, missed = _terms(at, degree), px - flat.to_px(points_m)
    for share in _KEPT_SHARES:
        bend, *_ = np.linalg.lstsq(terms[inside], missed[inside], rcond=1e-6)
        off = np.hypot(*(missed - terms @ bend).T)
        usual = float(np.median(off[inside]))
        close = max(_OUTLIER_MEDIANS * usual, _LEAST_OUTLIER_PX)
        inside = off <= (close if share == 1 else max(float(np.quantile(off[inside], share)), _LEAST_OUTLIER_PX))
    bend, *_ = np.linalg.lstsq(terms[inside], missed[inside], rcond=1e-6)
    return BoardMap(flat.homography, np.asarray(bend, np.float64), degree, half, half), inside


def _powers(degree: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]


def _terms(at: Array, degree: int) -> Array:
    across = np.polynomial.polynomial.polyvander(at[..., 0], degree)
    down = np.polynomial.polynomial.polyvander(at[..., 1], degree)
    i, j = np.array(_powers(degree)).T
    terms: Array = across[..., i] * down[..., j]
    return terms
