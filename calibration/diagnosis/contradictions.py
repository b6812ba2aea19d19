"""Contradictions that a single unmoved rig cannot produce: waves (sweeps that differ), and shifts between views.

It is assumed that nothing moved during the sweeps of a view. So their residuals, binned over the mirror's command, may
differ only by noise and by one constant for each direction (the remaining error of the lag). All other differences are
waves of single sweeps, a sign that exposures are not locked to the mirror. If no view has two sweeps, waves are
measured against each sweep's own straight line. Medians in bins keep bad passages out.

The fit of the whole rig may move a board by a millimetre to fit the light planes. So each pose is fitted again to the
corners alone, with camera and mirror as fitted before. The distance of the passages from the light planes then shows
how much the views disagree: only by the noise of the poses if one rig saw them all, or by a shift of each view if
camera or mirror moved in between.

With few passages, as in bright room light, a mean square is mostly noise. The largest value that may be noise is
returned too.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from calibration.arrays import Array
from calibration.model.rig_model import RigModel
from calibration.rig_fit.fit import RigFit, SweepFit
from calibration.rig_fit.rig_state import corner_scale
from calibration.rig_fit.solve import corner_weights
from calibration.views import FEWEST_CORNERS, BoardPose, View, robust_sd

BINS = 24
"""Bins of the command range: wide enough for tens of passages each, narrow enough for a wave of several periods."""
_FEWEST_IN_BIN = 5
_LEAST_SHARE_IN_BIN = 0.25
"""Least number of passages in a bin, as a share of the usual number in the sweep's bins: those of a nearly empty bin
are there by chance."""
_FEWEST_BINS = 4
_MEDIAN_VARIANCE = np.pi / 2
"""Variance of a median in units of the mean's, normal distribution."""
_MEDIAN_TAKES = 0.8
"""The robust scatter of n values around their own median is (n - 0.8) / n of the true one (Croux, Rousseeuw, 1992)."""
NOISE_SIGMAS = 4.0
"""Standard deviations of a mean square up to which it may be noise."""


@dataclass(frozen=True, slots=True, eq=False)
class SweepWaves:
    """Waves of the sweeps of each view.

    rms: root mean square of the waves in command units, without the noise; noise: the largest rms that may be noise;
    both are NaN if there are too few passages. command: (BINS,) middles of bins. sweeps: (sweeps, BINS) medians of the
    residuals, NaN where there are too few passages.
    """

    rms: float
    noise: float
    command: Array
    sweeps: Array


def sweep_waves(sweeps: Sequence[SweepFit]) -> SweepWaves:
    """Compare the sweeps of each view."""
    commands = [sweep.command for sweep in sweeps if sweep.command.size]
    low, high = (min(map(np.min, commands)), max(map(np.max, commands))) if commands else (-1.0, 1.0)
    edges = np.linspace(low, high if high > low else low + 1, BINS + 1)
    middle, variance = _binned(sweeps, edges)
    left = middle.copy()
    for direction in (-1, 1):
        mine = np.array([sweep.direction == direction for sweep in sweeps], dtype=bool)
        if np.isfinite(middle[mine]).any():
            left[mine] -= np.nanmedian(middle[mine])
    views: dict[str, list[int]] = {}
    for i, sweep in enumerate(sweeps):
        views.setdefault(sweep.view, []).append(i)
    square, sd = _between(left, variance, list(views.values()))
    if np.isnan(square):
        square, sd = _off_lines(left, variance)
    return SweepWaves(
        rms=float(np.sqrt(max(square, 0.0))) if np.isfinite(square) else np.nan,
        noise=float(np.sqrt(NOISE_SIGMAS * sd)),
        command=(edges[1:] + edges[:-1]) / 2,
        sweeps=middle,
    )


