"""Checks whether a calibration is valid for a scan: for its sensor, its mirror's speed and its range of commands.

`recalibrated` adapts the plan of a recording to a calibration made later. What mirror and gate did stays as it was; lag
and windows may change.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from calibration.errors import CalibrationError
from calibration.model.rig_model import RigModel
from drivers.interfaces import SpadInfo
from rig.config.models import ScanConfig
from rig.errors import UsageError
from rig.geometry.line_grid import window_overlap
from rig.geometry.windows import WORD_PX, sweep_geometry
from rig.plan.scan_plan import ScanPlan

MOST_TIMES = 1000.0
"""Most exposures that are advised for a calibration, as a multiple of the scan's."""


def model_problems(
    scan: ScanConfig, model: RigModel | None, info: SpadInfo, speed_per_s: float, line_offsets: Sequence[float]
) -> list[str]:
    """Reasons why a calibration does not fit this scan: sensor, speed, commands; empty if there is no calibration."""
    if model is None:
        return []
    problems = []
    checks: tuple[Callable[[], object], ...] = (
        lambda: model.check_sensor(info.width, info.height),
        lambda: require_speed(model, speed_per_s, scan.exposures),
        lambda: model.planes(np.add.outer(np.array(scan.command_range), np.array(line_offsets))),
    )
    for check in checks:
        try:
            check()
        except CalibrationError as error:
            problems.append(f"calibration: {error}")
    return problems


def require_speed(model: RigModel, speed_per_s: float, exposures: int) -> None:
    """Raise CalibrationError if the lag was measured, but not near this speed. The message has a command to measure it.

    The speed of a sweep is inversely proportional to its exposures. The command names this scan's exposures, and those
    that give the speed at the far end of the range measured so far, so that scans that were possible stay possible.
    """
    try:
        model.check_speed(speed_per_s)
    except CalibrationError as error:
        low, high = model.speed_range_per_s or (speed_per_s, speed_per_s)
        end = low if speed_per_s > high else high
        times = exposures * (min(speed_per_s / end, MOST_TIMES) if end > 0 else MOST_TIMES)
        other = max(1, math.floor(times) if speed_per_s > high else math.ceil(times))
        shown = ",".join(map(str, sorted({exposures, other if other != exposures else 2 * exposures})))
        raise CalibrationError(f"{error}: rig calibrate sync CONFIG --calibration FILE --exposures {shown}") from error


def whole_rows(plan: ScanPlan) -> ScanPlan:
    """The plan with whole frames, for a rig without calibration, in which any pixel may see any column."""
    padded = -(-plan.width // WORD_PX) * WORD_PX
    return replace(plan, x0=np.zeros_like(plan.x0), window=padded, windows=None)


def recalibrated(plan: ScanPlan, model: RigModel) -> ScanPlan:
    """The plan with the lag and the windows of `model`; an equal plan if it was compiled for that model.

    Mirror, gate and markers stay as they were, and so do the pixels that the SPAD sent. A frame that lacks pixels of a
    column's window does not count for that column. Raises UsageError if the calibration does not fit the plan's sensor,
    speed, commands or depth range.
    """
    try:
        model.check_sensor(plan.width, plan.rows)
        require_speed(model, plan.speed_per_s, plan.exposures)
        model.planes(np.array(plan.command_range))
        geometry = sweep_geometry(model, plan.commands, plan.depth_range_m)
    except CalibrationError as error:
        raise UsageError(f"calibration: {error}") from error
    lags = {1: model.lag_s.forward, -1: model.lag_s.backward}
    legs = tuple(replace(leg, lag_s=lags[leg.direction]) for leg in plan.legs)
    lines = plan.lines
    if lines is not None:
        lines = replace(lines, overlap=window_overlap(lines, geometry))
    return replace(plan, legs=legs, x0=geometry.x0, window=geometry.window, lines=lines)
