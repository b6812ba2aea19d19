"""Errors of metres are said in millimetres as they are, in every verdict."""

import numpy as np

from calibration.check import CheckedBoard
from calibration.diagnosis.verdicts import judge_check, judge_sync
from calibration.model.rig_model import Lag, RigModel
from calibration.model.scanner import PivotScanner
from calibration.sync.lag_fit import SweepTiming, SyncFit
from calibration.verdict import AccuracyGoal
from tests.unit.calibration.cameras import camera

FAR = CheckedBoard("000", 9.0, 1.2345, 3.0, 0.4, 900.0, 60, 1.0, 0.01, 0.1, np.zeros((2, 2)))


def test_a_board_metres_off_a_plane() -> None:
    (reason,) = judge_check([FAR], AccuracyGoal(0.35), 0.5).reasons
    assert "lie 1230 mm (rms) off a plane, expected are 400 mm, the limit at 9 m is 1130 mm" in reason.text


def test_lags_that_cost_metres() -> None:
    mirror = PivotScanner(np.array([-0.3, 0, 0.0]), np.array([0, 1.0, 0]), np.array([1.0, 0, 0]), np.array([0.1, 0.4]))
    model = RigModel(camera([]), mirror)
    sweeps = tuple(SweepTiming(way, speed, 2e-4, 1e-4, 99) for way, speed in ((1, 400.0), (-1, 400.0), (1, 15.0)))
    known = np.diag([1e-3, 1e-3, 1e-11]) ** 2
    fit = SyncFit(Lag(2e-4, 2e-4), 0.0, known, (15.0, 400.0), False, (1, -1), False, sweeps, 0.0, 1, 1.0)
    verdict = judge_sync(fit, model, AccuracyGoal(1.5))
    (reason,) = verdict.reasons
    assert reason.value > 1
    assert f"highest speed {float(f'{reason.value * 1e3:.3g}'):.0f} mm of depth, asked for are 1500 mm" in reason.text
