"""Finds markers, and checks that their places and ids agree with the board's file.

First each marker gets a place (column, row) on the lattice of squares, without using its id: the outline of a marker
tells where the neighbouring squares are, and so on from marker to marker. A layout says at which place each id should
be. If a layout other than the stated one fits clearly more of the markers, the print is another board. Ids run row by
row over the white squares, usually from 0. OpenCV before 4.6 began boards with an even number of rows with a white
square.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.arrays import Array
from calibration.board.board import Board

Places = NDArray[np.int64]

_NEXT_SQUARES = 2.5
"""Most columns or rows from a placed marker to the next; doubled once _FOR_HOMOGRAPHY are placed. Neighbours: 1."""
_OFF_SQUARES = 0.3
"""Largest distance, along a row or column, of a marker of the lattice from the middle of a square."""
_MOST_TURN_RAD = 0.6
_FOR_HOMOGRAPHY = 4
_MOST_ACROSS = 40
_CLEARLY_MORE = 2
"""By how many more markers another layout must fit: single ones may be misread."""
_LEAST_SHARE = 0.6
"""Least share of a lattice's markers that a layout must fit."""
_EDGE_SQUARES = 0.2
"""Distance beyond a row at which the next one is looked for: within the white paper around a print."""
_WHITE_PERCENT = 90
"""Percentile of the pixels among markers that counts as white; half of these pixels are white."""
_FEWEST = 6
"""Fewest markers for which _LEAST_SHARE is meaningful."""


@dataclass(frozen=True, slots=True, eq=False)
class Markers:
    """The markers that were read. ids: (n,) int64; px: (n, 4, 2) corners, clockwise from the marker's own top left."""

    ids: Places
    px: Array


