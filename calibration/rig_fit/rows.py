"""Residuals of a rig and their exact derivatives by every parameter.

A passage compares the mirror command at which the line crossed a pixel with the command c at which the light sheet
meets the pixel's ray on the board. With F the distance of that point X from a sheet along its normal n (see
`light_sheet`), F(c) = 0, and the residual, in units of the command, changes with a parameter p by (dF/dp) / (dF/dc).
With the ray r, X = t r lies on the board's plane m.(X - P) = 0 (m its normal, P its position). A turn w and shift s of
the board move X along r, which changes F by (n.r / m.r) (w.(m x (P - X)) + m.s). A change dr of the ray changes F by
t (n - (n.r / m.r) m).dr.

When row y sees the light, the mirror is where its command was lag - row_delay y earlier. Derivatives by parameters are
in the order of `Terms.names`; the turns and shifts of the axis are those of `calibration.model.parameters`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.polynomial import polynomial

from calibration.arrays import Array
from calibration.model.camera import Camera, LensModel
from calibration.model.light_sheet import fan_origin
from calibration.model.parameters import AXIS, DISTORTION, MATRIX, TIMES
from calibration.model.rig_model import RigModel
from calibration.model.scanner import PivotScanner
from calibration.views import BoardPose

LENS_TERMS = DISTORTION[:12]
"""Names of the distortion's terms, without those of a tilted sensor."""
ANGLE_TERMS = 6
OFFSET_TERMS = 2


