"""The blurred edge of a Gaussian and its integral, from a table: three times as fast as erf and exp.

    edge(a) = Phi(a),     edge_sum(a) = a Phi(a) + phi(a), whose slope is Phi

Cubic Hermite interpolation between values and slopes a 64th of a standard deviation apart: absolute error below 1e-10;
beyond seven standard deviations the limits, 0, 1 and a."""

import math

import numba
import numpy as np

_END = 7.0
_PER_SIGMA = 64
_GRID = np.arange(-_END * _PER_SIGMA, _END * _PER_SIGMA + 1) / _PER_SIGMA
_SLOPE = np.exp(-0.5 * _GRID**2) / math.sqrt(2.0 * math.pi)
_EDGE = np.array([0.5 * math.erfc(-a / math.sqrt(2.0)) for a in _GRID])
_SUM = _GRID * _EDGE + _SLOPE


@numba.njit(inline="always", error_model="numpy")
def _between(values, slopes, a):  # type: ignore[no-untyped-def]
    place = (a + _END) * _PER_SIGMA
    i = int(place)
    t = place - i
    h = 1.0 / _PER_SIGMA
    v0, v1, s0, s1 = values[i], values[i + 1], h * slopes[i], h * slopes[i + 1]
    step = v1 - v0
    return v0 + t * (s0 + t * (3.0 * step - 2.0 * s0 - s1 + t * (s0 + s1 - 2.0 * step)))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def edge(a: float) -> float:
    """Share of a Gaussian of mean 0 and standard deviation 1 that lies below a."""
    if a < -_END:
        return 0.0
    if a >= _END:
        return 1.0
    return float(_between(_EDGE, _SLOPE, a))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def edge_sum(a: float) -> float:
    """Integral of `edge` from minus infinity to a."""
    if a < -_END:
        return 0.0
    if a >= _END:
        return a
    return float(_between(_SUM, _EDGE, a))