@dataclass(frozen=True, slots=True, eq=False)
class _Layout:
    """An order of ids from first_id on. across: squares along a row. white_first: whether its top left one is white."""

    across: int
    white_first: bool = False
    first_id: int = 0

    def places(self, ids: Places) -> Places:
        """(n, 2) column and row of markers, also for ids below the first one."""
        if self.across % 2 == 0:
            row, at = np.divmod(ids - self.first_id, self.across // 2)
            column = 2 * at + (row + (not self.white_first)) % 2
        else:  # two rows hold as many markers as a row has squares
            pair, at = np.divmod(ids - self.first_id, self.across)
            upper = (self.across + self.white_first) // 2
            row = 2 * pair + (at >= upper)
            column = 2 * (at - upper * (at >= upper)) + (row + (not self.white_first)) % 2
        return np.stack([column, row], axis=-1)


def contradiction(read: Markers, board: Board, shown: NDArray[np.uint8]) -> str | None:
    """Say how the markers that were `read` in the picture `shown` contradict the board; None if they fit it."""
    assert board.marker_m is not None, "asked of boards with markers"
    placed, lattice = _lattice(read.px, board.marker_m / board.square_m)
    ids, lattice = read.ids[placed], lattice[placed]
    stated = _Layout(board.squares[0])
    known = ids < board.squares[0] * board.squares[1] // 2
    fitting, origin = _support(stated, ids[known], lattice[known])
    different = len(np.unique(ids))  # a second board alike repeats them, and may stand on the same lattice by chance
    if fitting < different:
        others = list(_others(board, int(ids.min())))
        support = [_support(layout, ids, lattice)[0] for layout in others]
        best = int(np.argmax(support))  # the first, and so the likeliest, of equally good ones
        if support[best] >= max(fitting + _CLEARLY_MORE, _LEAST_SHARE * different):
            return _named(others[best], ids, board)
        if different >= _FEWEST and fitting < _LEAST_SHARE * different:
            return f"{different - fitting} of the {different} markers read do not stand where the board has them"
    return _ends_early(board, shown, read.px[placed], lattice - origin)


def _others(board: Board, least_id: int) -> Iterator[_Layout]:
    """The layouts that may have been printed, the likeliest first. The first is the board's own, with more rows.

    least_id: the lowest id that was read. The pattern of places repeats every two rows, which together hold as many
    markers as a row has squares. So lower first ids than those tried here fit no differently.
    """
    across, down = board.squares
    yield _Layout(across)
    if down % 2 == 0:
        yield _Layout(across, white_first=True)
    widths = range(3, _MOST_ACROSS + 1)
    yield from (_Layout(width) for width in widths)
    for width in (across, *widths):
        yield from (_Layout(width, first_id=first) for first in range(least_id, max(0, least_id - width), -1))


def _named(layout: _Layout, ids: Places, board: Board) -> str:
    if layout.first_id:
        return f"its markers are numbered from {layout.first_id} on, those of the board from 0"
    if layout.across != board.squares[0]:
        return f"it is {layout.across} squares wide, the board {board.squares[0]}"
    if layout.white_first:
        return (
            "its top left square is white, the board's is black: OpenCV before 4.6 drew boards with an even number of "
            "rows so"
        )
    last = board.squares[0] * board.squares[1] // 2 - 1
    return (
        f"its markers are {ids.min()} to {ids.max()}, those of the board are 0 to {last}: its rows are more, or "
        "numbered otherwise"
    )


def _support(layout: _Layout, ids: Places, lattice: Places) -> tuple[int, Places]:
    """The number of markers that stand where the layout has them, and the lattice's place of its top left square."""
    if len(ids) == 0:
        return 0, np.zeros(2, np.int64)
    origins, counts = np.unique(lattice - layout.places(ids), axis=0, return_counts=True)
    most = int(np.argmax(counts))
    return int(counts[most]), origins[most]


def _lattice(px: Array, marker_squares: float) -> tuple[NDArray[np.bool_], Places]:
    """The lattice that holds most of the markers (n, 4, 2): a mask (n,) of these, and their (n, 2) columns and rows."""
    best, places = np.zeros(len(px), np.bool_), np.zeros((len(px), 2), np.int64)
    tried = np.zeros(len(px), np.bool_)
    for start in np.argsort([-cv2.contourArea(corners.astype(np.float32)) for corners in px]):
        if tried[start]:
            continue
        placed, found = _grown(px, int(start), marker_squares)
        tried |= placed
        if placed.sum() > best.sum():
            best, places = placed, found
    return best, places


def _grown(px: Array, start: int, marker_squares: float) -> tuple[NDArray[np.bool_], Places]:
    places = np.zeros((len(px), 2), np.int64)
    placed = np.arange(len(px)) == start
    while True:
        to_lattice = _map_to_lattice(places[placed], px[placed], marker_squares)
        if to_lattice is None:
            return placed, places
        at = cv2.perspectiveTransform(px.reshape(-1, 1, 2), to_lattice).reshape(-1, 4, 2)
        middle, right = at.mean(axis=1), at[:, 1] - at[:, 0] + at[:, 2] - at[:, 3]
        nearest = np.round(middle)
        apart = np.abs(nearest[:, None] - places[placed]).max(axis=-1)
        good = np.abs(middle - nearest).max(axis=1) < _OFF_SQUARES
        good &= np.abs(np.arctan2(right[:, 1], right[:, 0])) < _MOST_TURN_RAD
        good &= (apart.min(axis=1) > 0) & ~placed
        good &= apart.min(axis=1) < (_NEXT_SQUARES if placed.sum() < _FOR_HOMOGRAPHY else 2 * _NEXT_SQUARES)
        if not good.any():
            return placed, places
        places[good] = nearest[good].astype(np.int64)
        placed |= good


def _map_to_lattice(places: Places, px: Array, marker_squares: float) -> Array | None:
    """Map (3, 3) from pixels to squares; (0, 0) is the middle of the square at place (0, 0). None if there is none.

    For few markers it is affine: the errors of an affine map grow less with distance than those of a homography.
    """
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (marker_squares / 2)
    lattice, seen = (places[:, None] + corners).reshape(-1, 2), px.reshape(-1, 2)
    if len(places) < _FOR_HOMOGRAPHY:
        to_lattice = np.eye(3)
        to_lattice[:2] = np.linalg.lstsq(np.column_stack([seen, np.ones(len(seen))]), lattice, rcond=None)[0].T
    else:
        found, _ = cv2.findHomography(seen, lattice)
        if found is None:
            return None
        to_lattice = np.asarray(found, np.float64)
    return to_lattice if np.isfinite(to_lattice).all() and abs(np.linalg.det(to_lattice)) > 0 else None


def _ends_early(board: Board, shown: NDArray[np.uint8], px: Array, places: Places) -> str | None:
    """Say that white paper is visible below the print's last markers, where the board has black squares; else None."""
    across, down = board.squares
    assert board.marker_m is not None, "asked of boards with markers"
    to_lattice = _map_to_lattice(places, px, board.marker_m / board.square_m)
    if to_lattice is None:
        return None
    (left, top), (right, bottom) = px.reshape(-1, 2).min(axis=0).astype(int), px.reshape(-1, 2).max(axis=0).astype(int)
    white = float(np.percentile(shown[max(top, 0) : bottom + 1, max(left, 0) : right + 1], _WHITE_PERCENT))
    column = np.arange(across, dtype=np.float64)
    last = int(places[:, 1].max())
    for rows in range(last + 1, min(last + 3, down)):  # the last row's markers may not have been read
        below = _seen(shown, to_lattice, column[rows % 2 :: 2], rows - 0.5 + _EDGE_SQUARES)
        black = _seen(shown, to_lattice, column[(rows - 1) % 2 :: 2], rows - 1.0)
        if below is None or black is None:
            return None
        if float(below.min()) > (white + float(np.median(black))) / 2:
            return f"it ends below its row {rows}, the board has {down} rows"
    return None


def _seen(shown: NDArray[np.uint8], to_lattice: Array, column: Array, row: float) -> Array | None:
    """The picture at places of the lattice; None if one lies outside."""
    at = np.stack([column, np.full(column.size, row)], axis=-1)[:, None]
    px = np.round(cv2.perspectiveTransform(at, np.linalg.inv(to_lattice))[:, 0]).astype(int)
    height, width = shown.shape
    if px.min() < 0 or px[:, 0].max() >= width or px[:, 1].max() >= height:
        return None
    return np.asarray(shown[px[:, 1], px[:, 0]], np.float64)


Gray = NDArray[np.uint8]

FORMS = ((1, 0.0), (2, 0.8), (3, 0.8), (2, 1.5), (4, 1.2))
"""(enlargement, smoothing in pixels of the picture), in the order they are tried (docs/how-to/calibration.md)."""
_ENOUGH = 0.9
"""Share of the markers from which on no further form is tried."""
_DARKEST, _BRIGHTEST = 0.5, 99.5
"""Percentiles that become black and white: a hot pixel or a lamp is neither."""


@dataclass(frozen=True, slots=True, eq=False)
class MatchedPoints:
    """Points of the board (n, 2) in metres and their places in the picture, (n, 2) raw pixels, to about half a pixel.

    count: number of the board's markers, or of corners, read. mirrored: whether only the picture's mirror image shows
    the board. chessboards: 2 if another one like the board was seen, else 1. part: corners along (x, y) of what may be
    a part of the chessboard, or None. other: how the visible chessboard differs from the board, or None. markers: all
    that were read, the board's and others; None for a chessboard or a mirror image.
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
        """Side of a square in pixels, from the points' spread; 1 at least."""
        spread_px = np.sqrt(np.prod(np.std(self.px, axis=0)))
        return float(max(spread_px / np.sqrt(np.prod(np.std(self.points_m, axis=0))) * board.square_m, 1.0))


def gray(values: NDArray[np.float32]) -> Gray:
    """The picture scaled to 0..255 between its darkest and brightest parts."""
    low, high = np.percentile(values, [_DARKEST, _BRIGHTEST])
    span = max(float(high - low), 1e-12)
    return np.asarray(np.clip((values - low) * (255 / span), 0, 255), np.uint8)


def find_markers(shown: Gray, board: Board) -> MatchedPoints:
    """The corners of the board's markers. If few are found, and more than twice as many in the picture's mirror image,
    the result is that of the mirror image: `mirrored` is set, `px` are its pixels, and `markers` is None.
    """
    best = _most_markers(shown, board)
    if best.count <= 0.25 * len(board.charuco().getIds()):
        flipped = _most_markers(np.ascontiguousarray(shown[:, ::-1]), board)
        if flipped.count > 2 * best.count + 2:
            return MatchedPoints(flipped.points_m, flipped.px, flipped.count, mirrored=True)
    return best


def as_form(shown: Gray, scale: int, smooth: float) -> Gray:
    """The picture enlarged and smoothed. Pixel x of the result lies at (x + 0.5) / scale - 0.5 of the picture."""
    smoothed = cv2.GaussianBlur(shown, (0, 0), smooth) if smooth else shown
    if scale == 1:
        return np.asarray(smoothed, np.uint8)
    return np.asarray(cv2.resize(smoothed, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC), np.uint8)


def _most_markers(shown: Gray, board: Board) -> MatchedPoints:
    charuco = board.charuco()
    places = {
        int(marker): np.asarray(points, np.float64)[:, :2]
        for marker, points in zip(np.ravel(charuco.getIds()), charuco.getObjPoints(), strict=True)
    }
    detector = cv2.aruco.ArucoDetector(charuco.getDictionary())
    best, most = MatchedPoints(np.zeros((0, 2)), np.zeros((0, 2)), 0), (0, 0)
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
            best = MatchedPoints(points, px[known].reshape(-1, 2), most[0], markers=Markers(ids, px))
        if best.count >= _ENOUGH * len(places):
            break
    return best
