"""Is a calibration good enough, and if not, why: a verdict whose limits are depth errors.

A calibration passes where the depth error that its covariance predicts is at most what was asked for, and where its
data agree with each other and with what is known of the rig. The first reason is the root cause. Their order:

1. Causes of faults that are not there: room light that drowns the line, boards too far away to be placed.
2. Data that no one rig can have made (planes that wave, a rig that moved): nothing else can be believed then.
3. A baseline other than the stated one: everything is in proportion, only too large or too small.
4. Data that say too little (room light, too few poses, no tilt, boards too far, corners in a part of the picture only):
   a likely cause where the predicted error is too large; and where the covariance promises enough, but by the model
   alone, with next to nothing left to check the model by.

Where the error is too large and the data have none of these faults, there are simply too few of them. Last comes what
the predicted error does not show: sweeps whose directions and speeds told no lag for one of the ways that a scan may
go.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from calibration.diagnosis.evidence import PoseEvidence, ViewEvidence, data_lack, hiding
from calibration.errors import Degenerate, mm
from calibration.model.parameters import lag_groups, one_speed
from calibration.verdict import SIGMAS, WORST_TIMES, AccuracyGoal, Reason, Verdict, more_poses, reason_for

_SPEEDS = "scan both ways (scan.bidirectional), at two speeds or more (scan.exposures)"


def lag_lack(velocities_per_s: Sequence[float], *, mean_will_do: bool) -> list[Reason]:
    """Reasons why sweeps at these signed velocities do not tell both lags.

    mean_will_do: planes found with the mean of both lags at one speed are right at that speed, both ways.
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
"""Error of a tape measure: 3 mm in 300 mm."""
MOST_SHIFT = 0.25
"""Share of the accuracy asked by which views may contradict each other. A fit has gone between them already, and its
depth is off by several times what is left: 2 to 5 times over 30 simulated knocks."""

WAVES_MOVE = 2.0
"""Multiple of the waves that a view's shift must exceed to count as a move: waves move whole views too, of few sweeps
by as much as sweeps differ, up to 1.35 times in 23 simulated calibrations."""


@dataclass(frozen=True, slots=True)
class FitEvidence:
    """Evidence of a fit and of where its boards stood; NaN where it cannot tell.

    expected_m, worst_m: predicted sd of the depth at the distance asked, median and 95 % of the picture. wave_m: error
    of one sweep against another of the same view there; wave_noise_m: up to here that may be noise. shift_m,
    shift_noise_m: of a view against the others, and up to where that may be; moved_after: the view after which they
    changed, where one move explains them. misfit: factor by which the expected variances grew because the data
    contradict each other. baseline_m, baseline_sd_m: distance of camera and mirror axis. velocities_per_s: of the
    sweeps, signed; empty: not known.
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
    """The verdict where no model could be fitted: what the views lack, else what the fit said. poses: roughly.

    photons: as for `data_lack`.
    """
    lacking = [*hiding(views, poses, photons=photons), *data_lack(views, poses, imprecise=True, photons=photons)]
    code = _REFUSED_FOR.get(refused.reason, refused.reason)
    own = reason_for(code, str(refused))
    if refused.reason in _SEEN_AT_ONCE:  # but for room light, which hides boards, nothing goes before it
        return Verdict(False, (*[reason for reason in lacking if reason.code == "room-light"], own))
    codes = [reason.code for reason in lacking]
    if code not in codes:
        # That boards are parallel a fit sees better than rough poses do; of other refusals it can only guess the cause.
        seen = refused.reason == "coplanar" and "poor-coverage" in codes
        lacking.insert(codes.index("poor-coverage") if seen else len(codes), own)
    return Verdict(False, tuple(lacking))


_REFUSED_FOR = {"one-pose": "too-few-poses", "coplanar": "no-tilt"}
"""Reason for which a fit was impossible, and the lack of data behind it."""
_SEEN_AT_ONCE = ("no-board", "wrong-board", "board-half-out", "mirrored", "two-boards", "no-line")
"""Faults of single views that leave too few to be used."""


def _contradictions(fit: FitEvidence, asked: AccuracyGoal, imprecise: bool) -> list[Reason]:
    """Reasons that no one rig can have made. Sweeps of one view that differ tell waves from a rig that moved in
    between.

    Where the result would be precise but for the misfit, less than the accuracy asked is the cause already.
    """
    limit = asked.accuracy_m
    grown = math.sqrt(max(fit.misfit, 1.0))
    if imprecise and fit.expected_m <= limit * grown and fit.worst_m <= WORST_TIMES * limit * grown:
        limit /= grown
    waves = fit.wave_m > max(limit, fit.wave_noise_m)
    most_shift = max(MOST_SHIFT * limit, fit.shift_noise_m)
    moved = fit.shift_m > max(most_shift, WAVES_MOVE * fit.wave_m if waves else 0.0)
    found = []
    if waves:
        found.append(
            reason_for(
                "exposure-not-locked",
                f"planes wave: sweeps of one view differ by {mm(fit.wave_m)} of depth at {asked.at_m:g} m, the limit "
                f"is {mm(limit)}",
                fit.wave_m,
                limit,
            )
        )
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
