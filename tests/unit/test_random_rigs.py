"""The calibration campaigns: rigs and boards could stand in a lab; a figure that falls short is named."""

from collections import Counter

import numpy as np
import pytest

from calibration.depth_error import command_at
from tests.campaigns.calibration import fits, mistakes
from tests.campaigns.calibration.asked import Figure, exit_code, shortfalls
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


def test_a_figure_beyond_its_limits_or_missing_is_named_with_them(capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code([Figure("ratio", 0.8, (0.8, 1.3)), Figure("share", 0.97, (0.93, 0.97))]) == 0
    assert not capsys.readouterr().err
    assert exit_code([Figure("ratio", 1.31, (0.8, 1.3)), Figure("px", np.nan, (0, 0.1))]) == 1
    assert capsys.readouterr().err.splitlines() == [
        "short: ratio is 1.31, asked for are 0.8 to 1.3",
        "short: px was not found, asked for are 0 to 0.1",
    ]


def test_campaigns_judge_by_error_interval_and_share_of_trials() -> None:
    good = np.array([1.0, 1.1, 0.9]), np.array([0.95, 0.96, 0.94])
    found = [good, (1.4 * good[0], good[1]), (good[0], good[1] - 0.03), (np.array([]), np.array([]))]
    assert [len(shortfalls(fits.figures(*each))) for each in found] == [0, 1, 1, 2]
    table = {
        "moved": Counter({"moved-rig": 27, "passed": 3}),
        "not_locked": Counter({"exposure-not-locked": 25, "x": 5}),
    }
    (line,) = shortfalls(mistakes.figures(table))
    assert line == ("share of trials in which not_locked is 'exposure-not-locked' is 0.8333, asked for are 0.9 to 1")
