"""The camera from corners of a board at several poses: OpenCV's calibration, made robust and told how well it knows.

Three kinds of corners are left out and named: a view that does not fit the others (the board moved, its corners in
another order), single corners that do not fit their view, and a view whose board is seen from behind, which is a
mirror image. The fit is that of cv2.calibrateCamera on what is left. The covariance is s^2 (J^T J)^-1 with the poses
free and s^2 the residuals' variance, so it counts what the lens model misses as noise.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.board.board import Board
from calibration.board.coverage import Coverage, coverage_of
from calibration.camera_fit.solve import LEAST_SD_PX, Problem, Solution, rms
from calibration.errors import CalibrationError, Degenerate
from calibration.model.camera import Camera
from calibration.model.covariance import Covariance
from calibration.model.distortion import TERM_COUNTS
from calibration.robust import robust_sd
from calibration.views import LEAST_ACROSS_PX, BoardPose, Corners, View

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_FEWEST_CORNERS = 8
"""Of a view: four give the pose, the rest say whether it fits."""
_VIEW_LIMIT = 2.5
"""A view is an outlier where its residuals, in sds of its corners, are so many times those of the usual view."""
_CORNER_LIMIT = 6.0
"""Sds of either coordinate beyond which a corner is left out."""
_FEW_CORNERS = 1
"""Left out of a view without naming it."""
_LEAST_CLOSE = 0.7
"""Share of a view's corners; with fewer that fit, none is used."""
_FEWEST_VIEWS = 3
"""That stay when outliers leave."""
_MAX_ROUNDS = 20


@dataclass(frozen=True, slots=True, eq=False)
class CameraFit:
    """A camera and what it was made from. Sequences run over the views that have corners, named in `views`.

    residual_px: (n, 2) float64 projected less seen, of every corner. used: (n,) bool, those in the fit. rms_px: of
    those, of the distance. outliers: names of the views that do not fit, wholly or in more than one corner. condition:
    of the normal equations at unit diagonal. coverage: of the views that are in the fit.
    """

    camera: Camera
    views: tuple[str, ...]
    poses: tuple[BoardPose, ...]
    residual_px: tuple[Array, ...]
    used: tuple[Mask, ...]
    rms_px: float
    covariance: Covariance
    condition: float
    outliers: tuple[str, ...]
    coverage: Coverage

    @property
    def kept(self) -> tuple[str, ...]:
        """Names of the views that are in the fit, if only with a part of their corners."""
        return tuple(name for name, mask in zip(self.views, self.used, strict=True) if mask.any())

    @property
    def dropped(self) -> tuple[str, ...]:
        """Names of the views of which no corner is in the fit."""
        return tuple(name for name, mask in zip(self.views, self.used, strict=True) if not mask.any())

    @property
    def sd(self) -> dict[str, float]:
        """Of every parameter, by name: fx fy cx cy in pixels, the distortion's in its own units."""
        spread = np.sqrt(np.diag(self.covariance.matrix))
        return dict(zip(self.covariance.names, spread.tolist(), strict=True))

    @property
    def view_rms_px(self) -> Array:
        """(views,) float64 of all corners of each view, those left out too."""
        return np.array([rms(residual) for residual in self.residual_px])


