"""Whether a calibration holds for a scan: its sensor, its mirror's speed and the commands it passes."""

import math
from collections.abc import Callable, Sequence

import numpy as np

from calibration.errors import CalibrationError
from calibration.model.rig_model import RigModel
from drivers.interfaces import SpadInfo
from rig.config import ScanConfig

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
