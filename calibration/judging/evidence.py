"""What views and a fit tell about a calibration, as numbers that a verdict is made of.

Each number speaks for one way to go wrong: how many poses there were, how far they were tilted, how large the board was
seen, how much of the picture it reached, how bright the room was, what the baseline came out as.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.board.board import Board
from calibration.board.coverage import spread_rad
from calibration.model.camera import Camera
from calibration.model.scanner import PivotScanner, Scanner
from calibration.views import FEWEST_CORNERS, BoardPose, Corners, View

Array = NDArray[np.float64]

_WHITE_PERCENT = 75
"""Half of a board is white: this percentile of its pixels is."""


@dataclass(frozen=True, slots=True)
class ViewEvidence:
    """What is seen before anything is fitted; NaN where nothing tells.

    shown: poses. used: those of them that a fit can be checked by: with corners, and where a line is asked for with
    the line on the board too. coverage: share of the picture within the outline of all corners. room_flux: photons per
    pixel and exposure of white on the board (of the bright parts of the picture where there is no board), median over
    the views. odd: names of those that do not fit the others and had no say.
    """

    shown: int
    used: int
    coverage: float
    room_flux: float
    odd: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class PoseEvidence:
    """How the boards stood. tilt_rad: largest angle between two of them. distance_m: median of their centres.

    board_rad: angle under which the camera sees a board's longer side, median.
    """

    tilt_rad: float
    distance_m: float
    board_rad: float


def view_evidence(
    views: Sequence[View], size: tuple[int, int], used: int, left_out: Collection[str] = ()
) -> ViewEvidence:
    """Look at the views alone; size: (width, height) of the picture. used: as in the evidence. left_out: names of those
    whose corners had no say.
    """
    counted = [view.corners for view in views if view.name not in left_out and view.corners is not None]
    found = [corners for corners in counted if len(corners.ids) > 2]
    area = float(size[0] * size[1])
    fluxes = [_room_flux(view) for view in views if view.picture is not None]
    return ViewEvidence(
        shown=len(views),
        used=used,
        coverage=_outline_area(np.concatenate([corners.px for corners in found])) / area if found else 0.0,
        room_flux=float(np.median(fluxes)) if fluxes else np.nan,
        odd=tuple(left_out),
    )


def pose_evidence(poses: Sequence[BoardPose], board: Board) -> PoseEvidence:
    """Look at where a fit found the boards."""
    if not poses:
        return PoseEvidence(np.nan, np.nan, np.nan)
    middle = np.array([board.size_m[0] / 2, board.size_m[1] / 2, 0.0])
    away = [float(np.linalg.norm(pose.to_camera(middle))) for pose in poses]
    return PoseEvidence(
        tilt_rad=spread_rad(poses),
        distance_m=float(np.median(away)),
        board_rad=float(np.median(2 * np.arctan(max(board.size_m) / 2 / np.array(away)))),
    )


def rough_poses(views: Sequence[View], board: Board, camera: Camera) -> list[BoardPose]:
    """Where the boards stood, as a camera sees it that is known only roughly."""
    found = []
    for view in views:
        if view.corners is None or len(view.corners.ids) < FEWEST_CORNERS:
            continue
        corners_m = board.corners_m[view.corners.ids]
        done, turn, shift = cv2.solvePnP(corners_m, view.corners.px, camera.matrix, camera.distortion)
        if done:
            found.append(BoardPose(np.asarray(turn, np.float64).ravel(), np.asarray(shift, np.float64).ravel()))
    return found


def baseline_m(scanner: Scanner) -> float:
    """Distance of the camera from the axis that the line turns about; NaN where the scanner is a table of planes."""
    if not isinstance(scanner, PivotScanner):
        return float("nan")
    along = float(scanner.axis_direction @ scanner.axis_point_m)
    return float(np.linalg.norm(scanner.axis_point_m - along * scanner.axis_direction))


def _outline_area(px: Array) -> float:
    return float(cv2.contourArea(cv2.convexHull(px.astype(np.float32))))


def _room_flux(view: View) -> float:
    picture = view.picture
    assert picture is not None, "asked of views with a picture"
    inside = picture if view.corners is None else picture[_within(view.corners, picture.shape)]
    known = inside[np.isfinite(inside)]
    return float(np.percentile(known, _WHITE_PERCENT)) if known.size else np.nan


def _within(corners: Corners, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """True in the outline of the corners; everywhere where there is none."""
    if len(corners.ids) < 3:
        return np.ones(shape, bool)
    mask = np.zeros(shape, np.uint8)
    cv2.fillConvexPoly(mask, cv2.convexHull(np.round(corners.px).astype(np.int32)), 1)
    return mask > 0 if mask.any() else np.ones(shape, bool)
