"""The guided mode believes what the calibration itself will find."""

from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from calibration.errors import CalibrationError
from calibration.files.rig_file import KnownCamera
from calibration.guide import Advice, candidates
from calibration.model.camera import Camera
from calibration.model.rig_model import Covariance
from calibration.rig_fit.fit import fit_rig
from rig.calibrate import planes as planes_run
from rig.calibrate import views as taking
from rig.calibrate.planes import PoseGuide
from rig.calibrate.views import in_order
from tests.reference.boards.calibration_data import BOARD, Seen, TrueRig, random_views

SIZE = (512, 512)
RIG = TrueRig(lens=(-0.1, 0.03, 5e-4, -3e-4, 0.0))


def test_a_camera_that_is_known_counts_in_what_the_guide_expects() -> None:
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    known = Covariance(names, np.diag([0.05] * 4 + [1e-4] * 5) ** 2)
    lens = Camera(*SIZE, np.array([[600, 0, 255.5], [0, 600, 255.5], [0, 0, 1.0]]), np.array(RIG.lens))
    views = random_views(np.random.default_rng(4), RIG, 3, Seen(passages=150))
    taken = SimpleNamespace(views=views, size=SIZE, say=lambda line: None)
    asked = {"accuracy_m": 1e-4, "at_m": 5.0}
    before = []
    for camera in (None, KnownCamera(lens, known, frozenset())):
        fit = partial(planes_run._fit, taken, BOARD, None, camera)
        judge = partial(planes_run._judged, taken, asked)
        advice = PoseGuide(in_order(()), BOARD, (0.5, 4.0), taken, fit, judge).next(views)
        assert advice is not None
        before.append(advice.before_m)
    told = fit_rig(views, BOARD, SIZE, camera=lens, known=known)
    assert before[1] == planes_run._judged(taken, asked, told).evidence.expected_m
    assert before[1] < 0.8 * before[0]


def test_a_later_session_shows_the_poses_that_follow(monkeypatch: pytest.MonkeyPatch) -> None:
    lens = Camera(*SIZE, np.array([[600, 0, 255.5], [0, 600, 255.5], [0, 0, 1.0]]), np.zeros(5))
    monkeypatch.setattr(taking, "first_camera", lambda config: lens)
    config: Any = SimpleNamespace(scan=SimpleNamespace(depth_range=(0.5, 4.0)))
    first, later = (taking.good_poses(config, BOARD, 4, 5.0, 0, behind) for behind in (0, 4))
    whole = taking.good_poses(config, BOARD, 8, 5.0, 0)
    shown = [str(taking.in_order(later)([None] * live)) for live in range(4)]  # type: ignore[list-item]
    assert shown == [str(advice) for advice in whole[4:8]]
    assert not set(shown) & {str(advice) for advice in first[:4]}


def test_a_fit_whose_line_misses_the_distance_asked_does_not_end_the_session() -> None:
    views = random_views(np.random.default_rng(4), RIG, 3, Seen(passages=150))
    taken = SimpleNamespace(views=views, size=SIZE, say=lambda line: None)
    asked = {"at_m": 0.05}
    fit, judge = partial(planes_run._fit, taken, BOARD, None, None), partial(planes_run._judged, taken, asked)
    with pytest.raises(CalibrationError, match="does not reach"):
        judge(fit())
    lens = Camera(*SIZE, np.array([[600, 0, 255.5], [0, 600, 255.5], [0, 0, 1.0]]), np.zeros(5))
    poses = [Advice(choice, 0.05) for choice in candidates(lens, BOARD, (0.5, 4.0))[:4]]
    assert PoseGuide(in_order(poses), BOARD, (0.5, 4.0), taken, fit, judge).next(views) is poses[3]
