"""What is known of how well the parameters of a model are known: their covariance, by name."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError

Array = NDArray[np.float64]

_ASYMMETRY = 1e-6
"""By which two correlations that are the same may differ, and a smallest eigenvalue lie below 0, from rounding."""


@dataclass(frozen=True, eq=False)
class Covariance:
    """names: (p,) as `calibration.model.parameters` has them. matrix: (p, p) float64, each parameter in its own unit.

    What is not named counts as known exactly. Raises CalibrationError for a matrix that is no covariance.
    """

    names: tuple[str, ...]
    matrix: Array

    def __post_init__(self) -> None:
        """Check and freeze."""
        matrix = np.array(self.matrix, dtype=np.float64)
        names = tuple(self.names)
        if matrix.shape != (len(names), len(names)):
            raise CalibrationError(
                f"covariance has shape {matrix.shape} for {len(names)} names; it must be square, one row a name"
            )
        if len(set(names)) < len(names):
            raise CalibrationError(f"covariance names a parameter twice: {', '.join(names)}")
        variance = np.diag(matrix)
        if not np.all(np.isfinite(matrix)) or np.any(variance < 0):
            raise CalibrationError("covariance must be finite with variances of 0 or more; fit the model again")
        scale = np.sqrt(np.outer(variance, variance))
        unit = np.divide(matrix, scale, out=np.zeros_like(matrix), where=scale > 0)
        if np.any(np.abs(unit - unit.T) > _ASYMMETRY) or np.any(matrix[scale == 0]) or _least(unit) < -_ASYMMETRY:
            raise CalibrationError("covariance is not symmetric and positive, as one must be; fit the model again")
        matrix = 0.5 * (matrix + matrix.T)
        matrix.flags.writeable = False
        object.__setattr__(self, "names", names)
        object.__setattr__(self, "matrix", matrix)

    def of(self, names: Sequence[str]) -> Array:
        """The matrix of some of the parameters, in this order."""
        at = [self.names.index(name) for name in names]
        return self.matrix[np.ix_(at, at)]


def _least(correlation: Array) -> float:
    """The smallest eigenvalue; 0 of nothing."""
    return float(np.linalg.eigvalsh(correlation)[0]) if len(correlation) else 0.0
