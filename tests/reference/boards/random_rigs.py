"""Rigs as labs build them and boards as people hold them: the random cases that calibration is judged on.

Camera 400 to 900 px of focal length on 512 pixels, moderate distortion; the mirror 0.2 to 0.5 m to either side, its
axis up to 3 degrees off the vertical, its angle bent by up to 3 % (quadratic and cubic term), rising or falling with
the command; a lag of 100 to 300 us of its own each way; jitter none or 2e-5 to 2e-4 of the drive; a lab with its
lights low (5 lux) to half on (150 lux), 10 to 50 mW of laser light.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from calibration.arrays import Array
from calibration.board.board import MARGIN_SQUARES, Board
from calibration.model.camera import Camera
from calibration.model.rig_model import Lag, RigModel
from calibration.model.scanner import PivotScanner
from calibration.views import BoardPose

BOARD = Board("charuco", (8, 6), 0.08, 0.062, "DICT_4X4_50")
"""640 x 480 mm: its markers can be read as far away as most of the rigs' depth goes."""
COMMAND_REACH = 0.88
"""Mirror commands that cover the picture lie within plus and minus this."""
DISTANCE_M = (0.8, 3.0)
MOST_TILT_RAD = np.deg2rad(40)
_MODULE_PX = 2.6
"""Least size of a marker's module in the picture: people hold the board where the markers are found."""
_ALL_SEEN_M = 1.0
"""From here on the line can reach the whole picture."""
_INSIDE_PX = 3.0
_TRIES = 4000


@dataclass(frozen=True, slots=True, eq=False)
class RandomRig:
    """A rig as it truly is. jitter: of the mirror, rms in command units; power_w: of the laser while calibrating."""

    model: RigModel
    jitter: float
    illuminance_lux: float
    power_w: float
    pixel_seed: int


def random_rig(rng: np.random.Generator, size: int = 512) -> RandomRig:
    """A rig with a sensor of size x size pixels."""
    camera = _camera(rng, size)
    side = rng.choice([-1.0, 1.0])
    source = np.array([side * rng.uniform(0.2, 0.5), rng.uniform(-0.03, 0.03), rng.uniform(-0.05, 0.05)])
    tilt_x, tilt_z = np.deg2rad(3) * rng.uniform(-1, 1, 2)
    axis = np.array([np.sin(tilt_z), 1.0, np.sin(tilt_x)])
    scanner = PivotScanner(source, axis, np.array([1.0, 0.0, 0.0]), _angle(rng, camera, float(source[0])))
    lag = Lag(*rng.uniform(1e-4, 3e-4, 2))
    jitter = 0.0 if rng.random() < 0.25 else float(np.exp(rng.uniform(np.log(2e-5), np.log(2e-4))))
    return RandomRig(
        model=RigModel(camera, scanner, lag, source_m=source),
        jitter=jitter,
        illuminance_lux=float(np.exp(rng.uniform(np.log(5), np.log(150)))),
        power_w=float(np.exp(rng.uniform(np.log(1e-2), np.log(5e-2)))),
        pixel_seed=int(rng.integers(1 << 31)),
    )


def random_poses(rng: np.random.Generator, camera: Camera, board: Board, poses: int) -> tuple[BoardPose, ...]:
    """The board held still at so many poses, all of it in the picture, here and there, near and far, tilted."""
    cells = rng.permutation(16)
    return tuple(random_pose(rng, camera, board, cell=int(cells[i % 16])) for i in range(poses))