def _binned(sweeps: Sequence[SweepFit], edges: Array) -> tuple[Array, Array]:
    """Medians of the residuals (sweeps, BINS) and their variances."""
    middle, variance = np.full((len(sweeps), BINS), np.nan), np.full((len(sweeps), BINS), np.nan)
    for i, sweep in enumerate(sweeps):
        at = np.clip(np.searchsorted(edges, sweep.command, side="right") - 1, 0, BINS - 1)
        count = np.bincount(at, minlength=BINS)
        usual = float(np.median(count[count > 0])) if count.any() else 0.0
        for k in np.flatnonzero(count >= max(_FEWEST_IN_BIN, _LEAST_SHARE_IN_BIN * usual)):
            inside = sweep.residual[at == k]
            middle[i, k] = np.median(inside)
            sd = robust_sd(inside - middle[i, k]) * inside.size / (inside.size - _MEDIAN_TAKES)
            variance[i, k] = _MEDIAN_VARIANCE * sd**2 / inside.size
    return middle, variance


def _between(left: Array, variance: Array, views: Sequence[Sequence[int]]) -> tuple[float, float]:
    """Mean square of the differences between sweeps of a view without the noise, and its sd if all were noise; NaN if
    no two sweeps of a view share a bin.
    """
    found = weight = chance = 0.0
    for rows in views:
        if len(rows) > 1:
            noise = np.mean(variance[rows], axis=0)
            spread = np.var(left[rows], axis=0, ddof=1) - noise
            known, free = np.isfinite(spread), len(rows) - 1
            found += float(spread[known].sum()) * free
            weight += np.count_nonzero(known) * free
            chance += 2 * free * float(np.sum(noise[known] ** 2))
    return (found / weight, float(np.sqrt(chance)) / weight) if weight else (np.nan, np.nan)


def _off_lines(left: Array, variance: Array) -> tuple[float, float]:
    """Mean square of the distances of sweeps from their own straight lines, and its sd, as in `_between`; NaN if no
    sweep is long enough.
    """
    found = weight = chance = 0.0
    bins = np.arange(BINS)
    for values, noise in zip(left, variance, strict=True):
        known = np.isfinite(values)
        count = int(np.count_nonzero(known))
        if count < _FEWEST_BINS:
            continue
        line = np.polynomial.Polynomial.fit(bins[known], values[known], 1)
        free = count - 2
        found += float(np.sum((values[known] - line(bins[known])) ** 2)) - free * float(noise[known].mean())
        weight += free
        chance += 2 * free * float(noise[known].mean()) ** 2
    return (found / weight, float(np.sqrt(chance)) / weight) if weight else (np.nan, np.nan)


_STEP = 1e-6
"""Change for differences: of the command as a share of its range, of a pose in rad and m."""
_ROUNDS = 8
"""Rounds in which a pose and the weights of its corners are fitted in turn."""
_FEWEST_TO_SPLIT = 4
MOST_MISFIT = 3.0
"""Largest misfit, a factor on the variances, at which the views count as in agreement."""
MOST_UNEXPLAINED = 0.35
"""Largest share of the shifts' variance that may remain if a single move is to explain them."""


@dataclass(frozen=True, slots=True, eq=False)
class ViewShift:
    """Shift of one view in command units: the median distance of its passages from the light planes, with its sign; sd:
    its standard deviation due to the pose's noise."""

    name: str
    shift: float
    sd: float


def view_shifts(fit: RigFit, views: dict[str, View]) -> tuple[ViewShift, ...]:
    """The shifts of all views of a fit that have passages and enough corners. views: all views of the fit, by name."""
    shifts = []
    for name, pose, sweeps in zip(fit.views, fit.poses, fit.sweeps, strict=True):
        found = _corner_pose(fit, views[name], pose)
        if found is not None and sweeps:
            shifts.append(_shift(fit.model, name, *found, sweeps))
    return tuple(shifts)


def common_shift(shifts: tuple[ViewShift, ...], wave: float, sweeps: int) -> tuple[float, float]:
    """Root mean square of the views' shifts, without the noise of poses and waves, and the largest one that may be such
    noise; NaN for fewer than two views.

    wave: rms of the waves in command units. sweeps: number of sweeps of a view, each with its own wave.
    """
    if len(shifts) < 2:
        return np.nan, np.nan
    variances = np.array([one.sd**2 for one in shifts]) + (wave**2 / max(sweeps, 1) if np.isfinite(wave) else 0.0)
    square = float(np.mean([one.shift**2 for one in shifts])) - float(np.mean(variances))
    chance = float(np.sqrt(2 * np.sum(variances**2))) / len(shifts)
    return math.sqrt(max(square, 0.0)), math.sqrt(NOISE_SIGMAS * chance)


