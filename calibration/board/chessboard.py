"""Finds a plain chessboard in a picture: OpenCV finds a grid, the squares around it say whether it is the board.

OpenCV finds the grid that it is asked for in any larger print, and now and then in a smaller one, with corners that are
none. So a grid counts as the board only where its print has as many corners as the board, no fewer and no more, as far
as the picture shows (lattice.py). Measured by tests/reference/boards/chessboard_extent.py.
"""

import itertools
import math
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.arrays import Array
from calibration.board.board import Board
from calibration.board.lattice import FORMS, Gray, Lattice, MatchedPoints, as_form, known_lattice

_SMALLEST_PARTS = ((4, 4), (3, 3))
"""Inner corners of a chessboard that count as a part of one; small ones are more often found where none is."""
_FORMS_FOR_PARTS = ((1, 0.0), (1, 1.5), (2, 0.8))
"""(enlargement, smoothing), as FORMS: quick ones, since a part is looked for where the whole was not found."""
_NOTHING = MatchedPoints(np.zeros((0, 2)), np.zeros((0, 2)), 0)


def find_chessboard(shown: Gray, board: Board) -> MatchedPoints:
    """The chessboard's inner corners, the first one at the board's top left as far as that can be told; or what else
    there is: a part of it, or another chessboard.
    """
    seen: Lattice | None = None
    for form in FORMS:
        lattice = _lattice(shown, _grid(shown, board, form))
        if lattice is not None and _is_whole(lattice, board):
            return _found(lattice, shown, board, form)
        seen = _larger(seen, lattice)
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


def _larger(one: Lattice | None, other: Lattice | None) -> Lattice | None:
    return max((one, other), key=lambda lattice: 0 if lattice is None else lattice.px.size)


def _grid(shown: Gray, board: Board, form: tuple[int, float]) -> Array | None:
    """A grid with as many corners as the board, (down, across, 2) in pixels of the picture."""
    px = _whole_chessboard(as_form(shown, *form), board.grid)
    return None if px is None else (px + 0.5) / form[0] - 0.5


def _part(shown: Gray, form: tuple[int, float], smallest: tuple[int, int]) -> Array | None:
    """A grid of any number of corners."""
    flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_EXHAUSTIVE
    found, corners, meta = cv2.findChessboardCornersSBWithMeta(as_form(shown, *form), smallest, flags)
    if not found:
        return None
    return (np.asarray(corners, np.float64).reshape(*meta.shape[:2], 2) + 0.5) / form[0] - 0.5


def _whole_chessboard(form: Gray, grid: tuple[int, int]) -> Array | None:
    """(down, across, 2) inner corners in pixels of the form, or None."""
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
    found, corners = cv2.findChessboardCorners(form, grid, flags=flags)
    if not found:
        found, corners = cv2.findChessboardCornersSB(form, grid, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
    return np.asarray(corners, np.float64).reshape(grid[1], grid[0], 2) if found else None


def _found(lattice: Lattice, shown: Gray, board: Board, form: tuple[int, float]) -> MatchedPoints:
    """The board, whole; another one alike is looked for where it does not hide it."""
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


def _may_be(lattice: Lattice, board: Board) -> bool:
    """Whether the board, either way round, has as many corners as are seen, or more where they may go on."""
    return any(
        all(
            seen == has if known else seen <= has
            for seen, known, has in zip(lattice.least, lattice.known, grid, strict=True)
        )
        for grid in (board.grid, board.grid[::-1])
    )


def _unlike(lattice: Lattice, board: Board) -> MatchedPoints:
    """A part of the board, or another one."""
    count = lattice.px.size // 2
    if _may_be(lattice, board):
        return replace(_NOTHING, count=count, part=lattice.grid)
    size, looked_for = (f"{max(grid)} x {min(grid)}" for grid in (lattice.grid, board.grid))
    more = "" if all(lattice.known) else " or more"
    less = all(seen <= has for seen, has in zip(sorted(lattice.least), sorted(board.grid), strict=True))
    hidden = ", unless something hides the rest" if less else ""
    return replace(_NOTHING, count=count, other=f"a chessboard of {size}{more}, not {looked_for} corners{hidden}")


def _from_top_left(px: Array, shown: Gray, board: Board) -> tuple[Array, bool]:
    """The grid numbered as the board is, and whether it is the board's mirror image.

    The numbering is turned so that x to y is clockwise in the picture, as it is from in front of the board, then by
    half a turn where the top left square would be white. With both sides even, or both odd, a half turn changes no
    colour: then x runs to the right. With the same even number along both sides a quarter turn does.
    """
    along, below = px[:, -1] - px[:, 0], px[-1] - px[0]
    if np.mean(along, axis=0)[0] * np.mean(below, axis=0)[1] < np.mean(along, axis=0)[1] * np.mean(below, axis=0)[0]:
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
    """Whether the squares of the top left one's colour are the darker ones, as seen in the squares between the
    corners.
    """
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
