"""Views of a live rig, pose by pose: which poses, and until when."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from calibration.board.board import Board
from calibration.errors import CalibrationError
from calibration.files.rig_file import load_rig_model
from calibration.guide.poses import Advice, candidates, rough_camera, sequence
from calibration.judging.data_lack import FEWEST_POSES, FEWEST_WHY
from calibration.model.camera import Camera
from calibration.rig_fit.sightings import shows_line
from calibration.views import View
from rig.calibrating.capture import Capture, capture_view
from rig.calibrating.showing import Ask, shown
from rig.calibrating.speed_turns import SpeedTurns
from rig.calibrating.taken import Taken
from rig.config import RigConfig
from rig.errors import UsageError
from rig.progress import part
from rig.session import open_rig

MISSED_SHARE = 0.5
"""So many more poses than asked for are shown where the board is not found in some."""

LASTING = (["wrong-board"] * 3, ["mirrored"] * 3)
"""Why the first views of a session are refused where no pose of the board will change that."""


class ChoosesPoses(Protocol):
    """Says which pose to show next."""

    def next(self, views: Sequence[View]) -> Advice | None:
        """After these views; None: no more are needed."""
        ...


@dataclass(frozen=True, slots=True)
class FixedPoses:
    """Poses of a sequence that was chosen before."""

    poses: Sequence[Advice]

    def next(self, views: Sequence[View]) -> Advice | None:
        """The one that follows."""
        return self.poses[len(views)] if len(views) < len(self.poses) else None


def require_poses(taken: Taken, poses: int) -> None:
    """UsageError where so many poses of a live rig, and the views there are, can never pass, whatever they show."""
    there = sum(view.corners is not None for view in taken.views)
    if there + poses < FEWEST_POSES:
        beside = f" and {there} view{'s' * (there > 1)} taken before" if there else ""
        raise UsageError(
            f"poses is {poses}{beside}; {FEWEST_POSES} {FEWEST_WHY}: ask for {FEWEST_POSES - there} or more"
        )


def good_poses(config: RigConfig, board: Board, poses: int, at_m: float, seed: int, behind: int = 0) -> FixedPoses:
    """Poses that tell most about any rig, and a few more for those in which the board is missed.

    behind: so many of the sequence were shown before, by an earlier session: the next tell more than the same again.
    """
    choices = candidates(first_camera(config), board, config.scan.depth_range)
    if not choices:
        raise UsageError(f"no pose of a board of {board.size_m[0]:g} x {board.size_m[1]:g} m fits the picture within "
                         f"scan.depth_range; use a smaller board or widen the range")  # fmt: skip
    chosen = sequence(choices, behind + poses + math.ceil(MISSED_SHARE * poses), seed)
    return FixedPoses([Advice(candidate, at_m) for candidate in chosen[behind:]])


def first_camera(config: RigConfig) -> Camera:
    """A camera to place boards with: that of the config's calibration, else a rough one of the sensor's size."""
    if config.calibration is not None:
        try:
            return load_rig_model(config.calibration).camera
        except CalibrationError:
            pass  # it is about to be replaced
    with open_rig(config.model_copy(update={"calibration": None})) as rig:
        return rough_camera((rig.spad.info.width, rig.spad.info.height))


@dataclass(frozen=True, slots=True)
class Live:
    """How a live rig takes views. poses: good ones wanted; choose: which. ask: gets a person to move the board.

    exposures: per column, by turns, so that the mirror is seen at several speeds; those that it cannot do are left out,
    and those that never show the line where more exposures do; none: as the config says. line: whether it is to be seen
    on the board. defects: (rows, width), pixels not to be used. seed: of everything simulated.
    """

    config: RigConfig
    poses: int
    choose: ChoosesPoses
    ask: Ask | None = None
    exposures: Sequence[int] = ()
    seed: int = 0
    arm: bool = False
    defects: NDArray[np.bool_] | None = None
    line: bool = True

    def sees(self, capture: Capture) -> bool:
        """Whether a capture has what it was taken for."""
        return capture.refused is None and (not self.line or shows_line(capture.view))


def take_live(taken: Taken, live: Live, board: Board) -> None:
    """Take views of a board that is moved from pose to pose."""
    good, seen, reasons = 0, list[View](), list[str]()
    speeds = SpeedTurns(live.exposures, live.sees, taken.tell)
    while good < live.poses and len(seen) < live.poses + math.ceil(MISSED_SHARE * live.poses):
        advice = live.choose.next(seen)
        if advice is None:
            return
        config = shown(
            live.config, f"pose {good + 1} of {live.poses}: {advice}", advice.candidate, live.ask, taken.tell
        )
        with part(f"pose {good + 1} of {live.poses}"):
            capture = speeds.capture(good, partial(_scan, taken, live, config, board))
        taken.add_capture(capture)
        seen.append(capture.view)
        good += live.sees(capture)
        reasons.append("" if capture.refused is None else capture.refused.reason)
        if reasons in LASTING:
            taken.say(f"{len(reasons)} views are {reasons[0]}, which no other pose will change: no more are taken")
            return


def _scan(taken: Taken, live: Live, config: RigConfig, board: Board, exposures: int | None) -> Capture:
    """One view of the board as it stands."""
    at = len(taken.views)
    return capture_view(
        config, f"{at:03d}", board, seed=live.seed + at, exposures=exposures, arm=live.arm, defects=live.defects
    )