def counted(shifts: tuple[ViewShift, ...], outliers: tuple[str, ...], misfit: float = 1.0) -> tuple[ViewShift, ...]:
    """The shifts that have to agree. A single outlier is left out if it is not the last view and the misfit is at most
    MOST_MISFIT."""
    if len(outliers) != 1 or not shifts or shifts[-1].name in outliers or misfit > MOST_MISFIT:
        return shifts
    return tuple(one for one in shifts if one.name not in outliers)


def last_before_move(shifts: tuple[ViewShift, ...]) -> str | None:
    """The view after which the rig moved, if one move explains most of the shifts (in order of time); else None."""
    values = np.array([one.shift for one in shifts])
    if len(values) < _FEWEST_TO_SPLIT:
        return None
    spread = float(np.sum((values - values.mean()) ** 2))
    parts = [values[:at].var() * at + values[at:].var() * (len(values) - at) for at in range(1, len(values))]
    best = int(np.argmin(parts))
    return shifts[best].name if parts[best] < MOST_UNEXPLAINED * spread else None


def _corner_pose(fit: RigFit, view: View, start: BoardPose) -> tuple[BoardPose, Array] | None:
    """Pose from the corners alone, weighted as in the fit, and its covariance (6, 6); None for too few corners."""
    if view.corners is None:
        return None
    px = np.asarray(view.corners.px, np.float64)
    known = np.isfinite(px).all(axis=1)
    if np.count_nonzero(known) < FEWEST_CORNERS:
        return None
    points, px, camera = fit.board.corners_m[view.corners.ids[known]], px[known], fit.model.camera
    sd_px = fit.noise.corner_sd_px * corner_scale(view.corners)[known]
    pose = np.concatenate([start.rotation, start.position_m]).astype(np.float64)
    for _ in range(_ROUNDS):
        seen, slopes = cv2.projectPoints(points, pose[:3], pose[3:], camera.matrix, camera.distortion)
        left = seen.reshape(-1, 2) - px
        weighted = slopes[:, :6] * np.repeat(corner_weights(left.T, sd_px), 2)[:, None]
        covariance = np.asarray(np.linalg.pinv(weighted.T @ slopes[:, :6]), np.float64)
        pose -= covariance @ (weighted.T @ left.ravel())
    return BoardPose(pose[:3], pose[3:]), covariance


def _shift(model: RigModel, name: str, pose: BoardPose, covariance: Array, sweeps: tuple[SweepFit, ...]) -> ViewShift:
    residuals = [_residual(model, pose, sweep) for sweep in sweeps]
    slope = np.zeros(6)
    for i in range(6):
        step = np.zeros(6)
        step[i] = _STEP
        moved = BoardPose(pose.rotation + step[:3], pose.position_m + step[3:])
        change = [_residual(model, moved, sweep) - at for sweep, at in zip(sweeps, residuals, strict=True)]
        slope[i] = float(np.median(np.concatenate(change))) / _STEP
    return ViewShift(name, float(np.median(np.concatenate(residuals))), float(np.sqrt(slope @ covariance @ slope)))


def _residual(model: RigModel, pose: BoardPose, sweep: SweepFit) -> Array:
    """(m,) mirror command of each passage minus the command at which the light goes through the board's point."""
    u, v = model.camera.tangents_at(sweep.x_px, sweep.y_px)
    ray = np.stack([u, v, np.ones_like(u)], axis=-1)
    normal = pose.matrix[:, 2]
    points = ray * ((normal @ pose.position_m) / (ray @ normal))[:, None]
    low, high = model.scanner.command_range
    step = _STEP * (high - low)
    at = np.clip(sweep.command, low + step, high - step)
    off = model.sheets(at).distance_m(points)
    by_command = (model.sheets(at + step).distance_m(points) - model.sheets(at - step).distance_m(points)) / (2 * step)
    return off / by_command