def random_pose(
    rng: np.random.Generator,
    camera: Camera,
    board: Board,
    *,
    cell: int = 5,
    distance_m: tuple[float, float] | None = None,
    tilt_rad: float = MOST_TILT_RAD,
) -> BoardPose:
    """One pose with the board's middle in (or near) a cell of a 4 x 4 grid over the picture.

    distance_m: between which, as far as the whole board is in the picture; None: where its markers can be read.
    """
    low, high = _readable_m(camera, board) if distance_m is None else distance_m
    middle = np.array([*board.size_m, 0.0]) / 2
    size = np.array([camera.width, camera.height])
    target = (np.array([cell % 4, cell // 4]) + 0.5) / 4
    for trial in range(_TRIES):
        ease = trial / _TRIES  # what cannot be shown at the border is shown nearer to the middle
        at = ((1 - ease) * target + ease * 0.5 + rng.uniform(-0.12, 0.12, 2)) * size
        z = float(np.exp(rng.uniform(np.log(low), np.log(high))))
        u, v = camera.tangents_at(*at)
        turn = _turn(rng.uniform(-tilt_rad, tilt_rad), rng.uniform(-tilt_rad, tilt_rad), rng.uniform(-0.26, 0.26))
        pose = BoardPose(cv2.Rodrigues(turn)[0].ravel(), z * np.array([float(u), float(v), 1.0]) - turn @ middle)
        if _all_seen(camera, board, pose):
            return pose
    raise ValueError(f"a board of {board.size_m} m does not fit the picture between {low:.2f} and {high:.2f} m")


def _camera(rng: np.random.Generator, size: int) -> Camera:
    focal = rng.uniform(400, 900) * size / 512
    centre = (size - 1) / 2 + rng.uniform(-0.03, 0.03, 2) * size
    matrix = np.array([[focal, 0, centre[0]], [0, focal * rng.uniform(0.997, 1.003), centre[1]], [0, 0, 1]])
    while True:
        terms = rng.uniform(-1, 1, 5) * [0.2, 0.15, 1e-3, 1e-3, 0.1]
        camera = Camera(size, size, matrix, terms)
        if np.isfinite(camera.tangents_at([0, 0, size - 1, size - 1], [0, size - 1, 0, size - 1])[0]).all():
            return camera


def _angle(rng: np.random.Generator, camera: Camera, source_x_m: float) -> Array:
    """Optical angle as a polynomial in the command, such that the planes go through the whole picture."""
    middle = (camera.height - 1) / 2
    ends, _ = camera.tangents_at([0, camera.width - 1], [middle, middle])
    # A point at x = u z is lit at tan a = u - source_x / z, from the far distance to _ALL_SEEN_M.
    reach = [ends - source_x_m / z for z in (np.inf, _ALL_SEEN_M)]
    low, high = np.arctan(np.min(reach) - 0.02), np.arctan(np.max(reach) + 0.02)
    slope = (high - low) / 2 / COMMAND_REACH * rng.choice([-1.0, 1.0])
    bent, cubic = slope * rng.uniform(-0.03, 0.03, 2)
    return np.array([(low + high) / 2 - bent * COMMAND_REACH**2 / 2, slope, bent, cubic])


def _readable_m(camera: Camera, board: Board) -> tuple[float, float]:
    """Distances at which the board fits the picture and its markers are large enough."""
    focal = float(camera.matrix[0, 0])
    whole = max(side + 2 * MARGIN_SQUARES * board.square_m for side in board.size_m)
    low = max(DISTANCE_M[0], 1.15 * focal * whole / min(camera.width, camera.height))
    module_m = board.square_m / 4 if board.marker_m is None else board.marker_m / 6
    high = min(DISTANCE_M[1], focal * module_m / _MODULE_PX)
    return min(low, 0.9 * high), high


def _turn(*about_rad: float) -> Array:
    """Rotation about z, then y, then x."""
    about_x, about_y, about_z = (cv2.Rodrigues(vector)[0] for vector in np.diag(about_rad))
    return about_x @ about_y @ about_z


def paper(board: Board, pose: BoardPose) -> Array:
    """Points (n, 3) all over the board's paper, in the camera's frame."""
    margin = MARGIN_SQUARES * board.square_m
    along, down = (np.linspace(-margin, side + margin, 9) for side in board.size_m)
    return pose.to_camera(np.stack([*np.meshgrid(along, down), np.zeros((9, 9))], axis=-1).reshape(-1, 3))


def _all_seen(camera: Camera, board: Board, pose: BoardPose) -> bool:
    """Whether all of the paper is in the picture, front to the camera."""
    points = paper(board, pose)
    if points[:, 2].min() < 0.3 or pose.matrix[:, 2] @ points[0] <= 0:
        return False
    px = np.stack(camera.project(points), axis=-1)
    return bool(np.all((px > _INSIDE_PX) & (px < np.array([camera.width, camera.height]) - 1 - _INSIDE_PX)))
