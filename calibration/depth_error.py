"""The depth error that a calibration leaves at each pixel, in all and from each group of parameters, to first order.

    var z = J C J',    J = dz / d(parameters) of the pixel's ray on the light sheet of its mirror command.

C is the covariance. The part of a group g of parameters is the variance that would vanish if they were known exactly,
J C_.g C_gg^-1 C_g. J', with C_.g and C_g. the group's columns and rows of C, and C_gg its block. The part lies between
0 and the total, and is the group's own variance if the group is correlated with no other. Correlated groups share
variance, so parts may add up to more than the total.

There is also the covariance of any other number that follows from a model (`propagated`), the effect on depth of an
error in the mirror's command or in the stripe's position (`sensitivity`), and, if a simulation knows the true model,
the depth errors of another model (`depth_errors`).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from calibration.arrays import Array
from calibration.errors import CalibrationError, digits
from calibration.model.light_sheet import depth_slope
from calibration.model.parameters import DISTORTION, MATRIX, ROW_DELAY, TIMES, with_parameters
from calibration.model.rig_model import Covariance, RigModel

_STEPS = dict.fromkeys(MATRIX, 1e-3) | dict.fromkeys(TIMES, 1e-9) | {ROW_DELAY: 1e-12}
_STEP = 1e-6
"""Change of each parameter, in its own unit, for differences: small enough for linearity, large against rounding."""


def propagated(model: RigModel, measure: Callable[[RigModel], Array]) -> tuple[Array, Array]:
    """The values of measure(model), (n,), and their covariance (n, n) to first order, zero for a model without
    covariance."""
    values = np.atleast_1d(measure(model)).astype(np.float64)
    if model.covariance is None:
        return values, np.zeros((values.size, values.size))
    slopes = by_parameter(model, model.covariance.names, lambda tried: np.atleast_1d(measure(tried)))
    return values, slopes @ model.covariance.matrix @ slopes.T


def by_parameter(model: RigModel, names: tuple[str, ...], measure: Callable[[RigModel], Array]) -> Array:
    """Derivatives (n, p) of `measure(model)`, an array (n,), by the parameters `names`, from central differences. They
    are one-sided at a bound, such as a lag of 0, and NaN for a parameter that the model does not have."""
    slopes = np.empty((measure(model).size, len(names)))
    for i, name in enumerate(names):
        step = _STEPS.get(name, _STEP)
        (above, more), (below, less) = (_changed(model, name, sign * step) for sign in (1, -1))
        slopes[:, i] = (measure(more) - measure(less)) / (above - below)
    return slopes


def _changed(model: RigModel, name: str, step: float) -> tuple[float, RigModel]:
    """The step and the changed model; 0 and the same model if the step passes a bound, e.g. to a lag below 0 s."""
    try:
        return step, with_parameters(model, [name], [step])
    except CalibrationError:
        return 0.0, model


GROUPS: Final = {"baseline": "the baseline", "camera": "the camera", "angle": "the mirror's angle", "lag": "the lag"}
"""Groups of parameters, each with the words for it."""
_GRID = 48
"""Least number of pixels along the longer side of the picture at which depth is judged; all if it has fewer."""
_SEARCH_STEPS = 60
_FOUND_M = 1e-9
"""A mirror command is found when its sheet is this near to the point: a thousandth of any calibration's error."""
_INSIDE = 1e-6
"""Least distance from the ends of the command range, as a share of it, at which differences are taken."""
_INDEPENDENT = 1e-12
"""Eigenvalues of a correlation matrix below this are rounding."""


def group_of(parameter: str) -> str:
    """The group of GROUPS that a parameter belongs to."""
    if parameter in MATRIX or parameter in DISTORTION:
        return "camera"
    if parameter in TIMES:
        return "lag"
    return "baseline" if parameter.startswith(("axis_shift", "offset")) else "angle"


@dataclass(frozen=True, slots=True, eq=False)
class DepthUncertainty:
    """Standard deviation of the depth at one depth, over the picture.

    x_px (columns,), y_px (rows,): the pixels. sd_m: (rows, columns), NaN where no mirror command of the model lights
    the pixel at this depth. part_m: for each group, the square root of its part of the variance, of the same shape.
    """

    depth_m: float
    x_px: Array
    y_px: Array
    sd_m: Array
    part_m: Mapping[str, Array]

    def line(self) -> str:
        """One line such as 'at 5 m: 8 mm, 6 of them from the baseline', with medians over the picture and the largest
        part; or 'at 5 m: not lit'.
        """
        at = f"at {self.depth_m:g} m"
        if not np.isfinite(self.sd_m).any():
            return f"{at}: not lit"
        sd = float(np.nanmedian(self.sd_m))
        group, part = max(((name, float(np.nanmedian(m))) for name, m in self.part_m.items()), key=lambda item: item[1])
        unit, scale = ("mm", 1e3) if sd >= 1e-3 or sd == 0 else ("um", 1e6)
        whole, of_them = (digits(value * scale, 2) for value in (sd, part))
        return f"{at}: {whole} {unit}, {of_them} of them from {GROUPS[group]}"


