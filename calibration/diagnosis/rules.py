"""Judges whether a calibration is good enough, and if not, why. The limits of the verdict are depth errors.

Each number of the evidence reveals one possible mistake: how many poses there were, how far they were tilted, how large
the board appeared, how much of the picture it reached, how bright the room was, how long the baseline came out.

A calibration passes if the depth error that its covariance predicts is at most the one asked for, and if its data are
enough and agree with each other and with what is known of the rig. Otherwise the verdict lists reasons. The first one
is the most likely root cause. Their order is:

1. Conditions that make other faults appear: room light that hides the line, boards too far away to be located.
2. Data that no single rig can have produced (waves, a rig that moved), since no other result can be trusted then.
3. A baseline that differs from the stated one: the whole scene is then too large or too small. If the predicted error
is too large, this comes after 4, since a baseline is only as good as the fit it comes from.
4. Too little data (room light, too few poses, no tilt, boards too far away, corners in only a part of the picture).
This is a likely cause if the predicted error is too large. It counts even if the predicted error is small enough: a
small error may then come from the assumed model alone, and hardly any data are left to check the model.

If the error is too large and the data have none of these faults, there are simply too few of them. Last come faults
that the predicted error does not show: sweeps whose directions and speeds do not determine a lag for a direction of the
scan.
"""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.board.board import Board, spread_rad
from calibration.errors import Degenerate, mm
from calibration.model.camera import Camera
from calibration.model.light_sheet import fan_origin
from calibration.model.parameters import lag_groups, one_speed
from calibration.model.scanner import PivotScanner, Scanner
from calibration.rig_fit.rig_state import unfit
from calibration.verdict import SIGMAS, WORST_TIMES, AccuracyGoal, Reason, Verdict, more_poses, reason_for
from calibration.views import FEWEST_CORNERS, BoardPose, Corners, View

_WHITE_PERCENT = 75
"""Percentile of the board's pixels that counts as white: half of a board is white."""


@dataclass(frozen=True, slots=True)
class ViewEvidence:
    """Evidence from the views before anything is fitted; NaN if unknown.

    shown: number of poses. used: number of them that can check a fit: with corners and, if the rig is fitted, with the
    line on the board. coverage: share of the picture within the outline of all corners. room_flux: photons per
    pixel and exposure of white on the board (of the bright parts of the picture if there is no board), median over the
    views. odd: names of views that do not fit the others and were not used.
    """

    shown: int
    used: int
    coverage: float
    room_flux: float
    odd: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class PoseEvidence:
    """Evidence from the poses; NaN without poses. tilt_rad: largest angle between two boards. distance_m: median
    distance. board_rad: median angle that a board's longer side fills."""

    tilt_rad: float
    distance_m: float
    board_rad: float


def view_evidence(
    views: Sequence[View], size: tuple[int, int], used: int, left_out: Collection[str] = ()
) -> ViewEvidence:
    """The evidence from the views alone. size: (width, height) of the picture. used: as in `ViewEvidence`.

    left_out: names of views whose corners were not used.
    """
    counted = [view.corners for view in views if view.name not in left_out and view.corners is not None]
    found = [corners for corners in counted if len(corners.ids) > 2]
    area = float(size[0] * size[1])
    outline = cv2.contourArea(cv2.convexHull(np.concatenate([c.px for c in found]).astype(np.float32))) if found else 0
    fluxes = [_room_flux(view) for view in views if view.picture is not None]
    return ViewEvidence(
        shown=len(views),
        used=used,
        coverage=outline / area if found else 0.0,
        room_flux=float(np.median(fluxes)) if fluxes else np.nan,
        odd=tuple(left_out),
    )


