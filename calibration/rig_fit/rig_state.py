"""The state of a rig's fit (model, timing, poses, residuals), the sightings to which it is fitted, and first values.

A sighting is a view's corners and passages, cleaned and in the order that the fit needs.

First values are poses from corners, planes from passages, and the mirror's axis from the planes. With the poses known,
every passage is a point in space that the light met at a command c. For a line turned about an axis, x = d(c) - b(c) y
- e(c) z with smooth d, b, e. These are polynomials, found by one linear least squares fit over all points of one
direction and speed of sweep. The normals of the planes are perpendicular to the axis. Each sweep reaches an angle at a
command that is shifted by its velocity times the mirror's lag, so the lags follow from the differences of the commands.

Views that determine no rig model are refused with the reason, the measured value, its limit and what to do.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np
from numpy.polynomial import polynomial
from numpy.typing import NDArray

from calibration.arrays import Array
from calibration.board.board import PAPER_SQUARES, Board, spread_rad
from calibration.depth_error import command_at, depth_sd_m
from calibration.errors import Degenerate, condition_text, digits
from calibration.model.camera import Camera
from calibration.model.parameters import BACKWARD, FORWARD, ROW_DELAY, TIMES, lag_groups, with_parameters
from calibration.model.rig_model import RigModel
from calibration.model.scanner import PivotScanner
from calibration.rig_fit.rows import Rows, Terms, corner_rows, passage_rows, refined_rays
from calibration.verdict import AT_M
from calibration.views import (
    FEWEST_CORNERS,
    LEAST_ACROSS_PX,
    NO_POSE,
    USUAL_CORNER_SD_PX,
    BoardPose,
    Corners,
    Passages,
    View,
)

EDGE_PX = 1.5
"""Passages this close to the outline of the paper are left out: such pixels also see what is behind the board."""
LEAST_SD_SHARE = 0.05
"""Least sd of a passage, as a share of its sweep's median: a few with too small an sd must not dominate."""
LEAST_CORNER_SD_PX = 0.02
"""Error of a corner due to print, lens model and search, however bright the picture."""
FEWEST_PASSAGES = 30
"""Fewest passages of a sweep; fewer do not determine their noise."""


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """One view. corners_m (n, 3), corner_px (n, 2), corner_scale (n,): sd of a corner over the usual one.

    Per passage (m,), float64, sorted by sweep and command: x_px, y_px, command, sd, velocity_per_s (signed). starts:
    (sweeps + 1,), indices at which the sweeps begin and end.
    """

    name: str
    corners_m: Array
    corner_px: Array
    corner_scale: Array
    x_px: Array
    y_px: Array
    command: Array
    sd: Array
    velocity_per_s: Array
    starts: NDArray[np.int64]

    @property
    def sweeps(self) -> list[slice]:
        """The slices of passages that belong to each sweep."""
        return [slice(int(a), int(b)) for a, b in zip(self.starts[:-1], self.starts[1:], strict=True)]


def sighting(view: View, board: Board, camera: Camera, pose: BoardPose) -> Sighting:
    """The corners of a view, and its passages on the board's paper in sweeps with FEWEST_PASSAGES of them or more."""
    assert view.corners is not None
    sweeps = [_on_board(sweep, board, camera, pose) for sweep in view.passages]
    sweeps = [sweep for sweep in sweeps if sweep.x_px.size >= FEWEST_PASSAGES]

    def joined(name: str) -> Array:
        return np.concatenate([np.zeros(0), *(getattr(sweep, name) for sweep in sweeps)])

    sizes = [sweep.x_px.size for sweep in sweeps]
    return Sighting(
        name=view.name,
        corners_m=board.corners_m[view.corners.ids],
        corner_px=np.asarray(view.corners.px, np.float64),
        corner_scale=corner_scale(view.corners),
        x_px=joined("x_px"),
        y_px=joined("y_px"),
        command=joined("command"),
        sd=joined("sd"),
        velocity_per_s=np.repeat([sweep.velocity_per_s for sweep in sweeps], np.array(sizes, np.int64)),
        starts=np.cumsum([0, *sizes]),
    )


def corner_scale(corners: Corners) -> Array:
    """Standard deviation of each corner divided by the usual one, (n,); 1 if the picture gave none."""
    if corners.sd_px is None:
        return np.ones(len(corners.ids))
    return np.hypot(corners.likely_sd_px, LEAST_CORNER_SD_PX) / USUAL_CORNER_SD_PX