def fit_camera(
    views: Sequence[View], board: Board, size: tuple[int, int], *, distortion_terms: int = 5, robust: bool = True
) -> CameraFit:
    """The camera of pictures of `size` (width, height) from the corners in `views`.

    distortion_terms: 0, 4, 5, 8, 12 or 14, OpenCV's. robust: leave out what does not fit; else every corner counts.
    Raises Degenerate: no-board, mirrored, one-pose, coplanar, too-few-poses; the message has the condition number.
    """
    if distortion_terms not in (0, *TERM_COUNTS):
        raise CalibrationError(f"distortion has {distortion_terms} terms; OpenCV defines 0, {str(TERM_COUNTS)[1:-1]}")
    seen = [(view, view.corners) for view in views if view.corners is not None]
    seen = [
        (view, corners)
        for view, corners in seen
        if len(corners.ids) >= _FEWEST_CORNERS and corners.across_px >= LEAST_ACROSS_PX
    ]
    if not seen:
        raise Degenerate(
            "no-board", f"none of {len(views)} views shows the board; show all of it, closer or with more light"
        )
    names = [view.name for view, _ in seen]
    corners = [found for _, found in seen]
    behind = np.array([_is_mirrored(found, board) for found in corners])
    if behind.all():
        raise Degenerate("mirrored", "the board is mirrored in every view; turn the print or correct the orientation")
    problem = Problem(board, size, distortion_terms, corners)
    used = [np.full(len(found.ids), not back) for found, back in zip(corners, behind, strict=True)]
    problem.check(used)
    solution = problem.solve(used)
    if robust:
        solution, used = _without_outliers(problem, solution, used)
    variance, normal = problem.judged(solution, used)
    kept = [i for i, mask in enumerate(used) if mask.any()]
    shown = [seen[i][0] for i in kept]
    return CameraFit(
        camera=Camera(size[0], size[1], solution.matrix, solution.distortion),
        views=tuple(names),
        poses=solution.poses,
        residual_px=solution.residual_px,
        used=tuple(used),
        rms_px=rms(np.concatenate([r[mask] for r, mask in zip(solution.residual_px, used, strict=True)])),
        covariance=normal.covariance(variance),
        condition=normal.condition,
        outliers=tuple(n for n, mask in zip(names, used, strict=True) if (~mask).sum() > _FEW_CORNERS),
        coverage=coverage_of(shown, [solution.poses[i] for i in kept], board, size),
    )


def _without_outliers(problem: Problem, solution: Solution, used: list[Mask]) -> tuple[Solution, list[Mask]]:
    """The fit without what does not fit: the worst view at a time, then single corners, until nothing changes."""
    dropped = {i for i, mask in enumerate(used) if not mask.any()}
    behind = frozenset(dropped)
    relative = _relative_sds(problem.corners)
    for _ in range(_MAX_ROUNDS):
        scaled = [residual / sd for residual, sd in zip(solution.residual_px, relative, strict=True)]
        scale = np.array([robust_sd(residual) for residual in scaled])
        inside = [i for i in range(len(used)) if i not in dropped]
        usual = max(float(np.median(scale[inside])), LEAST_SD_PX)
        worst = max(inside, key=lambda i: scale[i])
        again = {i for i in dropped - behind if scale[i] <= _VIEW_LIMIT * usual}
        if scale[worst] > _VIEW_LIMIT * usual and len(inside) > _FEWEST_VIEWS:
            dropped = dropped | {worst}
            new = [mask & (i != worst) for i, mask in enumerate(used)]
        else:
            dropped = dropped - again
            new = [_close(residual, usual) & (i not in dropped) for i, residual in enumerate(scaled)]
        if all(np.array_equal(one, other) for one, other in zip(new, used, strict=True)):
            break
        used = new
        solution = problem.solve(used)
    return solution, used


def _relative_sds(corners: Sequence[Corners]) -> list[Array]:
    """(n, 1) of every view: its corners' sds against the usual one."""
    sds = [found.likely_sd_px for found in corners]
    usual = float(np.median(np.concatenate(sds)))
    return [(sd / usual)[:, None] for sd in sds]


def _close(residual_px: Array, sd_px: float) -> Mask:
    """Corners within the limit; none of a view that has more beyond it than it should."""
    close: Mask = np.abs(residual_px).max(axis=1) <= _CORNER_LIMIT * sd_px
    return close if close.mean() >= _LEAST_CLOSE else np.zeros_like(close)


def _is_mirrored(corners: Corners, board: Board) -> bool:
    """True where the numbering runs against the clock: the board seen from behind, or in a mirror."""
    homography, _ = cv2.findHomography(board.corners_m[corners.ids, :2], corners.px)
    if homography is None:
        return False
    middle = np.array([*board.size_m, 2.0]) / 2
    # The sign of the map's Jacobian at the board's middle: det H / w^3.
    return bool(np.linalg.det(homography) * (homography[2] @ middle) < 0)
