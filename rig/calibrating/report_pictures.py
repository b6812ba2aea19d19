"""Pictures of a calibration: where corners were seen, by how much they miss, how large the depth error is where."""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.depth.uncertainty import DepthUncertainty
from rig.pictures import depth_limits, depth_picture

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]

_WIDTH_PX = 640
_GROUND, _RIM, _INK = (255, 255, 255), (200, 194, 189), (77, 64, 51)
_ERROR = (0, 94, 213)
"""Colours are BGR."""
_COLOURS = ((178, 114, 0), (0, 94, 213), (115, 158, 0), (167, 121, 204), (0, 159, 230), (233, 180, 86), (66, 228, 240))
"""Of Okabe and Ito, told apart by the colour-blind too; by turns for the views."""
ARROW_TIMES = (1000, 500, 200, 100, 50, 20, 10, 5, 2, 1)


def view_colour(view: int) -> tuple[int, int, int]:
    """BGR, of the view with this number, in all pictures and charts."""
    return _COLOURS[view % len(_COLOURS)]


def coverage_picture(names: Sequence[str], corners_px: Sequence[Array], size: tuple[int, int]) -> Picture:
    """The corners of all views, a colour and its name for each view, in the outline of the picture (width, height)."""
    picture, scale = _sheet(size)
    for i, (name, corners) in enumerate(zip(names, corners_px, strict=True)):
        for x, y in corners:
            cv2.circle(picture, _at(x, y, scale), 3, view_colour(i), -1, cv2.LINE_AA)
        if len(corners):
            x, y = _at(float(corners[0, 0]), float(corners[0, 1]), scale)
            cv2.putText(picture, name, (x + 5, y - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.4, _INK, 1, cv2.LINE_AA)
    return picture


def residual_picture(
    corners_px: Sequence[Array], residuals_px: Sequence[Array], size: tuple[int, int]
) -> tuple[Picture, int]:
    """Arrows from corners along their residuals, and by how much they are drawn longer than they are."""
    picture, scale = _sheet(size)
    lengths = np.concatenate([np.hypot(*residual.T) for residual in residuals_px if len(residual)] or [np.ones(1)])
    typical = float(np.percentile(lengths, 90)) * scale
    times = next((factor for factor in ARROW_TIMES if typical * factor < _WIDTH_PX / 25), 1)
    for corners, residuals in zip(corners_px, residuals_px, strict=True):
        for (x, y), (dx, dy) in zip(corners, residuals, strict=True):
            end = _at(x + times * dx, y + times * dy, scale)
            cv2.line(picture, _at(x, y, scale), end, _ERROR, 1, cv2.LINE_AA)
            cv2.circle(picture, _at(x, y, scale), 2, _INK, -1, cv2.LINE_AA)
    return picture, times


def error_picture(uncertainty: DepthUncertainty) -> Picture:
    """The expected depth error in colour, red where it is large; black where the scan does not reach at this depth."""
    large = _enlarged_mm(uncertainty.sd_m)
    limits = depth_limits(large)
    return depth_picture(large, None if limits is None else (limits[1], limits[0]), unit="mm")  # red: large


def cells_picture(cells_m: Array) -> Picture:
    """How far the squares of a board lie off their plane, red in front of it; black where they were not scanned."""
    large = _enlarged_mm(cells_m)
    known = large[np.isfinite(large)]
    most = max(float(np.abs(known).max()), 1e-3) if known.size else 1.0
    return depth_picture(large, (-most, most), unit="mm")


def _enlarged_mm(values_m: Array) -> NDArray[np.float32]:
    rows, columns = values_m.shape
    size = (_WIDTH_PX, max(1, round(_WIDTH_PX * rows / columns)))
    return np.asarray(cv2.resize(values_m * 1e3, size, interpolation=cv2.INTER_NEAREST), np.float32)


def _sheet(size: tuple[int, int]) -> tuple[Picture, float]:
    width, height = size
    scale = _WIDTH_PX / width
    picture = np.full((round(height * scale), _WIDTH_PX, 3), _GROUND, np.uint8)
    cv2.rectangle(picture, (0, 0), (_WIDTH_PX - 1, picture.shape[0] - 1), _RIM, 1)
    return picture, scale


def _at(x: float, y: float, scale: float) -> tuple[int, int]:
    return round((x + 0.5) * scale), round((y + 0.5) * scale)
