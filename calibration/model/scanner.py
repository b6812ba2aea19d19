"""From mirror command to light plane (n, d), n.X = d, |n| = 1: a sampled table, or a mirror that turns about an axis.

The command is the one used in the calibration: a galvo's normalised drive (-1 to 1), or the column number of a cube of
frames. (n, d) and (-n, -d) are the same plane; the sign is chosen so that n_x >= 0, in a table on average.
"""

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from calibration.arrays import Array, set_frozen
from calibration.errors import CalibrationError

_ROUNDING = 1e-15
"""A few units in the last place of 1.0."""
_MOST_ANGLE_RAD = 1e3
"""Largest angle: sines of larger ones lose digits, and no mirror turns that far."""
_MOST_OFFSET_M = 10.0
"""Largest distance at which light could pass the axis of any mirror."""
_MOST_CONE_RAD = 0.5
"""A mirror that tilts the light more than this towards its axis is mounted wrongly."""
_MOST_BOW_PER_RAD = 0.5
"""At 0.64, light at right angles to the fan's middle would leave the fan backwards. Laser lines have about 0.01."""


class Scanner(Protocol):
    """The part of a scanner model that the rest of the project uses."""

    @property
    def command_range(self) -> tuple[float, float]:
        """Smallest and largest command the model was made for."""
        ...

    def planes(self, commands: ArrayLike) -> Array:
        """Planes (..., 4) = nx, ny, nz, d (metres) for commands (...). Raises CalibrationError outside the range."""
        ...


@dataclass(frozen=True, eq=False)
class PlaneTable:
    """Planes n.X = d at strictly increasing commands (columns,), interpolated linearly. rows: (columns, 4) nx, ny, nz,
    d, with d in metres. They are kept scaled to |n| = 1, with signs such that neighbouring normals point the same way
    and nx is not negative on average. Raises CalibrationError for another shape, for commands that do not increase, for
    a number that is not finite and for a normal of 0."""

    command: Array
    rows: Array

    def __post_init__(self) -> None:
        """Check, normalise and give neighbouring planes the same sign."""
        command = np.array(self.command, dtype=np.float64)
        rows = np.array(self.rows, dtype=np.float64)
        if rows.ndim != 2 or rows.shape[1] != 4 or len(rows) == 0:
            raise CalibrationError(f"plane table has shape {rows.shape}; it must be (columns, 4): nx, ny, nz, d")
        if command.shape != (len(rows),):
            raise CalibrationError(
                f"plane table has {len(rows)} planes for {command.size} commands; they must be as many"
            )
        with np.errstate(all="ignore"):
            scaled = _near_one(rows, rows[:, :3])
            scaled /= _exactly_one(np.linalg.norm(scaled[:, :3], axis=1))[:, None]
        bad = np.flatnonzero(~(np.isfinite(rows) & np.isfinite(scaled)).all(axis=1))
        if bad.size:
            first = rows[bad[0]].tolist()
            raise CalibrationError(f"plane {bad[0]} of the table is {first}; it needs a finite, non-zero normal")
        if not np.all(np.isfinite(command)) or np.any(np.diff(command) <= 0):
            at = int(np.argmax(~(np.diff(command) > 0))) if len(command) > 1 else 0
            raise CalibrationError(f"plane table's commands must increase; not so after row {at} ({command[at]:g})")
        rows = scaled
        turned = np.sum(rows[1:, :3] * rows[:-1, :3], axis=1) < 0
        rows[1:][np.cumsum(turned) % 2 == 1] *= -1
        if np.sum(rows[:, 0]) < 0:
            rows *= -1
        set_frozen(self, command=command, rows=rows)

    @property
    def command_range(self) -> tuple[float, float]:
        """First and last sampled command."""
        return float(self.command[0]), float(self.command[-1])

    def planes(self, commands: ArrayLike) -> Array:
        """Planes (..., 4) for commands (...). Raises CalibrationError outside the table."""
        at = _inside(commands, self.command_range)
        between = np.stack([np.interp(at, self.command, self.rows[:, i]) for i in range(4)], axis=-1)
        return np.asarray(between / np.linalg.norm(between[..., :3], axis=-1, keepdims=True))


