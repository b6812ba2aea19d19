"""One view of a calibration board held still: where its corners lie, and when the line passed over each pixel.

A pixel's passage is the mirror command at which the line's centre crosses it. At every command the pixel sees the same
spot, so the board's print hardly biases the passage. The print does bias a stripe's position along a row.
"""

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.arrays import Array

NO_POSE = "corners of a view are no picture of a board; take the view out, or name the board that it shows"
USUAL_CORNER_SD_PX = 0.03
FEWEST_CORNERS = 6
"""Fewest corners that give a board's pose, with some to spare."""
LEAST_ACROSS_PX = 1.0
"""Least `Corners.across_px` for a pose; corners are found to some 0.01 px."""


@dataclass(frozen=True, slots=True, eq=False)
class Corners:
    """Corners of a board in a picture.

    ids: (n,) int32, the corners' numbers on the board. px: (n, 2) float64 raw pixels, centres at integers. sd_px: (n,)
    float64, sd of either coordinate, from the picture's noise; None if unknown.
    """

    ids: NDArray[np.int32]
    px: Array
    sd_px: Array | None = None

    @property
    def likely_sd_px(self) -> Array:
        """(n,) sd of either coordinate in pixels, above 0: USUAL_CORNER_SD_PX where unknown, 1 where infinite."""
        if self.sd_px is None:
            return np.full(len(self.ids), USUAL_CORNER_SD_PX)
        known = np.nan_to_num(self.sd_px, nan=USUAL_CORNER_SD_PX, posinf=1.0)
        return np.where(known > 0, known, USUAL_CORNER_SD_PX)

    @property
    def across_px(self) -> float:
        """Root mean square distance of the corners from their best straight line; 0 without corners or with one
        that is not finite. Below LEAST_ACROSS_PX they give no pose.
        """
        if len(self.px) == 0 or not np.isfinite(self.px).all():
            return 0.0
        return float(np.linalg.svd(self.px - self.px.mean(axis=0), compute_uv=False)[-1] / np.sqrt(len(self.px)))


@dataclass(frozen=True, slots=True, eq=False)
class Passages:
    """Mirror commands at which the line's centre crossed the pixels of one sweep.

    x_px, y_px: (m,) float64. command: (m,) float64, the command at that instant, not corrected for lags. sd: (m,)
    float64 in command units. direction: +1 while the command rises, else -1. speed_per_s: size of the command's
    velocity, above 0.
    """

    x_px: Array
    y_px: Array
    command: Array
    sd: Array
    direction: int
    speed_per_s: float

    @property
    def velocity_per_s(self) -> float:
        """Signed velocity of the command."""
        return float(np.sign(self.direction)) * self.speed_per_s


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """One pose of the board as seen and scanned. corners: None if not found. passages: one for each sweep. picture:
    (height, width) float32, photons per pixel and exposure, or grey levels if it comes from an image file."""

    name: str
    corners: Corners | None
    passages: tuple[Passages, ...] = ()
    picture: NDArray[np.float32] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class BoardPose:
    """The pose of a board: X_camera = matrix X_board + position_m. rotation: (3,) float64 Rodrigues vector in rad;
    position_m: (3,) float64.
    """

    rotation: Array
    position_m: Array

    def to_camera(self, points_m: ArrayLike) -> Array:
        """Points (..., 3) of the board in the camera's frame, metres."""
        return np.asarray(points_m, np.float64) @ self.matrix.T + self.position_m

    @property
    def matrix(self) -> Array:
        """(3, 3) float64 rotation; its columns are the board's x, y and normal in the camera's frame."""
        return np.asarray(cv2.Rodrigues(np.asarray(self.rotation, np.float64))[0], np.float64)


MAD_TO_SD: Final = 1.4826
"""Standard deviation of a normal distribution, divided by the median of its absolute deviations."""


def robust_sd(deviations: ArrayLike) -> float:
    """Standard deviation of deviations (n,) from zero, n > 0, estimated from the median of their absolute values."""
    return float(MAD_TO_SD * np.median(np.abs(deviations)))
