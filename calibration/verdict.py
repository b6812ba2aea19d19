"""Is a calibration good enough, and if not, why: a verdict whose limits are depth errors.

A calibration passes where the depth error that its covariance predicts is at most what was asked for, and where its
data agree with each other and with what is known of the rig. The first reason is the root cause. Their order:

1. Data that no one rig can have made (planes that wave, a rig that moved): nothing else can be believed then.
2. A baseline other than the stated one: everything is in proportion, only too large or too small.
3. Data that say too little (room light, too few poses, no tilt, boards too far, corners in a part of the picture only):
   a likely cause where the predicted error is too large; and where the covariance promises enough, but by the model
   alone, with next to nothing left to check the model by.

Where the error is too large and the data have none of these faults, there are simply too few of them.
"""

import math
from dataclasses import asdict, dataclass
from typing import Any, Final

from calibration.errors import Degenerate
from calibration.evidence import PoseEvidence, ViewEvidence

_FEWEST_TO_JUDGE = 3
"""Of fewer poses neither tilt nor coverage can be asked."""
FEWEST_POSES: Final = 6
"""With fewer, a single bad view bends the fit to it, so that nothing shows that it was bad."""


@dataclass(frozen=True, slots=True)
class Limit:
    """Of a number: what is never enough, and what is no likely cause of an error that is too large."""

    always: float
    imprecise: float

    def at(self, imprecise: bool) -> float:
        """The one that counts."""
        return self.imprecise if imprecise else self.always


LEAST_TILT_RAD: Final = Limit(math.radians(12), math.radians(20))
"""Between two boards. Of boards parallel to each other focal length and distance cannot be told apart: they hang on the
mirror's model alone, which nothing checks then."""
LEAST_BOARD_RAD: Final = Limit(0.11, 0.15)
"""Seen under smaller angles, a board's perspective (by which focal length is told) goes with the angle's square."""
LEAST_COVERAGE: Final = Limit(0.3, 0.5)
"""Share of the picture within the outline of all corners; the lens is extrapolated outside, which nothing checks."""
MOST_ROOM_FLUX: Final = Limit(3.0, 1.0)
"""Photons per pixel and exposure from white. At 3, 95 % of the frames hold a 1 whether the line is there or not; from 1
on room light costs more than half of what a frame can tell of the line."""
LEAST_BASELINE_CHANGE: Final = 0.01
"""What a tape measure may be wrong: 3 mm in 300 mm."""
SIGMAS: Final = 4.0
"""By how many standard deviations a baseline must differ from the stated one."""
WORST_TIMES: Final = 4.0
"""The picture's worst places (95 %) may have this many times the error asked for."""


@dataclass(frozen=True, slots=True)
class Asked:
    """How good a calibration is to be: sd of depth at a distance; the baseline where somebody has measured it."""

    accuracy_m: float
    at_m: float = 5.0
    stated_baseline_m: float | None = None


@dataclass(frozen=True, slots=True)
class FitEvidence:
    """What a fit tells, besides where the boards stood; NaN where it cannot.

    expected_m, worst_m: predicted sd of the depth at the distance asked, median and 95 % of the picture. wave_m: error
    of one sweep against another of the same view there; shift_m: of a view against the others; moved_after: the view
    after which they changed, where one move explains them. outliers: views that do not fit. misfit: by which the
    expected variances grew because the data contradict each other. baseline_m, baseline_sd_m: distance of camera and
    mirror axis.
    """

    poses: PoseEvidence
    expected_m: float
    worst_m: float
    wave_m: float = math.nan
    shift_m: float = math.nan
    moved_after: str | None = None
    outliers: tuple[str, ...] = ()
    misfit: float = 1.0
    baseline_m: float = math.nan
    baseline_sd_m: float = math.nan


@dataclass(frozen=True, slots=True)
class Reason:
    """Why a calibration is not good enough: code for machines, text for people, value and limit in the same unit."""

    code: str
    text: str
    value: float
    limit: float
    next_step: str

    def __str__(self) -> str:
        """One line."""
        return f"{self.code}: {self.text}; {self.next_step}"


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether a calibration may be used, and why not: the root cause first."""

    passed: bool
    reasons: tuple[Reason, ...] = ()

    @property
    def codes(self) -> tuple[str, ...]:
        """The reasons' codes."""
        return tuple(reason.code for reason in self.reasons)

    def as_json(self) -> dict[str, Any]:
        """For programs."""
        return {"passed": self.passed, "reasons": [asdict(reason) for reason in self.reasons]}


