"""The camera from corners of a board at several poses: OpenCV's calibration, made robust and with an uncertainty.

Three kinds of corners are left out: those of a view that does not fit the others (because the board moved or its
corners are in another order), single corners that do not fit their view, and those of a board seen from behind, which
is a mirror image. Views that lose more than one corner are named. cv2.calibrateCamera fits the remaining corners. The
covariance is s^2 (J^T J)^-1 with the poses free, J the derivatives of the corners' pixels and s^2 the residuals'
variance (LEAST_SD_PX squared at least), so it counts errors of the lens model as noise.

The normal equations, with free poses, decide whether the corners determine a camera: by their condition number and by
the sd of the focal length. The angles between the boards only decide how a refusal is worded, and whether all
views show one pose.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.arrays import Array, Mask
from calibration.board.board import Board, spread_rad
from calibration.errors import Degenerate, condition_text
from calibration.model.camera import Camera
from calibration.model.parameters import DISTORTION, MATRIX
from calibration.model.rig_model import Covariance
from calibration.views import LEAST_ACROSS_PX, NO_POSE, BoardPose, Corners, View, robust_sd

Kind = TypeVar("Kind")
_POSE = 6
"""Columns of rotation and position in OpenCV's derivatives; those of fx fy cx cy and the distortion follow."""


@dataclass(frozen=True, slots=True, eq=False)
class Normal:
    """Normal equations of a camera. names: (p,) its parameters. matrix: (p, p) float64, J^T J after elimination of all
    poses; J: derivatives of the corners' pixels by the parameters, each in its own unit."""

    names: tuple[str, ...]
    matrix: Array

    @property
    def condition(self) -> float:
        """Condition number of the matrix scaled to a unit diagonal; inf if it is singular."""
        scale = np.sqrt(np.diag(self.matrix))
        if not np.all(np.isfinite(scale)) or not np.all(scale > 0):
            return float("inf")
        eigen = np.linalg.eigvalsh(self.matrix / np.outer(scale, scale))
        return float(eigen[-1] / eigen[0]) if eigen[0] > 0 else float("inf")

    def covariance(self, variance_px2: float) -> Covariance:
        """The covariance if each coordinate of a corner has this variance. Raises CalibrationError or LinAlgError if
        the matrix is singular."""
        scale = np.sqrt(np.diag(self.matrix))
        inverse = np.linalg.inv(self.matrix / np.outer(scale, scale)) / np.outer(scale, scale)
        return Covariance(self.names, variance_px2 * (inverse + inverse.T) / 2)


LEAST_SD_PX = 0.01
"""Least sd of corners: they are never better than this, however well they fit."""
_MOST_FOCAL_SD = 0.05
"""Largest relative sd of the focal length: above, depth would be wrong by as much."""
_MOST_CONDITION = 1e11
"""Largest condition number of the normal matrix at unit diagonal: beyond, doubles lose its smallest eigenvalue."""
_PARALLEL_RAD = float(np.radians(3.0))
_SAME_PLACE = 0.02
"""Largest distance between parallel boards at one pose, as a share of their distance from the camera."""
_GUESSED_FOCAL = (1.2, 0.7, 2.5)
"""Focal lengths, in widths of the picture, to start from where OpenCV's own start fails."""
_FLAGS = {
    0: cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST,
    4: cv2.CALIB_FIX_K3,
    5: 0,
    8: cv2.CALIB_RATIONAL_MODEL,
    12: cv2.CALIB_RATIONAL_MODEL | cv2.CALIB_THIN_PRISM_MODEL,
    14: cv2.CALIB_RATIONAL_MODEL | cv2.CALIB_THIN_PRISM_MODEL | cv2.CALIB_TILTED_MODEL,
}


@dataclass(frozen=True, slots=True, eq=False)
class CameraSolution:
    """A camera: its matrix (3, 3) in pixels and the terms of its distortion in OpenCV's order; and for every view the
    pose and the residuals (n, 2), projected minus seen.
    """

    matrix: Array
    distortion: Array
    poses: tuple[BoardPose, ...]
    residual_px: tuple[Array, ...]


