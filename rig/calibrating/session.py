"""The folder of a calibration: its views are written as they come and stay, whatever becomes of the rest.

    views/000.npz ...  rig.json (whose they are)  board.yaml (of what)  calibration.yaml (+ .npy)  report.html
    summary.json

A session that was interrupted, or whose views made no calibration, leaves its views, which are a source for the next.
"""

from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import yaml

from calibration.board.board import Board, load_board
from calibration.files.rig_file import CALIBRATION_FILE, save_rig_model
from calibration.model.rig_model import Identity, RigModel
from calibration.views import View
from drivers.json_text import parse_json
from rig.calibrating.sources import VIEWS
from rig.calibrating.view_files import save_view
from rig.calibration_notes import carry_notes
from rig.errors import UsageError
from rig.outputs import RunFolder
from rig.run import OutFolder

Made = tuple[Path, RigModel]
"""A calibration: its file, and what it holds."""

RIG_FILE = "rig.json"
BOARD_FILE = "board.yaml"


def session_rig(folder: Path) -> Identity | None:
    """Which rig the views of a session are of; None where it does not say."""
    try:
        content = parse_json((folder / RIG_FILE).read_text(encoding="utf-8"))
        return Identity(**{**content, "reasons": tuple(content["reasons"])})
    except FileNotFoundError:
        return None
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise UsageError(f"{folder / RIG_FILE} does not say which rig it is of ({error}); remove it") from error


def session_board(folder: Path) -> Board | None:
    """The board that a session's corners are of; None where none was looked for."""
    file = folder / BOARD_FILE
    return load_board(file) if file.is_file() else None


class Session:
    """Takes views one by one, then what was made of them."""

    def __init__(self, out: OutFolder, board: Board | None = None) -> None:
        """Claim the folder; None: write nothing. board: what the views show. UsageError where it cannot be."""
        self._board = board
        self._folder = None if out is None else RunFolder(out, in_place=True)
        self._views = 0

    @property
    def path(self) -> Path | None:
        """The folder."""
        return None if self._folder is None else self._folder.path

    def __enter__(self) -> Self:
        """The session itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Keep what was written if there is a view among it, and say so where something went wrong."""
        if self._folder is None:
            return
        if self._views:
            self._folder.keep()
            if error is not None:
                kept = "1 view is" if self._views == 1 else f"{self._views} views are"
                error.add_note(f"{kept} in {self._folder.path}, which can be given as a source")
        self._folder.discard()

    def note_rig(self, identity: Identity) -> None:
        """Write which rig the views are of."""
        if self._folder is not None:
            self._folder.write_json(RIG_FILE, asdict(identity))

    def add(self, view: View) -> None:
        """Write a view."""
        if self._folder is not None:
            folder = self._folder.place(VIEWS)
            folder.mkdir(exist_ok=True)
            if self._board is not None and not self._views:
                self.write_text(BOARD_FILE, _board_text(self._board))
            save_view(view, folder / f"{self._views:03d}.npz")
            self._views += 1

    def write_text(self, name: str, text: str) -> None:
        """Write a file of text."""
        if self._folder is not None:
            self._folder.write_text(name, text)

    def finish(
        self, summary: dict[str, Any], report: str, model: RigModel | None, made_from: Made | None = None
    ) -> Path | None:
        """Write what was made of the views; the calibration's file, None where there is none.

        made_from: file and content of the calibration that the model is a change of; what failed on it goes with it.
        """
        if self._folder is None:
            return None
        file = None
        if model is not None:
            file = self._folder.place(CALIBRATION_FILE)
            save_rig_model(model, file)
            if made_from is not None:
                carry_notes(*made_from, file, model)
        self._folder.write_text("report.html", report)
        self._folder.write_json("summary.json", summary)
        self._folder.publish()
        return None if file is None else self._folder.path / CALIBRATION_FILE


def _board_text(board: Board) -> str:
    """What `load_board` reads."""
    content: dict[str, Any] = {"kind": board.kind, "squares": list(board.squares), "square": _mm(board.square_m)}
    if board.marker_m is not None:
        content |= {"marker": _mm(board.marker_m), "dictionary": board.dictionary}
    return yaml.safe_dump(content, sort_keys=False, default_flow_style=None)


def _mm(length_m: float) -> str:
    return f"{length_m * 1e3:.10g} mm"