@dataclass(frozen=True, slots=True)
class Terms:
    """The parameters that all views share, in the order of the columns. lens: number of lens terms that are fitted."""

    lens: int

    @property
    def camera(self) -> tuple[str, ...]:
        """Names of the camera's parameters."""
        return (*MATRIX, *LENS_TERMS[: self.lens])

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all columns."""
        angle, offset = (f"angle_{k}" for k in range(ANGLE_TERMS)), (f"offset_{k}" for k in range(OFFSET_TERMS))
        return (*self.camera, *AXIS, *angle, *offset, "cone", "bow", *TIMES)

    def at(self, names: Sequence[str]) -> list[int]:
        """The column numbers of some parameters."""
        everything = self.names
        return [everything.index(name) for name in names]

    def tied(self, groups: Sequence[Sequence[str]]) -> Array:
        """(p, groups) matrix that maps free parameters to all of them. The parameters of one group share a value."""
        tie = np.zeros((len(self.names), len(groups)))
        for column, group in enumerate(groups):
            tie[self.at(group), column] = 1.0
        return tie


class Rows(NamedTuple):
    """Residuals (n,); their derivatives by shared parameters (n, p) and by the turn and shift of the pose (n, 6)."""

    residual: Array
    shared: Array
    pose: Array


class _Lit(NamedTuple):
    """Points relative to the light of a mirror: F, dF/dangle and dF/dcommand (m,), and the parts that
    derivatives need."""

    distance_m: Array
    per_angle: Array
    per_command: Array
    angle: Array
    flat: Array  # (m, 3) the normals without their cone
    normal: Array
    lever: Array  # (m, 3) from the axis
    bowing: Array  # (m,) dF/dbow


class Sheet(NamedTuple):
    """The light that meets n points: mirror command (n,), dF/dc (n,), normal (n, 3). columns: dF/dp (n, terms)."""

    command: Array
    per_command: Array
    normal: Array
    columns: Array


def sheet_rows(
    scanner: PivotScanner, source_m: Array | None, points_m: Array, command: Array, y_px: Array, velocity_per_s: Array
) -> Sheet:
    """The light that meets points (m, 3), with derivatives by scanner and timing. command: a start value of the
    mirror's command.
    """
    lit = _lit(scanner, source_m, points_m, command)
    met = command - lit.distance_m / lit.per_command
    lit = _lit(scanner, source_m, points_m, met)
    across_1, axis = scanner.zero_normal, scanner.axis_direction
    across_2 = np.cross(axis, across_1)
    cos_cone, sin_cone = np.cos(scanner.cone_rad), np.sin(scanner.cone_rad)
    moment = np.cross(lit.normal, lit.lever)
    columns: Array = np.empty((len(met), 4 + ANGLE_TERMS + OFFSET_TERMS + 2 + len(TIMES)))
    columns[:, 0], columns[:, 1] = moment @ across_1, moment @ across_2
    columns[:, 2], columns[:, 3] = -lit.normal @ across_1, -lit.normal @ across_2
    columns[:, 4 : 4 + ANGLE_TERMS] = lit.per_angle[:, None] * np.vander(met, ANGLE_TERMS, increasing=True)
    at = 4 + ANGLE_TERMS
    columns[:, at : at + OFFSET_TERMS] = -np.vander(lit.angle, OFFSET_TERMS, increasing=True)
    at += OFFSET_TERMS
    columns[:, at] = np.sum((cos_cone * axis - sin_cone * lit.flat) * lit.lever, axis=1)
    columns[:, at + 1] = lit.bowing
    rising = velocity_per_s > 0
    timed = -velocity_per_s * lit.per_command
    columns[:, at + 2], columns[:, at + 3] = np.where(rising, timed, 0.0), np.where(rising, 0.0, timed)
    columns[:, at + 4] = -timed * y_px
    return Sheet(met - lit.distance_m / lit.per_command, lit.per_command, lit.normal, columns)


def mirror_command(timing: Array, command: Array, y_px: Array, velocity_per_s: Array) -> Array:
    """Position of the mirror, as in `RigModel.mirror_command`, with `timing` (3,) instead of a model."""
    delay_s: Array = np.where(velocity_per_s > 0, timing[0], timing[1]) - timing[2] * y_px
    return command - velocity_per_s * delay_s


def _lit(scanner: PivotScanner, source_m: Array | None, points_m: Array, command: Array) -> _Lit:
    angle: Array = polynomial.polyval(command, scanner.angle_rad).astype(np.float64)
    across_1, axis = scanner.zero_normal, scanner.axis_direction
    across_2 = np.cross(axis, across_1)
    cos, sin = np.cos(angle)[:, None], np.sin(angle)[:, None]
    flat, turning = across_1 * cos + across_2 * sin, across_2 * cos - across_1 * sin
    cos_cone, sin_cone = np.cos(scanner.cone_rad), np.sin(scanner.cone_rad)
    normal = cos_cone * flat + sin_cone * axis
    lever = points_m - scanner.axis_point_m
    off = np.sum(normal * lever, axis=1)
    per_angle = cos_cone * np.sum(turning * lever, axis=1)
    if np.any(scanner.offset_m):
        off = off - polynomial.polyval(angle, scanner.offset_m)
        per_angle = per_angle - polynomial.polyval(angle, polynomial.polyder(scanner.offset_m))
    seen = points_m - fan_origin(scanner, source_m)
    along = seen @ axis
    reach = np.sqrt(np.maximum(np.sum(seen * seen, axis=1) - np.sum(seen * normal, axis=1) ** 2, 0.0))
    fan_rad = np.arctan2(along, np.sqrt(np.maximum(reach * reach - along * along, 0.0)))
    off = off - np.tan(scanner.bow_per_rad * fan_rad * fan_rad) * reach
    per_command = per_angle * polynomial.polyval(command, polynomial.polyder(scanner.angle_rad))
    return _Lit(off, per_angle, per_command, angle, flat, normal, lever, -fan_rad * fan_rad * reach)


def ray_columns(camera: Camera, terms: Terms, u: Array, v: Array, by_u: Array, by_v: Array) -> Array:
    """Derivatives (m, camera terms) of a quantity with respect to the camera's parameters, for fixed pixels. A change
    (du, dv) of a pixel's ray (u, v, 1) changes the quantity by `by_u` du + `by_v` dv."""
    lens = camera.lens
    ux, uy, vx, vy = lens.undistort_slope(u, v)
    by_x, by_y = by_u * ux + by_v * vx, by_u * uy + by_v * vy
    at, u_terms, v_terms = _lens_columns(lens, camera.distortion, terms.lens, u, v)
    fx, fy = camera.matrix[0, 0], camera.matrix[1, 1]
    columns: Array = np.empty((len(u), 4 + terms.lens))
    columns[:, 0], columns[:, 1] = -by_x * at[0] / fx, -by_y * at[1] / fy
    columns[:, 2], columns[:, 3] = -by_x / fx, -by_y / fy
    columns[:, 4:] = -(by_x[:, None] * u_terms + by_y[:, None] * v_terms)
    return columns


