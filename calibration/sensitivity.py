"""What an error of the mirror's command or of the stripe's place is worth in depth."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from calibration.model import RigModel
from calibration.triangulation import depth_slope
from calibration.uncertainty import command_at

_GRID: Final = 24
"""Pixels looked at along each side."""
_STEP = 1e-6
"""Of the command range."""


@dataclass(frozen=True, slots=True)
class Sensitivity:
    """Depth at one depth by command (m per command unit) and by the stripe's place (m per pixel): medians over the
    picture, NaN where the scan does not reach."""

    per_command_m: float
    per_pixel_m: float


def sensitivity(model: RigModel, at_m: float) -> Sensitivity:
    """Look at a grid over the picture."""
    camera = model.camera
    x = np.linspace(0, camera.width - 1, _GRID)
    y = np.linspace(0, camera.height - 1, _GRID)[:, None]
    command = command_at(model, x, y, at_m)
    lit = np.isfinite(command)
    if not lit.any():
        return Sensitivity(np.nan, np.nan)
    u, v = (tangent[lit] for tangent in camera.tangents_at(*np.broadcast_arrays(x, y)))
    low, high = model.scanner.command_range
    step = _STEP * (high - low)
    below, above = (np.clip(command[lit] + change, low, high) for change in (-step, step))
    change = model.sheets(above).depth(u, v) - model.sheets(below).depth(u, v)
    slope = depth_slope(u, v, model.planes(command[lit]), camera)
    return Sensitivity(
        per_command_m=float(np.nanmedian(np.abs(change / (above - below)))),
        per_pixel_m=float(np.nanmedian(np.abs(slope))),
    )
