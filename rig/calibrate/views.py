"""Takes views from all sources. They are stored as they come; no view is taken twice, and all must be of one rig.

`ViewCollection` holds them. `take_live` takes them with a live rig, pose by pose, as `LiveViewOptions` says;
`take_kept` takes those of earlier sessions, recorded runs and pictures. `told` and `refusal` are the messages about
views, and about views that give no calibration.
"""

import math
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.board.board import Board
from calibration.board.detect import find_corners
from calibration.diagnosis.rules import FEWEST_POSES, FEWEST_WHY
from calibration.diagnosis.verdicts import judge_refused
from calibration.errors import CalibrationError, Degenerate
from calibration.files.rig_file import corners_digest, load_rig_model
from calibration.guide import Advice, candidates, rough_camera, sequence
from calibration.model.camera import Camera
from calibration.model.rig_model import Identity
from calibration.rig_fit.state import FEWEST_PASSAGES, shows_line
from calibration.views import View
from rig.calibrate.capture import AskPerson, Capture, SpeedRotation, TellLine, capture_recorded, capture_view, shown
from rig.calibrate.session import BOARD_FILE, Session, load_views, session_board, session_rig
from rig.calibrate.sources import VIEWS, ViewSources
from rig.config.models import RigConfig
from rig.devices.calibration_use import same_rig
from rig.devices.open import open_rig
from rig.errors import UsageError
from rig.progress import part, tell_stage


class ViewCollection:
    """The views taken so far; the reasons for those without corners; and the rig they belong to (None if unknown)."""

    def __init__(self, session: Session, tell: TellLine | None = None, of_camera: Collection[str] = ()) -> None:
        """Take what keeps the views, what gets a line on each, and the digests of views that a camera was made of."""
        self.views: list[View] = []
        self.refused: dict[str, Degenerate] = {}
        self.identity: Identity | None = None
        self._session = session
        self.tell = tell
        self._seen: dict[str, str] = {}
        self._of_camera = of_camera

    def add(
        self,
        view: View,
        refused: Degenerate | None = None,
        identity: Identity | None = None,
        source: Path | None = None,
    ) -> None:
        """Add a view from a file or run under a name of its own. Raises UsageError for one that would count twice."""
        self._require_new(view, str(source or view.name))
        if view.name in [known.name for known in self.views]:
            view = replace(view, name=f"{view.name}-{len(self.views)}")
        self.views.append(view)
        if refused is not None:
            self.refused[view.name] = refused
        self._of_rig(identity)
        self._session.add(view)
        self.say(told(view, refused))

    def say(self, line: str) -> None:
        """Pass a line on to `tell`, if there is one."""
        if self.tell is not None:
            self.tell(line)

    def _require_new(self, view: View, where: str) -> None:
        if view.corners is None:
            return
        digest = corners_digest(view)
        if digest in self._of_camera:
            raise UsageError(
                f"{where} holds a view that the camera was made of; a view must not count twice: give other views "
                "(of a simulated rig: another --seed), or leave the camera out"
            )
        if digest in self._seen:
            raise UsageError(
                f"{where} holds the very corners of {self._seen[digest]}; a view must not count twice: name it once, "
                "or show the board again"
            )
        self._seen[digest] = where

    def _of_rig(self, identity: Identity | None) -> None:
        if identity is None:
            return
        if self.identity is None:
            self._session.note_rig(identity)
        elif not same_rig(self.identity, identity):
            raise UsageError(
                f"views are of two rigs: {self.identity.name} ({_devices(self.identity)}) and {identity.name} "
                f"({_devices(identity)}); calibrate each with its own"
            )
        self.identity = identity

    def add_capture(self, capture: Capture, source: Path | None = None) -> None:
        """Add the view of a scan. source: the run, if it was recorded."""
        self.add(capture.view, capture.refused, capture.identity, source)

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the pictures. Raises UsageError if views differ in size."""
        sizes = {view.picture.shape[::-1] for view in self.views if view.picture is not None}
        if len(sizes) != 1:
            named = ", ".join(f"{width} x {height}" for width, height in sorted(sizes)) or "none"
            raise UsageError(f"pictures of the views have sizes {named}; views of one sensor make a calibration")
        width, height = sizes.pop()
        return width, height


def _devices(identity: Identity) -> str:
    return ", ".join([*identity.kinds.values(), *identity.serials.values()])


MISSED_SHARE = 0.5
"""Share of further poses that are shown where the board is not found in some."""

LASTING = (["wrong-board"] * 3, ["mirrored"] * 3)
"""Refusals of a session's first views which no pose of the board will change: the session ends with them."""


