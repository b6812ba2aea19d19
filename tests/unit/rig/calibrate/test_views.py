"""A live rig is shown poses, at several speeds, until enough of them have told something; a guide chooses them."""

from collections.abc import Collection
from functools import partial
from operator import attrgetter
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from calibration.errors import CalibrationError, Degenerate
from calibration.files.rig_file import KnownCamera, corners_digest
from calibration.guide import Advice
from calibration.model.rig_model import Covariance
from calibration.rig_fit.fit import fit_rig
from calibration.views import Corners, Passages, View
from rig.calibrate import planes as planes_run
from rig.calibrate import views as taking
from rig.calibrate.capture import SpeedRotation
from rig.calibrate.check import _with_board
from rig.calibrate.planes import guided, speeds_of
from rig.calibrate.session import Session
from rig.calibrate.views import take_live
from rig.errors import PlanError, UsageError
from rig.requests import PlanesRequest
from tests.reference.boards.calibration_data import BOARD, SIZE, TrueRig, ViewErrors, random_views, true_camera

pytestmark = pytest.mark.slow


def shown(
    monkeypatch: pytest.MonkeyPatch,
    passages: int = 50,
    refused: str | None = None,
    *,
    line: bool = True,
    of_camera: Collection[str] = (),
) -> tuple[Session, list[str]]:
    """What was taken of four poses wanted, and said of them."""
    rng = np.random.default_rng(1)

    def capture(config: Any, name: str, board: Any, **given: Any) -> Any:
        if refused is not None:
            return SimpleNamespace(view=View(name, None), refused=Degenerate(refused, refused), identity=None)
        line = np.zeros(passages)
        sweep = Passages(line, line, line, line, 1, 30.0)
        corners = Corners(np.arange(9, dtype=np.int32), rng.normal(size=(9, 2)))
        return SimpleNamespace(view=View(name, corners, (sweep, sweep)), refused=None, identity=None)

    monkeypatch.setattr(taking, "capture_view", capture)
    monkeypatch.setattr(taking, "shown", lambda config, *given: config)
    told: list[str] = []
    nothing: Any = None
    session = Session(None, tell=told.append, of_camera=of_camera)
    request = PlanesRequest(poses=4)
    take_live(session, nothing, request, lambda views: Advice(nothing, 5.0), exposures=(3, 6), line=line)
    return session, told


def test_as_many_poses_as_are_wanted(monkeypatch: pytest.MonkeyPatch) -> None:
    assert len(shown(monkeypatch)[0].views) == 4


def test_a_pose_that_does_not_show_the_line_does_not_count_where_it_is_wanted(monkeypatch: pytest.MonkeyPatch) -> None:
    taken, told = shown(monkeypatch, passages=5)
    assert len(taken.views) == 6
    assert "9 corners, 5, 5 passages of the line, too few to count (limit 30 a sweep)" in told[-1]
    assert len(shown(monkeypatch, passages=5, line=False)[0].views) == 4


