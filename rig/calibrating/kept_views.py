"""Views that need no live rig: those of earlier sessions, of recorded runs, and pictures."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.board.board import Board
from calibration.board.detection import find_corners
from calibration.errors import Degenerate
from calibration.views import View
from rig.calibrating.capture import capture_recorded
from rig.calibrating.session import BOARD_FILE, session_board, session_rig
from rig.calibrating.sources import VIEWS, Sources
from rig.calibrating.taken import Taken
from rig.calibrating.view_files import load_views
from rig.errors import UsageError
from rig.progress import part, tell_stage


def take_kept(taken: Taken, sources: Sources, board: Board | None, defects: NDArray[np.bool_] | None = None) -> None:
    """Take the views that need no live rig. board: None where nothing moves and none is looked for.

    defects: (rows, width), pixels not to be used.
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
    """UsageError where a session's views do not show what is looked for. The squares' side may be another now: it is
    what is corrected where it was measured wrong.
    """
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
    """A picture of the board, taken with anything."""
    pixels = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
    if pixels is None:
        raise UsageError(f"{file} cannot be read as a picture; convert it to PNG")
    picture = np.asarray(pixels, np.float32)
    try:
        corners = None if board is None else find_corners(np.asarray(pixels), board)
        return View(file.name, corners, (), picture), None
    except Degenerate as error:
        return View(file.name, None, (), picture), error
