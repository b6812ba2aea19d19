"""Light that is not one plane within a column: sheets that bow, and rows that are exposed one after the other.

Windows, estimators and the joining of stripes work with planes and rays (u, v, 1). So they use rays that are bent
sideways: by as much as the bow moves the light in the middle of the depth range. The remaining error, together with the
delay of the rows, is below a pixel or two. The windows are widened by it (`beside_px`), and the depth of a map is
computed exactly in the end, from each pixel's command (`BentLight.inverse_depth`). `calibration.model.light_sheet` has
the formula of a bowed sheet. Arrays are float64, except the rays and depths of `BentLight`, which are float32.
"""

import math
from dataclasses import dataclass

import numpy as np

from calibration.model.light_sheet import fan_origin, inverse_depth
from calibration.model.rig_model import RigModel
from calibration.model.scanner import PivotScanner
from rig.simd import Float32, Float64

_SAMPLED_SHEETS = 4097
"""Sheets sampled over the command range: between two of them a plane is linear to 1e-8 rad."""
_SAMPLED_COLUMNS = 9
_SAMPLED_ROWS = 16
"""The error that bent rays leave is computed in about this many columns, and in one of this many rows."""


@dataclass(frozen=True, slots=True, eq=False)
class BentLight:
    """Rays and sheets that turn a map's commands into depth if the light is bent.

    u, v: float32 (rows, width), true rays. commands: (columns,), mirror command of each column. sheets: (samples, 10),
    the model's sheets as `bent_inverse_depth` reads them. velocity_per_s: of the command, negative if it falls.
    """

    model: RigModel
    u: Float32
    v: Float32
    commands: Float64
    sheets: Float64
    velocity_per_s: float = 0.0

    def inverse_depth(self, command: Float64, first_row: int = 0) -> Float32:
        """Inverse depth in 1/m, float32 (rows, width), of pixels lit at `command` (rows, width), NaN where that is NaN.
        first_row: row of the picture to which the first row of `command` belongs."""
        from rig.geometry.kernels import bent_inverse_depth

        model, rows = self.model, slice(first_row, first_row + len(command))
        ahead = np.arange(rows.start, rows.stop) * np.float64(self.velocity_per_s * model.row_delay_s)
        result = np.empty(command.shape, np.float32)
        bent_inverse_depth(
            command, ahead, self.u[rows], self.v[rows], self.sheets, *model.scanner.command_range,
            fan_origin(model.scanner, model.source_m), bow_per_rad(model), result,
        )  # fmt: skip
        return result


def bent_light(model: RigModel, u: Float32, v: Float32, commands: Float64) -> BentLight:
    """The bent light of a model, with its kernel compiled; u, v, commands as in `BentLight`."""
    sheets = model.sheets(np.linspace(*model.scanner.command_range, _SAMPLED_SHEETS))
    light = BentLight(model, u, v, commands, np.hstack([sheets.planes, sheets.middle, sheets.across]))
    light.inverse_depth(np.zeros((0, u.shape[1])))
    return light


def bow_per_rad(model: RigModel) -> float:
    """Bow of the model's sheets, per radian; 0 if there is none."""
    return float(getattr(model.scanner, "bow_per_rad", 0.0))


def is_bent(model: RigModel) -> bool:
    """Whether light of this model is bent: its sheets bow, or rows are exposed one after the other."""
    return model.row_delay_s != 0 or bow_per_rad(model) != 0


def bent_u(model: RigModel, u: Float64, v: Float64, depth_m: float) -> Float64:
    """The bent rays' u (rows, width). At this depth a bent ray meets a plane where the true ray meets the sheet.

    u, v: of the true rays. The scanner's offset and cone are left out: they change less than the windows' margin.
    Without a bow the result is u itself.
    """
    scanner = model.scanner
    if not isinstance(scanner, PivotScanner) or scanner.bow_per_rad == 0:
        return u
    seen = np.stack([u, v, np.ones_like(u)], axis=-1) * depth_m - fan_origin(scanner, model.source_m)
    across = np.sum(seen * scanner.axis_direction, axis=-1)
    normal = np.cross(scanner.axis_direction, seen)
    away = np.linalg.norm(normal, axis=-1)  # from the axis, within the plane
    normal_x = normal[..., 0] / away * np.where(normal @ scanner.zero_normal < 0, -1.0, 1.0)
    off = np.tan(scanner.bow_per_rad * np.arctan2(across, away) ** 2) * np.hypot(across, away)
    bent: Float64 = u - off / (normal_x * depth_m)
    return bent


def beside_px(
    model: RigModel, rays: tuple[Float64, Float64], bent: Float64, commands: Float64, depth_range_m: tuple[float, float]
) -> int:
    """Largest distance in pixels of true stripes from those that planes and bent rays give, within the depth range.

    rays: true u and v (rows, width). bent: u from `bent_u`. commands: (columns,). Rounded up, from a sample of rows and
    columns. The result holds for both directions of the sweep, up to the highest speed at which the lag was measured.
    If no speed is known, the rows' delay is left out.
    """
    u, v, bent = (each[::_SAMPLED_ROWS] for each in (*rays, bent))
    y = np.arange(0, len(rays[0]), _SAMPLED_ROWS)[:, None]
    fastest = 0.0 if model.speed_range_per_s is None else model.speed_range_per_s[1]
    near_m, far_m = depth_range_m
    most = 0.0
    for command in commands[:: max(1, len(commands) // _SAMPLED_COLUMNS)]:
        flat = inverse_depth(bent, v, model.planes(command))
        per_px = np.gradient(flat, axis=1) if flat.shape[1] > 1 else np.ones_like(flat)
        inside = (flat >= 1 / far_m) & (flat <= 1 / near_m)
        for velocity in {fastest * np.sign(model.row_delay_s), -fastest * np.sign(model.row_delay_s)}:
            delayed = np.clip(command + velocity * model.row_delay_s * y, *model.scanner.command_range)
            true = model.sheets(delayed).inverse_depth(u, v)
            off = np.abs((true - flat)[inside] / per_px[inside])
            most = max(most, float(np.max(off, initial=0.0, where=np.isfinite(off))))
    return math.ceil(most)