ChoosePose = Callable[[Sequence[View]], Advice | None]
"""A function that says which pose to show after these views; None if no more are needed."""


def in_order(poses: Sequence[Advice]) -> ChoosePose:
    """A function that chooses the poses of a sequence one after the other."""
    return lambda views: poses[len(views)] if len(views) < len(poses) else None


def require_poses(taken: ViewCollection, poses: int) -> None:
    """Raise UsageError if this number of poses, with the views taken already, is too small whatever they show."""
    there = sum(view.corners is not None for view in taken.views)
    if there + poses < FEWEST_POSES:
        beside = f" and {there} view{'s' * (there > 1)} taken before" if there else ""
        raise UsageError(
            f"poses is {poses}{beside}; {FEWEST_POSES} {FEWEST_WHY}: ask for {FEWEST_POSES - there} or more"
        )


def good_poses(config: RigConfig, board: Board, poses: int, at_m: float, seed: int, behind: int = 0) -> list[Advice]:
    """Poses that tell most about any rig, with some to spare. behind: number of poses of the sequence already shown."""
    choices = candidates(first_camera(config), board, config.scan.depth_range)
    if not choices:
        raise UsageError(f"no pose of a board of {board.size_m[0]:g} x {board.size_m[1]:g} m fits the picture within "
                         f"scan.depth_range; use a smaller board or widen the range")  # fmt: skip
    chosen = sequence(choices, behind + poses + math.ceil(MISSED_SHARE * poses), seed)
    return [Advice(candidate, at_m) for candidate in chosen[behind:]]


def first_camera(config: RigConfig) -> Camera:
    """A camera for placing boards: that of the config's calibration, or a rough one of the sensor's size."""
    if config.calibration is not None:
        try:
            return load_rig_model(config.calibration).camera
        except CalibrationError:
            pass  # it is about to be replaced
    with open_rig(config.model_copy(update={"calibration": None})) as rig:
        return rough_camera((rig.spad.info.width, rig.spad.info.height))


@dataclass(frozen=True, slots=True)
class LiveViewOptions:
    """Settings of `take_live`: views with a live rig.

    poses: number of good views wanted. choose: chooses the poses. ask: asks a person to move the board.
    exposures: per column, used in turn, so that the mirror is seen at several speeds; speeds that the rig cannot do are
      left out, and those that never show the line although more exposures do; empty is as the config says.
    line: whether the line has to be seen on the board. defects: (rows, width), pixels that are not used. seed: of
      everything simulated.
    """

    config: RigConfig
    poses: int
    choose: ChoosePose
    ask: AskPerson | None = None
    exposures: Sequence[int] = ()
    seed: int = 0
    arm: bool = False
    defects: NDArray[np.bool_] | None = None
    line: bool = True

    def sees(self, capture: Capture) -> bool:
        """Whether a capture shows the board and, if required, the line."""
        return capture.refused is None and (not self.line or shows_line(capture.view))


def take_live(taken: ViewCollection, live: LiveViewOptions, board: Board) -> None:
    """Take views of a board that is moved from pose to pose."""
    good, seen, reasons = 0, list[View](), list[str]()
    speeds = SpeedRotation(live.exposures, live.sees, taken.tell)
    while good < live.poses and len(seen) < live.poses + math.ceil(MISSED_SHARE * live.poses):
        advice = live.choose(seen)
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


def _scan(
    taken: ViewCollection, live: LiveViewOptions, config: RigConfig, board: Board, exposures: int | None
) -> Capture:
    """Take one view of the board where it is."""
    at = len(taken.views)
    return capture_view(
        config, f"{at:03d}", board, seed=live.seed + at, exposures=exposures, arm=live.arm, defects=live.defects
    )


