"""Fitted rigs against true ones: the figures of `tests.campaigns.calibration.rigs`, and what is asked for of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from calibration.arrays import Array
from calibration.depth_error import command_at, depth_sd_m
from calibration.model.light_sheet import depth_slope
from calibration.model.rig_model import RigModel
from calibration.rig_fit.fit import RigFit
from calibration.views import robust_sd
from tests.campaigns.calibration.asked import ADDED_PX, INSIDE, RATIO, Figure
from tests.campaigns.calibration.board_capture import speed

FAR_M = 5.0
GRID = 12
"""Points along each side of the picture."""
CALIBRATED, SCANNED = 10, (10, 1, 20)
"""Exposures of the views, and of the scans that the model is for."""
SURE = 1.959964
"""Standard deviations of a 95 % interval."""


@dataclass(frozen=True, slots=True, eq=False)
class Compared:
    """A fitted model against the truth, at points (n,) of the picture. error_m, sd_m: at FAR_M. added_px: by exposures
    and direction, root mean square over the picture of what the model adds to a scan's error.
    """

    error_m: Array
    sd_m: Array
    added_px: dict[tuple[int, int], float]


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """Calibration of a rig. trouble: why there is no model, '' where there is one."""

    seed: int
    seconds: float
    trouble: str
    poses: int = 0
    compared: Compared | None = None
    fit: RigFit | None = None


def compare(fitted: RigModel, true: RigModel) -> Compared:
    """The fitted model's depth against the true one's, for the same pixels and commands."""
    camera = true.camera
    x, y = np.meshgrid(*((np.arange(GRID) + 0.5) / GRID * size - 0.5 for size in (camera.width, camera.height)))
    mirror = command_at(true, x, y, FAR_M)
    there = np.isfinite(mirror)
    x, y, mirror = x[there], y[there], mirror[there]
    slope = np.abs(depth_slope(*camera.tangents_at(x, y), true.planes(mirror), camera))
    added, error, sd = {}, np.empty(0), np.empty(0)
    for exposures in SCANNED:
        for direction in (1, -1):
            velocity = direction * speed(exposures)
            lag_s = true.lag_s.forward if direction > 0 else true.lag_s.backward
            stands = fitted.mirror_command(mirror + velocity * lag_s, y, velocity)
            stands = np.clip(stands, *fitted.scanner.command_range)
            off = fitted.sheets(stands).depth(*fitted.camera.tangents_at(x, y)) - FAR_M
            added[exposures, direction] = float(np.sqrt(np.nanmean((off / slope) ** 2)))
            if exposures == CALIBRATED:
                error = np.concatenate([error, off])
                sd = np.concatenate([sd, depth_sd_m(fitted, x, y, stands, velocity)])
    return Compared(error, sd, added)


def summary(outcomes: Iterable[Outcome]) -> str:
    """The figures over all rigs."""
    done = list(outcomes)
    good = [(o, o.compared) for o in done if o.compared is not None]
    said = [f"{len(done)} rigs, {len(good)} calibrated, median {np.median([o.seconds for o in done]):.1f} s a rig"]
    said += [f"  refused, seed {o.seed}: {o.trouble}" for o in done if o.compared is None]
    if not good:
        return "\n".join(said)
    z = in_sds(c for _, c in good)
    medians = np.array([np.median(np.abs(c.error_m)) for _, c in good])
    worst = np.array([np.max(np.abs(c.error_m)) for _, c in good])
    inside = np.array([np.mean(np.abs(c.error_m) < SURE * c.sd_m) for _, c in good])
    spread = np.array([np.sqrt(np.mean((c.error_m / c.sd_m) ** 2)) for _, c in good])
    said += [
        f"depth error at {FAR_M:g} m, mm: median of the rigs' medians {1e3 * np.median(medians):.2f}, of their worst "
        f"{1e3 * np.median(worst):.2f}; worst of all {1e3 * worst.max():.1f}",
        f"error over stated sd: median {median_ratio(z):.3f}, rms {np.sqrt(np.mean(z**2)):.3f}, a rig's "
        f"rms {np.median(spread):.3f} (median), {np.percentile(spread, 95):.2f} (95 %), {spread.max():.2f} (worst)",
        f"true depth in the stated 95 % interval: {np.mean(np.abs(z) < SURE):.1%} of points; a rig's share "
        f"{np.percentile(inside, 5):.0%} (5 %)",
    ]
    for exposures in SCANNED:
        added = added_px((c for _, c in good), exposures)
        said.append(
            f"added to a scan at K = {exposures}, px: median {np.median(added):.4f}, 95 % "
            f"{np.percentile(added, 95):.4f}, worst {added.max():.4f}, above 0.1 px {np.mean(added > 0.1):.1%}"
        )
    odd = Counter(name for o, _ in good if o.fit is not None for name in o.fit.outliers)
    said.append(f"views called outliers: {sum(odd.values())} of {sum(o.poses for o, _ in good)}")
    return "\n".join(said)


def in_sds(compared: Iterable[Compared]) -> Array:
    """Errors of all points of all rigs in stated standard deviations."""
    return np.concatenate([np.empty(0), *(c.error_m / c.sd_m for c in compared)])


def median_ratio(z: Array) -> float:
    """Actual to stated errors, 1 for a normal distribution of these standard deviations; nan of none."""
    return robust_sd(z) if len(z) else np.nan


def added_px(compared: Iterable[Compared], exposures: int) -> Array:
    """Pixels that each model adds to a scan's error, each way."""
    return np.array([c.added_px[exposures, direction] for c in compared for direction in (1, -1)])


def figures(compared: Sequence[Compared]) -> list[Figure]:
    """Figures beside what is asked for."""
    z = in_sds(compared)
    inside = float(np.mean(np.abs(z) < SURE)) if len(z) else np.nan
    return [
        Figure("depth error over its stated sd (median)", median_ratio(z), RATIO),
        Figure("share of true depths in the stated 95 % intervals", inside, INSIDE),
        *(
            Figure(
                f"px added to a scan at K = {exposures} (worst rig)", _worst(added_px(compared, exposures)), ADDED_PX
            )
            for exposures in SCANNED
        ),
    ]


def _worst(values: Array) -> float:
    return float(values.max()) if len(values) else np.nan
