"""Finds a plain chessboard in a picture. OpenCV finds a grid; the squares around it tell whether it is the board.

If asked for a grid of some size, OpenCV also finds one in any larger print, and sometimes one with false corners in a
smaller print. So a grid counts as the board only if its print has exactly as many corners as the board, as far as the
picture shows.

At a corner four squares meet. The brightness changes from left to right: in one direction above the corner, in the
other below it. Along a row of corners the direction alternates. A row of corners that OpenCV only guessed, or that lies
on the edge of the print, shows no such change on its outer side. Where the print goes on outside the grid, the change
is visible there too. So a grid is cut down to the real corners, and extended while more of them follow
(`known_lattice`). What lies outside the picture is unknown.
"""

import itertools
import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.arrays import Array
from calibration.board.board import Board
from calibration.board.markers import FORMS, Gray, MatchedPoints, as_form
from calibration.board.registration import SUBPIXELS, WIDE, BoardMap, Drawing, fit_map, register, sides_px

Picture = NDArray[np.float32]

_OFFSETS = np.array([0.1, 0.2, 0.3, 0.4])
"""Distances from a corner, in squares, at which the change is measured: clear of the edges that meet in the corner, and
within the nearer half of an outer square."""
_THERE = 0.3
_GOES_ON = 0.5
"""Least change of brightness, as a share of the usual one in the grid. _THERE: for a corner or an outer row to be real.
_GOES_ON: outside the grid, for another row to follow there. In OpenCV's 26 chessboard pictures the share is 0.75 to
1.15 where a row follows, and 0.09 at most where none does."""
_LEAST_ALIKE = 0.8
"""Least share of a grid's corners that must show the change; in noise half of them do."""
_FEWEST = 2
"""Fewest corners along a side, and fewest measured changes from which a row is judged."""
_OUTLIER_SQUARES = 0.4
_MOST = 100
"""Most corners along a side: no board has more squares."""


@dataclass(frozen=True, slots=True, eq=False)
class Lattice:
    """Corners of a chessboard as far as they are visible.

    px: (down, across, 2) raw pixels. beyond: for its upper, right, lower and left side, the change of brightness at the
    next row of corners, on that row's outer side, as a share of the usual one; NaN if the picture does not show it.
    """

    px: Array
    beyond: tuple[float, ...]

    @property
    def grid(self) -> tuple[int, int]:
        """Number of corners along (x, y)."""
        return self.px.shape[1], self.px.shape[0]

    @property
    def least(self) -> tuple[int, int]:
        """Smallest possible number of corners along (x, y), counting rows that follow but could not be located."""
        upper, right, lower, left = (change >= _GOES_ON for change in self.beyond)
        return self.px.shape[1] + left + right, self.px.shape[0] + upper + lower

    @property
    def known(self) -> tuple[bool, bool]:
        """For (x, y): whether these are all corners of the print, because its end is visible on both sides."""
        upper, right, lower, left = (change < _GOES_ON for change in self.beyond)
        return left and right, upper and lower


def known_lattice(picture: Picture, px: Array) -> Lattice | None:
    """The real corners, from a grid (down, across, 2) that may have rows too many or too few; None if the picture shows
    no chessboard there.
    """
    cut = _cut_down(picture, px)
    if cut is None:
        return None
    grown = _grown(picture, cut)
    seen = _seen(picture, grown)
    if seen is None or seen.alike < _LEAST_ALIKE:
        return None
    return Lattice(grown, tuple(_seen_beyond(picture, np.rot90(grown, turn)) for turn in range(4)))


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """Light around the corners of a grid.

    map: maps positions in squares, from the outer corner of the top left square, to pixels. usual: median change of
    brightness at a corner, positive if the top left square is black. alike: share of the changes seen, above and below
    corners, that are like it. own: change on the outer side of the uppermost row, as a share of the usual one; NaN if
    not visible.
    """

    map: BoardMap
    usual: float
    alike: float
    own: float


def _cut_down(picture: Picture, px: Array) -> Array | None:
    """The grid without outer rows and columns that are not real; None if fewer than two of either are left."""
    while min(px.shape[:2]) >= _FEWEST:
        sides = [_seen(picture, np.rot90(px, turn)) for turn in range(4)]
        own = [np.inf if side is None or not np.isfinite(side.own) else side.own for side in sides]
        worst = int(np.argmin(own))
        if own[worst] >= _THERE:
            return px
        px = np.rot90(np.rot90(px, worst)[1:], -worst)
    return None


def _grown(picture: Picture, px: Array) -> Array:
    """The grid, extended on all sides by the rows of corners that follow, up to _MOST corners along a side."""
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
    return _Seen(board_map, usual, alike, _median(above[0] / usual))


def _seen_beyond(picture: Picture, px: Array) -> float:
    """The change at the next row of corners above the grid, on its upper side, as a share of the usual one, or NaN."""
    seen = _seen(picture, px)
    if seen is None:
        return np.nan
    x = np.arange(1, px.shape[1] + 1)
    change = _change(picture, seen.map, x, np.zeros_like(x), 1)
    return _median(np.where(x % 2 == 0, 1.0, -1.0) * change / seen.usual)