def judge(views: ViewEvidence, fit: FitEvidence, asked: Asked) -> Verdict:
    """The verdict on a fitted rig model."""
    imprecise = not (fit.expected_m <= asked.accuracy_m and fit.worst_m <= WORST_TIMES * asked.accuracy_m)
    reasons = [*_contradictions(fit, asked, imprecise)]
    poverty = data_lack(views, fit.poses, imprecise=imprecise)
    scale = _scale(fit, asked)
    # A baseline is only as good as the fit it comes from.
    reasons += [*poverty, *scale] if imprecise else [*scale, *poverty]
    if imprecise and not reasons:
        reasons.append(_more_poses(views, fit, asked))
    return Verdict(not reasons, tuple(reasons))


def judge_refusal(
    refused: Degenerate, views: ViewEvidence, poses: PoseEvidence | None = None, *, photons: bool = True
) -> Verdict:
    """The verdict where no model could be fitted: what the views lack, else what the fit said. poses: roughly.

    photons: as for `data_lack`.
    """
    lacking = data_lack(views, poses, imprecise=True, photons=photons)
    code = _REFUSED_FOR.get(refused.reason, refused.reason)
    own = Reason(code, str(refused), math.nan, math.nan, _NEXT_STEP.get(code, "show the board again"))
    if refused.reason in _SEEN_AT_ONCE:  # but for room light, which hides boards, nothing goes before it
        return Verdict(False, (*[reason for reason in lacking if reason.code == "room-light"], own))
    return Verdict(False, (*lacking, *([] if code in [reason.code for reason in lacking] else [own])))


_REFUSED_FOR = {"one-pose": "too-few-poses", "coplanar": "no-tilt"}
"""What a fit that is impossible was short of."""
_SEEN_AT_ONCE = ("no-board", "board-half-out", "mirrored", "two-boards")
"""What is wrong with single views."""

_NEXT_STEP = {
    "exposure-not-locked": "lock the exposures to the scan (shared clock, markers in the stream) and check for a loose "
    "marker cable",
    "moved-rig": "fix camera and scanner to one another, leave the rig alone and calibrate again",
    "wrong-square-size": "measure a square of the print and write its side into the board's file, or correct the "
    "stated baseline",
    "room-light": "darken the room or shorten the exposures",
    "too-few-poses": "show the board in more poses ('--guided' says which)",
    "no-tilt": "tilt the board by 20 to 40 degrees, to all sides",
    "board-too-far": "come nearer, until the board fills a third of the picture",
    "poor-coverage": "show the board at the borders and in the corners of the picture too",
    "no-board": "show the whole board, lit evenly, and check that the board's file is the print's",
    "board-half-out": "move it in until all of it is in the picture",
    "mirrored": "turn the print over, or correct the sensor's orientation in the config",
    "two-boards": "show one at a time",
}


def _reason(code: str, text: str, value: float, limit: float) -> Reason:
    return Reason(code, text, value, limit, _NEXT_STEP[code])


def _contradictions(fit: FitEvidence, asked: Asked, imprecise: bool) -> list[Reason]:
    """What no one rig can have made. Sweeps of one view that differ tell waves from a rig that moved in between.

    Where the result would be precise but for the misfit, less than the accuracy asked is the cause already.
    """
    limit = asked.accuracy_m
    grown = math.sqrt(max(fit.misfit, 1.0))
    if imprecise and fit.expected_m <= limit * grown and fit.worst_m <= WORST_TIMES * limit * grown:
        limit /= grown
    waves = fit.wave_m > limit
    moved = fit.shift_m > max(limit, fit.wave_m if waves else 0.0)
    found = []
    if waves:
        found.append(
            _reason(
                "exposure-not-locked",
                f"planes wave: sweeps of one view differ by {_mm(fit.wave_m)} of depth at {asked.at_m:g} m, the limit "
                f"is {_mm(limit)}",
                fit.wave_m,
                limit,
            )
        )
    if moved:
        named = f" (the rig moved after view {fit.moved_after})" if fit.moved_after else ""
        text = f"views contradict each other by {_mm(fit.shift_m)} of depth at {asked.at_m:g} m{named}"
        found.insert(0, _reason("moved-rig", f"{text}, the limit is {_mm(limit)}", fit.shift_m, limit))
    return found


