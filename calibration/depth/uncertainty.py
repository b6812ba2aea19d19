"""How well a depth is known, from the covariance of the calibration: first order, by pixel, and what it comes from.

    var z = J C J',    J = dz / d(parameters) of the pixel's ray on the light sheet of its mirror command.

A group's part of it is the variance that would go if the parameters of that group were known exactly,
J C_.g C_gg^-1 C_g. J': 0 at the least, all at the most, and the group's own variance where it is correlated with no
other. Groups that are correlated share what they have in common, so parts may add up to more than the whole.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.depth.propagation import by_parameter
from calibration.digits import digits
from calibration.errors import CalibrationError
from calibration.model.covariance import Covariance
from calibration.model.parameters import DISTORTION, MATRIX, TIMES
from calibration.model.rig_model import RigModel

Array = NDArray[np.float64]

GROUPS: Final = ("baseline", "camera", "angle", "lag")
_SAID = {"baseline": "the baseline", "camera": "the camera", "angle": "the mirror's angle", "lag": "the lag"}
_GRID = 48
"""Pixels looked at along the longer side of a map."""
_SEARCH_STEPS = 60
_FOUND_M = 1e-9
"""A mirror command is found when its sheet passes the point within this: a thousandth of any calibration's error."""
_INSIDE = 1e-6
"""Of the command range: by so much differences stay within it."""
_INDEPENDENT = 1e-12
"""Eigenvalues of a correlation matrix below this are rounding."""


def group_of(parameter: str) -> str:
    """The group that a parameter counts to."""
    if parameter in MATRIX or parameter in DISTORTION:
        return "camera"
    if parameter in TIMES:
        return "lag"
    return "baseline" if parameter.startswith(("axis_shift", "offset")) else "angle"


@dataclass(frozen=True, slots=True, eq=False)
class DepthUncertainty:
    """Standard deviation of the depth at one depth, over the picture.

    x_px (columns,), y_px (rows,): the pixels. sd_m: (rows, columns), NaN where no mirror command of the model lights
    the pixel at this depth. part_m: by group, the square root of its part of the variance, the same shape.
    """

    depth_m: float
    x_px: Array
    y_px: Array
    sd_m: Array
    part_m: Mapping[str, Array]

    def line(self) -> str:
        """One line, 'at 5 m: 8 mm, 6 of them from the baseline': medians over the picture, of 8 the group's 6.

        Without the group's part sqrt(8^2 - 6^2) would be left.
        """
        at = f"at {self.depth_m:g} m"
        if not np.isfinite(self.sd_m).any():
            return f"{at}: not lit"
        sd = float(np.nanmedian(self.sd_m))
        group, part = max(((name, float(np.nanmedian(m))) for name, m in self.part_m.items()), key=lambda item: item[1])
        unit, scale = ("mm", 1e3) if sd >= 1e-3 or sd == 0 else ("um", 1e6)
        whole, of_them = (digits(value * scale, 2) for value in (sd, part))
        return f"{at}: {whole} {unit}, {of_them} of them from {_SAID[group]}"


def depth_uncertainty(model: RigModel, depth_m: float, velocity_per_s: float | None = None) -> DepthUncertainty:
    """The uncertainty of a depth over the picture.

    velocity_per_s: of the command, signed, by which the lag counts; None: the fastest rise that the lag was measured
    at, 0 where it was not. Raises CalibrationError for a model without covariance.
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
    """Standard deviation (m) of the depth at raw pixels where the mirror stands at `command`; all broadcast.

    NaN where there is no depth. Raises CalibrationError for a model without covariance.
    """
    return np.sqrt(_variance(depth_jacobian(model, x_px, y_px, command, velocity_per_s), _covariance(model)))


def command_at(model: RigModel, x_px: ArrayLike, y_px: ArrayLike, depth_m: ArrayLike) -> Array:
    """Where the mirror stands when its light meets raw pixels at a depth; NaN where it does not within its range."""
    z = np.asarray(depth_m, np.float64)
    u, v = model.camera.tangents_at(x_px, y_px)
    points = np.stack(np.broadcast_arrays(u * z, v * z, z), axis=-1)

    def off(command: Array) -> Array:
        return model.sheets(command).distance_m(points)

    # False position, Illinois variant: an end that stays counts half the next time.
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
    """dz (m) at raw pixels and mirror commands (broadcast) by the parameters of the covariance: (..., p).

    The mirror stands at `command` for the model as it is; by the lag and the row delay it would stand elsewhere. NaN
    where there is no depth. Raises CalibrationError for a model without covariance.
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
    """Variance (...) that would go if the parameters `names` were known exactly. jacobian: (..., p)."""
    if not names:
        return np.zeros(jacobian.shape[:-1])
    at = [covariance.names.index(name) for name in names]
    inner = covariance.of(names)
    sd = np.sqrt(np.diag(inner))
    scale = np.divide(1.0, sd, out=np.zeros_like(sd), where=sd > 0)
    inverse = np.linalg.pinv(inner * np.outer(scale, scale), rcond=_INDEPENDENT, hermitian=True)
    shared = jacobian @ covariance.matrix[:, at] * scale
    variance: Array = np.maximum(np.einsum("...i,ij,...j", shared, inverse, shared), 0.0)
    return variance


def _variance(jacobian: Array, covariance: Covariance) -> Array:
    variance: Array = np.maximum(np.einsum("...i,ij,...j", jacobian, covariance.matrix, jacobian), 0.0)
    return variance


def _covariance(model: RigModel) -> Covariance:
    if model.covariance is None:
        raise CalibrationError(
            "the calibration has no covariance, so its depth error is unknown; calibrate with 'rig calibrate planes'"
        )
    return model.covariance
