"""Corners of pictures without noise: what finding them leaves, which no number of photons averages out."""

import numpy as np

from calibration.board.board import Board
from calibration.board.detect import find_corners
from calibration.board.drawing import Drawing
from sim_backend.scenes.board import BoardAtPose, board_scene
from tests.reference.boards.random_rigs import BOARD, random_poses, random_rig

MOST_RMS_PX = 0.0014
"""0.0012 here, most of it the drawn picture's own; drawn half as finely for the comparison 0.0017."""


def test_corners_without_noise_lie_within_a_thousandth_of_a_pixel() -> None:
    """Over a tilted board and a bent picture."""
    rng = np.random.default_rng(7)
    camera = random_rig(rng).model.camera
    rays = camera.tangents()
    off = []
    for pose in random_poses(rng, camera, BOARD, 1):
        picture = 0.05 * board_scene(*rays, [BoardAtPose(BOARD, pose)], 4.0).albedo
        found = find_corners(picture.astype(np.float32), BOARD)
        assert len(found.ids) == len(BOARD.corners_m)
        off.append(found.px - np.stack(camera.project(pose.to_camera(BOARD.corners_m[found.ids])), axis=-1))
    rms_px = np.sqrt(np.mean(np.concatenate(off) ** 2))
    assert rms_px < MOST_RMS_PX, rms_px


def test_drawings_of_many_squares_stay_small() -> None:
    assert Drawing.of(BOARD, 1e6).px_per_square == 256
    many = Drawing.of(Board("chessboard", (100, 100), 0.01), 1e6)
    assert many.px_per_square >= 32
    assert many.picture.nbytes <= 128 << 20