@dataclass(frozen=True, slots=True, eq=False)
class CameraProblem:
    """Corners of one board in pictures of `size` (width, height), and the number of distortion terms to find."""

    board: Board
    size: tuple[int, int]
    terms: int
    corners: Sequence[Corners]

    def points_m(self, view: int) -> Array:
        """(n, 3) float64, the view's corners on the board."""
        return self.board.corners_m[self.corners[view].ids]

    def check(self, used: Sequence[Mask]) -> None:
        """Raise Degenerate if all views show the board at one pose, or if a view's corners give no pose."""
        rough = self._rough(used)
        shown = _of_used(rough.poses, used)
        places = np.stack([pose.to_camera(np.array([*self.board.size_m, 0.0]) / 2) for pose in shown])
        off = np.linalg.norm(places - places[0], axis=1).max()
        if not (spread_rad(shown) < _PARALLEL_RAD and off < _SAME_PLACE * np.linalg.norm(places[0])):
            return
        raise Degenerate(
            "one-pose",
            f"{len(shown)} view{'s' * (len(shown) > 1)} of the board, all at one pose (condition number "
            f"{condition_text(self._normal(used, rough).condition)}): a camera takes three poses or more; show the "
            "board tilted to both sides, near and far",
        )

    def solve(self, used: Sequence[Mask]) -> CameraSolution:
        """The camera, by a least-squares fit to the used corners, and the poses of all views.

        Raises Degenerate if the fit fails.
        """
        kept = [i for i, mask in enumerate(used) if mask.any()]
        points = [self.points_m(i)[used[i]].astype(np.float32) for i in kept]
        px = [self.corners[i].px[used[i]].astype(np.float32) for i in kept]
        found = self._calibrated(points, px)
        if found is None:
            raise self._refusal(used, self._rough(used), "no camera fits")
        matrix, distortion, of_kept = found
        at = dict(zip(kept, of_kept, strict=True))
        poses = tuple(at[i] if i in at else self._pose(i, matrix, distortion) for i in range(len(used)))
        residual = []
        for i, pose in enumerate(poses):
            expected, _ = cv2.projectPoints(self.points_m(i), pose.rotation, pose.position_m, matrix, distortion)
            residual.append(np.asarray(expected.reshape(-1, 2) - self.corners[i].px, np.float64))
        return CameraSolution(matrix, distortion, poses, tuple(residual))

    def judged(self, solution: CameraSolution, used: Sequence[Mask]) -> tuple[float, Normal]:
        """(variance of a corner's coordinate in px^2, normal equations). Raises Degenerate if the corners determine no
        camera.
        """
        normal = self._normal(used, solution)
        off = np.concatenate([r[mask] for r, mask in zip(solution.residual_px, used, strict=True)])
        names = normal.names
        free = off.size - 6 * sum(bool(mask.any()) for mask in used) - len(names)
        if free < 1 or not np.isfinite(off).all():
            raise self._refusal(used, solution, f"{off.size // 2} corners for {len(names)} parameters")
        variance = max(float(np.sum(off**2)) / free, LEAST_SD_PX**2)
        if not normal.condition < _MOST_CONDITION:
            fewer = 4 + min(self.terms, 5)
            if Normal(names[:fewer], normal.matrix[:fewer, :fewer]).condition < _MOST_CONDITION:
                raise Degenerate(
                    "too-few-poses",
                    f"{self.terms} terms of distortion are more than these views determine (condition "
                    f"number {condition_text(normal.condition)}, {condition_text(_MOST_CONDITION)} at most); take 5, "
                    "or fill the picture",
                )
            raise self._refusal(used, solution, "the focal length cannot be told from the distance")
        sd = np.sqrt(np.diag(normal.covariance(variance).matrix))[:2] / np.diag(solution.matrix)[:2]
        if not sd.max() < _MOST_FOCAL_SD:
            said = f"the focal length is known to {sd.max():.1%} only ({_MOST_FOCAL_SD:.0%} at most)"
            raise self._refusal(used, solution, said)
        return variance, normal

    def _calibrated(
        self, points: list[NDArray[np.float32]], px: list[NDArray[np.float32]]
    ) -> tuple[Array, Array, list[BoardPose]] | None:
        for focal in (None, *_GUESSED_FOCAL):
            start = None if focal is None else self._guess(focal)
            flags = _FLAGS[self.terms] | (0 if start is None else cv2.CALIB_USE_INTRINSIC_GUESS)
            stop = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-10)
            try:
                _, matrix, distortion, turns, shifts = cv2.calibrateCamera(
                    points, px, self.size, start, None, flags=flags, criteria=stop
                )
            except cv2.error:
                continue
            poses = [
                BoardPose(np.ravel(r).astype(float), np.ravel(t).astype(float))
                for r, t in zip(turns, shifts, strict=True)
            ]
            terms = np.ravel(distortion)[: self.terms].astype(np.float64)
            sound = [matrix, terms, *turns, *shifts]
            if all(np.isfinite(part).all() for part in sound) and min(matrix[0, 0], matrix[1, 1]) > 0:
                return np.asarray(matrix, np.float64), terms, poses
        return None

    def _pose(self, view: int, matrix: Array, distortion: Array) -> BoardPose:
        points, px = self.points_m(view), self.corners[view].px
        try:
            _, turn, shift = cv2.solvePnP(points, px, matrix, distortion, flags=cv2.SOLVEPNP_IPPE)
            turn, shift = cv2.solvePnPRefineLM(points, px, matrix, distortion, turn, shift)
        except cv2.error as error:
            raise Degenerate("no-board", NO_POSE) from error
        return BoardPose(np.ravel(turn), np.ravel(shift))

    def _rough(self, used: Sequence[Mask]) -> CameraSolution:
        """A guessed camera, and the poses at which it sees the board in all views."""
        matrix = self._guess(_GUESSED_FOCAL[0])
        poses = tuple(self._pose(i, matrix, np.zeros(5)) for i in range(len(used)))
        return CameraSolution(matrix, np.zeros(self.terms), poses, ())

    def _normal(self, used: Sequence[Mask], solution: CameraSolution) -> Normal:
        """The normal equations of the camera, with as many terms of distortion as are fitted."""
        terms, distortion = self.terms, solution.distortion
        total = np.zeros((4 + terms, 4 + terms))
        given = np.zeros(max(len(distortion), 5)) if terms <= 5 else np.zeros(14 if terms > 8 else 8)
        given[: len(distortion)] = distortion
        for i, (mask, pose) in enumerate(zip(used, solution.poses, strict=True)):
            if mask.any():
                points = self.points_m(i)[mask]
                _, slopes = cv2.projectPoints(points, pose.rotation, pose.position_m, solution.matrix, given)
                camera_part = slopes[:, _POSE : _POSE + 4 + terms]
                # The effect of a change of the camera that no change of the pose undoes (Schur complement by QR).
                basis, _ = np.linalg.qr(slopes[:, :_POSE])
                rest = camera_part - basis @ (basis.T @ camera_part)
                total += rest.T @ rest
        return Normal((*MATRIX, *DISTORTION[:terms]), total)

    def _guess(self, focal_widths: float) -> Array:
        width, height = self.size
        focal = focal_widths * width
        return np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]], np.float64)

    def _refusal(self, used: Sequence[Mask], solution: CameraSolution, why: str) -> Degenerate:
        shown = _of_used(solution.poses, used)
        spread = spread_rad(shown)
        said = f"{why} (condition number {condition_text(self._normal(used, solution).condition)}) from {len(shown)} "
        said += f"views, turned by up to {np.degrees(spread):.1f} degrees against each other"
        if spread < 3 * _PARALLEL_RAD:
            return Degenerate("coplanar", f"the boards are parallel: {said}; tilt the board by 30 degrees to all sides")
        return Degenerate("too-few-poses", f"too few poses: {said}; show the board at more poses, all over the picture")


