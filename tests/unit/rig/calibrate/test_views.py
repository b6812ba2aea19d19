"""A live rig is shown poses until enough of them have told something."""

from collections.abc import Collection
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from calibration.errors import Degenerate
from calibration.files.rig_file import corners_digest
from calibration.guide import Advice
from calibration.views import Corners, Passages, View
from rig.calibrate import views as taking
from rig.calibrate.check import _with_board
from rig.calibrate.session import Session
from rig.calibrate.views import take_live
from rig.errors import UsageError
from rig.requests import PlanesRequest


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
    with pytest.raises(UsageError, match=r"001 holds a view that the camera was made of; .* another --seed"):
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
