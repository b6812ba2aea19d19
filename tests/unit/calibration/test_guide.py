"""Poses of the guide fit into the picture, differ from each other, and the best by the forecast comes first."""

import math

import numpy as np
import pytest

from calibration import guide
from calibration.board.board import load_board
from calibration.guide import candidates, next_pose, rough_camera, sequence
from calibration.model.camera import Camera
from calibration.views import BoardPose
from tests.stability.inventory import covers

covers(guide)

BOARD = load_board()
DEPTH_RANGE_M = (0.4, 8.0)


@pytest.mark.parametrize("focal", [400, 600, 900])
def test_every_candidate_shows_the_whole_board(focal: float) -> None:
    camera = Camera(512, 512, np.array([[focal, 0, 250.0], [0, focal, 260], [0, 0, 1]]), np.array([-0.2, 0.1, 0, 0, 0]))
    found = candidates(camera, BOARD, DEPTH_RANGE_M)
    assert len(found) > 40
    width, height = BOARD.size_m
    outline = np.array([(x, y, 0.0) for x in (0, width) for y in (0, height)])
    for candidate in found:
        x, y = camera.project(candidate.pose.to_camera(outline))
        assert np.all((x > 0) & (x < 511) & (y > 0) & (y < 511))
        middle = candidate.pose.to_camera([width / 2, height / 2, 0])
        assert middle[2] == pytest.approx(candidate.distance_m)


def test_words_say_which_side_is_turned_away() -> None:
    found = candidates(rough_camera((512, 512)), BOARD, DEPTH_RANGE_M)
    width, height = BOARD.size_m
    for candidate in found:
        left, right = (candidate.pose.to_camera([x, height / 2, 0])[2] for x in (0, width))
        upper, lower = (candidate.pose.to_camera([width / 2, y, 0])[2] for y in (0, height))
        for side, further in (("left", left - right), ("right", right - left), ("upper", upper - lower)):
            assert (f"its {side} side turned away" in str(candidate)) == (further > 1e-6)


def test_the_sequence_spreads_over_distance_place_and_tilt() -> None:
    found = candidates(rough_camera((512, 512)), BOARD, DEPTH_RANGE_M)
    chosen = sequence(found, 12, seed=3)
    assert len({id(one) for one in chosen}) == 12
    assert len({one.place for one in chosen}) >= 5
    assert len({one.tilt for one in chosen}) >= 4
    assert len({round(one.distance_m, 3) for one in chosen}) >= 2
    assert sequence(found, 4, seed=3) == chosen[:4]


def test_the_next_pose_is_the_one_with_the_least_expected_error() -> None:
    found = candidates(rough_camera((512, 512)), BOARD, DEPTH_RANGE_M)

    def forecast(pose: BoardPose) -> float:
        return math.nan if pose.rotation[1] == 0 else 0.009 + 0.001 * float(pose.position_m[2])

    advice = next_pose(found, 5.0, 0.014, forecast)
    assert advice.after_m == min(forecast(one.pose) for one in found if one.tilt[1])
    assert "35 degrees about the vertical" in str(advice)
    assert "expected error at 5 m falls from 14 mm to 9." in str(advice)
