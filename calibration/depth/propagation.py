"""How well a number is known that follows from a model: its covariance, from that of the model's parameters."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError
from calibration.model.parameters import MATRIX, ROW_DELAY, TIMES, with_parameters
from calibration.model.rig_model import RigModel

Array = NDArray[np.float64]

_STEPS = dict.fromkeys(MATRIX, 1e-3) | dict.fromkeys(TIMES, 1e-9) | {ROW_DELAY: 1e-12}
_STEP = 1e-6
"""Of each parameter, in its own unit: small against what bends, large against rounding."""


def propagated(model: RigModel, measure: Callable[[RigModel], Array]) -> tuple[Array, Array]:
    """measure(model) (n,) and its covariance (n, n), to first order; of zeros for a model without a covariance."""
    values = np.atleast_1d(measure(model)).astype(np.float64)
    if model.covariance is None:
        return values, np.zeros((values.size, values.size))
    slopes = by_parameter(model, model.covariance.names, lambda tried: np.atleast_1d(measure(tried)))
    covariance: Array = slopes @ model.covariance.matrix @ slopes.T
    return values, covariance


def by_parameter(model: RigModel, names: tuple[str, ...], measure: Callable[[RigModel], Array]) -> Array:
    """(n, p): how measure(model) (n,) changes with the parameters `names`, by differences."""
    slopes = np.empty((measure(model).size, len(names)))
    for i, name in enumerate(names):
        step = _STEPS.get(name, _STEP)
        (above, more), (below, less) = (_changed(model, name, sign * step) for sign in (1, -1))
        slopes[:, i] = (measure(more) - measure(less)) / (above - below)
    return slopes


def _changed(model: RigModel, name: str, step: float) -> tuple[float, RigModel]:
    """The step taken and the model then; no step where a parameter is at its bound, as a lag of 0 s."""
    try:
        return step, with_parameters(model, [name], [step])
    except CalibrationError:
        return 0.0, model