def test_a_view_that_the_camera_was_made_of_is_refused_before_the_next_is_shown(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    first, second, *_ = shown(monkeypatch)[0].views
    told: list[str] = []
    monkeypatch.setattr(Session, "say", lambda self, line: told.append(line))
    with pytest.raises(UsageError, match=r"001 holds a view that the camera was made of; .* another `seed`"):
        shown(monkeypatch, of_camera={corners_digest(second)})
    assert len(told) == 1
    with pytest.raises(UsageError, match="000 holds a view that the camera"):
        shown(monkeypatch, of_camera={corners_digest(first)})


@pytest.mark.parametrize(("reason", "views"), [("wrong-board", 3), ("mirrored", 3), ("no-board", 6)])
def test_no_more_poses_are_shown_where_none_will_help(monkeypatch: pytest.MonkeyPatch, reason: str, views: int) -> None:
    assert len(shown(monkeypatch, refused=reason)[0].views) == views


@pytest.mark.parametrize(("tell", "notes"), [(None, ["view 000: the board lies half out"]), (print, [])])
def test_a_check_without_a_board_names_each_view_once(tell: Any, notes: list[str]) -> None:
    """What is wrong with a view is said once: when it was taken, or with the error where nobody was told."""
    refused = {"000": Degenerate("board-half-out", "the board lies half out")}
    session: Any = SimpleNamespace(views=[SimpleNamespace(corners=None)], refused=refused, tell=tell)
    with pytest.raises(Degenerate, match="board-half-out: 0 views show the board") as error:
        _with_board(session, 1)
    assert getattr(error.value, "__notes__", []) == notes


def taken(exposures: tuple[int, ...], least: int, poses: int, *, most: int = 99) -> tuple[list[int | None], list[str]]:
    """At which exposures the poses were scanned, and what was said; fewer than `least` show no line."""
    scanned: list[int | None] = []
    told: list[str] = []

    def scan(exposures: int | None) -> Any:
        if exposures is not None and exposures > most:
            raise PlanError("too slow")
        scanned.append(exposures)
        return SimpleNamespace(refused=None, seen=exposures is None or exposures >= least)

    turns = SpeedRotation(exposures, attrgetter("seen"), told.append)
    for pose in range(poses):
        turns.capture(pose, scan)
    return scanned, told


def test_speeds_take_turns_and_those_that_cannot_be_are_left_out() -> None:
    assert taken((3, 2, 6), 2, 5) == ([3, 2, 6, 3, 2], [])
    assert taken((), 2, 2) == ([None, None], [])
    assert taken((3, 2, 6), 2, 5, most=5)[0] == [3, 2, 3, 2, 3]
    with pytest.raises(PlanError):
        taken((6,), 2, 1, most=5)


def test_a_pose_that_does_not_show_the_line_is_scanned_again_at_the_slowest_speed() -> None:
    scanned, told = taken((3, 1, 6), 2, 5)
    assert scanned == [3, 1, 6, 3, 6, 3]
    assert told == [
        "at 1 exposure per column the line does not stand out on the board: again at 6",
        "scans at 1 exposure per column are left out from now on",
    ]


def test_no_speed_is_left_out_for_a_board_that_the_line_does_not_reach() -> None:
    scanned, told = taken((3, 2, 6), 99, 3)
    assert scanned == [3, 6, 2, 6, 6]
    assert not [line for line in told if "left out" in line]


@pytest.mark.parametrize(("own", "speeds"), [(1, (1, 2, 4)), (2, (2, 4)), (3, (3, 2, 6)), (10, (10, 3, 20))])
def test_speeds_by_default_are_several_and_none_but_the_own_is_a_single_exposure(own: int, speeds: object) -> None:
    live: Any = SimpleNamespace(scan=SimpleNamespace(exposures=own))
    assert speeds_of(live) == speeds


RIG = TrueRig(lens=(-0.1, 0.03, 5e-4, -3e-4, 0.0))


def three_views(asked: dict[str, float], camera: KnownCamera | None = None) -> tuple[Any, Any, Any]:
    """A session of three views, and how it is fitted and judged."""
    views = random_views(np.random.default_rng(4), RIG, 3, ViewErrors(passages=150))
    session = SimpleNamespace(views=views, size=SIZE, say=lambda line: None)
    fit = partial(planes_run._fit, session, BOARD, None, camera)
    return session, fit, partial(planes_run._judged, session, asked)


@pytest.mark.long
def test_a_camera_that_is_known_counts_in_what_the_guide_expects() -> None:
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    lens, known = true_camera(RIG), Covariance(names, np.diag([0.05] * 4 + [1e-4] * 5) ** 2)
    before = []
    for camera in (None, KnownCamera(lens, known, frozenset())):
        session, fit, judge = three_views({"accuracy_m": 1e-4, "at_m": 5.0}, camera)
        advice = guided(lambda views: None, BOARD, (1.0, 1.3), session, fit, judge)(session.views)
        before.append(advice.before_m)
    told = fit_rig(session.views, BOARD, SIZE, camera=lens, known=known)
    assert before[1] == judge(told).evidence.expected_m
    assert before[1] < 0.8 * before[0]


def test_a_later_session_shows_the_poses_that_follow(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(taking, "first_camera", lambda config: true_camera(TrueRig()))
    config: Any = SimpleNamespace(scan=SimpleNamespace(depth_range=(0.5, 4.0)))

    def shown(poses: int, behind: int, live: int) -> list[str]:
        choose = taking.good_poses(config, BOARD, poses, 5.0, 0, behind)
        return [str(choose([None] * at)) for at in range(live)]

    assert shown(4, 4, 4) == shown(8, 0, 8)[4:]
    assert not set(shown(4, 4, 4)) & set(shown(4, 0, 4))


def test_a_fit_whose_line_misses_the_distance_asked_does_not_end_the_session() -> None:
    session, fit, judge = three_views({"at_m": 0.05})
    with pytest.raises(CalibrationError, match="does not reach"):
        judge(fit())
    start: Any = len
    assert guided(start, BOARD, (0.5, 4.0), session, fit, judge)(session.views) == 3
