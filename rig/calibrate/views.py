"""Takes views from all sources. No view is taken twice, and all must be of one rig.

`take_live` takes them with a live rig, pose by pose; `take_kept` takes those of earlier sessions, recorded runs and
pictures. `refusal` is the error for views that give no calibration.
"""

import math
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.board.board import Board, load_board
from calibration.diagnosis.rules import FEWEST_POSES, FEWEST_WHY
from calibration.diagnosis.verdicts import judge_refused
from calibration.errors import CalibrationError, Degenerate
from calibration.files.rig_file import load_rig_model
from calibration.guide import Advice, candidates, rough_camera, sequence
from calibration.model.camera import Camera
from calibration.rig_fit.rig_state import shows_line
from calibration.views import View
from rig.calibrate.capture import AskPerson, Capture, SpeedRotation, capture_recorded, capture_view, corners_in, shown
from rig.calibrate.session import BOARD_FILE, Session, load_views, session_rig
from rig.calibrate.sources import VIEWS, ViewSources
from rig.config.models import RigConfig
from rig.devices.open import open_rig
from rig.errors import UsageError
from rig.progress import part, tell_stage
from rig.requests import BoardRequest

MISSED_SHARE = 0.5
"""Most extra poses, as a share of those requested, that are shown if some give no good view."""

LASTING = (["wrong-board"] * 3, ["mirrored"] * 3)
"""A session ends if these are the reasons against its first views, since no other pose of the board would help."""


ChoosePose = Callable[[Sequence[View]], Advice | None]
"""A function that says which pose to show after these views; None if no more are needed."""


def require_poses(session: Session, poses: int) -> None:
    """Raise UsageError if this number of poses, with the views of a board taken already, is below FEWEST_POSES."""
    there = sum(view.corners is not None for view in session.views)
    if there + poses < FEWEST_POSES:
        beside = f" and {there} view{'s' * (there > 1)} taken before" if there else ""
        raise UsageError(
            f"poses is {poses}{beside}; {FEWEST_POSES} {FEWEST_WHY}: ask for {FEWEST_POSES - there} or more"
        )


def good_poses(config: RigConfig, board: Board, poses: int, at_m: float, seed: int, behind: int = 0) -> ChoosePose:
    """Return a function that chooses the poses of `calibration.guide.sequence` in order, with some to spare.

    behind: number of poses to skip at the beginning. Raises UsageError if no pose fits the picture.
    """
    choices = candidates(first_camera(config), board, config.scan.depth_range)
    if not choices:
        raise UsageError(f"no pose of a board of {board.size_m[0]:g} x {board.size_m[1]:g} m fits the picture within "
                         f"scan.depth_range; use a smaller board or widen the range")  # fmt: skip
    chosen = sequence(choices, behind + poses + math.ceil(MISSED_SHARE * poses), seed)[behind:]
    return lambda views: Advice(chosen[len(views)], at_m) if len(views) < len(chosen) else None


def first_camera(config: RigConfig) -> Camera:
    """A camera for placing boards: that of the config's calibration or, if it has no usable one, a rough one. For the
    latter the rig is opened."""
    if config.calibration is not None:
        try:
            return load_rig_model(config.calibration).camera
        except CalibrationError:
            pass  # it is about to be replaced
    with open_rig(config.model_copy(update={"calibration": None})) as rig:
        return rough_camera((rig.spad.info.width, rig.spad.info.height))


def take_live(
    session: Session,
    live: RigConfig,
    request: BoardRequest,
    choose: ChoosePose,
    ask: AskPerson | None = None,
    *,
    exposures: Sequence[int] = (),
    defects: NDArray[np.bool_] | None = None,
    line: bool = True,
) -> None:
    """Take views of a board moved from pose to pose, until as many as requested are good. Ends early if `choose` has no
    further pose, if no other pose would help (`LASTING`), or after MISSED_SHARE more poses than requested.

    choose: chooses the poses. ask: asks a person to move the board.
    exposures: per column, used in turn, so that the mirror is seen at several speeds (see `SpeedRotation`); empty: the
      config's.
    defects: (rows, width), pixels that are not used. line: whether a good view has to show the line on the board.
    """

    def sees(capture: Capture) -> bool:
        return capture.refused is None and (not line or shows_line(capture.view))

    good, seen, reasons = 0, list[View](), list[str]()
    speeds = SpeedRotation(exposures, sees, session.tell)
    while good < request.poses and len(seen) < request.poses + math.ceil(MISSED_SHARE * request.poses):
        advice = choose(seen)
        if advice is None:
            return
        place, at = f"pose {good + 1} of {request.poses}", len(session.views)
        config = shown(live, f"{place}: {advice}", advice.candidate, ask, session.tell)
        scan = partial(capture_view, config, f"{at:03d}", session.board, seed=request.seed + at, arm=request.arm)
        with part(place):
            capture = speeds.capture(good, partial(scan, defects=defects))
        session.add_capture(capture)
        seen.append(capture.view)
        good += sees(capture)
        reasons.append("" if capture.refused is None else capture.refused.reason)
        if reasons in LASTING:
            session.say(f"{len(reasons)} views are {reasons[0]}, which no other pose will change: no more are taken")
            return