def _change(picture: Picture, board_map: BoardMap, x: NDArray[np.integer], y: NDArray[np.integer], side: int) -> Array:
    """Light right of a lattice point minus that left of it, above (side 1) or below (-1); NaN outside the picture."""
    along, up = np.meshgrid(np.concatenate([-_OFFSETS[::-1], _OFFSETS]), side * _OFFSETS)
    at = np.stack([x[..., None, None] + along, y[..., None, None] - up], axis=-1)
    px = board_map.to_px(at).astype(np.float32).reshape(-1, 2)
    height, width = picture.shape
    inside = ((px >= 0) & (px <= np.array([width - 1, height - 1]))).all(axis=1)
    at_x, at_y = np.where(inside, px.T, 0)
    light = cv2.remap(picture, at_x, at_y, cv2.INTER_LINEAR).ravel()
    light = np.where(inside, light, np.nan).reshape(*at.shape[:-1])
    half = len(_OFFSETS)
    return np.asarray(light[..., half:].mean(axis=(-1, -2)) - light[..., :half].mean(axis=(-1, -2)))


def _row_above(picture: Picture, px: Array) -> Array | None:
    """(across, 2) corners above the uppermost row. A corner that is not found is put at its expected place; None if
    most are not found or no smooth map fits.
    """
    seen = _seen(picture, px)
    if seen is None:
        return None
    down, across = px.shape[:2]
    x = np.arange(1, across + 1)
    expected = seen.map.to_px(np.stack([x, np.zeros_like(x)], axis=-1))
    taller = _map(np.concatenate([expected[None], px]))
    if taller is None:
        return None
    board = _board(across, down + 1)
    # The drawing's top left square is black; that of the taller grid is black where this grid's is white.
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
    """The map of `_Seen` through the corners of a grid; None if no smooth map fits them."""
    board = _board(px.shape[1], px.shape[0])
    points = px.reshape(-1, 2)
    side = np.median(np.linalg.norm(np.diff(px, axis=1), axis=-1))
    found = fit_map(board.corners_m[:, :2], points, max(_OUTLIER_SQUARES * float(side), 1.0), board.size_m)
    return None if found is None else found[0]


def _board(across: int, down: int) -> Board:
    return Board("chessboard", (across + 1, down + 1), 1.0)


