"""What a calibration found beside what a simulated rig's world knows."""

from typing import Any

import numpy as np

from calibration.depth.against_truth import DepthErrors, depth_errors
from calibration.model.rig_model import RigModel
from rig.calibration_identity import KnowsRig
from rig.config import RigConfig
from rig.session import open_rig


def true_model(live: RigConfig) -> RigModel | None:
    """The rig as its world knows it; asked after everything was estimated."""
    if live.world is None:
        return None
    with open_rig(live.model_copy(update={"calibration": None})) as rig:
        return rig.world.true_model() if isinstance(rig.world, KnowsRig) else None


def true_errors(model: RigModel, live: RigConfig, at_m: float) -> DepthErrors | None:
    """How far depths are off, where the rig's world knows."""
    truth = true_model(live)
    if truth is None:
        return None
    speed = 0.0 if model.speed_range_per_s is None else float(np.mean(model.speed_range_per_s))
    return depth_errors(model, truth, at_m, speed)


def truth_content(errors: DepthErrors) -> dict[str, Any]:
    """For programs."""
    return {
        "at_m": errors.depth_m,
        "median_m": errors.median_m,
        "worst_m": errors.worst_m,
        "ratio_to_sd": errors.ratio,
    }
