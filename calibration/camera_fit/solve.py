"""OpenCV's calibration of a camera from corners, and whether they determine it.

What decides is the normal matrix: its condition number and the sd it gives the focal length. How far the boards are
turned against each other only chooses the word for the refusal.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.board.board import Board
from calibration.board.coverage import spread_rad
from calibration.camera_fit.normal import Normal, camera_normal
from calibration.digits import condition_text
from calibration.errors import Degenerate
from calibration.views import NO_POSE, BoardPose, Corners

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

LEAST_SD_PX = 0.01
"""Corners are never better than this, however well they fit."""
_MOST_FOCAL_SD = 0.05
"""Of the focal length, relative: above, depth would be wrong by as much."""
_MOST_CONDITION = 1e11
"""Of the normal matrix at unit diagonal: beyond, doubles lose its smallest eigenvalue."""
_PARALLEL_RAD = float(np.radians(3.0))
_SAME_PLACE = 0.02
"""Of the distance: boards nearer to each other than that, and parallel, are one pose."""
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
class Solution:
    """A camera, and of every view the pose and the residuals (n, 2), projected less seen."""

    matrix: Array
    distortion: Array
    poses: tuple[BoardPose, ...]
    residual_px: tuple[Array, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """Corners of one board in pictures of `size` (width, height), and the number of distortion terms to find."""

    board: Board
    size: tuple[int, int]
    terms: int
    corners: Sequence[Corners]

    def points_m(self, view: int) -> Array:
        """(n, 3) float64 of the view's corners on the board."""
        return self.board.corners_m[self.corners[view].ids]

    def check(self, used: Sequence[Mask]) -> None:
        """Raise Degenerate where there is one pose only."""
        kept = [i for i, mask in enumerate(used) if mask.any()]
        matrix = self._guess(_GUESSED_FOCAL[0])
        poses = [self._pose(i, matrix, np.zeros(5)) for i in range(len(used))]
        if len(kept) > 1 and not self._one_place([poses[i] for i in kept]):
            return
        condition = self._normal(used, Solution(matrix, np.zeros(self.terms), tuple(poses), ())).condition
        raise Degenerate(
            "one-pose",
            f"{len(kept)} view{'s' * (len(kept) > 1)} of the board, all at one pose (condition number "
            f"{condition_text(condition)}): a camera takes three poses or more; show the board tilted to both sides, "
            "near and far",
        )

    def solve(self, used: Sequence[Mask]) -> Solution:
        """The least squares camera of the corners used, and the poses of all views. Raises Degenerate."""
        kept = [i for i, mask in enumerate(used) if mask.any()]
        points = [self.points_m(i)[used[i]].astype(np.float32) for i in kept]
        px = [self.corners[i].px[used[i]].astype(np.float32) for i in kept]
        found = self._calibrated(points, px)
        if found is None:
            matrix = self._guess(_GUESSED_FOCAL[0])
            poses = tuple(self._pose(i, matrix, np.zeros(5)) for i in range(len(used)))
            normal = self._normal(used, Solution(matrix, np.zeros(self.terms), poses, ()))
            raise self._refusal(used, poses, normal, "no camera fits")
        matrix, distortion, of_kept = found
        at = dict(zip(kept, of_kept, strict=True))
        poses = tuple(at[i] if i in at else self._pose(i, matrix, distortion) for i in range(len(used)))
        residual = tuple(self._residual(i, matrix, distortion, pose) for i, pose in enumerate(poses))
        return Solution(matrix, distortion, poses, residual)

    def judged(self, solution: Solution, used: Sequence[Mask]) -> tuple[float, Normal]:
        """(variance of a corner's coordinate in px^2, normal matrix); Degenerate where they determine no camera."""
        normal = self._normal(used, solution)
        off = np.concatenate([r[mask] for r, mask in zip(solution.residual_px, used, strict=True)])
        free = off.size - 6 * sum(bool(mask.any()) for mask in used) - len(normal.names)
        if free < 1 or not np.isfinite(off).all():
            raise self._refusal(
                used, solution.poses, normal, f"{off.size // 2} corners for {len(normal.names)} parameters"
            )
        variance = max(float(np.sum(off**2)) / free, LEAST_SD_PX**2)
        if not normal.condition < _MOST_CONDITION:
            if normal.first(4 + min(self.terms, 5)).condition < _MOST_CONDITION:
                raise Degenerate(
                    "too-few-poses",
                    f"{self.terms} terms of distortion are more than these views determine (condition "
                    f"number {condition_text(normal.condition)}, {condition_text(_MOST_CONDITION)} at most); take 5, "
                    "or fill the picture",
                )
            raise self._refusal(used, solution.poses, normal, "the focal length cannot be told from the distance")
        sd = np.sqrt(np.diag(normal.covariance(variance).matrix))[:2] / np.diag(solution.matrix)[:2]
        if not sd.max() < _MOST_FOCAL_SD:
            said = f"the focal length is known to {sd.max():.1%} only ({_MOST_FOCAL_SD:.0%} at most)"
            raise self._refusal(used, solution.poses, normal, said)
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
            sound = [matrix, terms, *(pose.rotation for pose in poses), *(pose.position_m for pose in poses)]
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

    def _residual(self, view: int, matrix: Array, distortion: Array, pose: BoardPose) -> Array:
        expected, _ = cv2.projectPoints(self.points_m(view), pose.rotation, pose.position_m, matrix, distortion)
        return np.asarray(expected.reshape(-1, 2) - self.corners[view].px, np.float64)

    def _normal(self, used: Sequence[Mask], solution: Solution) -> Normal:
        kept = [i for i, mask in enumerate(used) if mask.any()]
        points = [self.points_m(i)[used[i]] for i in kept]
        poses = [solution.poses[i] for i in kept]
        return camera_normal(points, poses, solution.matrix, solution.distortion, self.terms)

    def _guess(self, focal_widths: float) -> Array:
        width, height = self.size
        focal = focal_widths * width
        return np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]], np.float64)

    def _one_place(self, poses: Sequence[BoardPose]) -> bool:
        """True where all boards are parallel and at the same place."""
        places = np.stack([pose.to_camera(np.array([*self.board.size_m, 0.0]) / 2) for pose in poses])
        off = np.linalg.norm(places - places[0], axis=1).max()
        return spread_rad(poses) < _PARALLEL_RAD and bool(off < _SAME_PLACE * np.linalg.norm(places[0]))

    def _refusal(self, used: Sequence[Mask], poses: Sequence[BoardPose], normal: Normal, why: str) -> Degenerate:
        shown = [pose for pose, mask in zip(poses, used, strict=True) if mask.any()]
        spread = spread_rad(shown)
        said = f"{why} (condition number {condition_text(normal.condition)}) from {len(shown)} views, turned by up to "
        said += f"{np.degrees(spread):.1f} degrees against each other"
        if spread < 3 * _PARALLEL_RAD:
            return Degenerate("coplanar", f"the boards are parallel: {said}; tilt the board by 30 degrees to all sides")
        return Degenerate("too-few-poses", f"too few poses: {said}; show the board at more poses, all over the picture")


def rms(residual_px: Array) -> float:
    """Of the distance, as OpenCV has it: root of the mean of dx^2 + dy^2."""
    return float(np.sqrt(np.mean(np.sum(residual_px**2, axis=-1)))) if len(residual_px) else float("nan")
