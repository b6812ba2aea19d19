"""The rig model: calibrated camera and scanner, other known properties of the rig, and the parameters' covariance."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.arrays import Array, set_frozen
from calibration.errors import CalibrationError
from calibration.model.camera import Camera
from calibration.model.light_sheet import LightSheets, fan_origin, light_sheets
from calibration.model.scanner import Scanner
from calibration.verdict import VerdictWord

_ASYMMETRY = 1e-6
"""Allowance for rounding: difference of equal correlations, and distance of the smallest eigenvalue below 0."""


@dataclass(frozen=True, eq=False)
class Covariance:
    """Covariance of parameters. names: (p,) as in `calibration.model.parameters`. matrix: (p, p) float64, in the
    parameters' units.

    A parameter that is not named counts as exactly known. Raises CalibrationError for a matrix that is no
    covariance, and for a name given twice.
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
        least = np.linalg.eigvalsh(unit)[0] if len(unit) else 0.0
        if np.any(np.abs(unit - unit.T) > _ASYMMETRY) or np.any(matrix[scale == 0]) or least < -_ASYMMETRY:
            raise CalibrationError("covariance is not symmetric and positive, as one must be; fit the model again")
        set_frozen(self, names=names, matrix=0.5 * (matrix + matrix.T))

    def of(self, names: Sequence[str]) -> Array:
        """The covariance of some of the parameters, in the given order. Raises ValueError for one that is not named."""
        at = [self.names.index(name) for name in names]
        return self.matrix[np.ix_(at, at)]


class Lag(NamedTuple):
    """Seconds by which the mirror lags behind its command, for each sweep direction (forward: rising command)."""

    forward: float = 0.0
    backward: float = 0.0