@dataclass(frozen=True, eq=False)
class PivotScanner:
    """A line turned about a fixed axis, with the deviations of a real mirror and lens.

        n(a) = cos(cone) (n0 cos a + (axis x n0) sin a) + sin(cone) axis,    d(a) = n . axis_point + offset(a)

    axis_point_m, axis_direction, zero_normal (n0): (3,) float64; the part of n0 along the axis is dropped, then both
    are scaled to length 1. angle_rad: (terms,) float64, the optical angle a as a polynomial in the command, constant
    term first.
    offset_m: (terms,) float64, distance at which the light passes the axis, a polynomial in the optical angle, constant
    first.
    cone_rad: constant tilt of the normal towards the axis; the planes then touch a cone whose tip is axis_point_m.
    bow_per_rad: bending of the sheet out of its plane by bow x (angle within the fan)^2, along n(a); see `light_sheet`.
    Raises CalibrationError for numbers that describe no such mirror.
    """

    axis_point_m: Array
    axis_direction: Array
    zero_normal: Array
    angle_rad: Array
    command_range: tuple[float, float] = (-1.0, 1.0)
    offset_m: Array = field(default_factory=lambda: np.zeros(0))
    cone_rad: float = 0.0
    bow_per_rad: float = 0.0

    def __post_init__(self) -> None:
        """Check and normalise."""
        point = _vector(self.axis_point_m, "axis_point_m")
        axis = _unit(_vector(self.axis_direction, "axis_direction"), "axis_direction")
        normal = _vector(self.zero_normal, "zero_normal")
        normal = _near_one(normal, normal)
        normal = _across(_across(normal, axis), axis)  # twice, since the first result is inexact near the axis
        angle = np.array(self.angle_rad, dtype=np.float64)
        if angle.ndim != 1 or angle.size == 0 or not np.all(np.isfinite(angle)):
            raise CalibrationError("pivot scanner's angle_rad must be finite polynomial terms, constant first")
        low, high = self.command_range
        if not (np.isfinite(low) and np.isfinite(high) and low < high):
            raise CalibrationError(f"scanner command_range is [{low:g}, {high:g}]; the first must be the smaller one")
        with np.errstate(over="ignore"):
            reach = float(np.polynomial.polynomial.polyval(max(abs(low), abs(high)), np.abs(angle)))
        if not reach <= _MOST_ANGLE_RAD:
            raise CalibrationError(
                f"pivot scanner's angle_rad reaches {reach:.3g} rad over command_range [{low:g}, {high:g}], more than "
                f"{_MOST_ANGLE_RAD:g}; give the optical angle in radians as a polynomial in the command"
            )
        offset = np.array(self.offset_m, dtype=np.float64)
        if offset.ndim != 1 or not np.all(np.isfinite(offset)):
            raise CalibrationError("pivot scanner's offset_m must be finite polynomial terms in metres, constant first")
        with np.errstate(over="ignore", invalid="ignore"):
            passes = float(np.polynomial.polynomial.polyval(reach, np.abs(offset))) if offset.size else 0.0
        for what, size, most in (
            ("offset_m over the whole turn", passes, _MOST_OFFSET_M),
            ("cone_rad", self.cone_rad, _MOST_CONE_RAD),
            ("bow_per_rad", self.bow_per_rad, _MOST_BOW_PER_RAD),
        ):
            if not abs(size) <= most:
                raise CalibrationError(f"pivot scanner's {what} is {size:g}; it must lie within -{most:g} and {most:g}")
        set_frozen(self, axis_point_m=point, axis_direction=axis, zero_normal=normal, angle_rad=angle, offset_m=offset)
        set_frozen(self, command_range=(float(low), float(high)))

    def planes(self, commands: ArrayLike) -> Array:
        """Planes (..., 4) for commands (...). Raises CalibrationError outside command_range."""
        planes = self.turned(commands)
        return np.asarray(np.where(planes[..., :1] < 0, -planes, planes))

    def turned(self, commands: ArrayLike) -> Array:
        """`planes` with the sign of n(a), which is the sign that offset_m, cone_rad and bow_per_rad refer to."""
        at = _inside(commands, self.command_range)
        angle = np.polynomial.polynomial.polyval(at, self.angle_rad)[..., None]
        normal = self.zero_normal * np.cos(angle) + np.cross(self.axis_direction, self.zero_normal) * np.sin(angle)
        if self.cone_rad != 0:
            normal = np.cos(self.cone_rad) * normal + np.sin(self.cone_rad) * self.axis_direction
        distance = np.sum(normal * self.axis_point_m, axis=-1, keepdims=True)
        if self.offset_m.size:
            distance = distance + np.polynomial.polynomial.polyval(angle, self.offset_m)
        return np.concatenate([normal, distance], axis=-1)


def _inside(commands: ArrayLike, limits: tuple[float, float]) -> Array:
    at = np.asarray(commands, dtype=np.float64)
    low, high = limits
    slack = 1e-9 * max(1.0, abs(low), abs(high))  # rounding of a sweep that ends exactly at the limit
    wrong = ~((at >= low - slack) & (at <= high + slack))
    if np.any(wrong):
        raise CalibrationError(
            f"scanner command {at[wrong].flat[0]:g} lies outside the calibrated range [{low:g}, {high:g}]; "
            "narrow the sweep or calibrate over the wider range"
        )
    return np.clip(at, low, high)


def _vector(value: ArrayLike, name: str) -> Array:
    vector = np.array(value, dtype=np.float64)
    if vector.shape != (3,) or not np.all(np.isfinite(vector)):
        raise CalibrationError(f"pivot scanner's {name} is {vector.tolist()}; it must be three finite numbers")
    return vector


def _near_one(values: Array, vectors: Array) -> Array:
    """Values (..., m) times the power of two that brings the vectors (..., n) to length about 1, without rounding."""
    _, exponent = np.frexp(np.abs(vectors).max(axis=-1, keepdims=True))
    return np.asarray(np.ldexp(values, -exponent))


def _across(normal: Array, axis: Array) -> Array:
    """Unit vector along the part of `normal` across the unit vector `axis`."""
    along = float(axis @ normal)
    across = normal - axis * (along if abs(along) > _ROUNDING else 0.0)
    if np.abs(across).max() < 1e-9:
        raise CalibrationError("pivot scanner's zero_normal (across the axis) has length zero")
    return _unit(across, "zero_normal")


def _unit(vector: Array, name: str) -> Array:
    vector = _near_one(vector, vector)
    length = float(np.linalg.norm(vector))
    if length == 0:
        raise CalibrationError(f"pivot scanner's {name} has length zero")
    return vector / _exactly_one(np.array(length))


def _exactly_one(length: Array) -> Array:
    """The lengths, with exactly 1 for those within rounding of 1: a model read back from its file stays the same."""
    return np.where(np.abs(length - 1) < _ROUNDING, 1.0, length)
