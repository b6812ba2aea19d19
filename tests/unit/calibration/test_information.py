"""What a pose that nobody has shown yet would bring."""

import numpy as np

from calibration.information import Forecast
from calibration.rig_fit import fit_rig
from calibration.views import BoardPose
from tests.reference.calibration_data import BOARD, Seen, TrueRig, random_pose, random_views, seen_view

RIG = TrueRig(lens=(-0.1, 0.03, 5e-4, -3e-4, 0.0), angle=(0.09, 0.53, 0.02))
SEEN = Seen(passages=300, passage=5e-4, corner_px=0.04)


def test_a_shown_pose_brings_what_was_forecast() -> None:
    rng = np.random.default_rng(0)
    views = random_views(rng, RIG, 6, SEEN)
    forecast = Forecast(fit_rig(views, BOARD, (512, 512)), 5.0)
    turn, position = random_pose(rng, RIG)
    expected = forecast(BoardPose(turn, position))
    views.append(seen_view(rng, RIG, turn, position, SEEN))
    found = Forecast(fit_rig(views, BOARD, (512, 512)), 5.0).now_m
    assert expected < forecast.now_m
    assert abs(found / expected - 1) < 0.25


def test_poses_differ_and_one_out_of_sight_brings_nothing() -> None:
    rng = np.random.default_rng(1)
    forecast = Forecast(fit_rig(random_views(rng, RIG, 5, SEEN), BOARD, (512, 512)), 5.0)
    poses = [BoardPose(*random_pose(rng, RIG)) for _ in range(8)]
    worth = np.array([forecast(pose) for pose in poses])
    assert np.all(worth < forecast.now_m)
    assert worth.max() > 1.05 * worth.min()
    assert np.isnan(forecast(BoardPose(np.zeros(3), np.array([5.0, 0, 1.0]))))