def usable(views: Sequence[View]) -> list[View]:
    """The views that have enough corners for a pose, not all of them on one line.

    Corners whose position is not finite are left out first.
    """
    found = []
    for view in views:
        if view.corners is None:
            continue
        ids, px, sd_px = view.corners.ids, view.corners.px, view.corners.sd_px
        seen = np.isfinite(px).all(axis=1)
        if seen.sum() >= FEWEST_CORNERS:
            corners = Corners(ids[seen], px[seen], None if sd_px is None else sd_px[seen])
            if corners.across_px >= LEAST_ACROSS_PX:
                found.append(replace(view, corners=corners))
    return found


def shows_line(view: View) -> bool:
    """Whether any sweep of a view has enough passages to be used."""
    return any(sweep.x_px.size >= FEWEST_PASSAGES for sweep in view.passages)


def _on_board(sweep: Passages, board: Board, camera: Camera, pose: BoardPose) -> Passages:
    """The valid passages of a sweep within the outline of the board's paper, sorted by command."""
    x, y, command, sd = (np.asarray(of, np.float64) for of in (sweep.x_px, sweep.y_px, sweep.command, sweep.sd))
    keep = np.isfinite(x) & np.isfinite(y) & np.isfinite(command) & np.isfinite(sd) & (sd > 0)
    u, v = camera.tangents_at(x, y)
    ray = np.stack([u, v, np.ones_like(u)], axis=-1)
    turn = pose.matrix
    with np.errstate(all="ignore"):
        depth = (turn[:, 2] @ pose.position_m) / (ray @ turn[:, 2])
        place = (depth[:, None] * ray - pose.position_m) @ turn
    margin = EDGE_PX * float(np.linalg.norm(pose.position_m)) / camera.matrix[0, 0]
    margin -= PAPER_SQUARES * board.square_m
    width, height = board.size_m
    with np.errstate(invalid="ignore"):
        keep &= (depth > 0) & (place[:, 0] > margin) & (place[:, 0] < width - margin)
        keep &= (place[:, 1] > margin) & (place[:, 1] < height - margin)
    at = np.flatnonzero(keep)
    at = at[np.argsort(command[at], kind="stable")]
    floor = LEAST_SD_SHARE * float(np.median(sd[at])) if at.size else 0.0
    return Passages(x[at], y[at], command[at], np.maximum(sd[at], floor), sweep.direction, sweep.speed_per_s)


@dataclass(frozen=True, slots=True, eq=False)
class RigState:
    """The state of a fit. model: has lags of 0. timing (3,): both lags and row delay in s, of any sign. poses, rays:
    one entry for each view; rays (2, m): u and v of the pixels of its passages."""

    model: RigModel
    timing: Array
    poses: tuple[BoardPose, ...]
    rays: tuple[Array, ...]

    @property
    def scanner(self) -> PivotScanner:
        """The mirror."""
        assert isinstance(self.model.scanner, PivotScanner)
        return self.model.scanner

    def rows(self, view: int, seen: Sighting, terms: Terms) -> tuple[Rows, Rows]:
        """Residuals and derivatives of one view, for its corners (pixels) and its passages (command units)."""
        pose = self.poses[view]
        corners = corner_rows(self.model.camera, terms, pose, seen.corners_m, seen.corner_px)
        passages = passage_rows(
            self.model, terms, self.timing, pose, self.rays[view], seen.command, seen.y_px, seen.velocity_per_s,
        )  # fmt: skip
        return corners, passages

    def stepped(self, terms: Terms, shared: Array, poses: Sequence[Array], sightings: Sequence[Sighting]) -> "RigState":
        """The state after changes of the shared parameters (p,), in the order of `terms.names`, and of the views'
        poses.

        poses: for each view (6,), a rotation vector in rad about the camera's axes, then a shift in m. Raises
        CalibrationError if there is no such model."""
        untimed = len(terms.names) - len(TIMES)
        moved = [name for name, change in zip(terms.names[:untimed], shared, strict=False) if change != 0]
        model = with_parameters(self.model, moved, [shared[terms.names.index(name)] for name in moved])
        rays = self.rays
        if model.camera is not self.model.camera:
            rays = tuple(
                refined_rays(model.camera, ray, seen.x_px, seen.y_px)
                for ray, seen in zip(self.rays, sightings, strict=True)
            )
        turned = tuple(_moved(pose, change) for pose, change in zip(self.poses, poses, strict=True))
        return RigState(model, self.timing + shared[untimed:], turned, rays)


def first_state(model: RigModel, timing: Array, poses: Sequence[BoardPose], sightings: Sequence[Sighting]) -> RigState:
    """The state for a model, with `timing` instead of the model's own lags."""
    rays = tuple(np.stack(model.camera.tangents_at(seen.x_px, seen.y_px)) for seen in sightings)
    timeless = replace(model, lag_s=type(model.lag_s)(), row_delay_s=0.0, covariance=None)
    return RigState(timeless, np.asarray(timing, np.float64), tuple(poses), rays)