def _of_used(of_views: Sequence[Kind], used: Sequence[Mask]) -> tuple[Kind, ...]:
    """The entries of those views that have a corner in use."""
    return tuple(each for each, mask in zip(of_views, used, strict=True) if mask.any())


def rms(residual_px: Array) -> float:
    """Root of the mean of dx^2 + dy^2, which is the rms distance as OpenCV counts it; NaN without residuals."""
    return float(np.sqrt(np.mean(np.sum(residual_px**2, axis=-1)))) if len(residual_px) else float("nan")


_FEWEST_CORNERS = 8
"""Fewest corners of a view: four determine the pose, the others check it."""
_VIEW_LIMIT = 2.5
"""A view is an outlier if its residuals, in sds of its corners, exceed those of the usual view by this factor."""
_CORNER_LIMIT = 6.0
"""Sds of either coordinate beyond which a corner is left out."""
_FEW_CORNERS = 1
"""Number of corners that may be left out of a view without naming it."""
_LEAST_CLOSE = 0.7
"""Least share of a view's corners that must fit; with fewer, none of them is used."""
_FEWEST_VIEWS = 3
"""With so few views left in the fit, none is dropped for its scatter; its corners may still be left out."""
_MAX_ROUNDS = 20


@dataclass(frozen=True, slots=True, eq=False)
class CameraFit:
    """A camera and the data it was fitted to. Sequences run over the views with enough corners, which `views` names.

    residual_px: (n, 2) float64, projected minus seen, of every corner. used: (n,) bool, corners in the fit. rms_px: rms
    distance of the corners in the fit. outliers: names of the views with more than one corner left out, mirrored ones
    too. condition: condition number of the normal equations at unit diagonal. spread_rad: largest angle between the
    boards in the fit.
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
    spread_rad: float

    @property
    def kept(self) -> tuple[str, ...]:
        """Names of the views with at least one corner in the fit."""
        return _of_used(self.views, self.used)

    @property
    def dropped(self) -> tuple[str, ...]:
        """Names of the views without any corner in the fit."""
        return tuple(name for name, mask in zip(self.views, self.used, strict=True) if not mask.any())

    @property
    def sd(self) -> dict[str, float]:
        """Standard deviation of every parameter by name: fx fy cx cy in pixels, the distortion's in its own units."""
        spread = np.sqrt(np.diag(self.covariance.matrix))
        return dict(zip(self.covariance.names, spread.tolist(), strict=True))

    @property
    def view_rms_px(self) -> Array:
        """(views,) float64, rms distance of all corners of each view, including those left out."""
        return np.array([rms(residual) for residual in self.residual_px])


