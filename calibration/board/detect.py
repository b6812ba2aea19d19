"""Finds a board's corners in a noisy picture, which shows the flux from summed counts or comes from an image file.

Unusable pixels are first filled in from their neighbours. OpenCV looks for the markers, or the chessboard, in the
picture as it is, then in enlarged and smoothed versions, until one shows enough. A smooth map through what it found
gives the places of all corners, and each corner is then fitted on its own (registration.py). A picture that cannot be
used is refused with the reason: no board, the wrong board, half of one, its mirror image, or two boards.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calibration.arrays import Array
from calibration.board.board import Board
from calibration.board.chessboard import find_chessboard
from calibration.board.markers import MatchedPoints, contradiction, find_markers, gray
from calibration.board.registration import OWN, SUBPIXELS, WIDE, BoardMap, Drawing, fit_map, register, sides_px
from calibration.errors import Degenerate
from calibration.views import Corners

_REACHES = (1, 2, 4)
"""Half widths of the neighbourhood, in pixels. The next one is used where a whole neighbourhood is unusable."""


def repaired(picture: NDArray[np.generic], defects: NDArray[np.bool_] | None = None) -> NDArray[np.float32]:
    """The picture with defects (True) and non-finite values replaced by the median of usable pixels nearby, or by 0."""
    values: NDArray[np.float32] = np.array(picture, dtype=np.float32)
    bad = ~np.isfinite(values)
    if defects is not None:
        bad |= defects
    values[bad] = np.nan
    for reach in _REACHES:
        rows, columns = np.nonzero(np.isnan(values))
        if len(rows) == 0:
            return values
        padded = np.pad(values, reach, constant_values=np.nan)
        step = np.arange(2 * reach + 1)
        around = padded[rows[:, None, None] + step[:, None], columns[:, None, None] + step].reshape(len(rows), -1)
        known = ~np.isnan(around).all(axis=1)
        values[rows[known], columns[known]] = np.nanmedian(around[known], axis=1)
    return np.nan_to_num(values)


LEAST_SHARE = 0.5
"""A view must show more than this share of the board's corners."""
_SECOND_BOARD_MARKERS = 4
"""Fewest markers off the board that count as a second board: so many would not be misread alike."""
_MAP_OUTLIER_SQUARES = 0.4
"""Largest distance of a point from the homography, in squares. Lenses bend a board by less; misread markers are farther
off."""
_GROWTH_SQUARES = 1.6
"""Distance from the known part of a board to the next corners; beyond, a map through a few markers is too wrong."""
_OUTLIER_SDS = 6.0
"""Sds that a corner may lie off the map. The limit is at least _LEAST_OUTLIER_PX and _LEAST_OUTLIER_SQUARES, since the
map does not follow a lens exactly."""
_LEAST_OUTLIER_PX = 0.3
_MOST_USUAL_SDS = 4.0
"""Largest ratio of a corner's sd to the median one: beyond, the drawing was matched to something else."""
_LEAST_OUTLIER_SQUARES = 0.02


def find_corners(picture: NDArray[np.generic], board: Board, defects: NDArray[np.bool_] | None = None) -> Corners:
    """The board's corners in a picture (height, width), float or uint8; defects: (height, width), True = unusable.

    Raises Degenerate with no-board, wrong-board, board-half-out, mirrored or two-boards. A chessboard can be seen to be
    mirrored only if the numbers of squares along both sides are even and not equal. Takes about 0.2 s for 48 corners.
    """
    values = repaired(picture, defects)
    shown = gray(values)
    sighting = find_chessboard(shown, board) if board.kind == "chessboard" else find_markers(shown, board)
    wrong = sighting.other if sighting.markers is None else contradiction(sighting.markers, board, shown)
    if wrong is not None:
        raise Degenerate(
            "wrong-board",
            f"the picture shows another board than the one looked for: {wrong}; name the board that is shown "
            "(--board), or print that one",
        )
    limit_px = _MAP_OUTLIER_SQUARES * sighting.square_px(board) if len(sighting.px) >= 4 else 0.0
    found = fit_map(sighting.points_m, sighting.px, limit_px, board.size_m)
    if sighting.chessboards > 1 or (found is not None and _another(sighting, ~found[1], limit_px, board)):
        raise Degenerate(
            "two-boards",
            f"the picture shows two boards alike ({len(sighting.points_m)} corners of squares or markers, more than "
            "one board of them); show one at a time, or boards with different markers",
        )
    if sighting.mirrored:
        raise Degenerate(
            "mirrored",
            "the board is mirrored: it is found only in the picture's mirror image; turn the print over, take the "
            "mirror out of the path, or correct the sensor's orientation in the config",
        )
    if found is None:
        raise _not_found(sighting, board)
    ids, px, sd = _refined(values, board, found[0], sighting)
    if len(ids) <= LEAST_SHARE * len(board.corners_m):
        raise _too_few(len(ids), board, found[0], values.shape)
    order = np.argsort(ids)
    return Corners(ids[order], px[order], sd[order])


