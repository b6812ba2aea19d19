"""What an error of the mirror's command or of the stripe's place is worth in depth, and where there is any depth."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibration.depth.uncertainty import command_at
from calibration.errors import CalibrationError
from calibration.model.rig_model import RigModel
from calibration.model.triangulation import depth_slope

Array = NDArray[np.float64]

_GRID: Final = 24
"""Pixels looked at along each side."""
LEAST_LIT_SHARE: Final = 0.05
"""Of the picture, for a distance to be judged at: more than a border column or row."""
_DISTANCES_M: Final = np.geomspace(0.05, 100.0, 60)
_STEP = 1e-6
"""Of the command range."""


@dataclass(frozen=True, slots=True)
class Sensitivity:
    """Depth at one depth by command (m per command unit) and by the stripe's place (m per pixel): medians over those
    parts of the picture where the line reaches it."""

    per_command_m: float
    per_pixel_m: float


def sensitivity(model: RigModel, at_m: float) -> Sensitivity:
    """Look at a grid over the picture. CalibrationError where the line does not reach that depth."""
    camera = model.camera
    x = np.linspace(0, camera.width - 1, _GRID)
    y = np.linspace(0, camera.height - 1, _GRID)[:, None]
    command = command_at(model, x, y, at_m)
    lit = np.isfinite(command)
    if lit.mean() < LEAST_LIT_SHARE:
        raise CalibrationError(
            f"the line does not reach {at_m:g} m, {_said_reach(model, x, y)}; judge by another distance (--at)"
        )
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


def _said_reach(model: RigModel, x: Array, y: Array) -> str:
    """From where to where the line reaches."""
    share = np.array([np.isfinite(command_at(model, x, y, at)).mean() for at in _DISTANCES_M])
    lit = _DISTANCES_M[share >= LEAST_LIT_SHARE]
    return f"it reaches {lit[0]:.2g} to {lit[-1]:.2g} m" if lit.size else "nor anything else within 100 m"
