"""Pictures of boards that share nothing with the simulated rig: rays through every pixel's area, then photons."""

import functools

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.arrays import Array
from calibration.board.board import WHITE, Board
from calibration.views import BoardPose

SIZE = (320, 240)
MATRIX = np.array([[380.0, 0, 162], [0, 379.0, 117], [0, 0, 1]])
DISTORTION = np.array([-0.2, 0.05, 0.001, -0.001, 0.0])
CHARUCO = Board("charuco", (9, 7), 0.06, 0.047, "DICT_4X4_50")
CHESSBOARD = Board("chessboard", (9, 6), 0.06)
WALL = 0.4
_RAYS, _STEP = 21, 13
"""Per pixel, on a Fibonacci lattice: their projections on either axis are 1/21 px apart."""


def pose(
    board: Board, distance_m: float, at: tuple[float, float] = (0, 0), turn: tuple[float, ...] = (0, 0, 0)
) -> BoardPose:
    """The board's middle at a distance along the ray with tangents `at`, turned by a Rodrigues vector."""
    rotation = np.array(turn, np.float64)
    matrix, _ = cv2.Rodrigues(rotation)
    middle = distance_m * np.array([*at, 1.0])
    return BoardPose(rotation, middle - matrix @ np.array([*board.size_m, 0]) / 2)


def corners_px(board: Board, stands: BoardPose) -> Array:
    """(n, 2) true corners."""
    px, _ = cv2.projectPoints(board.corners_m, stands.rotation, stands.position_m, MATRIX, DISTORTION)
    return px.reshape(-1, 2)


def albedo(board: Board, *poses: BoardPose) -> Array:
    """(height, width) reflectance of boards before a grey wall, averaged over each pixel's area."""
    total = np.zeros(SIZE[::-1])
    for rays in _rays():
        seen = np.full(len(rays), WALL)
        for stands in poses:
            normal = stands.matrix[:, 2]
            met = rays * (normal @ stands.position_m / (rays @ normal))[:, None]
            x, y, _ = ((met - stands.position_m) @ stands.matrix).T
            value = board.albedo_at(x, y)
            seen = np.where(np.isnan(value), seen, value)
        total += seen.reshape(total.shape)
    return total / _RAYS


@functools.cache
def _rays() -> list[Array]:
    """(pixels, 3) directions of each of a pixel's rays."""
    y, x = np.mgrid[: SIZE[1], : SIZE[0]].astype(np.float64)
    found = []
    for i in range(_RAYS):
        at = np.stack([x + (i + 0.5) / _RAYS - 0.5, y + (i * _STEP % _RAYS + 0.5) / _RAYS - 0.5], -1).reshape(-1, 1, 2)
        tangents = cv2.undistortPoints(at, MATRIX, DISTORTION, None, None, None, (3, 8, 1e-9)).reshape(-1, 2)
        found.append(np.concatenate([tangents, np.ones((len(tangents), 1))], axis=1))
    return found


def exposed(light: Array, white_flux: float, frames: int, seed: int) -> NDArray[np.float32]:
    """The flux picture of so many binary frames, white paper giving `white_flux` photons per pixel and frame."""
    chance = 1 - np.exp(-light / WHITE * white_flux)
    counts = np.random.default_rng(seed).binomial(frames, chance)
    return (-np.log1p(-np.minimum(counts, frames - 0.5) / frames)).astype(np.float32)
