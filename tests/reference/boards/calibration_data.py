"""Views of a calibration board as a known rig would see them: corners and passages by exact ray tracing.

A yardstick for `calibration.rig_fit.fit`: its own lens, rotations and light, nothing shared with what it judges but the
data classes it hands over. Light leaves the mirror in sheets that turn about an axis; a sheet may pass the axis at a
distance, lie on a cone and bow. `fitted` and `depth_errors`, at the end,
fit such views and compare the depth with the true rig's: same pixels, same instants.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.arrays import Array
from calibration.board.board import Board
from calibration.depth_error import depth_sd_m
from calibration.model.camera import Camera
from calibration.model.rig_model import Covariance, RigModel
from calibration.rig_fit.fit import RigFit, fit_rig
from calibration.views import Corners, Passages, View

BOARD = Board("chessboard", (9, 7), 0.06)
HOLD_S = 1e-4
"""For how long the mirror's error stays the same."""
LINE_HOLDS = 0.5
"""Width (sd) of the line over a pixel, in those times."""


@dataclass(frozen=True)
class TrueRig:
    """A rig. lens: k1 k2 p1 p2 k3. axis, across: unit vectors; angle: polynomial in the command."""

    width: int = 512
    height: int = 512
    fx: float = 600.0
    fy: float = 600.0
    cx: float = 255.5
    cy: float = 255.5
    lens: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    point: Array = field(default_factory=lambda: np.array([-0.3, 0.0, 0.0]))
    axis: Array = field(default_factory=lambda: np.array([0.0, 1.0, 0.0]))
    across: Array = field(default_factory=lambda: np.array([1.0, 0.0, 0.0]))
    angle: tuple[float, ...] = (0.0872, 0.5315)
    offset: float = 0.0
    cone: float = 0.0
    bow: float = 0.0
    lag: tuple[float, float] = (2e-4, 2e-4)
    row_delay: float = 0.0

    def project(self, points: Array) -> tuple[Array, Array]:
        """Raw pixels of points (..., 3)."""
        u, v = points[..., 0] / points[..., 2], points[..., 1] / points[..., 2]
        k1, k2, p1, p2, k3 = self.lens
        r2 = u * u + v * v
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        x = u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u)
        y = v * radial + p1 * (r2 + 2 * v * v) + 2 * p2 * u * v
        return self.fx * x + self.cx, self.fy * y + self.cy

    def inside(self, x: Array, y: Array) -> NDArray[np.bool_]:
        """Whether pixels are in the picture."""
        seen: NDArray[np.bool_] = (x >= 0) & (x <= self.width - 1) & (y >= 0) & (y <= self.height - 1)
        return seen

    def off(self, command: Array, points: Array) -> Array:
        """Distances of points from the sheet of light at a command."""
        turn = np.polynomial.polynomial.polyval(command, self.angle)[..., None]
        other = np.cross(self.axis, self.across)
        normal = np.cos(self.cone) * (np.cos(turn) * self.across + np.sin(turn) * other) + np.sin(self.cone) * self.axis
        result = np.sum(normal * (points - self.point), axis=-1) - self.offset
        if self.bow:
            origin = self.point - (self.point @ self.axis) * self.axis
            seen = points - origin
            along = seen @ self.axis
            fan = np.arctan2(along, np.sqrt(np.sum(seen**2, axis=-1) - along**2))
            result = result - np.tan(self.bow * fan**2) * np.linalg.norm(seen, axis=-1)
        return np.asarray(result)

    def mirror_at(self, points: Array) -> Array:
        """The command at which a mirror without lag would light points; NaN outside -1.2 to 1.2."""
        low, high = np.full(points.shape[:-1], -1.2), np.full(points.shape[:-1], 1.2)
        first, last = self.off(low, points), self.off(high, points)
        found = np.sign(first) != np.sign(last)
        for _ in range(52):
            middle = (low + high) / 2
            same = np.sign(self.off(middle, points)) == np.sign(first)
            low, high = np.where(same, middle, low), np.where(same, high, middle)
        return np.where(found, (low + high) / 2, np.nan)

    def command_at(self, points: Array, velocity: float) -> Array:
        """The command given at the instant in which the line crosses points."""
        _, y = self.project(points)
        lag = self.lag[0] if velocity > 0 else self.lag[1]
        return self.mirror_at(points) + velocity * (lag - self.row_delay * y)

    def moved(self, shift: Array, turn: Array) -> TrueRig:
        """A rig of the same camera with its scanner shifted (m) and turned (rad)."""
        turned = rotation(turn)
        return replace(self, point=self.point + shift, axis=turned @ self.axis, across=turned @ self.across)