def passage_rows(
    model: RigModel, terms: Terms, timing: Array, pose: BoardPose, rays: Array, command: Array, y_px: Array,
    velocity_per_s: Array,
) -> Rows:  # fmt: skip
    """Rows of the least-squares fit, one for each of m passages, in units of the command.

    timing: both lags and the row delay, (3,). rays: u and v of the passages' pixels, (2, m). command, y_px,
    velocity_per_s: of the passages, (m,).
    """
    assert isinstance(model.scanner, PivotScanner)
    u, v = rays
    ray = np.stack([u, v, np.ones_like(u)], axis=-1)
    board = pose.matrix[:, 2]
    facing = ray @ board
    depth = (board @ pose.position_m) / facing
    points = depth[:, None] * ray
    mirror = mirror_command(timing, command, y_px, velocity_per_s)
    sheet = sheet_rows(model.scanner, model.source_m, points, mirror, y_px, velocity_per_s)
    slant = np.sum(sheet.normal * ray, axis=1) / facing
    by_ray = depth[:, None] * (sheet.normal - slant[:, None] * board)
    shared = np.hstack([ray_columns(model.camera, terms, u, v, by_ray[:, 0], by_ray[:, 1]), sheet.columns])
    turned = slant[:, None] * np.cross(board, pose.position_m - points)
    moved = slant[:, None] * board
    each = sheet.per_command[:, None]
    return Rows(mirror - sheet.command, shared / each, np.hstack([turned, moved]) / each)


def corner_rows(camera: Camera, terms: Terms, pose: BoardPose, corners_m: Array, corner_px: Array) -> Rows:
    """Rows of corners (n, 3) seen at (n, 2): predicted minus seen, in pixels, (2 n,) with all x first."""
    moved = corners_m @ pose.matrix.T
    points = moved + pose.position_m
    z = points[:, 2]
    u, v = points[:, 0] / z, points[:, 1] / z
    lens = camera.lens
    ux, uy, vx, vy = lens.undistort_slope(u, v)
    det = ux * vy - uy * vx
    at, u_terms, v_terms = _lens_columns(lens, camera.distortion, terms.lens, u, v)
    (fx, _, cx), (_, fy, cy) = camera.matrix[:2]
    x, y = fx * at[0] + cx, fy * at[1] + cy
    n = len(corners_m)
    shared = np.zeros((2 * n, len(terms.names)))
    shared[:n, 0], shared[n:, 1], shared[:n, 2], shared[n:, 3] = at[0], at[1], 1.0, 1.0
    shared[:n, 4 : 4 + terms.lens], shared[n:, 4 : 4 + terms.lens] = fx * u_terms, fy * v_terms
    poses = []
    for by_u, by_v, scale in ((vy / det, -uy / det, fx), (-vx / det, ux / det, fy)):
        by_point = scale * np.stack([by_u / z, by_v / z, -(by_u * u + by_v * v) / z], axis=-1)
        poses.append(np.hstack([np.cross(moved, by_point), by_point]))
    return Rows(np.concatenate([x - corner_px[:, 0], y - corner_px[:, 1]]), shared, np.concatenate(poses))


def refined_rays(camera: Camera, rays: Array, x_px: Array, y_px: Array) -> Array:
    """Rays (2, m) of pixels, from those of a camera that differs little, by two steps of Newton's method."""
    matrix = camera.matrix
    x, y = (x_px - matrix[0, 2]) / matrix[0, 0], (y_px - matrix[1, 2]) / matrix[1, 1]
    u, v = rays
    return np.stack(camera.lens.newton(u, v, x, y, steps=2))


def _lens_columns(lens: LensModel, distortion: Array, terms: int, u: Array, v: Array) -> tuple[Array, Array, Array]:
    """Distorted tangents (2, m), and how they change with the first terms of the lens: (m, terms) each."""
    seen = lens.forward(u, v)
    k1, k2, _, _, k3, k4, k5, k6 = (*distortion, *np.zeros(8))[:8]
    r2 = u * u + v * v
    denominator = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    g = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / denominator
    r4, r6, none = r2 * r2, r2 * r2 * r2, np.zeros_like(r2)
    radial = [r2 / denominator, r4 / denominator, none, none, r6 / denominator]
    radial += [-g * r2 / denominator, -g * r4 / denominator, -g * r6 / denominator]
    by_u, by_v = [u * factor for factor in radial], [v * factor for factor in radial]
    by_u[2], by_u[3] = 2 * u * v, r2 + 2 * u * u
    by_v[2], by_v[3] = r2 + 2 * v * v, 2 * u * v
    by_u += [r2, r4, none, none]
    by_v += [none, none, r2, r4]
    return np.stack([seen.u, seen.v]), np.array(by_u).T[:, :terms], np.array(by_v).T[:, :terms]
