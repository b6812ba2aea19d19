"""The random rigs and boards of the calibration campaigns: every one could stand in a lab."""

import numpy as np
import pytest

from calibration.depth_error import command_at
from tests.reference.boards.random_rigs import BOARD, COMMAND_REACH, random_poses, random_rig


@pytest.mark.parametrize("seed", range(3))
def test_the_line_of_a_random_rig_reaches_the_whole_picture(seed: int) -> None:
    model = random_rig(np.random.default_rng(seed), size=256).model
    x, y = np.meshgrid(np.linspace(0, 255, 5), np.linspace(100, 155, 3))
    for depth_m in (1.5, 5.0):
        assert np.abs(command_at(model, x, y, depth_m)).max() < COMMAND_REACH + 0.06  # the axis may be tilted


@pytest.mark.parametrize("seed", range(3))
def test_boards_are_held_within_the_picture_all_over_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    camera = random_rig(rng).model.camera
    poses = random_poses(rng, camera, BOARD, 10)
    corners = np.stack([np.stack(camera.project(pose.to_camera(BOARD.corners_m)), axis=-1) for pose in poses])
    assert corners.min() > 0
    assert corners.max() < 511
    assert np.ptp(corners.mean(axis=1), axis=0).min() > 100
    normals = np.stack([pose.matrix[:, 2] for pose in poses])
    assert np.rad2deg(np.arccos((normals @ normals.T).min())) > 30
