"""The guided mode: after each view the rig is fitted, and the pose is shown that makes the expected error fall most."""

from collections.abc import Callable, Sequence

from calibration.board.board import Board
from calibration.digits import mm
from calibration.errors import CalibrationError
from calibration.guide.forecast import Forecast
from calibration.guide.poses import Advice, candidates, next_pose
from calibration.judging.rig import Judged
from calibration.rig_fit.result import RigFit
from calibration.views import View
from rig.calibrating.showing import Tell
from rig.calibrating.taken import Taken
from rig.calibrating.taking import FixedPoses

START_POSES = 3
"""Before anything is fitted."""


class Guide:
    """Chooses poses by what they are worth. Stops where the accuracy that was asked for is expected."""

    def __init__(
        self, start: FixedPoses, board: Board, depth_range_m: tuple[float, float], taken: Taken,
        fit: Callable[[], RigFit], judge: Callable[[RigFit], Judged], tell: Tell | None,
    ) -> None:  # fmt: skip
        """start: poses for as long as no fit can be judged. taken: all views so far, those kept earlier too. fit,
        judge: of these, as the calibration itself will be fitted and judged."""
        self._start = start
        self._board = board
        self._depth_range_m = depth_range_m
        self._taken = taken
        self._fitted = fit
        self._judged = judge
        self._tell = tell
        self._asked: set[tuple[float, tuple[int, int], tuple[int, int]]] = set()

    def next(self, views: Sequence[View]) -> Advice | None:
        """The next pose; None where the error is small enough."""
        known = self._taken.views
        told = self._told() if len(known) >= START_POSES else None
        if told is None:
            return self._start.next(views)
        fit, judged = told
        at_m = judged.asked.at_m
        now_m = judged.evidence.expected_m
        if self._tell is not None:
            self._tell(f"expected error {judged.uncertainty.line()}; asked {mm(judged.asked.accuracy_m)}")
        if judged.verdict.passed:
            return None
        choices = [
            choice
            for choice in candidates(fit.model.camera, self._board, self._depth_range_m)
            if (choice.fill, choice.place, choice.tilt) not in self._asked
        ]
        if not choices:
            return None
        advice = next_pose(len(known), choices, at_m, now_m, Forecast(fit, at_m))
        chosen = advice.candidate
        self._asked.add((chosen.fill, chosen.place, chosen.tilt))  # a board that was not found there will not be again
        return advice

    def _told(self) -> tuple[RigFit, Judged] | None:
        """What the views so far tell; None where that is no model yet, or one whose line misses the distance asked."""
        try:
            fit = self._fitted()
            return fit, self._judged(fit)
        except CalibrationError:
            return None
