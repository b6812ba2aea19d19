"""Whether a calibration holds for a scan: its sensor, its mirror's speed and the commands it passes.

The plan of a recording for a calibration made since: what was scanned stays, where it is seen may change.
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
"""As many exposures as a scan that a calibration at its speed is advised to look at: more say nothing of a mirror."""


def model_problems(
    scan: ScanConfig, model: RigModel | None, info: SpadInfo, speed_per_s: float, line_offsets: Sequence[float]
) -> list[str]:
    """What keeps a calibration from being that of this scan: sensor, speed, commands; nothing where there is none."""
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
    """CalibrationError where the lag was not measured around this speed, with the command that measures it here too.

    A sweep is as many times faster as it has fewer exposures: named are this scan's, and those of the end of the old
    range that is farther off, so that what was scanned before still can be.
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
    """The plan of whole frames, where nothing is known of the rig any more: every pixel can be anybody's."""
    padded = -(-plan.width // WORD_PX) * WORD_PX
    return replace(plan, x0=np.zeros_like(plan.x0), window=padded, windows=None)


def recalibrated(plan: ScanPlan, model: RigModel) -> ScanPlan:
    """The plan with the lag and the windows of `model`: the same plan where it was compiled for that.

    Mirror, gate and markers are those that there were, and so are the pixels that the SPAD sent: where they do not hold
    a column's window its frames do not count. UsageError where the calibration is not one of this rig and scan.
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