def depth_uncertainty(model: RigModel, depth_m: float, velocity_per_s: float | None = None) -> DepthUncertainty:
    """The uncertainty at a given depth over the picture.

    velocity_per_s: signed velocity of the command, which multiplies the lag. None: that of a command rising at the
    highest speed for which the lag holds, or 0 if the lag was not measured. Raises CalibrationError for a model without
    covariance.
    """
    covariance = _covariance(model)
    if velocity_per_s is None:
        velocity_per_s = 0.0 if model.speed_range_per_s is None else model.speed_range_per_s[1]
    camera = model.camera
    step = max(1, max(camera.width, camera.height) // _GRID)
    x = np.arange(step // 2, camera.width, step, dtype=np.float64)
    y = np.arange(step // 2, camera.height, step, dtype=np.float64)
    command = command_at(model, x, y[:, None], depth_m)
    jacobian = depth_jacobian(model, x, y[:, None], command, velocity_per_s)
    names = covariance.names
    parts = {g: np.sqrt(explained(jacobian, covariance, [n for n in names if group_of(n) == g])) for g in GROUPS}
    return DepthUncertainty(depth_m, x, y, np.sqrt(_variance(jacobian, covariance)), parts)


def depth_sd_m(
    model: RigModel, x_px: ArrayLike, y_px: ArrayLike, command: ArrayLike, velocity_per_s: float = 0.0
) -> Array:
    """Sd (m) of the depth at raw pixels for a mirror at `command`; NaN where there is no depth.

    Raises CalibrationError for a model without covariance.
    """
    return np.sqrt(_variance(depth_jacobian(model, x_px, y_px, command, velocity_per_s), _covariance(model)))


def command_at(model: RigModel, x_px: ArrayLike, y_px: ArrayLike, depth_m: ArrayLike) -> Array:
    """Mirror command at which the light reaches raw pixels at a depth; NaN if the command range holds none."""
    z = np.asarray(depth_m, np.float64)
    u, v = model.camera.tangents_at(x_px, y_px)
    points = np.stack(np.broadcast_arrays(u * z, v * z, z), axis=-1)

    def off(command: Array) -> Array:
        return model.sheets(command).distance_m(points)

    # False position, Illinois variant: the value at an end that stays is halved.
    low, high = (np.full(points.shape[:-1], end) for end in model.scanner.command_range)
    off_low, off_high = off(low), off(high)
    with np.errstate(invalid="ignore"):
        enclosed = off_low * off_high <= 0
    off_low, off_high = np.where(enclosed, off_low, -1.0), np.where(enclosed, off_high, 1.0)
    for _ in range(_SEARCH_STEPS):
        share = np.divide(off_low, off_low - off_high, out=np.zeros_like(low), where=off_low != off_high)
        command = low + share * (high - low)
        here = np.where(enclosed, off(command), 0.0)
        if not (np.abs(here) > _FOUND_M).any():
            break
        same = here * off_low > 0
        low, high = np.where(same, command, low), np.where(same, high, command)
        off_high = np.where(same, 0.5 * off_high, here)
        off_low = np.where(same, here, 0.5 * off_low)
    return np.where(enclosed, command, np.nan)


def depth_jacobian(
    model: RigModel, x_px: ArrayLike, y_px: ArrayLike, command: ArrayLike, velocity_per_s: float = 0.0
) -> Array:
    """Derivatives of z (m) at raw pixels and mirror commands (broadcast) by the parameters of the covariance: (..., p).

    The mirror is at `command` in the unchanged model; a change of the lag or the row delay moves the mirror. NaN where
    there is no depth. Raises CalibrationError for a model without covariance.
    """
    names = _covariance(model).names
    x, y, at = np.broadcast_arrays(*(np.asarray(a, np.float64) for a in (x_px, y_px, command)))
    lit = np.isfinite(at) & np.isfinite(y)
    result = np.full((*x.shape, len(names)), np.nan)
    x, y, at = x[lit], y[lit], at[lit]
    rays = model.camera.tangents_at(x, y)
    low, high = model.scanner.command_range
    inside = _INSIDE * (high - low)
    at = np.clip(at, low + inside, high - inside)
    commanded = 2 * at - model.mirror_command(at, y, velocity_per_s)

    def depth(tried: RigModel) -> Array:
        u, v = rays if tried.camera is model.camera else tried.camera.tangents_at(x, y)
        mirror = tried.mirror_command(commanded, y, velocity_per_s)
        return tried.sheets(np.clip(mirror, low, high)).depth(u, v)

    result[lit] = by_parameter(model, names, depth)
    return result


def explained(jacobian: Array, covariance: Covariance, names: list[str]) -> Array:
    """Variance (...) that would vanish if the parameters `names` were known exactly. jacobian: (..., p)."""
    if not names:
        return np.zeros(jacobian.shape[:-1])
    at = [covariance.names.index(name) for name in names]
    inner = covariance.of(names)
    sd = np.sqrt(np.diag(inner))
    scale = np.divide(1.0, sd, out=np.zeros_like(sd), where=sd > 0)
    inverse = np.linalg.pinv(inner * np.outer(scale, scale), rcond=_INDEPENDENT, hermitian=True)
    shared = jacobian @ covariance.matrix[:, at] * scale
    return np.asarray(np.maximum(np.einsum("...i,ij,...j", shared, inverse, shared), 0.0))


def _variance(jacobian: Array, covariance: Covariance) -> Array:
    return np.asarray(np.maximum(np.einsum("...i,ij,...j", jacobian, covariance.matrix, jacobian), 0.0))


def _covariance(model: RigModel) -> Covariance:
    if model.covariance is None:
        raise CalibrationError(
            "the calibration has no covariance, so its depth error is unknown; calibrate with 'rig calibrate planes'"
        )
    return model.covariance


_SENSITIVITY_GRID: Final = 24
"""Pixels along each side at which the sensitivity is computed."""
LEAST_LIT_SHARE: Final = 0.05
"""Share of the picture that the line must reach at a distance for the sensitivity there: more than a border column or
row."""
_DISTANCES_M: Final = np.geomspace(0.05, 100.0, 60)


@dataclass(frozen=True, slots=True)
class Sensitivity:
    """Size of the change of depth with the command (m per command unit) and with the stripe's position (m per pixel).
    Each is the median over the pixels that the line reaches.
    """

    per_command_m: float
    per_pixel_m: float


def sensitivity(model: RigModel, at_m: float) -> Sensitivity:
    """The sensitivity at depth `at_m`, over a grid of pixels. Raises CalibrationError if the line does not reach that
    depth.
    """
    camera = model.camera
    x = np.linspace(0, camera.width - 1, _SENSITIVITY_GRID)
    y = np.linspace(0, camera.height - 1, _SENSITIVITY_GRID)[:, None]
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
    """Words for the range of distances that the line reaches."""
    share = np.array([np.isfinite(command_at(model, x, y, at)).mean() for at in _DISTANCES_M])
    lit = _DISTANCES_M[share >= LEAST_LIT_SHARE]
    return f"it reaches {lit[0]:.2g} to {lit[-1]:.2g} m" if lit.size else "nor anything else within 100 m"


_TRUTH_GRID = 32


@dataclass(frozen=True, slots=True)
class DepthErrors:
    """Errors at the pixels that the true rig lights at one depth and that have a depth in the model; NaN without any.

    median_m, worst_m: median and largest absolute error. ratio: root mean square of the errors, each divided by the sd
    that the model's covariance predicts for it. If covariances are right, its square averages 1 over many calibrations.
    The ratio is also NaN if the model has no covariance.
    """

    depth_m: float
    median_m: float
    worst_m: float
    ratio: float


def depth_errors(model: RigModel, truth: RigModel, depth_m: float, velocity_per_s: float) -> DepthErrors:
    """The errors of `model` at pixels that see the light at `depth_m`. velocity_per_s: signed velocity of the
    command."""
    camera = truth.camera
    x, y = np.meshgrid(np.linspace(0, camera.width - 1, _TRUTH_GRID), np.linspace(0, camera.height - 1, _TRUTH_GRID))
    commanded = command_at(truth, x, y, depth_m) - truth.mirror_command(0, y, velocity_per_s)
    found = model.mirror_command(commanded, y, velocity_per_s)
    low, high = model.scanner.command_range
    lit = np.isfinite(found) & (found >= low) & (found <= high)
    x, y, found = x[lit], y[lit], found[lit]
    error = model.sheets(found).depth(*model.camera.tangents_at(x, y)) - depth_m
    sd = np.full(error.shape, np.nan) if model.covariance is None else depth_sd_m(model, x, y, found, velocity_per_s)
    off, known = np.abs(error[np.isfinite(error)]), np.isfinite(error) & (sd > 0)
    return DepthErrors(
        depth_m,
        median_m=float(np.median(off)) if off.size else np.nan,
        worst_m=float(off.max()) if off.size else np.nan,
        ratio=float(np.sqrt(np.mean((error[known] / sd[known]) ** 2))) if known.any() else np.nan,
    )
