"""Where a board is, roughly: OpenCV's markers and chessboards, on every form of the picture that may show them.

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

_FORMS = ((1, 0.0), (2, 0.8), (3, 0.8), (2, 1.5), (4, 1.2))
"""(enlargement, smoothing in pixels of the picture), in the order they are tried; measured in docs/calibration.md."""
_ENOUGH = 0.9
"""Share of the markers at which no further form is tried."""
_DARKEST, _BRIGHTEST = 0.5, 99.5
"""Percentiles that become black and white: a hot pixel or a lamp is neither."""
_SMALLEST_PART = (3, 3)
"""Inner corners of a chessboard that count as a part of one."""


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """Points of the board (n, 2) in metres and where they are seen, (n, 2) raw pixels, about half a pixel.

    count: markers or corners read. chessboards: how many are in the picture. part: inner corners of a chessboard that
    is smaller than the board. markers: all that were read, the board's and others.
    """

    points_m: Array
    px: Array
    count: int
    mirrored: bool = False
    chessboards: int = 1
    part: tuple[int, int] | None = None
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


def find_chessboard(shown: Gray, board: Board) -> Sighting:
    """The chessboard's inner corners, the first one at the board's top left as far as that can be told."""
    nothing = np.zeros((0, 2))
    for scale, smooth in _FORMS:
        form = _form(shown, scale, smooth)
        px = _whole_chessboard(form, board.grid)
        if px is None:
            continue
        px = (px + 0.5) / scale - 0.5
        px, mirrored = _from_top_left(px, shown, board)
        hidden = shown.copy()
        cv2.fillConvexPoly(hidden, _outline(px.reshape(-1, 2), board), int(np.median(shown)))
        again = _whole_chessboard(_form(hidden, scale, smooth), board.grid) is not None
        points = board.corners_m[:, :2]
        return Sighting(points, px.reshape(-1, 2), len(points), mirrored, 1 + again)
    for scale, smooth in _FORMS[:2]:
        flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_EXHAUSTIVE
        found, corners, meta = cv2.findChessboardCornersSBWithMeta(_form(shown, scale, smooth), _SMALLEST_PART, flags)
        if found:
            return Sighting(nothing, nothing, len(corners), part=(meta.shape[1], meta.shape[0]))
    return Sighting(nothing, nothing, 0)


def _form(shown: Gray, scale: int, smooth: float) -> Gray:
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
    for scale, smooth in _FORMS:
        corners, found, _ = detector.detectMarkers(_form(shown, scale, smooth))
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


def _whole_chessboard(form: Gray, grid: tuple[int, int]) -> Array | None:
    """(down, across, 2) inner corners in pixels of the form, or None."""
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
    found, corners = cv2.findChessboardCorners(form, grid, flags=flags)
    if not found:
        found, corners = cv2.findChessboardCornersSB(form, grid, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
    return np.asarray(corners, np.float64).reshape(grid[1], grid[0], 2) if found else None


def _from_top_left(px: Array, shown: Gray, board: Board) -> tuple[Array, bool]:
    """The grid numbered as the board is, and whether it is the board's mirror image.

    The numbering is turned so that x to y is clockwise in the picture, as it is from in front of the board, then by
    half a turn where the top left square would be white. With both sides even, or both odd, a half turn changes no
    colour: then x runs to the right.
    """
    along, below = px[:, -1] - px[:, 0], px[-1] - px[0]
    if np.mean(along, axis=0)[0] * np.mean(below, axis=0)[1] < np.mean(along, axis=0)[1] * np.mean(below, axis=0)[0]:
        px = px[::-1]
    across, down = board.squares
    if (across + down) % 2:
        return (px if _top_left_is_black(px, shown) else px[::-1, ::-1]), False
    if np.mean(px[:, -1] - px[:, 0], axis=0)[0] < 0:
        px = px[::-1, ::-1]
    chiral = across % 2 == 0 and across != down
    return px, chiral and not _top_left_is_black(px, shown)


def _top_left_is_black(px: Array, shown: Gray) -> bool:
    """Of the squares between the corners: those of the top left one's colour are the darker ones."""
    middles = (px[:-1, :-1] + px[:-1, 1:] + px[1:, :-1] + px[1:, 1:]) / 4
    height, width = shown.shape
    x = np.clip(np.round(middles[..., 0]).astype(int), 0, width - 1)
    y = np.clip(np.round(middles[..., 1]).astype(int), 0, height - 1)
    # The first square between corners is the second along both sides: of the top left one's colour.
    same = np.add.outer(np.arange(middles.shape[0]), np.arange(middles.shape[1])) % 2 == 0
    light = shown[y, x].astype(np.float64)
    return bool(light[same].mean() < light[~same].mean())


def _outline(px: Array, board: Board) -> NDArray[np.int32]:
    """The board's four outer corners in the picture."""
    homography, _ = cv2.findHomography(board.corners_m[:, :2], px)
    width, height = board.size_m
    ends = np.array([[[0, 0], [width, 0], [width, height], [0, height]]], np.float64)
    seen = np.asarray(cv2.perspectiveTransform(ends, homography), np.float64)
    return np.asarray(np.round(seen[0]), np.int32)
