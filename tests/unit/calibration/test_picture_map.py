"""The map from a board to its picture, against an exact lens."""

import numpy as np
import pytest

from calibration import Camera
from calibration.board.board import Board
from calibration.board.drawing import fit_map
from calibration.views import BoardPose

BOARD = Board("chessboard", (9, 7), 0.06)


@pytest.mark.parametrize("bend", [-0.2, 0.2])
@pytest.mark.parametrize("tilt", [(0.5, 0.0, 0.0), (0.1, -0.6, 0.3), (-0.4, 0.4, 0.0)])
def test_a_lens_bends_a_tilted_boards_picture_as_the_map_says(bend: float, tilt: tuple[float, float, float]) -> None:
    """Between the corners too: what is drawn there moves them, alike in all pictures of a camera."""
    camera = Camera(512, 512, np.array([[600.0, 0, 255.5], [0, 600, 255.5], [0, 0, 1]]), np.array([bend, 0, 0, 0, 0]))
    pose = BoardPose(np.array(tilt), np.array([-0.27, -0.21, 1.0]))

    def seen(points_m: np.ndarray) -> np.ndarray:
        flat = np.concatenate([points_m, np.zeros((len(points_m), 1))], axis=1)
        return np.stack(camera.project(pose.to_camera(flat)), axis=-1)

    corners_m = BOARD.corners_m[:, :2]
    found = fit_map(corners_m, seen(corners_m), 5.0, BOARD.size_m)
    assert found is not None
    board_map, inside = found
    assert inside.all()
    between_m = corners_m + BOARD.square_m * np.array([0.25, -0.25])
    off = board_map.to_px(between_m) - seen(between_m)
    assert np.abs(off).max() < 0.03
