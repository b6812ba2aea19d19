"""Poses of the guide fit into the picture, differ from each other, and the best by the forecast comes first."""

import math
from dataclasses import replace

import numpy as np
import pytest

from calibration import guide
from calibration.board.board import load_board
from calibration.guide import Forecast, candidates, next_pose, rough_camera, sequence
from calibration.model.camera import Camera
from calibration.rig_fit.fit import fit_rig
from calibration.views import BoardPose
from tests.reference.boards.calibration_data import BOARD, TrueRig, ViewErrors, random_pose, random_views, seen_view
from tests.stability.inventory import covers

covers(guide)

PRINTED = load_board()
DEPTH_RANGE_M = (0.4, 8.0)


@pytest.mark.parametrize("focal", [400, 600, 900])
def test_every_candidate_shows_the_whole_board(focal: float) -> None:
    camera = Camera(512, 512, np.array([[focal, 0, 250.0], [0, focal, 260], [0, 0, 1]]), np.array([-0.2, 0.1, 0, 0, 0]))
    found = candidates(camera, PRINTED, DEPTH_RANGE_M)
    assert len(found) > 40
    width, height = PRINTED.size_m
    outline = np.array([(x, y, 0.0) for x in (0, width) for y in (0, height)])
    for candidate in found:
        x, y = camera.project(candidate.pose.to_camera(outline))
        assert np.all((x > 0) & (x < 511) & (y > 0) & (y < 511))
        middle = candidate.pose.to_camera([width / 2, height / 2, 0])
        assert middle[2] == pytest.approx(candidate.distance_m)


def test_words_say_which_side_is_turned_away() -> None:
    found = candidates(rough_camera((512, 512)), PRINTED, DEPTH_RANGE_M)
    width, height = PRINTED.size_m
    for candidate in found:
        left, right = (candidate.pose.to_camera([x, height / 2, 0])[2] for x in (0, width))
        upper, lower = (candidate.pose.to_camera([width / 2, y, 0])[2] for y in (0, height))
        for side, further in (("left", left - right), ("right", right - left), ("upper", upper - lower)):
            assert (f"its {side} side turned away" in str(candidate)) == (further > 1e-6)


def test_the_sequence_spreads_over_distance_place_and_tilt() -> None:
    found = candidates(rough_camera((512, 512)), PRINTED, DEPTH_RANGE_M)
    chosen = sequence(found, 12, seed=3)
    assert len({id(one) for one in chosen}) == 12
    assert len({one.place for one in chosen}) >= 5
    assert len({one.tilt for one in chosen}) >= 4
    assert len({round(one.distance_m, 3) for one in chosen}) >= 2
    assert sequence(found, 4, seed=3) == chosen[:4]


def test_the_next_pose_is_the_one_with_the_least_expected_error() -> None:
    found = candidates(rough_camera((512, 512)), PRINTED, DEPTH_RANGE_M)

    def forecast(pose: BoardPose) -> float:
        return math.nan if pose.rotation[1] == 0 else 0.009 + 0.001 * float(pose.position_m[2])

    advice = next_pose(found, 5.0, 0.014, forecast)
    assert advice.after_m == min(forecast(one.pose) for one in found if one.tilt[1])
    assert "35 degrees about the vertical" in str(advice)
    assert "expected error at 5 m falls from 14 mm to 9." in str(advice)


RIG = TrueRig(lens=(-0.1, 0.03, 5e-4, -3e-4, 0.0), angle=(0.09, 0.53, 0.02))
SEEN = ViewErrors(passages=300, passage=5e-4, corner_px=0.04)


SPEEDS = (35.2, 117.0, 17.6)


def test_a_shown_pose_brings_what_was_forecast() -> None:
    rng = np.random.default_rng(0)
    shown = enumerate(random_pose(rng, RIG) for _ in range(7))
    views = [seen_view(rng, RIG, *pose, SEEN, (SPEEDS[i % 3], -SPEEDS[i % 3]), f"{i}") for i, pose in shown]
    forecast = Forecast(fit_rig(views, BOARD, (512, 512)), 5.0)
    turn, position = random_pose(rng, RIG)
    expected = forecast(BoardPose(turn, position))
    views.append(seen_view(rng, RIG, turn, position, SEEN, (SPEEDS[1], -SPEEDS[1]), "7"))
    found = Forecast(fit_rig(views, BOARD, (512, 512)), 5.0).now_m
    assert expected < forecast.now_m
    assert abs(found / expected - 1) < 0.15


def test_a_forecast_counts_corners_as_the_fit_found_them_whatever_they_state() -> None:
    rng = np.random.default_rng(2)
    views = random_views(rng, RIG, 5, SEEN)
    stated = [
        replace(view, corners=replace(view.corners, sd_px=np.full(len(view.corners.ids), 0.005))) for view in views
    ]
    pose = BoardPose(*random_pose(rng, RIG))
    silent, sharp = (Forecast(fit_rig(of, BOARD, (512, 512)), 5.0)(pose) for of in (views, stated))
    assert abs(sharp / silent - 1) < 0.01


def test_poses_differ_and_one_out_of_sight_brings_nothing() -> None:
    rng = np.random.default_rng(1)
    forecast = Forecast(fit_rig(random_views(rng, RIG, 5, SEEN), BOARD, (512, 512)), 5.0)
    poses = [BoardPose(*random_pose(rng, RIG)) for _ in range(8)]
    worth = np.array([forecast(pose) for pose in poses])
    assert np.all(worth < forecast.now_m)
    assert worth.max() > 1.05 * worth.min()
    assert np.isnan(forecast(BoardPose(np.zeros(3), np.array([5.0, 0, 1.0]))))
