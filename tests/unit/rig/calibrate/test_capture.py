"""Poses are scanned at several speeds by turns, but for those that do not show the line."""

from operator import attrgetter
from types import SimpleNamespace
from typing import Any

import pytest

from rig.calibrate.capture import SpeedRotation
from rig.calibrate.planes import speeds_of
from rig.errors import PlanError


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