def pose_evidence(poses: Sequence[BoardPose], board: Board) -> PoseEvidence:
    """The evidence from the poses that a fit, or `rough_poses`, found."""
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
    """Poses of the boards from a camera that is known only roughly. Views without a pose are left out."""
    found = []
    for view in views:
        if view.corners is None or len(view.corners.ids) < FEWEST_CORNERS:
            continue
        corners_m = board.corners_m[view.corners.ids]
        if not np.isfinite(view.corners.px).all():
            continue
        done, turn, shift = cv2.solvePnP(corners_m, view.corners.px, camera.matrix, camera.distortion)
        if done:
            found.append(BoardPose(np.asarray(turn, np.float64).ravel(), np.asarray(shift, np.float64).ravel()))
    return found


def baseline_m(scanner: Scanner) -> float:
    """Distance of the camera from the axis about which the line turns; NaN if the scanner is a table of planes."""
    return float(np.linalg.norm(fan_origin(scanner, None))) if isinstance(scanner, PivotScanner) else math.nan


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
"""Fewest poses that can be checked: with fewer, a bad view bends the fit to itself, and nothing shows that."""
FEWEST_WHY: Final = "are the fewest that can be checked against each other"


# Two limits of each number. Beyond the first, the data are never good enough. The second, stricter one holds if the
# result is not precise enough: beyond it, the number is a likely cause of that.
LEAST_TILT_RAD: Final = math.radians(12), math.radians(20)
"""Tilt between two boards. Parallel boards do not distinguish focal length from distance."""
LEAST_BOARD_RAD: Final = 0.11, 0.15
"""Angle under which a board is seen. The focal length follows from its perspective, which goes with the angle's square.
"""
LEAST_COVERAGE: Final = 0.3, 0.5
"""Share of the picture within the outline of all corners. Outside, the lens model is extrapolated and unchecked."""
MOST_ROOM_FLUX: Final = 3.0, 1.0
"""Photons per pixel and exposure from white. At 3, 95 % of the frames hold a 1 whether the line is there or not. From 1
on, room light costs more than half of a frame's information about the line."""


def data_lack(
    views: ViewEvidence, poses: PoseEvidence | None, *, imprecise: bool, photons: bool = True
) -> list[Reason]:
    """Reasons why the data are too few, except those of `hiding`.

    imprecise: whether the result is not precise enough, which makes the limits stricter. poses: None if unknown.
    photons: whether pictures count photons; pictures from files do not.
    """
    found = []
    bright = photons and MOST_ROOM_FLUX[imprecise] < views.room_flux <= MOST_ROOM_FLUX[0]
    light = [_room_light(views.room_flux, MOST_ROOM_FLUX[imprecise])] if bright else []
    if views.used < FEWEST_POSES <= views.shown:
        found, light = light, []  # what hides board and line goes before the views that lack them
    if views.used < FEWEST_POSES:
        found.append(_too_few(views))
    if views.used < _FEWEST_TO_JUDGE:
        return found
    if poses is not None:
        tilt_rad, board_rad = LEAST_TILT_RAD[imprecise], LEAST_BOARD_RAD[imprecise]
        if poses.tilt_rad < tilt_rad:
            text = (
                f"no two boards are tilted more than {math.degrees(poses.tilt_rad):.0f} degrees against each other, "
                f"{math.degrees(tilt_rad):.0f} are needed"
            )
            found.append(reason_for("no-tilt", text, poses.tilt_rad, tilt_rad))
        if LEAST_BOARD_RAD[0] <= poses.board_rad < board_rad:
            found.append(_too_far(poses, board_rad))
    least = LEAST_COVERAGE[imprecise]
    if views.coverage < least:
        text = f"corners reach {views.coverage:.0%} of the picture, {least:.0%} are needed"
        found.append(reason_for("poor-coverage", text, views.coverage, least))
    return found + light


def hiding(views: ViewEvidence, poses: PoseEvidence | None, *, photons: bool = True) -> list[Reason]:
    """Reasons that make other faults appear: room light so bright that frames hold little else, and boards so far away
    that their corners do not locate them. Arguments as in `data_lack`.
    """
    found = []
    if photons and views.room_flux > MOST_ROOM_FLUX[0]:
        found.append(_room_light(views.room_flux, MOST_ROOM_FLUX[0]))
    if views.used >= _FEWEST_TO_JUDGE and poses is not None and poses.board_rad < LEAST_BOARD_RAD[0]:
        found.append(_too_far(poses, LEAST_BOARD_RAD[0]))
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