@dataclass(frozen=True)
class ViewErrors:
    """Errors of what is seen. factor: of the passages' errors to their stated sd. wave: (amplitude, turns over the
    sweep) of an exposure that is not locked.
    """

    corner_px: float = 0.05
    passage: float = 8e-4
    factor: float = 1.0
    jitter: float = 0.0
    passages: int = 800
    outliers: float = 0.0
    wave: tuple[float, float] = (0.0, 0.0)


def rotation(vector: Array) -> Array:
    """Rotation matrix by a vector (rad), Rodrigues' formula."""
    angle = float(np.linalg.norm(vector))
    if angle == 0:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)


def random_rig(rng: np.random.Generator) -> TrueRig:
    """Baseline 0.2 to 0.5 m on either side, f 400 to 900 px, five terms of lens, the axis tilted, a quadratic angle."""
    side = rng.choice([-1.0, 1.0])
    focal = rng.uniform(400, 900)
    baseline = rng.uniform(0.2, 0.5)
    tilt = rotation(np.radians([rng.uniform(-3, 3), 0, rng.uniform(-3, 3)]))
    return TrueRig(
        fx=focal,
        fy=focal * rng.uniform(0.998, 1.002),
        cx=255.5 + rng.uniform(-10, 10),
        cy=255.5 + rng.uniform(-10, 10),
        lens=(rng.uniform(-0.2, 0.1), rng.uniform(-0.05, 0.1), *rng.uniform(-1e-3, 1e-3, 2), rng.uniform(-0.02, 0.02)),
        point=np.array([side * baseline, rng.uniform(-0.05, 0.05), rng.uniform(-0.05, 0.05)]),
        axis=tilt @ [0.0, 1.0, 0.0],
        across=tilt @ [1.0, 0.0, 0.0],
        angle=(-side * baseline / rng.uniform(2, 4), rng.uniform(0.45, 0.65), rng.uniform(-0.03, 0.03)),
        lag=(rng.uniform(1e-4, 3e-4), rng.uniform(1e-4, 3e-4)),
    )


def random_pose(rng: np.random.Generator, rig: TrueRig, near: float = 0.8, far: float = 3.0) -> tuple[Array, Array]:
    """(rotation vector, position) of a board as a person holds it, most of it in the picture."""
    width, height = BOARD.size_m
    while True:
        turn = np.append(np.radians(rng.uniform(-40, 40, 2)), np.radians(rng.uniform(-15, 15)))
        depth = rng.uniform(near, far)
        middle = depth * np.array([*(rng.uniform(-0.4, 0.4, 2) * 512 / rig.fx), 1.0])
        position = middle - rotation(turn) @ [width / 2, height / 2, 0]
        corners = BOARD.corners_m @ rotation(turn).T + position
        x, y = rig.project(corners)
        if corners[:, 2].min() > 0.3 and rig.inside(x, y).mean() > 0.6:
            return turn, position


def seen_view(
    rng: np.random.Generator, rig: TrueRig, turn: Array, position: Array, seen: ViewErrors,
    velocities: tuple[float, ...] = (35.2, -35.2), name: str = "view",
) -> View:  # fmt: skip
    """One pose of the board, with a sweep for each signed velocity."""
    matrix = rotation(turn)
    corners = BOARD.corners_m @ matrix.T + position
    x, y = rig.project(corners)
    ids = np.flatnonzero(rig.inside(x, y) & (corners[:, 2] > 0))
    px = np.stack([x, y], axis=-1)[ids] + rng.normal(0, seen.corner_px, (ids.size, 2))
    sweeps = tuple(_sweep(rng, rig, matrix, position, seen, velocity) for velocity in velocities)
    return View(name, Corners(ids.astype(np.int32), px), sweeps)


def _sweep(
    rng: np.random.Generator, rig: TrueRig, matrix: Array, position: Array, seen: ViewErrors, velocity: float
) -> Passages:
    places = rng.uniform([0, 0], BOARD.size_m, (3 * seen.passages, 2))
    points = np.hstack([places, np.zeros((len(places), 1))]) @ matrix.T + position
    x, y = rig.project(points)
    mirror = rig.mirror_at(points)
    command = rig.command_at(points, velocity)
    keep = np.flatnonzero(rig.inside(x, y) & (np.abs(mirror) < 0.95) & (points[:, 2] > 0))[: seen.passages]
    x, y, command = x[keep], y[keep], command[keep]
    stated = seen.passage * np.exp(rng.normal(0, 0.4, x.size))
    error = seen.factor * stated * rng.normal(size=x.size)
    error += _shaken(rng, command, velocity) * seen.jitter
    amplitude, turns = seen.wave
    error += amplitude * np.sin(np.pi * turns * command + rng.uniform(0, 2 * np.pi))
    wrong = rng.random(x.size) < seen.outliers
    error[wrong] += rng.uniform(-0.3, 0.3, int(wrong.sum()))
    return Passages(x, y, command + error, stated, 1 if velocity > 0 else -1, abs(velocity))