def take_kept(
    taken: ViewCollection, sources: ViewSources, board: Board | None, defects: NDArray[np.bool_] | None = None
) -> None:
    """Take the views that need no live rig. defects: (rows, width), pixels that are not used. board: None if nothing
    moves.
    """
    for note in sources.notes:
        taken.say(note)
    for folder in sources.sessions:
        _require_alike(folder, board)
        identity = session_rig(folder)
        for view in load_views(folder / VIEWS):
            taken.add(view, None, identity, folder / VIEWS / view.name)
    for number, run in enumerate(sources.recorded, 1):
        with part(f"run {number} of {len(sources.recorded)}"):
            taken.add_capture(capture_recorded(run, run.name, board, defects=defects), run)
    for done, file in enumerate(sources.pictures):
        tell_stage("finding the board", done, len(sources.pictures), "pictures")
        taken.add(*_pictured(file, board), source=file)


def _require_alike(folder: Path, board: Board | None) -> None:
    """Raise UsageError where a session shows another board; the side of the squares may have been measured anew."""
    known = session_board(folder)
    if known is None:
        return
    if board is None:
        raise UsageError(
            f"{folder} holds views of a board that was moved, lags are told by what stands still; name a rig, runs of "
            "one unmoved scene, or the folder of an earlier 'rig calibrate sync'"
        )
    if _print(known) != _print(board):
        raise UsageError(
            f"{folder} holds views of a {_print(known)}, looked for is a {_print(board)}; name the board that was "
            f"shown: --board {folder / BOARD_FILE}"
        )


def _print(board: Board) -> str:
    of = "" if board.dictionary is None else f" of {board.dictionary}"
    return f"{board.kind} board of {board.squares[0]} x {board.squares[1]} squares{of}"


def _pictured(file: Path, board: Board | None) -> tuple[View, Degenerate | None]:
    """Read a picture of the board, taken with any camera, as a view."""
    pixels = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
    if pixels is None:
        raise UsageError(f"{file} cannot be read as a picture; convert it to PNG")
    picture = np.asarray(pixels, np.float32)
    try:
        corners = None if board is None else find_corners(np.asarray(pixels), board)
        return View(file.name, corners, (), picture), None
    except Degenerate as error:
        return View(file.name, None, (), picture), error


def refusal(
    refused: Degenerate, taken: ViewCollection, board: Board, *, photons: bool = True, line: bool = True
) -> Degenerate:
    """The error for views that give no calibration, with its root cause, and everything else in notes.

    The other arguments are as in `judge_refused`.
    """
    refused = _of_views(refused, taken)
    reasons = judge_refused(refused, taken.views, board, taken.size, photons=photons, line=line).reasons
    error = Degenerate(reasons[0].code, str(reasons[0]))
    if str(refused) not in str(error):
        error.add_note(f"{refused.reason}: {refused}")
    for reason in reasons[1:]:
        if reason.text != str(refused):
            error.add_note(str(reason))
    note_views(error, taken)
    return error


def note_views(error: Degenerate, taken: ViewCollection) -> None:
    """Add the problems of single views as notes, unless they were reported when the views were taken."""
    for name, why in taken.refused.items() if taken.tell is None else ():
        error.add_note(f"view {name}: {why}")


def _of_views(refused: Degenerate, taken: ViewCollection) -> Degenerate:
    """The reason why most views have no board, where that is why there is no model; otherwise the error as it is."""
    if refused.reason != "no-board" or not taken.refused:
        return refused
    (reason, _), *_ = Counter(why.reason for why in taken.refused.values()).most_common()
    return Degenerate(reason, f"none of {len(taken.views)} views shows the board as it should")


def told(view: View, refused: Degenerate | None) -> str:
    """Describe a view in one line: what is seen in it or, if it was `refused`, why it has no corners."""
    if refused is not None:
        return f"view {view.name}: {refused}"
    parts = [] if view.corners is None else [f"{len(view.corners.ids)} corners"]
    if view.passages:
        counts = ", ".join(str(len(sweep.command)) for sweep in view.passages)
        parts.append(f"{counts} passages of the line" + ("" if shows_line(view) else _too_few(view)))
    return f"view {view.name}: {', '.join(parts) or 'neither corners nor passages'}"


def _too_few(view: View) -> str:
    """Say why so few passages are as good as none, and what to do about it."""
    where = "" if view.corners is None else ", or hold the board where the line passes"
    return (
        f", too few to count (limit {FEWEST_PASSAGES} a sweep): the line does not stand out in single pixels; give it "
        f"more exposures per column (2 to 5 do in a dark room) or more power{where}"
    )
