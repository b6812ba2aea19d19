"""A model's numbers as a minimal list of local parameters, for fits and covariances; and which lags sweeps determine.

Directions and points have fewer degrees of freedom than numbers. So the parameters of the axis are changes, 0 for the
present model, about and along two fixed directions across the axis, e1 = zero_normal and e2 = axis x zero_normal.

    fx fy cx cy                     pixels
    k1 k2 p1 p2 k3 ... tau_y        distortion, those terms that the camera has
    axis_turn_1, axis_turn_2        rad; axis and zero_normal turned together about e1, e2, through axis_point_m
    axis_shift_1, axis_shift_2      m; axis_point_m along e1, e2
    angle_0, angle_1, ...           rad; terms of angle_rad
    offset_0, ..., cone, bow        m, ..., rad, rad per rad^2; terms of offset_m, cone_rad, bow_per_rad
    lag_forward, lag_backward, row_delay   s

A table of planes has no parameters of its own; only those of the camera and the lags exist.

One rule, for planes and for `calibration.sync`, says which lags follow from the directions and speeds of the sweeps.
The position of the line is not known beforehand. A sweep of signed velocity v sees it at

    command = position + v lag_of_its_direction

So the position and the two lags can be separated only by at least three different sweeps: two speeds in one direction,
and a sweep in the other direction. One speed in each direction determines only v_up lag_forward + v_down lag_backward,
whether the two speeds are equal or not. One direction at one speed determines no lag.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.arrays import Array
from calibration.errors import CalibrationError
from calibration.model.camera import Camera
from calibration.model.rig_model import Lag, RigModel
from calibration.model.scanner import PivotScanner

MATRIX = {"fx": (0, 0), "fy": (1, 1), "cx": (0, 2), "cy": (1, 2)}
DISTORTION = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y")
AXIS = ("axis_turn_1", "axis_turn_2", "axis_shift_1", "axis_shift_2")
MOST_TERMS = 32
"""Most terms of a polynomial; a galvo's law has two to five."""
TIMES = FORWARD, BACKWARD, ROW_DELAY = "lag_forward", "lag_backward", "row_delay"


def parameters(model: RigModel) -> tuple[tuple[str, ...], Array]:
    """Names and values (p,) of all parameters of a model."""
    camera, scanner = model.camera, model.scanner
    named = {name: camera.matrix[at] for name, at in MATRIX.items()}
    named |= dict(zip(DISTORTION, camera.distortion, strict=False))
    if isinstance(scanner, PivotScanner):
        named |= dict.fromkeys(AXIS, 0.0)
        named |= {f"angle_{i}": term for i, term in enumerate(scanner.angle_rad)}
        named |= {f"offset_{i}": term for i, term in enumerate(scanner.offset_m)}
        named |= {"cone": scanner.cone_rad, "bow": scanner.bow_per_rad}
    named |= dict(zip(TIMES, (*model.lag_s, model.row_delay_s), strict=True))
    return tuple(named), np.array(list(named.values()), np.float64)


def with_parameters(model: RigModel, names: Sequence[str], deltas: ArrayLike) -> RigModel:
    """The model with `deltas` (n,) added to the parameters `names`; the others stay.

    Terms angle_i and offset_i beyond those of the model start from 0. Raises CalibrationError for a parameter that a
    model of this kind does not have, and if the changed model is not valid.
    """
    change = dict(zip(names, np.asarray(deltas, np.float64).tolist(), strict=True))
    camera = changed_camera(model.camera, change)
    scanner = model.scanner
    if isinstance(scanner, PivotScanner):
        scanner = _pivot(scanner, change)
    forward, backward, row_delay = (change.pop(name, 0.0) for name in TIMES)
    if change:
        raise CalibrationError(
            f"the model has no parameter {', '.join(change)}; it has {', '.join(parameters(model)[0])}"
        )
    lag = model.lag_s
    return replace(
        model,
        camera=camera,
        scanner=scanner,
        lag_s=Lag(lag.forward + forward, lag.backward + backward),
        row_delay_s=model.row_delay_s + row_delay,
    )


def changed_camera(camera: Camera, change: dict[str, float]) -> Camera:
    """The camera after those changes that concern it; they are removed from `change`. Raises CalibrationError if the
    result is no valid camera."""
    matrix, distortion = camera.matrix.copy(), camera.distortion.copy()
    touched = False
    for name, at in MATRIX.items():
        if name in change:
            matrix[at] += change.pop(name)
            touched = True
    for i, name in enumerate(DISTORTION[: distortion.size]):
        if name in change:
            distortion[i] += change.pop(name)
            touched = True
    return Camera(camera.width, camera.height, matrix, distortion) if touched else camera