def with_terms_of(state: RigState, groups: Sequence[Sequence[str]]) -> RigState:
    """The state with those terms of angle, offset, cone, bow and row delay set to 0 that are not named."""
    named = {name for group in groups for name in group}
    scanner = state.scanner
    plain = replace(
        scanner,
        angle_rad=np.where([f"angle_{k}" in named for k in range(scanner.angle_rad.size)], scanner.angle_rad, 0.0),
        offset_m=np.where([f"offset_{k}" in named for k in range(scanner.offset_m.size)], scanner.offset_m, 0.0),
        cone_rad=scanner.cone_rad if "cone" in named else 0.0,
        bow_per_rad=scanner.bow_per_rad if "bow" in named else 0.0,
    )
    timing = np.where([name != ROW_DELAY or name in named for name in TIMES], state.timing, 0.0)
    return RigState(replace(state.model, scanner=plain), timing, state.poses, state.rays)


def _moved(pose: BoardPose, change: Array) -> BoardPose:
    turned = cv2.Rodrigues(cv2.Rodrigues(change[:3])[0] @ pose.matrix)[0]
    return BoardPose(np.asarray(turned, np.float64).ravel(), pose.position_m + change[3:])


_ORDERS = (3, 1, 3)
"""Orders of d, b and e in the command: enough for tangents of angles from -22.5 to 22.5 degrees."""
BOARDS_FOR_PLANES = 2
"""Fewest boards at one speed for a lag: one board shows a line of each plane, which fits any plane through it."""
POSES_FOR_PLANES = 5
"""Fewest boards at one speed for planes: on fewer boards, a command's light gives too few lines for a good plane."""
MOST_FIRST_LAG_S = 1e-3
"""Largest first value of a lag: ten times that of a small galvo."""
_STEP = 0.7
"""Share of a sweep's command range over which its planes are sampled; those at the ends are least accurate."""


@dataclass(frozen=True, slots=True, eq=False)
class LitPoints:
    """Points at which light met the board: (m, 3), with command (m,), velocity (m,) and view (m,) of each."""

    points_m: Array
    command: Array
    velocity_per_s: Array
    view: NDArray[np.int64]


def first_pose(camera: Camera, corners_m: Array, corner_px: Array) -> BoardPose:
    """The pose of a board from its corners. Raises Degenerate if OpenCV finds no pose."""
    try:
        _, turn, shift = cv2.solvePnP(
            corners_m, corner_px, camera.matrix, camera.distortion, flags=cv2.SOLVEPNP_ITERATIVE
        )
    except cv2.error as error:
        raise Degenerate("no-board", NO_POSE) from error
    return BoardPose(np.asarray(turn, np.float64).ravel(), np.asarray(shift, np.float64).ravel())


def board_points(camera: Camera, sightings: Sequence[Sighting], poses: Sequence[BoardPose]) -> LitPoints:
    """The points at which the light met the boards."""
    points = []
    for seen, pose in zip(sightings, poses, strict=True):
        ray = np.stack([*camera.tangents_at(seen.x_px, seen.y_px), np.ones(seen.x_px.size)], axis=-1)
        board = pose.matrix[:, 2]
        points.append(ray * ((board @ pose.position_m) / (ray @ board))[:, None])
    return LitPoints(
        np.concatenate(points),
        np.concatenate([seen.command for seen in sightings]),
        np.concatenate([seen.velocity_per_s for seen in sightings]),
        np.repeat(np.arange(len(sightings)), [seen.command.size for seen in sightings]),
    )


def first_scanner(points: LitPoints, command_range: tuple[float, float]) -> tuple[PivotScanner, Array]:
    """Start values of a fit: a mirror and (lag forward, lag backward, 0).

    Lags are between 0 and MOST_FIRST_LAG_S. Lags that the sweeps cannot separate get one value; if the sweeps determine
    neither, both are 0.
    """
    # The signed speeds at which enough boards were scanned for planes; if there are none, those with most boards.
    velocities = np.unique(points.velocity_per_s)
    shown = np.array([np.unique(points.view[points.velocity_per_s == velocity]).size for velocity in velocities])
    velocities = velocities[shown >= min(POSES_FOR_PLANES, int(shown.max()))]
    lags = _first_lags(points, velocities) if shown.max() >= BOARDS_FOR_PLANES else np.zeros(2)
    mirror = points.command - points.velocity_per_s * np.where(points.velocity_per_s > 0, lags[0], lags[1])
    one = LitPoints(points.points_m, mirror, np.ones_like(mirror), points.view)
    commands, planes = _planes_of(one, 1.0)
    axis, point, first = _pivot(planes)
    angle: Array = polynomial.polyfit(commands, _angles(planes, axis, first), 1).astype(np.float64)
    return PivotScanner(point, axis, first, angle, command_range), np.array([*lags, 0.0])


