"""How well a number is known that follows from a model: its covariance, from that of the model's parameters."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError
from calibration.model import RigModel
from calibration.parameters import with_parameters

Array = NDArray[np.float64]

_STEP_SD = 0.1
"""Of each parameter, its own standard deviations: small against what bends, large against rounding."""


def propagated(model: RigModel, measure: Callable[[RigModel], Array]) -> tuple[Array, Array]:
    """measure(model) (n,) and its covariance (n, n), to first order; of zeros for a model without a covariance."""
    values = np.atleast_1d(measure(model)).astype(np.float64)
    known = model.covariance
    if known is None:
        return values, np.zeros((values.size, values.size))
    slopes = np.zeros((values.size, len(known.names)))
    steps = _STEP_SD * np.sqrt(np.diag(known.matrix))
    for i, (name, step) in enumerate(zip(known.names, steps, strict=True)):
        if step > 0:
            (above, up), (below, down) = (_changed(model, measure, name, sign * step, values) for sign in (1, -1))
            slopes[:, i] = (up - down) / (above - below)
    covariance: Array = slopes @ known.matrix @ slopes.T
    return values, covariance


def _changed(
    model: RigModel, measure: Callable[[RigModel], Array], name: str, step: float, values: Array
) -> tuple[float, Array]:
    """The step taken and what is measured then; no step where a parameter is at its bound, as a lag of 0 s."""
    try:
        changed = with_parameters(model, [name], [step])
    except CalibrationError:
        return 0.0, values
    return step, np.atleast_1d(measure(changed))