def _median(values: Array) -> float:
    """The median of the known values; NaN if fewer than half of them, or fewer than two, are known."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) >= max(_FEWEST, len(values) / 2) else np.nan


_SMALLEST_PARTS = ((4, 4), (3, 3))
"""Fewest inner corners of a part of a chessboard, tried in turn; smaller grids are often found where no board is."""
_FORMS_FOR_PARTS = ((1, 0.0), (1, 1.5), (2, 0.8))
"""(enlargement, smoothing), as in FORMS; few and quick ones, since they are tried after all of FORMS have failed."""
_NOTHING = MatchedPoints(np.zeros((0, 2)), np.zeros((0, 2)), 0)


def find_chessboard(shown: Gray, board: Board) -> MatchedPoints:
    """The board's inner corners, from its top left if the print shows which corner that is. If only a part of it or a
    chessboard of another size is seen, there are no points, and `part` or `other` says so. If the corner squares are
    white, there are points, and `other` says so. If nothing is found, there are no points either.
    """
    seen: Lattice | None = None
    for form in FORMS:
        lattice = _lattice(shown, _grid(shown, board, form))
        if lattice is not None and _is_whole(lattice, board):
            return _found(lattice, shown, board, form)
        seen = max(seen, lattice, key=lambda one: 0 if one is None else one.px.size)
        if seen is not None and math.prod(seen.least) > len(board.corners_m):
            break
    if seen is not None:
        return _unlike(seen, board)
    for form, smallest in itertools.product(_FORMS_FOR_PARTS, _SMALLEST_PARTS):
        lattice = _lattice(shown, _part(shown, form, smallest))
        if lattice is not None and min(lattice.grid) >= min(smallest):
            return _found(lattice, shown, board, form) if _is_whole(lattice, board) else _unlike(lattice, board)
    return _NOTHING


def _lattice(shown: Gray, px: Array | None) -> Lattice | None:
    return None if px is None else known_lattice(shown.astype(np.float32), px)


def _as_grid(corners: ArrayLike, shape: tuple[int, ...], scale: int) -> Array:
    """Corners in an enlarged picture as a grid (down, across, 2) in pixels of the picture itself."""
    return (np.asarray(corners, np.float64).reshape(*shape, 2) + 0.5) / scale - 0.5


def _grid(shown: Gray, board: Board, form: tuple[int, float]) -> Array | None:
    """The corners (down, across, 2) that OpenCV finds for the board's own grid; None if it finds none."""
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
    picture = as_form(shown, *form)
    found, corners = cv2.findChessboardCorners(picture, board.grid, flags=flags)
    if not found:
        found, corners = cv2.findChessboardCornersSB(picture, board.grid, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
    return _as_grid(corners, board.grid[::-1], form[0]) if found else None


def _part(shown: Gray, form: tuple[int, float], smallest: tuple[int, int]) -> Array | None:
    """A grid of any number of corners from `smallest` on; None if there is none."""
    flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_EXHAUSTIVE
    found, corners, meta = cv2.findChessboardCornersSBWithMeta(as_form(shown, *form), smallest, flags)
    return _as_grid(corners, meta.shape[:2], form[0]) if found else None


def _found(lattice: Lattice, shown: Gray, board: Board, form: tuple[int, float]) -> MatchedPoints:
    """The points of the whole board; `chessboards` is 2 if the rest of the picture shows another one like it."""
    px = lattice.px if lattice.grid == board.grid else lattice.px.transpose(1, 0, 2)
    px, mirrored = _from_top_left(px, shown, board)
    points = board.corners_m[:, :2]
    sighting = MatchedPoints(points, px.reshape(-1, 2), len(points), mirrored)
    if not mirrored and not _top_left_is_black(px, shown):
        return replace(sighting, other="a chessboard whose corner squares are white, not black")
    hidden = shown.copy()
    cv2.fillConvexPoly(hidden, _outline(sighting.px, board), int(np.median(shown)))
    again = _lattice(hidden, _grid(hidden, board, form))
    return replace(sighting, chessboards=1 + (again is not None and _is_whole(again, board)))


def _is_whole(lattice: Lattice, board: Board) -> bool:
    """Whether as many corners are seen as the board has, and no sign of more."""
    return sorted(lattice.least) == sorted(lattice.grid) == sorted(board.grid)


def _unlike(lattice: Lattice, board: Board) -> MatchedPoints:
    """The result for a lattice that is not the whole board: a part of the board, or another chessboard."""
    count = lattice.px.size // 2
    may_be = any(  # with x and y as they are or exchanged: the corners seen are all, or more may follow
        all(
            seen == has if known else seen <= has
            for seen, known, has in zip(lattice.least, lattice.known, grid, strict=True)
        )
        for grid in (board.grid, board.grid[::-1])
    )
    if may_be:
        return replace(_NOTHING, count=count, part=lattice.grid)
    size, looked_for = (f"{max(grid)} x {min(grid)}" for grid in (lattice.grid, board.grid))
    more = "" if all(lattice.known) else " or more"
    less = all(seen <= has for seen, has in zip(sorted(lattice.least), sorted(board.grid), strict=True))
    hidden = ", unless something hides the rest" if less else ""
    return replace(_NOTHING, count=count, other=f"a chessboard of {size}{more}, not {looked_for} corners{hidden}")


def _from_top_left(px: Array, shown: Gray, board: Board) -> tuple[Array, bool]:
    """The grid numbered as the board is, and whether it is the board's mirror image.

    First the rows are ordered so that x to y is clockwise in the picture, as in front of the board. If one number of
    squares is odd and the other even, the numbering is then turned by half a turn if the top left square would be
    white. Otherwise half a turn changes no colour, and x is made to run to the right; if both numbers are the same, a
    quarter turn comes first if the top left square would be white.
    """
    (along_x, along_y), (below_x, below_y) = np.mean(px[:, -1] - px[:, 0], axis=0), np.mean(px[-1] - px[0], axis=0)
    if along_x * below_y < along_y * below_x:
        px = px[::-1]
    across, down = board.squares
    if (across + down) % 2:
        return (px if _top_left_is_black(px, shown) else px[::-1, ::-1]), False
    if across == down and not _top_left_is_black(px, shown):
        px = np.rot90(px)
    if np.mean(px[:, -1] - px[:, 0], axis=0)[0] < 0:
        px = px[::-1, ::-1]
    chiral = across % 2 == 0 and across != down
    return px, chiral and not _top_left_is_black(px, shown)


def _top_left_is_black(px: Array, shown: Gray) -> bool:
    """Whether the top left square is black, judged by the brightness of all squares between the corners."""
    middles = (px[:-1, :-1] + px[:-1, 1:] + px[1:, :-1] + px[1:, 1:]) / 4
    height, width = shown.shape
    x = np.clip(np.round(middles[..., 0]).astype(int), 0, width - 1)
    y = np.clip(np.round(middles[..., 1]).astype(int), 0, height - 1)
    # The first square between corners is the second of the board along x and y, so it has the top left one's colour.
    same = np.add.outer(np.arange(middles.shape[0]), np.arange(middles.shape[1])) % 2 == 0
    light = shown[y, x].astype(np.float64)
    return bool(light[same].mean() < light[~same].mean())


def _outline(px: Array, board: Board) -> NDArray[np.int32]:
    """The board's four outer corners in the picture."""
    homography, _ = cv2.findHomography(board.corners_m[:, :2], px)
    width, height = board.size_m
    ends = np.array([[[0, 0], [width, 0], [width, height], [0, height]]], np.float64)
    return np.asarray(np.round(cv2.perspectiveTransform(ends, homography)[0]), np.int32)
