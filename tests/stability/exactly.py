"""50-digit references: floats go in exactly as they are, so that only the rounding of the tested code counts."""

from collections.abc import Callable

import mpmath
import numpy as np


def relative(values: object, of: Callable[..., object], *arguments: object) -> np.ndarray:
    """Relative errors of `values` against the 50-digit function `of` the arguments, element by element.

    Where the exact value is 0 the value itself is the error.
    """
    got, *given = np.broadcast_arrays(np.asarray(values, np.float64), *(np.asarray(a) for a in arguments))
    errors = np.empty(got.shape)
    with mpmath.workdps(50):
        for at in np.ndindex(got.shape):
            exact = mpmath.mpf(of(*(_number(g[at]) for g in given)))
            off = mpmath.mpf(float(got[at])) - exact
            errors[at] = float(abs(off / exact)) if exact != 0 else float(abs(off))
    return errors


def _number(value: object) -> object:
    return mpmath.mpf(float(value))  # type: ignore[arg-type]
