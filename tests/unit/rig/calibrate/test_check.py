"""What is wrong with a view is said once: when it was taken, or with the error where nobody was told."""

from types import SimpleNamespace
from typing import Any

import pytest

from calibration.errors import Degenerate
from rig.calibrate.check import _with_board


@pytest.mark.parametrize(("tell", "notes"), [(None, ["view 000: the board lies half out"]), (print, [])])
def test_a_check_without_a_board_names_each_view_once(tell: Any, notes: list[str]) -> None:
    refused = {"000": Degenerate("board-half-out", "the board lies half out")}
    taken: Any = SimpleNamespace(views=[SimpleNamespace(corners=None)], refused=refused, tell=tell)
    with pytest.raises(Degenerate, match="board-half-out: 0 views show the board") as error:
        _with_board(taken, 1)
    assert getattr(error.value, "__notes__", []) == notes
