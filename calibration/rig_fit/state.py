"""The state of a rig's fit (model, timing, poses, residuals), and the sightings to which it is fitted.

A sighting is a pose's corners and passages, cleaned and in the order that the fit needs.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.arrays import Array
from calibration.board.board import PAPER_SQUARES, Board
from calibration.model.camera import Camera
from calibration.model.parameters import ROW_DELAY, TIMES, with_parameters
from calibration.model.rig_model import RigModel
from calibration.model.scanner import PivotScanner
from calibration.rig_fit.rows import Rows, Terms, corner_rows, passage_rows, refined_rays
from calibration.views import FEWEST_CORNERS, LEAST_ACROSS_PX, USUAL_CORNER_SD_PX, BoardPose, Corners, Passages, View

EDGE_PX = 1.5
"""Passages this close to the board's outline are left out: such pixels see what stands behind it too."""
LEAST_SD_SHARE = 0.05
"""Least sd of a passage, as a share of its sweep's median: a few that are too sure of themselves must not decide."""
LEAST_CORNER_SD_PX = 0.02
"""Error that the print, the lens model and the finding of corners leave, however bright the picture."""
FEWEST_PASSAGES = 30
"""Fewest passages of a sweep; fewer say nothing that the noise can be told from."""


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """One view. corners_m (n, 3), corner_px (n, 2), corner_scale (n,): sd of a corner relative to the others.

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
    """The corners of a view and those of its passages that lie on the board's paper."""
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
    """Relative sd of each corner, 1 if the picture gave none."""
    if corners.sd_px is None:
        return np.ones(len(corners.ids))
    return np.hypot(corners.likely_sd_px, LEAST_CORNER_SD_PX) / USUAL_CORNER_SD_PX


def usable(views: Sequence[View]) -> list[View]:
    """The views with enough corners for a pose, without corners at invalid positions."""
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
    """The passages of a sweep within the board's outline, sorted by command."""
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
    """The model with lags of 0; timing (3,): both lags and row delay in s, of any sign; per view poses and rays
    (2, m)."""

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
        """The state after changes of shared parameters (p,) and of poses (6,). Raises CalibrationError if there is no
        such model.
        """
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
    """The state for a model, without the model's own lags."""
    rays = tuple(np.stack(model.camera.tangents_at(seen.x_px, seen.y_px)) for seen in sightings)
    timeless = replace(model, lag_s=type(model.lag_s)(), row_delay_s=0.0, covariance=None)
    return RigState(timeless, np.asarray(timing, np.float64), tuple(poses), rays)


def with_terms_of(state: RigState, groups: Sequence[Sequence[str]]) -> RigState:
    """The state with all mirror terms that are not named set to 0."""
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