def _too_far(poses: PoseEvidence, least: float) -> Reason:
    text = (
        f"boards stood {poses.distance_m:.2g} m away (median) and were seen under "
        f"{math.degrees(poses.board_rad):.1f} degrees, {math.degrees(least):.1f} are needed"
    )
    return reason_for("board-too-far", text, poses.board_rad, least)


def _room_light(flux: float, limit: float) -> Reason:
    text = f"room light gives {flux:.2g} photons per pixel and exposure on white, the limit is {limit:g}"
    return reason_for("room-light", text, flux, limit)


_SPEEDS = "scan both ways (scan.bidirectional), at two speeds or more (scan.exposures)"


def lag_lack(velocities_per_s: Sequence[float], *, mean_will_do: bool) -> list[Reason]:
    """Reasons why sweeps do not determine both lags; none if there are no sweeps.

    mean_will_do: whether the mean of the lags is enough. For planes it is if all sweeps run at one speed, in both
    directions.
    """
    ways = {velocity > 0 for velocity in velocities_per_s}
    if not ways:
        return []
    if len(ways) == 1:
        way, other = ("up", "down") if True in ways else ("down", "up")
        text = f"only sweeps {way} were scanned; nothing tells the lag {other}, which is taken to be the same"
        return [Reason("one-way", text, 1.0, 2.0, _SPEEDS)]
    if len(lag_groups(velocities_per_s)) == 2 or (mean_will_do and one_speed(velocities_per_s)):
        return []
    text = "one speed each way tells a mean of the two lags only"
    return [Reason("one-speed", text, 1.0, 2.0, _SPEEDS)]


LEAST_BASELINE_CHANGE: Final = 0.01
"""Least relative change of the baseline that counts: the error of a tape measure, 3 mm in 300 mm."""
MOST_SHIFT = 0.25
"""Largest contradiction between views, as a share of the accuracy asked for. The fit lies between contradicting views
already, and its depth is off by several times the remaining contradiction: 2 to 5 times over 30 simulated knocks."""

WAVES_MOVE = 2.0
"""Multiple of the waves that a view's shift must exceed to count as a move. Waves shift whole views too: views of few
sweeps by as much as the sweeps differ, up to 1.35 times as much in 23 simulated calibrations."""


@dataclass(frozen=True, slots=True)
class FitEvidence:
    """Evidence from a fit and the poses of its boards; what is unknown has its default.

    expected_m, worst_m: predicted sd of depth at the distance asked for, median and 95th percentile over the picture.
    wave_m: depth error there of one sweep against another of the same view; wave_noise_m: its largest value that may be
    noise. shift_m: depth error of a view against the others; shift_noise_m: its largest value that may be noise;
    moved_after: the view after which the rig moved, if one move explains the shifts. misfit: factor by which the
    variances were increased because the data contradict each other. baseline_m, baseline_sd_m: distance from camera to
    mirror axis, and its sd. velocities_per_s: signed velocities of the sweeps; empty if unknown.
    """

    poses: PoseEvidence
    expected_m: float
    worst_m: float
    wave_m: float = math.nan
    wave_noise_m: float = 0.0
    shift_m: float = math.nan
    shift_noise_m: float = 0.0
    moved_after: str | None = None
    misfit: float = 1.0
    baseline_m: float = math.nan
    baseline_sd_m: float = math.nan
    velocities_per_s: tuple[float, ...] = ()


def judge(views: ViewEvidence, fit: FitEvidence, asked: AccuracyGoal) -> Verdict:
    """The verdict on a fitted rig model."""
    imprecise = not (fit.expected_m <= asked.accuracy_m and fit.worst_m <= WORST_TIMES * asked.accuracy_m)
    reasons = [*hiding(views, fit.poses), *_contradictions(fit, asked, imprecise)]
    poverty = data_lack(views, fit.poses, imprecise=imprecise)
    scale = _scale(fit, asked)
    # A baseline is only as good as the fit it comes from.
    reasons += [*poverty, *scale] if imprecise else [*scale, *poverty]
    if imprecise and not reasons:
        what = f"the expected depth error at {asked.at_m:g} m is"
        reasons.append(more_poses(views.used, what, (fit.expected_m, fit.worst_m), asked.accuracy_m, mm))
    reasons += lag_lack(fit.velocities_per_s, mean_will_do=True)
    return Verdict(not reasons, tuple(reasons))