def _first_lags(points: LitPoints, velocities: Array) -> Array:
    """(lag forward, lag backward), from the planes that the sweeps at these signed speeds give one by one."""
    counts = [np.count_nonzero(points.velocity_per_s == velocity) for velocity in velocities]
    swept = [_planes_of(points, velocity) for velocity in velocities]
    axis, _, first = _pivot(swept[int(np.argmax(counts))][1])
    curves = [(commands, _angles(planes, axis, first)) for commands, planes in swept]
    return np.clip(_lags(velocities, curves), 0.0, MOST_FIRST_LAG_S)


def _planes_of(points: LitPoints, velocity: float) -> tuple[Array, Array]:
    """(commands, planes (n, 4)) of the passages at one signed speed."""
    chosen = points.velocity_per_s == velocity
    command, at = points.command[chosen], points.points_m[chosen]
    low, high = np.percentile(command, [1, 99])
    c = (2 * command - low - high) / (high - low)

    def powers(order: int) -> Array:
        return np.stack([c**k for k in range(order + 1)], axis=-1)

    d, b, e = (powers(order) for order in _ORDERS)
    design = np.hstack([d, -b * at[:, 1:2], -e * at[:, 2:3]])
    weight = np.ones(len(c))
    for _ in range(6):  # points that other light than the line's gave are few and far off
        terms = np.linalg.lstsq(design * weight[:, None], at[:, 0] * weight, rcond=1e-10)[0]
        left = np.abs(at[:, 0] - design @ terms)
        weight = 1 / np.hypot(1, left / max(2 * float(np.median(left)), 1e-12))
    ends = np.cumsum([0, *(order + 1 for order in _ORDERS)])
    sampled = np.linspace(-_STEP, _STEP, 21)
    plane_d, plane_b, plane_e = (polynomial.polyval(sampled, terms[i:j]) for i, j in pairwise(ends))
    planes = np.stack([np.ones_like(sampled), plane_b, plane_e, plane_d], axis=-1)
    planes /= np.linalg.norm(planes[:, :3], axis=1, keepdims=True)
    return (sampled * (high - low) + low + high) / 2, planes


