"""The guided mode: after each view the rig is fitted, and the pose is shown that makes the expected error fall most."""

from collections.abc import Sequence

from calibration.board import Board
from calibration.errors import CalibrationError
from calibration.guide import Advice, candidates, next_pose
from calibration.information import Forecast
from calibration.judging import judge_fit
from calibration.rig_fit import RigFit, fit_rig
from calibration.views import View
from rig.calibrating.showing import Tell
from rig.calibrating.taking import FixedPoses, Taken
from rig.config import RigConfig

START_POSES = 3
"""Before anything is fitted."""


class Guide:
    """Chooses poses by what they are worth. Stops where the accuracy that was asked for is expected."""

    def __init__(
        self, start: FixedPoses, board: Board, config: RigConfig, at_m: float, accuracy_m: float | None,
        taken: Taken, tell: Tell | None,
    ) -> None:  # fmt: skip
        """start: poses for as long as there is no fit. taken: all views so far, those kept earlier too."""
        self._start = start
        self._board = board
        self._config = config
        self._at_m = at_m
        self._accuracy_m = accuracy_m
        self._taken = taken
        self._tell = tell
        self._asked: set[tuple[float, tuple[int, int], tuple[int, int]]] = set()

    def next(self, views: Sequence[View]) -> Advice | None:
        """The next pose; None where the error is small enough."""
        known = self._taken.views
        fit = self._fit(known) if len(known) >= START_POSES else None
        if fit is None:
            return self._start.next(views)
        judged = judge_fit(fit, known, at_m=self._at_m, accuracy_m=self._accuracy_m)
        now_m = judged.evidence.expected_m
        if self._tell is not None:
            self._tell(f"expected error {judged.uncertainty.line()}; asked {judged.asked.accuracy_m * 1e3:.3g} mm")
        if judged.verdict.passed:
            return None
        choices = [
            choice
            for choice in candidates(fit.model.camera, self._board, self._config.scan.depth_range)
            if (choice.fill, choice.place, choice.tilt) not in self._asked
        ]
        if not choices:
            return None
        advice = next_pose(len(known), choices, self._at_m, now_m, Forecast(fit, self._at_m))
        chosen = advice.candidate
        self._asked.add((chosen.fill, chosen.place, chosen.tilt))  # a board that was not found there will not be again
        return advice

    def _fit(self, views: Sequence[View]) -> RigFit | None:
        try:
            return fit_rig(views, self._board, self._taken.size)
        except CalibrationError:
            return None
