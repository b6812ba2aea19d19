"""Depth by a fitted rig model against that of the true rig: same pixels, same instants."""

from __future__ import annotations

import numpy as np

from calibration.arrays import Array
from calibration.depth_error import depth_sd_m
from calibration.model.rig_model import RigModel
from tests.reference.boards.calibration_data import TrueRig, points_at


def normalised(model: RigModel, rig: TrueRig, depth_m: float, velocity_per_s: float) -> float:
    """Root mean square of the errors in units of their stated sd: 1 where the covariance is right, on average."""
    error, sd = depth_errors(model, rig, depth_m, velocity_per_s)
    return float(np.sqrt(np.mean((error / sd) ** 2)))


def depth_errors(
    model: RigModel, rig: TrueRig, depth_m: float, velocity_per_s: float, seed: int = 0, count: int = 60
) -> tuple[Array, Array]:
    """(errors, sd that the model states) in metres, at points all over the picture."""
    points = points_at(np.random.default_rng(seed), rig, depth_m, count)
    x, y = rig.project(points)
    mirror = model.mirror_command(rig.command_at(points, velocity_per_s), y, velocity_per_s)
    mirror = np.clip(mirror, *model.scanner.command_range)
    u, v = model.camera.tangents_at(x, y)
    return model.sheets(mirror).depth(u, v) - depth_m, depth_sd_m(model, x, y, mirror, velocity_per_s)
