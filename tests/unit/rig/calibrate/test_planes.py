"""The guided mode believes what the calibration itself will find."""

from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from calibration.errors import CalibrationError
from calibration.files.rig_file import KnownCamera
from calibration.model.rig_model import Covariance
from calibration.rig_fit.fit import fit_rig
from rig.calibrate import planes as planes_run
from rig.calibrate import views as taking
from rig.calibrate.planes import guided
from tests.reference.boards.calibration_data import BOARD, Seen, TrueRig, random_views
from tests.unit.calibration.fitted_rigs import SIZE, true_camera

RIG = TrueRig(lens=(-0.1, 0.03, 5e-4, -3e-4, 0.0))


def three_views(asked: dict[str, float], camera: KnownCamera | None = None) -> tuple[Any, Any, Any]:
    """A session of three views, and how it is fitted and judged."""
    views = random_views(np.random.default_rng(4), RIG, 3, Seen(passages=150))
    session = SimpleNamespace(views=views, size=SIZE, say=lambda line: None)
    fit = partial(planes_run._fit, session, BOARD, None, camera)  # type: ignore[arg-type]
    return session, fit, partial(planes_run._judged, session, asked)  # type: ignore[arg-type]


def test_a_camera_that_is_known_counts_in_what_the_guide_expects() -> None:
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    lens, known = true_camera(RIG), Covariance(names, np.diag([0.05] * 4 + [1e-4] * 5) ** 2)
    before = []
    for camera in (None, KnownCamera(lens, known, frozenset())):
        session, fit, judge = three_views({"accuracy_m": 1e-4, "at_m": 5.0}, camera)
        advice = guided(lambda views: None, BOARD, (0.5, 4.0), session, fit, judge)(session.views)
        assert advice is not None
        before.append(advice.before_m)
    told = fit_rig(session.views, BOARD, SIZE, camera=lens, known=known)
    assert before[1] == judge(told).evidence.expected_m
    assert before[1] < 0.8 * before[0]


def test_a_later_session_shows_the_poses_that_follow(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(taking, "first_camera", lambda config: true_camera(TrueRig()))
    config: Any = SimpleNamespace(scan=SimpleNamespace(depth_range=(0.5, 4.0)))

    def shown(poses: int, behind: int, live: int) -> list[str]:
        choose = taking.good_poses(config, BOARD, poses, 5.0, 0, behind)
        return [str(choose([None] * at)) for at in range(live)]  # type: ignore[list-item]

    assert shown(4, 4, 4) == shown(8, 0, 8)[4:]
    assert not set(shown(4, 4, 4)) & set(shown(4, 0, 4))


def test_a_fit_whose_line_misses_the_distance_asked_does_not_end_the_session() -> None:
    session, fit, judge = three_views({"at_m": 0.05})
    with pytest.raises(CalibrationError, match="does not reach"):
        judge(fit())
    start: Any = len
    assert guided(start, BOARD, (0.5, 4.0), session, fit, judge)(session.views) == 3
