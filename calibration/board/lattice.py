"""The extent of a chessboard in a picture: which corners of a grid are there; and the first search for markers.

Where four squares meet, the light changes across the line between them above the corner and, the other way round, below
it; along a row of corners the change turns about from one to the next. A row that was only guessed, or that lies on the
edge of the print, shows no such change on its outer side, and one that follows outside the grid does. So a grid is cut
down to the corners that are there, and grows while more of them follow. What lies outside the picture is not known.

OpenCV looks for markers on every form of the picture that may show them. Under few photons the picture is tried
enlarged (small markers are read when their modules have a few pixels) and smoothed (shot noise breaks their outline).
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.arrays import Array
from calibration.board.board import Board
from calibration.board.drawing import BoardMap, Drawing, fit_map
from calibration.board.markers import Markers
from calibration.board.registration import SUBPIXELS, WIDE, register, sides_px

Picture = NDArray[np.float32]

_OFFSETS = np.array([0.1, 0.2, 0.3, 0.4])
"""Places where the change is looked at, in squares from the corner: clear of its edges, and within the outer squares
where half of them was cut off."""
_THERE = 0.3
_GOES_ON = 0.5
"""Least change across a line outside the grid, as a share of that in the grid, for another row to follow there. In
OpenCV's 26 chessboard pictures a row that is there has 0.75 to 1.15 of it, one that is not 0.09 at most."""
_LEAST_ALIKE = 0.8
"""Share of the corners that are there; in noise it is half of them."""
_FEWEST = 2
"""Corners along a side, and changes that tell of a row."""
_OUTLIER_SQUARES = 0.4
_MOST = 100
"""Corners along a side: as many as a board may have."""


@dataclass(frozen=True, slots=True, eq=False)
class Lattice:
    """Corners of a chessboard as far as they are seen.

    px: (down, across, 2) raw pixels. beyond: of its upper, right, lower and left side, the change of light in the next
    row of squares as a share of the usual one; NaN where the picture does not show it.
    """

    px: Array
    beyond: tuple[float, float, float, float]

    @property
    def grid(self) -> tuple[int, int]:
        """Corners along (x, y)."""
        return self.px.shape[1], self.px.shape[0]

    @property
    def least(self) -> tuple[int, int]:
        """Corners along (x, y), counting rows that are seen to follow but could not be placed."""
        upper, right, lower, left = (change >= _GOES_ON for change in self.beyond)
        return self.px.shape[1] + left + right, self.px.shape[0] + upper + lower

    @property
    def known(self) -> tuple[bool, bool]:
        """Whether the number along (x, y) is the print's: it is seen to end on both sides."""
        upper, right, lower, left = (change < _GOES_ON for change in self.beyond)
        return left and right, upper and lower


def known_lattice(picture: Picture, px: Array) -> Lattice | None:
    """The corners that are there, from a grid (down, across, 2) that may have some too many or too few; None where
    the picture shows no chessboard there.
    """
    cut = _cut_down(picture, px)
    if cut is None:
        return None
    grown = _grown(picture, cut)
    seen = _seen(picture, grown)
    if seen is None or seen.alike < _LEAST_ALIKE:
        return None
    upper, right, lower, left = (_seen_beyond(picture, np.rot90(grown, turn)) for turn in range(4))
    return Lattice(grown, (upper, right, lower, left))


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """usual: change across a line, positive where the top left square is black. alike: share of the corners with one
    like it. own: of the uppermost row, on its outer side, as a share of the usual; NaN where it cannot be seen.
    """

    usual: float
    alike: float
    own: float


def _cut_down(picture: Picture, px: Array) -> Array | None:
    """The grid without outer rows that are not there."""
    while min(px.shape[:2]) >= _FEWEST:
        sides = [_seen(picture, np.rot90(px, turn)) for turn in range(4)]
        own = [np.inf if side is None or not np.isfinite(side.own) else side.own for side in sides]
        worst = int(np.argmin(own))
        if own[worst] >= _THERE:
            return px
        px = np.rot90(np.rot90(px, worst)[1:], -worst)
    return None


def _grown(picture: Picture, px: Array) -> Array:
    """The grid with the rows that follow outside."""
    turn = kept = 0
    while kept < 4 and max(px.shape[:2]) < _MOST:
        turned = np.rot90(px, turn)
        more = _row_above(picture, turned) if _seen_beyond(picture, turned) >= _GOES_ON else None
        if more is None:
            turn, kept = (turn + 1) % 4, kept + 1
        else:
            px, kept = np.rot90(np.concatenate([more[None], turned]), -turn), 0
    return px


def _seen(picture: Picture, px: Array) -> _Seen | None:
    board_map = _map(px)
    if board_map is None:
        return None
    down, across = px.shape[:2]
    x, y = np.meshgrid(np.arange(1, across + 1), np.arange(1, down + 1))
    sign = np.where((x + y) % 2 == 0, 1.0, -1.0)
    above, below = (sign * side * _change(picture, board_map, x, y, side) for side in (1, -1))
    both = np.stack([above, below])
    if np.isfinite(both).sum() < both.size / 2:
        return None
    usual = float(np.nanmedian(both))
    if usual == 0:
        return None
    alike = float(np.mean(both[np.isfinite(both)] / usual > _THERE))
    return _Seen(usual, alike, _median(above[0] / usual))