def _another(sighting: MatchedPoints, rest: NDArray[np.bool_], limit_px: float, board: Board) -> bool:
    """Whether the points `rest`, which are not on the best board, lie on a second one."""
    if rest.sum() < 4 * _SECOND_BOARD_MARKERS:
        return False
    second = fit_map(sighting.points_m[rest], sighting.px[rest], limit_px, board.size_m)
    return second is not None and int(second[1].sum()) >= 4 * _SECOND_BOARD_MARKERS


def _refined(
    values: NDArray[np.float32], board: Board, rough: BoardMap, sighting: MatchedPoints
) -> tuple[NDArray[np.int32], Array, Array]:
    """Ids, pixels and sds of all corners found: first those close to the points of `sighting`, then those farther out,
    with maps through the corners found so far, and last each on the pixels nearest to it. Empty if no map fits.
    """
    corners_m = board.corners_m[:, :2]
    side = sides_px(board, rough, np.array([board.size_m]) / 2)[0]
    drawing = Drawing.of(board, SUBPIXELS * side)
    board_map, wanted = rough, _close_to(sighting.points_m, board)
    before, reach, search = 0, WIDE, True
    while True:
        ids, px, sd = register(values, drawing, board_map, wanted, reach, search)
        better = fit_map(corners_m[ids], px, _MAP_OUTLIER_SQUARES * side, board.size_m)
        if better is None:
            return ids[:0], px[:0], sd[:0]
        board_map = better[0]
        off = np.hypot(*(px - board_map.to_px(corners_m[ids])).T)
        usual_sd = np.median(sd) if len(sd) else 0.0
        good = (sd <= _MOST_USUAL_SDS * usual_sd) & (
            off <= np.maximum(_OUTLIER_SDS * sd, max(_LEAST_OUTLIER_PX, _LEAST_OUTLIER_SQUARES * side))
        )
        ids, px, sd = ids[good], px[good], sd[good]
        if reach == OWN:
            return ids, px, sd
        wanted = _close_to(corners_m[ids], board)
        if not search and (len(ids) <= before or len(ids) == len(corners_m)):
            wanted, reach = ids, OWN
        before, search = (0 if search else len(ids)), False


def _close_to(known_m: Array, board: Board) -> NDArray[np.int32]:
    """Ids of the corners so close to known points that the map through these points holds there."""
    away = np.linalg.norm(board.corners_m[:, None, :2] - known_m, axis=-1).min(axis=1, initial=np.inf)
    return np.flatnonzero(away <= _GROWTH_SQUARES * board.square_m).astype(np.int32)


def _not_found(sighting: MatchedPoints, board: Board) -> Degenerate:
    markers = board.kind == "charuco"
    whole, what = (len(board.charuco().getIds()), "markers") if markers else (len(board.corners_m), "corners")
    if sighting.part is not None:
        seen, all_of_them = (f"{max(grid)} x {min(grid)}" for grid in (sighting.part, board.grid))
        return Degenerate(
            "board-half-out",
            f"the picture shows {seen} of the chessboard's {all_of_them} corners; all of them must be in it, with "
            "white around: move the board in, name the board that is shown (--board), or print one with markers",
        )
    return Degenerate(
        "no-board",
        f"no board in the picture: {sighting.count} of {whole} {what} read; bring it closer, give it more light, or "
        "name the board that is shown (--board)",
    )


def _too_few(found: int, board: Board, board_map: BoardMap, shape: tuple[int, ...]) -> Degenerate:
    # Without the polynomial, which grows without limit outside the points that it was fitted to.
    expected = replace(board_map, bend_px=np.zeros_like(board_map.bend_px)).to_px(board.corners_m[:, :2])
    height, width = shape
    beyond = {
        "left": expected[:, 0] < 0,
        "right": expected[:, 0] > width - 1,
        "upper": expected[:, 1] < 0,
        "lower": expected[:, 1] > height - 1,
    }
    outside = np.any(list(beyond.values()), axis=0)
    count, whole = int(outside.sum()), len(expected)
    seen = f"{found} of {whole} corners found; more than {int(LEAST_SHARE * whole)} are needed"
    if 2 * count >= whole - found:
        border = max(beyond, key=lambda side: int(beyond[side].sum()))
        return Degenerate(
            "board-half-out",
            f"the board is half out of the picture: {seen}, and {count} lie beyond the {border} border; move it in",
        )
    return Degenerate("no-board", f"the board can hardly be seen: {seen}; bring it closer or give it more light")
