"""The plan of a recording for a calibration made since: what was scanned stays, where it is seen may change."""

from dataclasses import replace

import numpy as np

from calibration.errors import CalibrationError
from calibration.model.rig_model import RigModel
from rig.calibration_reach import require_speed
from rig.errors import UsageError
from rig.geometry import WORD_PX, sweep_geometry
from rig.multi_line import window_overlap
from rig.scan_plan import ScanPlan


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
