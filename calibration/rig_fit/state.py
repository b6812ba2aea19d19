"""Where a fit of a rig stands: the model, its timing, the poses, and all residuals at that point."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.model.parameters import ROW_DELAY, TIMES, with_parameters
from calibration.model.rig_model import RigModel
from calibration.model.scanner import PivotScanner
from calibration.rig_fit.rows import Rows, Terms, corner_rows, passage_rows, refined_rays
from calibration.rig_fit.sightings import Sighting
from calibration.views import BoardPose

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class RigState:
    """model: camera and PivotScanner, its lags 0. timing: (3,) lag_forward, lag_backward, row_delay in s, any sign.

    poses, rays ((2, m) of the passages' pixels): per view.
    """

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
        """Residuals and derivatives of one view: of its corners (pixels) and of its passages (command units)."""
        camera, pose = self.model.camera, self.poses[view]
        corners = corner_rows(camera, terms, pose, seen.corners_m, seen.corner_px)
        passages = passage_rows(
            camera, terms, self.scanner, self.model.source_m, self.timing, pose, self.rays[view], seen.command,
            seen.y_px, seen.velocity_per_s,
        )  # fmt: skip
        return corners, passages

    def stepped(self, terms: Terms, shared: Array, poses: Sequence[Array], sightings: Sequence[Sighting]) -> "RigState":
        """Moved by changes of the shared parameters (p,) and of each pose (6,). CalibrationError: no such model."""
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
    """The state at a model, whose own lags are left aside."""
    rays = tuple(np.stack(model.camera.tangents_at(seen.x_px, seen.y_px)) for seen in sightings)
    timeless = replace(model, lag_s=type(model.lag_s)(), row_delay_s=0.0, covariance=None)
    return RigState(timeless, np.asarray(timing, np.float64), tuple(poses), rays)


def with_terms_of(state: RigState, groups: Sequence[Sequence[str]]) -> RigState:
    """The state without those terms of the mirror that are not named: they are 0."""
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
    import cv2

    turned = cv2.Rodrigues(cv2.Rodrigues(change[:3])[0] @ pose.matrix)[0]
    return BoardPose(np.asarray(turned, np.float64).ravel(), pose.position_m + change[3:])
