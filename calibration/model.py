"""The rig model: the calibrated camera and scanner together, with what else the calibration knows of the rig."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.camera import Camera
from calibration.errors import CalibrationError
from calibration.scanner import Scanner

Array = NDArray[np.float64]


class Lag(NamedTuple):
    """Seconds by which the mirror follows its command, per sweep direction (forward: rising command)."""

    forward: float = 0.0
    backward: float = 0.0


@dataclass(frozen=True, eq=False)
class RigModel:
    """Camera, scanner, lag, defects and provenance of one rig.

    speed_range_per_s: command speeds the lag was measured at, None where it was not measured.
    source_m: (3,) where the light leaves the mirror, camera frame; None where unknown.
    defects: (height, width) bool, True = pixel not to be used; None where unknown.
    Raises CalibrationError for planes within 45 degrees of the search axis: along the row they give no position.
    """

    camera: Camera
    scanner: Scanner
    lag_s: Lag = field(default_factory=Lag)
    speed_range_per_s: tuple[float, float] | None = None
    source_m: Array | None = None
    defects: NDArray[np.bool_] | None = None
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check that the parts fit each other."""
        if not all(np.isfinite(lag) and lag >= 0 for lag in self.lag_s):
            raise CalibrationError(f"lag_s is {tuple(self.lag_s)}; a mirror follows its command by 0 s or more")
        size = (self.camera.height, self.camera.width)
        if self.defects is not None and self.defects.shape != size:
            raise CalibrationError(f"defect map is {_size(self.defects.shape)} pixels, the camera {_size(size)}")
        low, high = self.scanner.command_range
        commands = getattr(self.scanner, "command", np.linspace(low, high, 33))
        planes = self.scanner.planes(commands)
        flat = np.abs(planes[:, 0]) <= np.abs(planes[:, 1])
        if np.any(flat):
            at = int(np.argmax(flat))
            angle = np.degrees(np.arctan2(abs(planes[at, 0]), abs(planes[at, 1])))
            raise CalibrationError(
                f"light plane at command {commands[at]:g} lies {angle:.1f} degrees from the search axis (image row); "
                "it must be more than 45: turn the line, or mount the sensor sideways"
            )

    def planes(self, commands: ArrayLike) -> Array:
        """Light planes (..., 4) = nx, ny, nz, d (metres) for mirror commands (...)."""
        return self.scanner.planes(commands)

    def check_sensor(self, width: int, height: int) -> None:
        """Raise CalibrationError unless the model was made for a sensor of this size."""
        if (width, height) != (self.camera.width, self.camera.height):
            raise CalibrationError(
                f"calibration is for a sensor of {self.camera.width} x {self.camera.height} pixels, this one has "
                f"{width} x {height}; use the calibration made with this sensor"
            )

    def check_speed(self, speed_per_s: float) -> None:
        """Raise CalibrationError unless the lag was measured around this command speed."""
        if self.speed_range_per_s is None:
            return
        low, high = self.speed_range_per_s
        if not low <= speed_per_s <= high:
            raise CalibrationError(
                f"sweep speed {speed_per_s:.4g} /s lies outside the {low:.4g} to {high:.4g} /s the lag was calibrated "
                "at; change columns, exposures or frame_rate, or calibrate at this speed"
            )

    def fingerprint(self) -> str:
        """Sixteen hexadecimal digits that change with any number the depth depends on."""
        low, high = self.scanner.command_range
        digest = hashlib.sha256()
        parts: tuple[ArrayLike, ...] = (
            [self.camera.width, self.camera.height],
            self.camera.matrix,
            self.camera.distortion,
            [low, high, *self.lag_s],
            self.scanner.planes(getattr(self.scanner, "command", np.linspace(low, high, 33))),
            [] if self.defects is None else np.flatnonzero(self.defects),
        )
        for part in parts:
            values = np.ascontiguousarray(part, dtype="<f8")
            digest.update(str(values.shape).encode() + values.tobytes())
        return digest.hexdigest()[:16]


def _size(shape: tuple[int, ...]) -> str:
    return " x ".join(str(n) for n in reversed(shape))
