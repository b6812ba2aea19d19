"""A random rig and a person who shows it boards: what `rig calibrate planes` would say first of the views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.board.board import Board
from calibration.board.detect import find_corners
from calibration.diagnosis.rig import judge_fit, judge_refused
from calibration.errors import Degenerate
from calibration.rig_fit.fit import fit_rig
from calibration.views import BoardPose, View
from sim_backend.scenes.board import ShownBoard
from tests.campaigns.calibration.board_capture import HOT_PER_S, Stand, SweepAsked, take_sweeps
from tests.campaigns.calibration.rig_figures import CALIBRATED
from tests.campaigns.calibration.rigs import OTHER_SPEED, room_picture, view_of
from tests.reference.boards.random_rigs import BOARD, random_pose

BOTH_WAYS = tuple(SweepAsked(CALIBRATED, direction) for direction in (1, -1))
TWO_SPEEDS = (*BOTH_WAYS, *(SweepAsked(OTHER_SPEED, direction) for direction in (1, -1)))
PASSED = "passed"


@dataclass(frozen=True, slots=True)
class Session:
    """A rig and a person with a board. rng: of all that is random."""

    stand: Stand
    rng: np.random.Generator

    def view(self, name: str, pose: BoardPose, board: Board = BOARD, sweeps: Sequence[SweepAsked] = BOTH_WAYS) -> View:
        """The board at a pose."""
        return view_of(name, self.stand, take_sweeps(self.stand, [ShownBoard(board, pose)], sweeps, self.rng), board)

    def views(
        self, poses: Sequence[BoardPose], board: Board = BOARD, sweeps: Sequence[SweepAsked] = BOTH_WAYS
    ) -> list[View]:
        """The board at several poses, at two speeds at the first one."""
        asked = [TWO_SPEEDS if i == 0 and sweeps is BOTH_WAYS else sweeps for i in range(len(poses))]
        pairs = enumerate(zip(poses, asked, strict=True))
        return [self.view(f"{i:03d}", pose, board, ways) for i, (pose, ways) in pairs]

    def pose(self, **how: object) -> BoardPose:
        """A random one."""
        return random_pose(self.rng, self.stand.rig.model.camera, BOARD, **how)  # type: ignore[arg-type]

    def distance_m(self, board: Board, seen_px: tuple[float, float]) -> tuple[float, float]:
        """Between which distances the board's width is seen at these sizes in pixels."""
        focal = float(self.stand.rig.model.camera.matrix[0, 0])
        return focal * board.size_m[0] / seen_px[1], focal * board.size_m[0] / seen_px[0]

    def named(self, views: Sequence[View], board: Board = BOARD, stated_baseline_m: float | None = None) -> str:
        """What is named first."""
        camera = self.stand.rig.model.camera
        size = (camera.width, camera.height)
        try:
            fit = fit_rig(views, board, size)
        except Degenerate as refused:
            return judge_refused(refused, views, board, size).codes[0]
        verdict = judge_fit(fit, views, stated_baseline_m=stated_baseline_m).verdict
        return PASSED if verdict.passed else verdict.codes[0]

    def refused(self, shown: Sequence[ShownBoard]) -> str:
        """Why there are no corners in a view of these boards."""
        picture = room_picture(self.stand, take_sweeps(self.stand, shown, BOTH_WAYS, self.rng))
        try:
            find_corners(picture, BOARD, self.stand.dark_per_s > HOT_PER_S)
        except Degenerate as refused:
            return refused.reason
        return PASSED