def _pivot(planes: Array) -> tuple[Array, Array, Array]:
    """(axis direction, its point nearest to the camera, normal of the middle plane) of planes (n, 4)."""
    axis = np.linalg.svd(planes[:, :3])[2][2]
    axis = axis if axis[1] >= 0 else -axis
    point = np.linalg.lstsq(planes[:, :3], planes[:, 3], rcond=1e-4)[0]
    middle = planes[len(planes) // 2, :3]
    return axis, point - (point @ axis) * axis, middle - (middle @ axis) * axis


def _angles(planes: Array, axis: Array, first: Array) -> Array:
    first = first / np.linalg.norm(first)
    return np.unwrap(np.arctan2(planes[:, :3] @ np.cross(axis, first), planes[:, :3] @ first))


def _lags(velocities: Array, curves: Sequence[tuple[Array, Array]]) -> tuple[float, float]:
    """Both lags, by least squares of c(angle) = c0 + velocity lag over the sweeps, at an angle in their middle."""
    ties = lag_groups(velocities)
    if not ties:
        return 0.0, 0.0
    middle = float(np.mean([np.median(angle) for _, angle in curves]))
    # full=True: no warning if all angles are the same, as with too few poses.
    commands = [polynomial.polyfit(angle - middle, command, 2, full=True)[0][0] for command, angle in curves]
    design = np.array(
        [[1.0] + [v if (FORWARD if v > 0 else BACKWARD) in tie else 0.0 for tie in ties] for v in velocities]
    )
    scale = np.abs(design).max(axis=0)
    values = np.linalg.lstsq(design / scale, np.array(commands), rcond=1e-8)[0] / scale
    lag = {name: float(value) for tie, value in zip(ties, values[1:], strict=True) for name in tie}
    return lag[FORWARD], lag[BACKWARD]


LEAST_TILT_RAD = np.radians(5.0)
"""Tilt between boards below which a refusal names the tilt as its reason."""
LEAST_THICKNESS = 0.01
"""Least thickness of the points about their best plane, as a share of their distance: less is one plane."""
LEAST_SPAN = 0.02
"""Least span of the commands, in command units: a line that hardly moved does not show how it turns."""
LEAST_LIT_SHARE = 0.1
"""Least share of the picture that the line must reach at a distance for depth to be judged there."""
MOST_DEPTH_SD_SHARE = 0.2
"""Largest sd of depth, as a share of the distance; a model with more is refused."""


def check_views(views: Sequence[View], sightings: Sequence[Sighting]) -> None:
    """Raise Degenerate unless two views show board and line, and the line moved across the board."""
    with_line = [seen for seen in sightings if seen.command.size]
    if len(sightings) == 0:
        raise Degenerate(
            "no-board", f"none of {len(views)} views shows the board; show all of it, closer or with more light"
        )
    if len(with_line) < 2:
        raise Degenerate(
            "one-pose" if len(sightings) < 2 else "no-line",
            f"{len(with_line)} of {len(views)} views show both the board and the line on it, limit 2 (condition number "
            "inf); show the board at 8 or more poses, at several distances and tilted differently",
        )
    commands = np.concatenate([seen.command for seen in with_line])
    low, high = np.percentile(commands, [1, 99])
    if high - low < LEAST_SPAN:
        raise Degenerate(
            "poor-coverage",
            f"line passed the board at commands {low:.4g} to {high:.4g} alone, limit a span of {LEAST_SPAN:g} "
            "(condition number inf); sweep further, or show the board where the line moves",
        )


def check_poses(points_m: Array, poses: Sequence[BoardPose]) -> None:
    """Raise Degenerate if all points (m, 3) at which the light met the boards lie in one plane."""
    middle = points_m.mean(axis=0)
    sizes = np.linalg.svd(points_m - middle, compute_uv=False) / np.sqrt(len(points_m))
    thickness = float(sizes[2] / np.linalg.norm(middle))
    if not thickness >= LEAST_THICKNESS:
        raise Degenerate(
            "coplanar",
            f"boards of all {len(poses)} views lie in one plane: the light's points leave it by {thickness:.2g} of "
            f"their distance, limit {LEAST_THICKNESS:g} (condition number "
            f"{condition_text(sizes[0] / max(sizes[2], 1e-300))}); show the board at other distances and tilted "
            "differently",
        )


def reason_of(poses: Sequence[BoardPose]) -> str:
    """'too-few-poses' or 'no-tilt': a guess at why boards at these poses determine too little."""
    return "too-few-poses" if spread_rad(poses) >= LEAST_TILT_RAD and len(poses) < 6 else "no-tilt"


def no_start(error: Exception, poses: Sequence[BoardPose]) -> Degenerate:
    """The error for views that fit no mirror, whether this shows in the first guess or in the fit."""
    return Degenerate(
        reason_of(poses),
        f"light on {len(poses)} boards fits no mirror: {error}; show the board at 8 or more poses, at several "
        "distances and tilted differently",
    )


def unfit(names: Sequence[str]) -> str:
    """Text that names the views that were not used."""
    return f"view{'s' if len(names) > 1 else ''} {', '.join(names)} left out: unlike the others"


def check_depth(
    model: RigModel,
    poses: Sequence[BoardPose],
    condition: float,
    velocity_per_s: float,
    misfit: float = 1.0,
    outliers: Sequence[str] = (),
) -> None:
    """Raise Degenerate if the line reaches nothing, or the poses hardly determine depth even without the misfit."""
    camera = model.camera
    x, y = np.meshgrid(np.linspace(0.1, 0.9, 7) * camera.width, np.linspace(0.1, 0.9, 5) * camera.height)
    for at_m in (AT_M, float(np.median([np.linalg.norm(pose.position_m) for pose in poses]))):
        command = command_at(model, x, y, at_m)
        sd = depth_sd_m(model, x, y, command, velocity_per_s)
        if np.isfinite(sd).mean() >= LEAST_LIT_SHARE:
            break
    else:
        raise Degenerate(
            reason_of(poses), f"line reaches nothing at {at_m:.3g} m; sweep further, or show the board at more poses"
        )
    usual = float(np.nanmedian(sd)) / math.sqrt(misfit)
    odd = f" ({unfit(outliers)})" if outliers else ""
    if usual > MOST_DEPTH_SD_SHARE * at_m:
        raise Degenerate(
            reason_of(poses),
            f"depth at {at_m:.3g} m would be known to {digits(usual)} m from {len(poses)} poses{odd}, limit "
            f"{MOST_DEPTH_SD_SHARE * at_m:.3g} m (condition number {condition_text(condition)}); show the board at "
            "more poses, at other distances and tilted differently",
        )