def _pivot(scanner: PivotScanner, change: dict[str, float]) -> PivotScanner:
    """The scanner after those changes that concern it; they are removed from `change`."""
    first, axis = scanner.zero_normal, scanner.axis_direction
    second = np.cross(axis, first)
    turn_1, turn_2, shift_1, shift_2 = (change.pop(name, 0.0) for name in AXIS)
    turn = _rotation(turn_1 * first + turn_2 * second)
    return replace(
        scanner,
        axis_point_m=scanner.axis_point_m + shift_1 * first + shift_2 * second,
        axis_direction=turn @ axis,
        zero_normal=turn @ first,
        angle_rad=_terms(scanner.angle_rad, "angle_", change),
        offset_m=_terms(scanner.offset_m, "offset_", change),
        cone_rad=scanner.cone_rad + change.pop("cone", 0.0),
        bow_per_rad=scanner.bow_per_rad + change.pop("bow", 0.0),
    )


def _terms(terms: Array, stem: str, change: dict[str, float]) -> Array:
    """The terms, more if needed, plus the changes named stem0, stem1, ...; these are removed from `change`."""
    asked = {i: f"{stem}{i}" for i in range(MOST_TERMS) if f"{stem}{i}" in change}
    result: Array = np.zeros(max([terms.size, *(i + 1 for i in asked)]))
    result[: terms.size] = terms
    for i, name in asked.items():
        result[i] += change.pop(name)
    return result


def _rotation(vector: Array) -> Array:
    """Rotation matrix (3, 3) of a Rodrigues vector, smooth at zero. Raises CalibrationError beyond half a turn."""
    if not np.all(np.abs(vector) <= np.pi):
        raise CalibrationError(f"axis turns by {np.abs(vector).max():.3g} rad; changes are small, at most half a turn")
    angle = float(np.linalg.norm(vector))
    x, y, z = vector
    cross: Array = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    # np.sinc is sin(pi t) / (pi t): no division by an angle that may be zero.
    once, twice = np.sinc(angle / np.pi), 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    return np.eye(3) + once * cross + twice * (cross @ cross)


SWEPT: Final = "velocities_per_s"
"""Key in a model's provenance: the signed velocities of the sweeps that its planes were found from."""
ALIKE_SPEEDS: Final = 0.02
"""Relative difference up to which two speeds count as one: a lag from speeds so close errs 50 times as much as a
passage."""
SPEED_MARGIN: Final = 0.05
"""A measured lag is assumed to hold for speeds outside the measured ones by up to this share."""


def lag_groups(velocities_per_s: ArrayLike) -> tuple[tuple[str, ...], ...]:
    """The names of the lags that sweeps determine, in groups with one value each. Both are in one group if they cannot
    be separated; there is no group if neither can be determined."""
    velocity = np.asarray(velocities_per_s, np.float64)
    up, down = velocity[velocity > 0], -velocity[velocity < 0]
    several = _several(up) or _several(down)
    if several and up.size and down.size:
        return ((FORWARD,), (BACKWARD,))
    return ((FORWARD, BACKWARD),) if several or (up.size and down.size) else ()


def one_speed(velocities_per_s: ArrayLike) -> bool:
    """Whether all sweeps ran at the same speed, within ALIKE_SPEEDS, in either direction."""
    return not _several(np.abs(np.asarray(velocities_per_s, np.float64)))


def untold(velocities_per_s: Sequence[float]) -> Array:
    """(n, 3): changes of (position, lag forward, lag backward) that no sweep shows; the larger lag's change is 1 s."""
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
    """(n,): a group number for each speed, whatever its direction. Neighbouring speeds that differ by at most
    ALIKE_SPEEDS, relative to the faster one, share a group."""
    speeds, which = np.unique(np.abs(np.asarray(speeds_per_s, np.float64)), return_inverse=True)
    apart = np.diff(speeds, prepend=speeds[:1]) > ALIKE_SPEEDS * speeds
    return np.cumsum(apart, dtype=np.int64)[which.reshape(-1)]


def speed_range(speeds_per_s: ArrayLike) -> tuple[float, float]:
    """(lowest, highest) speed for which a lag measured at these speeds is assumed to hold, SPEED_MARGIN beyond them.

    speeds_per_s: at least one, in command units per second, all above 0 whatever the direction.
    """
    speeds = np.asarray(speeds_per_s, np.float64)
    return float(speeds.min() * (1 - SPEED_MARGIN)), float(speeds.max() * (1 + SPEED_MARGIN))


def _several(speeds: Array) -> bool:
    return speeds.size > 1 and float(np.ptp(speeds)) > ALIKE_SPEEDS * float(speeds.max())
