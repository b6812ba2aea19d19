"""Which lags sweeps tell, by the directions and speeds at which they ran: one rule for planes and for `sync`.

Where the line stands is not known beforehand. A sweep of signed velocity v sees it at

    command = position + v lag_of_its_direction

so that the position and two lags are told apart only where three sweeps differ: two speeds in one direction at least,
and the other direction too. One speed each way tells v_up lag_forward + v_down lag_backward alone, whether the two
speeds are the same or not; one way at one speed tells nothing of a lag.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.model.parameters import BACKWARD, FORWARD

Array = NDArray[np.float64]

SWEPT: Final = "velocities_per_s"
"""In a model's provenance: the signed velocities of the sweeps that its planes were found from."""
ALIKE_SPEEDS: Final = 0.02
"""Relative difference up to which two speeds are one: they would tell a lag 50 times worse than their own places."""
SPEED_MARGIN: Final = 0.05
"""So far beyond the speeds at which it was measured a lag is taken to hold."""


def lag_groups(velocities_per_s: ArrayLike) -> tuple[tuple[str, ...], ...]:
    """The lags that sweeps at these signed velocities tell: groups of names, each of one value.

    Both lags are one where they cannot be told apart, and where one way was never swept; none: nothing is told.
    """
    up, down = _speeds(velocities_per_s)
    several = _several(up) or _several(down)
    if several and up.size and down.size:
        return ((FORWARD,), (BACKWARD,))
    return ((FORWARD, BACKWARD),) if several or (up.size and down.size) else ()


def one_speed(velocities_per_s: ArrayLike) -> bool:
    """Whether all ran at the same speed, whichever way."""
    return not _several(np.abs(np.asarray(velocities_per_s, np.float64)))


def untold(velocities_per_s: Sequence[float]) -> Array:
    """(n, 3): changes of (position, lag forward, lag backward), in seconds and command units, that no sweep shows.

    Each has a lag of 1 s; nothing at all where there are no sweeps.
    """
    velocity = np.asarray(velocities_per_s, np.float64)
    if velocity.size == 0:
        return np.zeros((0, 3))
    fastest = float(np.abs(velocity).max())
    design = np.stack([np.full(velocity.size, fastest), np.maximum(velocity, 0), np.minimum(velocity, 0)], axis=-1)
    told = 1 + len(lag_groups(velocity))
    open_ones: Array = np.linalg.svd(design)[2][told:]
    open_ones = open_ones / np.abs(open_ones[:, 1:]).max(axis=1, keepdims=True)
    return open_ones * [fastest, 1.0, 1.0]


def alike_speeds(speeds_per_s: ArrayLike) -> NDArray[np.int64]:
    """(n,): a number for each speed, shared by all between which and it there is no gap, whichever way they went."""
    speeds, which = np.unique(np.abs(np.asarray(speeds_per_s, np.float64)), return_inverse=True)
    apart = np.diff(speeds, prepend=speeds[:1]) > ALIKE_SPEEDS * speeds
    result: NDArray[np.int64] = np.cumsum(apart, dtype=np.int64)[which.reshape(-1)]
    return result


def speed_range(speeds_per_s: ArrayLike) -> tuple[float, float]:
    """The speeds at which a lag measured at these holds."""
    speeds = np.asarray(speeds_per_s, np.float64)
    return float(speeds.min() * (1 - SPEED_MARGIN)), float(speeds.max() * (1 + SPEED_MARGIN))


def _speeds(velocities_per_s: ArrayLike) -> tuple[Array, Array]:
    """(up, down)."""
    velocity = np.asarray(velocities_per_s, np.float64)
    return velocity[velocity > 0], -velocity[velocity < 0]


def _several(speeds: Array) -> bool:
    return speeds.size > 1 and float(np.ptp(speeds)) > ALIKE_SPEEDS * float(speeds.max())