def _seen_beyond(picture: Picture, px: Array) -> float:
    """The change in the row of squares above the grid's uppermost, as a share of the usual; NaN where not seen."""
    board_map, seen = _map(px), _seen(picture, px)
    if board_map is None or seen is None:
        return np.nan
    x = np.arange(1, px.shape[1] + 1)
    change = _change(picture, board_map, x, np.zeros_like(x), 1)
    return _median(np.where(x % 2 == 0, 1.0, -1.0) * change / seen.usual)


def _change(picture: Picture, board_map: BoardMap, x: NDArray[np.integer], y: NDArray[np.integer], side: int) -> Array:
    """Light right of a lattice point less that left of it, above (side 1) or below (-1); NaN outside the picture."""
    along, up = np.meshgrid(np.concatenate([-_OFFSETS[::-1], _OFFSETS]), side * _OFFSETS)
    at = np.stack([x[..., None, None] + along, y[..., None, None] - up], axis=-1)
    px = board_map.to_px(at).astype(np.float32).reshape(-1, 2)
    height, width = picture.shape
    inside = ((px >= 0) & (px <= np.array([width - 1, height - 1]))).all(axis=1)
    light = cv2.remap(picture, np.where(inside, px.T, 0)[0], np.where(inside, px.T, 0)[1], cv2.INTER_LINEAR).ravel()
    light = np.where(inside, light, np.nan).reshape(*at.shape[:-1])
    half = len(_OFFSETS)
    change: Array = light[..., half:].mean(axis=(-1, -2)) - light[..., :half].mean(axis=(-1, -2))
    return change


def _row_above(picture: Picture, px: Array) -> Array | None:
    """(across, 2) corners above the uppermost row; None where most of them are not found."""
    board_map, seen = _map(px), _seen(picture, px)
    if board_map is None or seen is None:
        return None
    down, across = px.shape[:2]
    x = np.arange(1, across + 1)
    expected = board_map.to_px(np.stack([x, np.zeros_like(x)], axis=-1))
    taller = _map(np.concatenate([expected[None], px]))
    if taller is None:
        return None
    board = _board(across, down + 1)
    # The drawing's top left square is black; that of the taller grid is where this one's is white.
    shown = picture if seen.usual < 0 else np.float32(picture.max()) - picture
    side = sides_px(board, taller, np.array([board.size_m]) / 2)[0]
    ids, found, _ = register(
        shown, Drawing.of(board, SUBPIXELS * side), taller, np.arange(across, dtype=np.int32), WIDE, True
    )
    if 2 * len(ids) < across:
        return None
    expected[ids] = found
    return expected


def _map(px: Array) -> BoardMap | None:
    """The map to pixels from squares, counted from the outer corner of the grid's top left one."""
    board = _board(px.shape[1], px.shape[0])
    points = px.reshape(-1, 2)
    side = np.median(np.linalg.norm(np.diff(px, axis=1), axis=-1))
    found = fit_map(board.corners_m[:, :2], points, max(_OUTLIER_SQUARES * float(side), 1.0), board.size_m)
    return None if found is None else found[0]


def _board(across: int, down: int) -> Board:
    return Board("chessboard", (across + 1, down + 1), 1.0)


def _median(values: Array) -> float:
    """NaN where fewer than half of them, or than two, are known."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) >= max(_FEWEST, len(values) / 2) else np.nan


Gray = NDArray[np.uint8]

FORMS = ((1, 0.0), (2, 0.8), (3, 0.8), (2, 1.5), (4, 1.2))
"""(enlargement, smoothing in pixels of the picture), in the order they are tried; measured in
docs/how-to/calibration.md."""
_ENOUGH = 0.9
"""Share of the markers at which no further form is tried."""
_DARKEST, _BRIGHTEST = 0.5, 99.5
"""Percentiles that become black and white: a hot pixel or a lamp is neither."""


@dataclass(frozen=True, slots=True, eq=False)
class MatchedPoints:
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


def find_markers(shown: Gray, board: Board) -> MatchedPoints:
    """The board's markers; `mirrored` where the mirror image of the picture shows more of them."""
    best = _most_markers(shown, board)
    if best.count <= 0.25 * len(board.charuco().getIds()):
        flipped = _most_markers(np.ascontiguousarray(shown[:, ::-1]), board)
        if flipped.count > 2 * best.count + 2:
            return MatchedPoints(flipped.points_m, flipped.px, flipped.count, mirrored=True)
    return best


def as_form(shown: Gray, scale: int, smooth: float) -> Gray:
    """One of the forms; a pixel of it lies at (x + 0.5) / scale - 0.5 of the picture."""
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
