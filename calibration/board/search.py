"""Where a board is, roughly: OpenCV's markers, on every form of the picture that may show them.

Under few photons the picture is tried enlarged (small markers are read when their modules have a few pixels) and
smoothed (shot noise breaks their outline).
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.board.board import Board
from calibration.board.marker_layout import Markers

Array = NDArray[np.float64]
Gray = NDArray[np.uint8]

FORMS = ((1, 0.0), (2, 0.8), (3, 0.8), (2, 1.5), (4, 1.2))
"""(enlargement, smoothing in pixels of the picture), in the order they are tried; measured in docs/calibration.md."""
_ENOUGH = 0.9
"""Share of the markers at which no further form is tried."""
_DARKEST, _BRIGHTEST = 0.5, 99.5
"""Percentiles that become black and white: a hot pixel or a lamp is neither."""


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """Points of the board (n, 2) in metres and where they are seen, (n, 2) raw pixels, about half a pixel.

    count: markers or corners read. chessboards: how many are in the picture. part: corners along (x, y) of what may be
    a part of the chessboard. other: how the chessboard that is seen differs from the board. markers: all that were
    read, the board's and others.
    """

    points_m: Array
    px: Array
    count: int
    mirrored: bool = False
    chessboards: int = 1
    part: tuple[int, int] | None = None
    other: str | None = None
    markers: Markers | None = None

    def square_px(self, board: Board) -> float:
        """Side of a square, from the points' spread."""
        spread_px = np.sqrt(np.prod(np.std(self.px, axis=0)))
        return float(max(spread_px / np.sqrt(np.prod(np.std(self.points_m, axis=0))) * board.square_m, 1.0))


def gray(values: NDArray[np.float32]) -> Gray:
    """The picture from 0 to 255, stretched between its darkest and brightest parts."""
    low, high = np.percentile(values, [_DARKEST, _BRIGHTEST])
    span = max(float(high - low), 1e-12)
    return np.asarray(np.clip((values - low) * (255 / span), 0, 255), np.uint8)


def find_markers(shown: Gray, board: Board) -> Sighting:
    """The board's markers; `mirrored` where the mirror image of the picture shows more of them."""
    best = _most_markers(shown, board)
    if best.count <= 0.25 * len(board.charuco().getIds()):
        flipped = _most_markers(np.ascontiguousarray(shown[:, ::-1]), board)
        if flipped.count > 2 * best.count + 2:
            return Sighting(flipped.points_m, flipped.px, flipped.count, mirrored=True)
    return best


def as_form(shown: Gray, scale: int, smooth: float) -> Gray:
    """One of the forms; a pixel of it lies at (x + 0.5) / scale - 0.5 of the picture."""
    smoothed = cv2.GaussianBlur(shown, (0, 0), smooth) if smooth else shown
    if scale == 1:
        return np.asarray(smoothed, np.uint8)
    return np.asarray(cv2.resize(smoothed, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC), np.uint8)


def _most_markers(shown: Gray, board: Board) -> Sighting:
    charuco = board.charuco()
    places = {
        int(marker): np.asarray(points, np.float64)[:, :2]
        for marker, points in zip(np.ravel(charuco.getIds()), charuco.getObjPoints(), strict=True)
    }
    detector = cv2.aruco.ArucoDetector(charuco.getDictionary())
    best, most = Sighting(np.zeros((0, 2)), np.zeros((0, 2)), 0), (0, 0)
    for scale, smooth in FORMS:
        corners, found, _ = detector.detectMarkers(as_form(shown, scale, smooth))
        if found is None:
            continue
        ids = found.ravel().astype(np.int64)
        px = (np.array(corners, np.float64).reshape(-1, 4, 2) + 0.5) / scale - 0.5
        known = np.isin(ids, list(places))
        if (int(known.sum()), len(ids)) > most:
            most = int(known.sum()), len(ids)
            points = np.array([places[marker] for marker in ids[known].tolist()]).reshape(-1, 2)
            best = Sighting(points, px[known].reshape(-1, 2), most[0], markers=Markers(ids, px))
        if best.count >= _ENOUGH * len(places):
            break
    return best