def judge_refusal(
    refused: Degenerate, views: ViewEvidence, poses: PoseEvidence | None = None, *, photons: bool = True
) -> Verdict:
    """The verdict if no model could be fitted: what the views lack, and why the fit failed. Arguments as in
    `data_lack`.
    """
    lacking = [*hiding(views, poses, photons=photons), *data_lack(views, poses, imprecise=True, photons=photons)]
    code = _REFUSED_FOR.get(refused.reason, refused.reason)
    own = reason_for(code, str(refused))
    if refused.reason in _SEEN_AT_ONCE:  # only room light, which hides boards, goes before it
        return Verdict(False, (*[reason for reason in lacking if reason.code == "room-light"], own))
    codes = [reason.code for reason in lacking]
    if code not in codes:
        # A fit recognizes parallel boards better than rough poses do. The causes of other refusals are only guessed.
        seen = refused.reason == "coplanar" and "poor-coverage" in codes
        lacking.insert(codes.index("poor-coverage") if seen else len(codes), own)
    return Verdict(False, tuple(lacking))


_REFUSED_FOR = {"one-pose": "too-few-poses", "coplanar": "no-tilt"}
"""For reasons why a fit was impossible: the verdict's reason, which is the lack of data behind it."""
_SEEN_AT_ONCE = ("no-board", "wrong-board", "board-half-out", "mirrored", "two-boards", "no-line")
"""Faults of single views, due to which too few views can be used."""


def _contradictions(fit: FitEvidence, asked: AccuracyGoal, imprecise: bool) -> list[Reason]:
    """Reasons why no single rig can have made the data. Limits are lower if only the misfit makes the fit imprecise."""
    limit = asked.accuracy_m
    grown = math.sqrt(max(fit.misfit, 1.0))
    if imprecise and fit.expected_m <= limit * grown and fit.worst_m <= WORST_TIMES * limit * grown:
        limit /= grown
    waves = fit.wave_m > max(limit, fit.wave_noise_m)
    most_shift = max(MOST_SHIFT * limit, fit.shift_noise_m)
    moved = fit.shift_m > max(most_shift, WAVES_MOVE * fit.wave_m if waves else 0.0)
    found = []
    if waves:
        text = f"planes wave: sweeps of one view differ by {mm(fit.wave_m)} of depth at {asked.at_m:g} m, the limit is "
        found.append(reason_for("exposure-not-locked", text + mm(limit), fit.wave_m, limit))
    if moved:
        named = f" (the rig moved after view {fit.moved_after})" if fit.moved_after else ""
        text = f"views contradict each other by {mm(fit.shift_m)} of depth at {asked.at_m:g} m{named}"
        found.insert(0, reason_for("moved-rig", f"{text}, the limit is {mm(most_shift)}", fit.shift_m, most_shift))
    return found


def _scale(fit: FitEvidence, asked: AccuracyGoal) -> list[Reason]:
    stated = asked.stated_baseline_m
    if stated is None or not math.isfinite(fit.baseline_m):
        return []
    change = fit.baseline_m / stated - 1
    limit = max(LEAST_BASELINE_CHANGE, SIGMAS * (fit.baseline_sd_m / stated if fit.baseline_sd_m > 0 else 0.0))
    if abs(change) <= limit:
        return []
    text = (
        f"the baseline comes out as {mm(fit.baseline_m)}, stated are {mm(stated)}: {change:+.1%}, the limit is "
        f"{limit:.1%}; so is every depth"
    )
    return [reason_for("wrong-square-size", text, change, limit)]
