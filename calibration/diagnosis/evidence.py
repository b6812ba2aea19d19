"""The evidence on a calibration: numbers that tell what its views and its fit lack, and the reasons that follow.

Each number speaks for one way to go wrong: how many poses there were, how far they were tilted, how large the board was
seen, how much of the picture it reached, how bright the room was, how long the baseline came out.
"""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.arrays import Array
from calibration.board.board import Board, spread_rad
from calibration.model.camera import Camera
from calibration.model.scanner import PivotScanner, Scanner
from calibration.rig_fit.start import unfit
from calibration.verdict import Reason, reason_for
from calibration.views import FEWEST_CORNERS, BoardPose, Corners, View

_WHITE_PERCENT = 75
"""Percentile of the board's pixels that is white: half of a board is."""


@dataclass(frozen=True, slots=True)
class ViewEvidence:
    """Evidence of the views before anything is fitted; NaN where nothing tells.

    shown: number of poses. used: those of them that a fit can be checked by: with corners, and where a line is asked
    for with the line on the board too. coverage: share of the picture within the outline of all corners. room_flux:
    photons per pixel and exposure of white on the board (of the bright parts of the picture where there is no board),
    median over the views. odd: names of those that do not fit the others and had no say.
    """

    shown: int
    used: int
    coverage: float
    room_flux: float
    odd: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class PoseEvidence:
    """Evidence of the boards' poses. tilt_rad: largest angle between two of them. distance_m: median of their centres.

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
    """Poses of the boards by a camera that is known only roughly; views that give none are left out."""
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
    """Mask of the pixels within the outline of the corners; all of them where there is none."""
    if len(corners.ids) < 3:
        return np.ones(shape, bool)
    mask = np.zeros(shape, np.uint8)
    cv2.fillConvexPoly(mask, cv2.convexHull(np.round(corners.px).astype(np.int32)), 1)
    return mask > 0 if mask.any() else np.ones(shape, bool)


_FEWEST_TO_JUDGE = 3
"""Fewest poses from which tilt and coverage can be judged."""
_MEND_VIEWS = "mend what is said of the other views, then show more"
_SHOW_ANEW = "show the board again for each of these, at rest until its sweeps are over"
FEWEST_POSES: Final = 6
"""Fewest poses that can be checked: with fewer, a single bad view bends the fit to it, and nothing shows that it was
bad."""
FEWEST_WHY: Final = "are the fewest that can be checked against each other"


@dataclass(frozen=True, slots=True)
class EvidenceLimit:
    """Limits of a number.

    always: beyond it the number is never enough. imprecise: within it the number is no likely cause of an error that is
    too large.
    """

    always: float
    imprecise: float

    def at(self, imprecise: bool) -> float:
        """The limit that counts."""
        return self.imprecise if imprecise else self.always


LEAST_TILT_RAD: Final = EvidenceLimit(math.radians(12), math.radians(20))
"""Tilt between two boards. Of boards parallel to each other focal length and distance cannot be told apart: they hang
on the mirror's model alone, which nothing checks then."""
LEAST_BOARD_RAD: Final = EvidenceLimit(0.11, 0.15)
"""Angle under which a board is seen. Under smaller ones its perspective (by which focal length is told) goes with the
angle's square."""
LEAST_COVERAGE: Final = EvidenceLimit(0.3, 0.5)
"""Share of the picture within the outline of all corners; the lens is extrapolated outside, which nothing checks."""
MOST_ROOM_FLUX: Final = EvidenceLimit(3.0, 1.0)
"""Photons per pixel and exposure from white. At 3, 95 % of the frames hold a 1 whether the line is there or not; from 1
on room light costs more than half of what a frame can tell of the line."""


def data_lack(
    views: ViewEvidence, poses: PoseEvidence | None, *, imprecise: bool, photons: bool = True
) -> list[Reason]:
    """Reasons why the data are too few, those of `hiding` left aside; stricter where the result is not precise enough.

    poses: None where nothing tells. photons: whether pictures count photons; those from files do not.
    """
    found = []
    bright = photons and MOST_ROOM_FLUX.at(imprecise) < views.room_flux <= MOST_ROOM_FLUX.always
    light = [_room_light(views.room_flux, MOST_ROOM_FLUX.at(imprecise))] if bright else []
    if views.used < FEWEST_POSES <= views.shown:
        found, light = light, []  # what hides board and line goes before the views that lack them
    if views.used < FEWEST_POSES:
        found.append(_too_few(views))
    if views.used < _FEWEST_TO_JUDGE:
        return found
    if poses is not None:
        found += _poses_lack(poses, imprecise)
    least = LEAST_COVERAGE.at(imprecise)
    if views.coverage < least:
        text = f"corners reach {views.coverage:.0%} of the picture, {least:.0%} are needed"
        found.append(reason_for("poor-coverage", text, views.coverage, least))
    return found + light


def hiding(views: ViewEvidence, poses: PoseEvidence | None, *, photons: bool = True) -> list[Reason]:
    """Reasons that make other faults appear: room light in which frames hold little else, and boards so far away that
    their corners do not say where they are. Arguments as for `data_lack`.
    """
    found = []
    if photons and views.room_flux > MOST_ROOM_FLUX.always:
        found.append(_room_light(views.room_flux, MOST_ROOM_FLUX.always))
    if views.used >= _FEWEST_TO_JUDGE and poses is not None and poses.board_rad < LEAST_BOARD_RAD.always:
        found.append(_too_far(poses, LEAST_BOARD_RAD.always))
    return found


def _too_few(views: ViewEvidence) -> Reason:
    shown = f"{views.shown} {'pose was' if views.shown == 1 else 'poses were'} shown"
    limit = f"{FEWEST_POSES} {FEWEST_WHY}"
    if views.used == views.shown:
        return reason_for("too-few-poses", f"{shown}, {limit}", views.shown, FEWEST_POSES)
    odd = f" ({unfit(views.odd)})" if views.odd else ""
    text = f"{shown}, {views.used or 'none'} of them could be used{odd}, {limit}"
    step = _SHOW_ANEW if views.used + len(views.odd) == views.shown else _MEND_VIEWS
    return replace(reason_for("too-few-poses", text, views.used, FEWEST_POSES), next_step=step)


def _poses_lack(poses: PoseEvidence, imprecise: bool) -> list[Reason]:
    found = []
    least = LEAST_TILT_RAD.at(imprecise)
    if poses.tilt_rad < least:
        text = (
            f"no two boards are tilted more than {math.degrees(poses.tilt_rad):.0f} degrees against each other, "
            f"{math.degrees(least):.0f} are needed"
        )
        found.append(reason_for("no-tilt", text, poses.tilt_rad, least))
    if LEAST_BOARD_RAD.always <= poses.board_rad < LEAST_BOARD_RAD.at(imprecise):
        found.append(_too_far(poses, LEAST_BOARD_RAD.at(imprecise)))
    return found


def _too_far(poses: PoseEvidence, least: float) -> Reason:
    text = (
        f"boards stood {poses.distance_m:.2g} m away (median) and were seen under "
        f"{math.degrees(poses.board_rad):.1f} degrees, {math.degrees(least):.1f} are needed"
    )
    return reason_for("board-too-far", text, poses.board_rad, least)


def _room_light(flux: float, limit: float) -> Reason:
    text = f"room light gives {flux:.2g} photons per pixel and exposure on white, the limit is {limit:g}"
    return reason_for("room-light", text, flux, limit)