def _shaken(rng: np.random.Generator, command: Array, velocity: float) -> Array:
    """The mirror's error at passages, of unit size: held for HOLD_S, seen through a line of some width."""
    step = abs(velocity) * HOLD_S
    at = (command + 2) / step
    held = rng.normal(size=int(4 / step) + 20)
    nearest = np.round(at).astype(int)
    offsets = np.arange(-3, 4)
    share = np.exp(-0.5 * ((at[:, None] - nearest[:, None] - offsets) / LINE_HOLDS) ** 2)
    share /= share.sum(axis=1, keepdims=True)
    return np.asarray(np.sum(share * held[nearest[:, None] + offsets + 5], axis=1))


def random_views(
    rng: np.random.Generator, rig: TrueRig, poses: int, seen: ViewErrors, velocities: tuple[float, ...] = (35.2, -35.2)
) -> list[View]:
    """Views of so many random poses."""
    shown = [random_pose(rng, rig) for _ in range(poses)]
    return [seen_view(rng, rig, *pose, seen, velocities, f"{i:03d}") for i, pose in enumerate(shown)]


def points_at(rng: np.random.Generator, rig: TrueRig, depth: float, count: int) -> Array:
    """Points (n, 3) at a depth that are in the picture and that the line reaches, at most so many."""
    reach = 0.5 * 512 / min(rig.fx, rig.fy) * depth
    points = np.hstack([rng.uniform(-reach, reach, (4 * count, 2)), np.full((4 * count, 1), depth)])
    x, y = rig.project(points)
    return points[rig.inside(x, y) & (np.abs(rig.mirror_at(points)) < 0.9)][:count]


def normalised(model: RigModel, rig: TrueRig, depth_m: float, velocity_per_s: float) -> float:
    """Root mean square of the errors in units of their stated sd: 1 where the covariance is right, on average."""
    error, sd = depth_errors(model, rig, depth_m, velocity_per_s)
    return float(np.sqrt(np.mean((error / sd) ** 2)))


def depth_errors(
    model: RigModel, rig: TrueRig, depth_m: float, velocity_per_s: float, seed: int = 0, count: int = 60
) -> tuple[Array, Array]:
    """(errors, sd that the model states) in metres, at points all over the picture."""
    points = points_at(np.random.default_rng(seed), rig, depth_m, count)
    x, y = rig.project(points)
    mirror = model.mirror_command(rig.command_at(points, velocity_per_s), y, velocity_per_s)
    mirror = np.clip(mirror, *model.scanner.command_range)
    u, v = model.camera.tangents_at(x, y)
    return model.sheets(mirror).depth(u, v) - depth_m, depth_sd_m(model, x, y, mirror, velocity_per_s)


SIZE = (512, 512)
SEEN = ViewErrors(passages=200, passage=1e-3, corner_px=0.04)
EXACT = ViewErrors(passages=200, passage=1e-3, factor=1e-6, corner_px=1e-7)
RIG = TrueRig(lens=(-0.1, 0.03, 5e-4, -3e-4, 0.0), angle=(0.09, 0.53, 0.02), lag=(1.5e-4, 2.5e-4))


def fitted(rig: TrueRig, seed: int, seen: ViewErrors = SEEN, poses: int = 8, **given: object) -> RigFit:
    velocities = given.pop("velocities", (35.2, -35.2))
    views = random_views(np.random.default_rng(seed), rig, poses, seen, velocities)
    return fit_rig(views, BOARD, SIZE, **given)


def held(rig: TrueRig) -> dict[str, Any]:
    """What is given to a fit of a rig whose camera is known exactly."""
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    return {"camera": true_camera(rig), "known": Covariance(names, np.zeros((9, 9)))}


def true_camera(rig: TrueRig) -> Camera:
    return Camera(*SIZE, np.array([[rig.fx, 0, rig.cx], [0, rig.fy, rig.cy], [0, 0, 1.0]]), np.array(rig.lens))