@dataclass(frozen=True, slots=True)
class Identity:
    """The rig, date and verdict of a calibration. Programs check them before they use the model.

    rig: hash of kinds and serials. name: the rig's name. created: date and time, ISO 8601. kinds, serials: those of the
    devices by slot (spad, scanner, ...), if known. verdict: that on the calibration when it was made, None if it was
    not judged. reasons: codes of the reasons against it.
    """

    rig: str
    created: str
    name: str = ""
    kinds: Mapping[str, str] = field(default_factory=dict)
    serials: Mapping[str, str] = field(default_factory=dict)
    verdict: VerdictWord | None = None
    reasons: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class RigModel:
    """Camera, scanner, lag, defects and provenance of one rig.

    speed_range_per_s: lowest and highest command speed for which the lag holds; None if the lag was not measured.
    source_m: (3,) where the light leaves the mirror, metres, camera frame; None if unknown.
    defects: (height, width) bool, True = pixel not to be used; None if unknown.
    dark_rate_per_s: (height, width) float32, counts per second in the dark; None if unknown.
    row_delay_s: delay of each row's exposure after that of the row above. gate_delay_s: delay of the light after the
    gate's edge. colour_skew_s: time by which the scanner's gate output precedes its mirror. marker_rising: whether the
    rising edge of a scan marker counts, rather than the falling one.
    covariance: that of the estimated parameters, None if unknown. identity: None if it was not recorded.
    Raises CalibrationError for a lag below 0, a time that is not finite, a map of another size than the camera's, and
    planes within 45 degrees of the image row, since they give no position along the row.
    """

    camera: Camera
    scanner: Scanner
    lag_s: Lag = field(default_factory=Lag)
    speed_range_per_s: tuple[float, float] | None = None
    source_m: Array | None = None
    defects: NDArray[np.bool_] | None = None
    provenance: Mapping[str, Any] = field(default_factory=dict)
    dark_rate_per_s: NDArray[np.float32] | None = None
    row_delay_s: float = 0.0
    gate_delay_s: float = 0.0
    colour_skew_s: float = 0.0
    marker_rising: bool = True
    covariance: Covariance | None = None
    identity: Identity | None = None

    def __post_init__(self) -> None:
        """Check that the parts fit each other."""
        if not all(np.isfinite(lag) and lag >= 0 for lag in self.lag_s):
            raise CalibrationError(f"lag_s is {tuple(self.lag_s)}; a mirror follows its command by 0 s or more")
        for name in ("row_delay_s", "gate_delay_s", "colour_skew_s"):
            if not np.isfinite(getattr(self, name)):
                raise CalibrationError(f"{name} is {getattr(self, name)}; it must be a finite number of seconds")
        size = (self.camera.height, self.camera.width)
        for what, pixels in (("defect", self.defects), ("dark rate", self.dark_rate_per_s)):
            if pixels is not None and pixels.shape != size:
                raise CalibrationError(f"{what} map is {_size(pixels.shape)} pixels, the camera {_size(size)}")
        commands = self._commands()
        planes = self.scanner.planes(commands)
        flat = np.abs(planes[:, 0]) <= np.abs(planes[:, 1])
        if np.any(flat):
            at = int(np.argmax(flat))
            angle = np.degrees(np.arctan2(abs(planes[at, 0]), abs(planes[at, 1])))
            raise CalibrationError(
                f"light plane at command {commands[at]:g} lies {angle:.1f} degrees from the search axis (image row); "
                "it must be more than 45: turn the line, or mount the sensor sideways"
            )

    def _commands(self) -> Array:
        """Commands over the whole range: those of a table, otherwise 33, evenly spaced."""
        return np.asarray(getattr(self.scanner, "command", np.linspace(*self.scanner.command_range, 33)))

    def planes(self, commands: ArrayLike) -> Array:
        """Light planes (..., 4) = nx, ny, nz, d (metres) for mirror commands (...). Raises CalibrationError outside the
        command range."""
        return self.scanner.planes(commands)

    def sheets(self, commands: ArrayLike) -> LightSheets:
        """The light at mirror commands (...): `planes` and their bow. Raises CalibrationError outside the range."""
        return light_sheets(self.scanner, self.source_m, commands)

    def mirror_command(self, commands: ArrayLike, y_px: ArrayLike, velocity_per_s: ArrayLike) -> Array:
        """Position of the mirror, on the command's scale, when row y sees the light.

        commands: those at the time when the first row is exposed; a later row sees the mirror farther on.
        velocity_per_s: the command's velocity, positive while it rises; the lag is that of this direction. All
        arguments broadcast.
        """
        velocity = np.asarray(velocity_per_s, np.float64)
        lag_s = np.where(velocity < 0, self.lag_s.backward, self.lag_s.forward)
        return np.asarray(commands, np.float64) - velocity * (lag_s - self.row_delay_s * np.asarray(y_px, np.float64))

    def check_sensor(self, width: int, height: int) -> None:
        """Raise CalibrationError unless the model was made for a sensor of this size."""
        if (width, height) != (self.camera.width, self.camera.height):
            raise CalibrationError(
                f"calibration is for a sensor of {self.camera.width} x {self.camera.height} pixels, this one has "
                f"{width} x {height}; use the calibration made with this sensor"
            )

    def check_speed(self, speed_per_s: float) -> None:
        """Raise CalibrationError if the lag was measured, but not around this command speed."""
        if self.speed_range_per_s is None:
            return
        low, high = self.speed_range_per_s
        if not low <= speed_per_s <= high:
            raise CalibrationError(
                f"sweep speed {speed_per_s:.4g} /s lies outside the {low:.4g} to {high:.4g} /s the lag was calibrated "
                "at; change columns, exposures or frame_rate, or calibrate at this speed"
            )

    def fingerprint(self) -> str:
        """Sixteen hexadecimal digits that change with any number on which the depth depends."""
        low, high = self.scanner.command_range
        commands = self._commands()
        digest = hashlib.sha256()
        parts: tuple[ArrayLike, ...] = (
            [self.camera.width, self.camera.height],
            self.camera.matrix,
            self.camera.distortion,
            [low, high, *self.lag_s],
            self.scanner.planes(commands),
            [] if self.defects is None else np.flatnonzero(self.defects),
        )
        if not np.array_equal(commands, np.linspace(low, high, len(commands))):
            parts += (commands,)
        bow_per_rad = getattr(self.scanner, "bow_per_rad", 0.0)
        if bow_per_rad:
            parts += ([bow_per_rad, *fan_origin(self.scanner, self.source_m)],)
        if self.row_delay_s:
            parts += ([self.row_delay_s],)
        for part in parts:
            values = np.ascontiguousarray(part, dtype="<f8")
            digest.update(str(values.shape).encode() + values.tobytes())
        return digest.hexdigest()[:16]


def _size(shape: tuple[int, ...]) -> str:
    return " x ".join(str(n) for n in reversed(shape))
