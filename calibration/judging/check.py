"""The verdict of a check: errors that are larger than the covariance lets expect and than depth can bear."""

import math
from collections.abc import Sequence
from typing import Final

from calibration.check.boards import CheckedAngle, CheckedBoard
from calibration.digits import mm
from calibration.verdict import SIGMAS, Asked, Reason, Verdict

UNLIKELY_SDS: Final = 4.0
"""Of chi2 about its number of degrees of freedom, by which deviations are no longer chance."""

_AGAIN = "calibrate again"


def judge_check(
    boards: Sequence[CheckedBoard],
    asked: Asked,
    board_width_m: float,
    angle: CheckedAngle | None = None,
    stated_angle_rad: float | None = None,
) -> Verdict:
    """Judge checked boards. asked: depth error that is good enough; at other distances it goes with their square."""
    found: list[Reason] = []
    for board in boards:
        bearable_m = asked.accuracy_m * (board.distance_m / asked.at_m) ** 2
        found += _flatness(board, bearable_m)
        found += _scale(board, asked)
    if angle is not None and stated_angle_rad is not None and boards:
        bearable_m = asked.accuracy_m * (boards[0].distance_m / asked.at_m) ** 2
        limit = max(SIGMAS * angle.sd_rad, 2 * bearable_m / board_width_m)
        error = angle.angle_rad - stated_angle_rad
        if not abs(error) <= limit:
            text = (
                f"the angle between the boards is scanned as {math.degrees(angle.angle_rad):.2f} degrees, stated are "
                f"{math.degrees(stated_angle_rad):.2f}; the limit is {math.degrees(limit):.2f} off"
            )
            step = f"measure the angle and check with it once more; where it stays so, {_AGAIN}"
            found.append(Reason("wrong-angle", text, error, limit, step))
    return Verdict(not found, tuple(found))


def _flatness(board: CheckedBoard, bearable_m: float) -> list[Reason]:
    likely = board.freedom + UNLIKELY_SDS * math.sqrt(2 * board.freedom)
    if board.chi2 <= likely or board.flatness_rms_m <= bearable_m:
        return []
    text = (
        f"view {board.name}: the board's squares lie {mm(board.flatness_rms_m)} (rms) off a plane, expected "
        f"are {mm(board.expected_m)}, the limit at {board.distance_m:.2g} m is {mm(bearable_m)}"
    )
    step = f"check that the board is flat, then {_AGAIN}"
    return [Reason("not-flat", text, board.flatness_rms_m, max(bearable_m, board.expected_m), step)]


def _scale(board: CheckedBoard, asked: Asked) -> list[Reason]:
    limit = max(SIGMAS * board.scale_sd, asked.accuracy_m / asked.at_m)
    if abs(board.scale - 1) <= limit:
        return []
    text = (
        f"view {board.name}: the board is scanned {board.scale - 1:+.2%} larger than stated, the limit is {limit:.2%}"
    )
    return [Reason("wrong-scale", text, board.scale - 1, limit, f"measure the board's squares, then {_AGAIN}")]