def _scale(fit: FitEvidence, asked: Asked) -> list[Reason]:
    stated = asked.stated_baseline_m
    if stated is None or not math.isfinite(fit.baseline_m):
        return []
    change = fit.baseline_m / stated - 1
    limit = max(LEAST_BASELINE_CHANGE, SIGMAS * (fit.baseline_sd_m / stated if fit.baseline_sd_m > 0 else 0.0))
    if abs(change) <= limit:
        return []
    text = (
        f"the baseline comes out as {_mm(fit.baseline_m)}, stated are {_mm(stated)}: {change:+.1%}, the limit is "
        f"{limit:.1%}; so is every depth"
    )
    return [_reason("wrong-square-size", text, change, limit)]


def data_lack(
    views: ViewEvidence, poses: PoseEvidence | None, *, imprecise: bool, photons: bool = True
) -> list[Reason]:
    """What the data lack: more counts where the result is not precise enough.

    poses: None where nothing tells. photons: whether pictures count photons; those from files do not.
    """
    found = []
    bright = MOST_ROOM_FLUX.at(imprecise) if photons else math.inf
    if views.room_flux > max(bright, MOST_ROOM_FLUX.always):
        found.append(_room_light(views.room_flux, bright))
    if views.shown < FEWEST_POSES:
        were = "pose was" if views.shown == 1 else "poses were"
        text = f"{views.shown} {were} shown, {FEWEST_POSES} are the fewest that can be checked against each other"
        found.append(_reason("too-few-poses", text, views.shown, FEWEST_POSES))
    if views.shown < _FEWEST_TO_JUDGE:
        return found
    if poses is not None:
        found += _poses_lack(poses, imprecise)
    least = LEAST_COVERAGE.at(imprecise)
    if views.coverage < least:
        text = f"corners reach {views.coverage:.0%} of the picture, {least:.0%} are needed"
        found.append(_reason("poor-coverage", text, views.coverage, least))
    if bright < views.room_flux <= MOST_ROOM_FLUX.always:
        found.append(_room_light(views.room_flux, bright))
    return found


def _poses_lack(poses: PoseEvidence, imprecise: bool) -> list[Reason]:
    found = []
    least = LEAST_TILT_RAD.at(imprecise)
    if poses.tilt_rad < least:
        text = (
            f"no two boards are tilted more than {math.degrees(poses.tilt_rad):.0f} degrees against each other, "
            f"{math.degrees(least):.0f} are needed"
        )
        found.append(_reason("no-tilt", text, poses.tilt_rad, least))
    least = LEAST_BOARD_RAD.at(imprecise)
    if poses.board_rad < least:
        text = (
            f"boards stood {poses.distance_m:.2g} m away (median) and were seen under "
            f"{math.degrees(poses.board_rad):.1f} degrees, {math.degrees(least):.1f} are needed"
        )
        found.append(_reason("board-too-far", text, poses.board_rad, least))
    return found


def _room_light(flux: float, limit: float) -> Reason:
    text = f"room light gives {flux:.2g} photons per pixel and exposure on white, the limit is {limit:g}"
    return _reason("room-light", text, flux, limit)


def _more_poses(views: ViewEvidence, fit: FitEvidence, asked: Asked) -> Reason:
    """Nothing is wrong with the data but their number: errors fall with the root of it."""
    short = max(fit.expected_m / asked.accuracy_m, fit.worst_m / (WORST_TIMES * asked.accuracy_m))
    text = (
        f"the expected depth error at {asked.at_m:g} m is {_mm(fit.expected_m)}, asked for are {_mm(asked.accuracy_m)}"
    )
    if not math.isfinite(short):
        return _reason("too-few-poses", text, views.shown, math.nan)
    needed = math.ceil(views.shown * short**2)
    return _reason("too-few-poses", f"{text}: about {needed} poses would do", views.shown, needed)


def _mm(length_m: float) -> str:
    return f"{length_m * 1e3:.3g} mm"
