"""What the passes of a live map are decided by: an estimate of the counts so far, and the time that passes take."""

import functools
import math
from typing import Any, Protocol

import numpy as np

from calibration.errors import CalibrationError
from drivers.interfaces import SpadTiming
from rig.adaptive import BLOCKS, EXPOSURES, Pass, Unsettled, moved_rows, next_pass
from rig.adaptive_thinning import thinned
from rig.config import AdaptiveConfig
from rig.counting import CountVolume
from rig.errors import PlanError
from rig.estimators import create_estimator
from rig.geometry import SweepGeometry
from rig.path_search import find_path
from rig.plan import path_demand
from rig.scan_plan import ScanPlan
from rig.session import OpenRig, prepare


class ChoosesPasses(Protocol):
    """Where the passes of the maps of a run come from: decided as it goes, or recorded."""

    def next(self, index: int, taken: int, counts: CountVolume | None, spent_s: float) -> Pass | None:
        """The next pass of map `index`, of which so many were taken in spent_s of sensor time; None: it is whole."""
        ...

    def prepare(self, one: Pass) -> tuple[ScanPlan, SpadTiming]:
        """The plan of a pass, checked, with the SPAD configured for it."""
        ...


class DecidedPasses:
    """Decides, between two passes of a map, whether and where to take another. whole: the plan of one plain sweep.

    Its estimator is one of its own: what maps are estimated with does not depend on what was looked at on the way.
    """

    def __init__(self, rig: OpenRig, whole: ScanPlan, geometry: SweepGeometry, threads: int) -> None:
        """Raises PlanError where not even the first pass can be made."""
        assert rig.config.scan.adaptive is not None, "asked for by the config"
        self._rig = rig
        self._whole = whole
        self._geometry = geometry
        self._settings: AdaptiveConfig = rig.config.scan.adaptive
        self._scout = create_estimator(rig.config.estimate.estimator, threads)
        self._searched = geometry.x_lo <= geometry.x_hi
        self._first = first_pass(rig, whole)
        self._pass_time = functools.cache(functools.partial(pass_time_s, rig, whole))
        self._budget_s = budget_s(self._settings, whole)

    def next(self, index: int, taken: int, counts: CountVolume | None, spent_s: float) -> Pass | None:
        """See `ChoosesPasses`."""
        if counts is None:
            return self._first
        left_s = self._budget_s - spent_s
        if taken >= self._settings.passes or left_s <= 0:
            return None
        now = self._scout.estimate(counts, self._geometry)
        if float(now.confidence[self._searched].mean()) >= self._settings.target_share:
            return None
        before = self._scout.estimate(thinned(counts), self._geometry)
        unsettled = Unsettled(moved_rows(before, now, self._searched), counts.n_frames)
        return next_pass(unsettled, self._pass_time, left_s, self._settings.passes - taken)

    def prepare(self, one: Pass) -> tuple[ScanPlan, SpadTiming]:
        """See `ChoosesPasses`."""
        return _prepared(self._rig, self._whole, one)


def budget_s(settings: AdaptiveConfig, whole: ScanPlan) -> float:
    """Most sensor time of a map in passes; by default that of one plain sweep, whose plan is `whole`."""
    return settings.time_budget or float(whole.sweep_s)


def passes_content(settings: AdaptiveConfig, whole: ScanPlan) -> dict[str, Any]:
    """What passes a map will have at most, for programs."""
    return {
        "most_passes": settings.passes,
        "time_budget_s": budget_s(settings, whole),
        "first_exposures": settings.first_exposures,
        "target_share": settings.target_share,
    }


def describe_passes(settings: AdaptiveConfig, whole: ScanPlan) -> str:
    """The same for people, a line below those of the plan of a plain sweep."""
    return (
        f"passes      at most {settings.passes} a map in {budget_s(settings, whole) * 1e3:.1f} ms of sensor time; "
        f"first {settings.first_exposures} exposures of all columns (above: the plain sweep)"
    )


def first_pass(rig: OpenRig, whole: ScanPlan) -> Pass:
    """The first pass of every map, its plan checked.

    PlanError where it cannot be, takes more time than a map may, or so much of it that no other pass can follow.
    """
    settings = rig.config.scan.adaptive
    assert settings is not None, "asked for by the config"
    first = Pass(0, whole.columns, settings.first_exposures)
    try:
        _prepared(rig, whole, first)
    except PlanError as error:
        what = "scan.adaptive: the first pass: "
        said = (problem.replace("scan.exposures", "first_exposures") for problem in error.problems)
        raise PlanError(*(what + problem for problem in said)) from error
    first_s = pass_time_s(rig, whole, first.columns, first.exposures)
    allowed_s = budget_s(settings, whole)
    allowed = f"{allowed_s * 1e3:.1f} ms"
    next_step = f"raise {'scan.exposures' if settings.time_budget is None else 'time_budget'} or lower first_exposures"
    if first_s is not None and first_s > allowed_s:
        raise PlanError(
            f"scan.adaptive: the first pass takes {first_s * 1e3:.1f} ms, all passes of a map may take {allowed}; "
            + next_step
        )
    left_s, shortest_s = allowed_s - (first_s or 0.0), _shortest_s(rig, whole)
    if left_s < shortest_s:
        raise PlanError(
            f"scan.adaptive: {first.exposures} first_exposures leave {left_s * 1e3:.1f} ms of the {allowed} of a map, "
            f"the shortest other pass takes {shortest_s * 1e3:.1f} ms, so that it would be a plain sweep; {next_step}"
        )
    return first


def _shortest_s(rig: OpenRig, whole: ScanPlan) -> float:
    """Sensor time of the shortest further pass, inf where there is none."""
    columns = max(1, whole.columns // BLOCKS)
    times = [pass_time_s(rig, whole, columns, exposures) for exposures in EXPOSURES]
    return min((time_s for time_s in times if time_s is not None), default=math.inf)


def pass_time_s(rig: OpenRig, whole: ScanPlan, columns: int, exposures: int) -> float | None:
    """Sensor time of a pass, run-in, fly-back and read-out too; None where mirror or calibration do not allow it."""
    scan = Pass(0, columns, exposures).scan(rig.config.scan)
    demand = path_demand(scan, columns, whole.frame_rate_hz, rig.model, markers=rig.spad.info.markers)
    try:
        if rig.model is not None:
            rig.model.check_speed(demand.speed_per_s)
    except CalibrationError:
        return None
    found = find_path(demand, rig.scanner.limits, rig.scanner.point_clock)
    if found.path is None:
        return None
    sweep_s = float(found.path.points / found.rate_hz)
    frames = sweep_s * float(whole.frame_rate_hz)
    most = whole.burst_frames
    return None if most is not None and frames > most else sweep_s + whole.readout_s(round(frames))


def _prepared(rig: OpenRig, whole: ScanPlan, one: Pass) -> tuple[ScanPlan, SpadTiming]:
    windows = np.ascontiguousarray(whole.x0[one.part]), whole.window
    return prepare(rig, one.scan(rig.config.scan), windows)
