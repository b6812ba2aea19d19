"""What a pose that nobody has shown yet would bring."""

from dataclasses import replace

import numpy as np

from calibration.guide import Forecast
from calibration.rig_fit.fit import fit_rig
from calibration.views import BoardPose
from tests.reference.boards.calibration_data import BOARD, Seen, TrueRig, random_pose, random_views, seen_view

RIG = TrueRig(lens=(-0.1, 0.03, 5e-4, -3e-4, 0.0), angle=(0.09, 0.53, 0.02))
SEEN = Seen(passages=300, passage=5e-4, corner_px=0.04)


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