def take_kept(session: Session, sources: ViewSources, defects: NDArray[np.bool_] | None = None) -> None:
    """Take the views that need no live rig. defects: (rows, width), pixels that are not used. Raises UsageError for
    views of another board or rig, and for files that cannot be read."""
    for note in sources.notes:
        session.say(note)
    for folder in sources.sessions:
        _require_alike(folder, session.board)
        identity = session_rig(folder)
        for view in load_views(folder / VIEWS):
            session.add(view, None, identity, folder / VIEWS / view.name)
    for number, run in enumerate(sources.recorded, 1):
        with part(f"run {number} of {len(sources.recorded)}"):
            session.add_capture(capture_recorded(run, run.name, session.board, defects=defects), run)
    for done, file in enumerate(sources.pictures):
        tell_stage("finding the board", done, len(sources.pictures), "pictures")
        session.add(*_pictured(file, session.board), source=file)


def _require_alike(folder: Path, board: Board | None) -> None:
    """Raise UsageError if a session shows another board, or any where none is expected. Squares may differ in size."""
    file = folder / BOARD_FILE
    if not file.is_file():  # no board was looked for
        return
    known = load_board(file)
    if board is None:
        raise UsageError(
            f"{folder} holds views of a board that was moved, lags are told by what stands still; name a rig, runs of "
            "one unmoved scene, or the folder of an earlier 'rig calibrate sync'"
        )
    if _print(known) != _print(board):
        raise UsageError(
            f"{folder} holds views of a {_print(known)}, looked for is a {_print(board)}; name the board that was "
            f"shown: `board={file}`"
        )


def _print(board: Board) -> str:
    of = "" if board.dictionary is None else f" of {board.dictionary}"
    return f"{board.kind} board of {board.squares[0]} x {board.squares[1]} squares{of}"


def _pictured(file: Path, board: Board | None) -> tuple[View, Degenerate | None]:
    """A picture of the board as a view, and why it has no corners (None if it has). Raises UsageError if unreadable."""
    pixels = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
    if pixels is None:
        raise UsageError(f"{file} cannot be read as a picture; convert it to PNG")
    picture = np.asarray(pixels, np.float32)
    corners, refused = corners_in(picture, board)
    return View(file.name, corners, (), picture), refused


def refusal(
    refused: Degenerate, session: Session, board: Board, *, photons: bool = True, line: bool = True
) -> Degenerate:
    """The error for views that give no calibration: its message is the likely root cause, its notes the other reasons.

    photons, line: as in `judge_refused`.
    """
    if refused.reason == "no-board" and session.refused:  # replaced by the most common reason of the views
        (reason, _), *_ = Counter(why.reason for why in session.refused.values()).most_common()
        refused = Degenerate(reason, f"none of {len(session.views)} views shows the board as it should")
    reasons = judge_refused(refused, session.views, board, session.size, photons=photons, line=line).reasons
    error = Degenerate(reasons[0].code, str(reasons[0]))
    if str(refused) not in str(error):
        error.add_note(f"{refused.reason}: {refused}")
    for other in reasons[1:]:
        if other.text != str(refused):
            error.add_note(str(other))
    note_views(error, session)
    return error


def note_views(error: Degenerate, session: Session) -> None:
    """Add the problems of single views as notes, unless the session has a `tell`, which got them as the views came."""
    for name, why in session.refused.items() if session.tell is None else ():
        error.add_note(f"view {name}: {why}")