def fit_camera(views: Sequence[View], board: Board, size: tuple[int, int], *, distortion_terms: int = 5) -> CameraFit:
    """The camera for pictures of `size` (width, height), from the corners in `views`.

    distortion_terms: 0, 4, 5, 8, 12 or 14, as in OpenCV. Corners that do not fit are left out. Raises Degenerate with
    no-board, mirrored, one-pose, coplanar or too-few-poses; the last three give the condition number.
    """
    every = [(view.name, view.corners) for view in views if view.corners is not None]
    seen = [one for one in every if len(one[1].ids) >= _FEWEST_CORNERS and one[1].across_px >= LEAST_ACROSS_PX]
    if not seen:
        raise Degenerate(
            "no-board", f"none of {len(views)} views shows the board; show all of it, closer or with more light"
        )
    names, corners = zip(*seen, strict=True)
    behind = np.array([_is_mirrored(found, board) for found in corners])
    if behind.all():
        raise Degenerate("mirrored", "the board is mirrored in every view; turn the print or correct the orientation")
    problem = CameraProblem(board, size, distortion_terms, corners)
    used = [np.full(len(found.ids), not back) for found, back in zip(corners, behind, strict=True)]
    problem.check(used)
    solution = problem.solve(used)
    solution, used = _without_outliers(problem, solution, used)
    variance, normal = problem.judged(solution, used)
    return CameraFit(
        camera=Camera(size[0], size[1], solution.matrix, solution.distortion),
        views=names,
        poses=solution.poses,
        residual_px=solution.residual_px,
        used=tuple(used),
        rms_px=rms(np.concatenate([r[mask] for r, mask in zip(solution.residual_px, used, strict=True)])),
        covariance=normal.covariance(variance),
        condition=normal.condition,
        outliers=tuple(n for n, mask in zip(names, used, strict=True) if (~mask).sum() > _FEW_CORNERS),
        spread_rad=spread_rad(_of_used(solution.poses, used)),
    )


def _without_outliers(
    problem: CameraProblem, solution: CameraSolution, used: list[Mask]
) -> tuple[CameraSolution, list[Mask]]:
    """Repeat the fit without outliers, first one view at a time, then single corners, in at most _MAX_ROUNDS rounds."""
    dropped = {i for i, mask in enumerate(used) if not mask.any()}
    behind = frozenset(dropped)
    sds = [found.likely_sd_px for found in problem.corners]
    usual_sd = float(np.median(np.concatenate(sds)))
    relative = [(sd / usual_sd)[:, None] for sd in sds]
    for _ in range(_MAX_ROUNDS):
        scaled = [residual / sd for residual, sd in zip(solution.residual_px, relative, strict=True)]
        scale = np.array([robust_sd(residual) for residual in scaled])
        inside = [i for i in range(len(used)) if i not in dropped]
        usual = max(float(np.median(scale[inside])), LEAST_SD_PX)
        worst = max(inside, key=lambda i: scale[i])
        if scale[worst] > _VIEW_LIMIT * usual and len(inside) > _FEWEST_VIEWS:
            dropped = dropped | {worst}
            new = [mask & (i != worst) for i, mask in enumerate(used)]
        else:
            dropped = {i for i in dropped if i in behind or scale[i] > _VIEW_LIMIT * usual}
            new = [_close(residual, usual) & (i not in dropped) for i, residual in enumerate(scaled)]
        if all(np.array_equal(one, other) for one, other in zip(new, used, strict=True)):
            break
        used = new
        solution = problem.solve(used)
    return solution, used


def _close(residual_px: Array, sd_px: float) -> Mask:
    """Corners within _CORNER_LIMIT; none if these are less than _LEAST_CLOSE of the view's corners."""
    close: Mask = np.abs(residual_px).max(axis=1) <= _CORNER_LIMIT * sd_px
    return close if close.mean() >= _LEAST_CLOSE else np.zeros_like(close)


def _is_mirrored(corners: Corners, board: Board) -> bool:
    """Whether the corners are numbered in the opposite sense: the board is seen from behind, or in a mirror."""
    homography, _ = cv2.findHomography(board.corners_m[corners.ids, :2], corners.px)
    if homography is None:
        return False
    middle = np.array([*board.size_m, 2.0]) / 2
    # The sign of the map's Jacobian at the board's middle: det H / w^3.
    return bool(np.linalg.det(homography) * (homography[2] @ middle) < 0)
