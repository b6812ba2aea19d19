"""A model beside the true one, where a simulation knows it: by how much it gets depths wrong."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.depth.uncertainty import command_at, depth_sd_m
from calibration.model.rig_model import RigModel

Array = NDArray[np.float64]

_GRID = 32


@dataclass(frozen=True, slots=True, eq=False)
class DepthErrors:
    """Over a grid of pixels that the true rig lights at one depth. error_m: (n,) signed; sd_m: (n,) as the model's
    covariance predicts, NaN for a model without one.
    """

    depth_m: float
    error_m: Array
    sd_m: Array

    @property
    def median_m(self) -> float:
        """Median of the absolute errors."""
        return float(np.median(np.abs(self.error_m))) if self.error_m.size else np.nan

    @property
    def worst_m(self) -> float:
        """Largest absolute error."""
        return float(np.abs(self.error_m).max()) if self.error_m.size else np.nan

    @property
    def ratio(self) -> float:
        """Root mean square of errors in units of their predicted sd: 1 where the covariance is right, on average."""
        known = self.sd_m > 0
        return float(np.sqrt(np.mean((self.error_m[known] / self.sd_m[known]) ** 2))) if known.any() else np.nan


def depth_errors(model: RigModel, truth: RigModel, depth_m: float, velocity_per_s: float) -> DepthErrors:
    """What `model` makes of pixels that see the light at `depth_m`. velocity_per_s: of the command, signed."""
    camera = truth.camera
    x, y = np.meshgrid(np.linspace(0, camera.width - 1, _GRID), np.linspace(0, camera.height - 1, _GRID))
    mirror = command_at(truth, x, y, depth_m)
    lag_s = truth.lag_s.backward if velocity_per_s < 0 else truth.lag_s.forward
    commanded = mirror + velocity_per_s * (lag_s - truth.row_delay_s * y)
    found = model.mirror_command(commanded, y, velocity_per_s)
    low, high = model.scanner.command_range
    lit = np.isfinite(found) & (found >= low) & (found <= high)
    x, y, found = x[lit], y[lit], found[lit]
    z = model.sheets(found).depth(*model.camera.tangents_at(x, y))
    sd = np.full(z.shape, np.nan) if model.covariance is None else depth_sd_m(model, x, y, found, velocity_per_s)
    known = np.isfinite(z)
    return DepthErrors(depth_m, z[known] - depth_m, sd[known])
