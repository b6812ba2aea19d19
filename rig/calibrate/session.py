"""The folder of a calibration. Views are written as they come and are kept even if the calibration fails.

    views/000.npz ...  rig.json (whose they are)  board.yaml (of what)  calibration.yaml (+ .npy)  report.html
    summary.json

`Session` writes it; `CalibrationResult` is what a calibration returns. A session that was interrupted, or whose views
gave no calibration, leaves its views, which can be a source for the next. A view's file, `views/000.npz`, has all that
a fit needs of a pose. It is written completely or not at all:

    format_version () int   name () str   picture (height, width) float32, if there is one
    corner_ids (n,) int32   corner_px (n, 2) float64   corner_sd_px (n,) float64, if the board was found
    passages_0 (4, m) float64: x_px, y_px, command, sd   sweep_0 (2,) float64: direction, speed_per_s   passages_1 ...
"""

import io
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import numpy as np
import yaml
from numpy.typing import NDArray

from calibration.board.board import Board, load_board
from calibration.depth_error import DepthErrors, depth_errors
from calibration.files.npy_files import load_numpy
from calibration.files.rig_file import CALIBRATION_FILE, save_rig_model
from calibration.model.rig_model import Identity, RigModel
from calibration.verdict import Verdict
from calibration.views import Corners, Passages, View
from drivers.json_text import parse_json
from rig.calibrate.sources import VIEWS
from rig.config.models import RigConfig
from rig.devices.calibration_use import KnowsRig, carry_notes
from rig.devices.open import open_rig
from rig.errors import UsageError
from rig.run_folder.folder import RunFolder
from rig.scan.run import OutFolder

LoadedCalibration = tuple[Path, RigModel]
"""A calibration: its file, and what it holds."""

RIG_FILE = "rig.json"
BOARD_FILE = "board.yaml"


def session_rig(folder: Path) -> Identity | None:
    """The rig of a session's views; None if the session does not say."""
    try:
        content = parse_json((folder / RIG_FILE).read_text(encoding="utf-8"))
        return Identity(**{**content, "reasons": tuple(content["reasons"])})
    except FileNotFoundError:
        return None
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise UsageError(f"{folder / RIG_FILE} does not say which rig it is of ({error}); remove it") from error


def session_board(folder: Path) -> Board | None:
    """The board of a session's corners; None if no board was looked for."""
    file = folder / BOARD_FILE
    return load_board(file) if file.is_file() else None


class Session:
    """Writes the views of a calibration one by one, then the result."""

    def __init__(self, out: OutFolder, board: Board | None = None) -> None:
        """Claim the folder; None writes nothing. board: what the views show. Raises UsageError if it cannot be
        claimed."""
        self._board = board
        self._folder = None if out is None else RunFolder(out, in_place=True)
        self._views = 0

    @property
    def path(self) -> Path | None:
        """Path of the folder; None if nothing is written."""
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
        """Write to which rig the views belong."""
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
        self, summary: dict[str, Any], report: str, model: RigModel | None, made_from: LoadedCalibration | None = None
    ) -> Path | None:
        """Write the result, with notes on the calibration it was made from; return the new calibration's file,
        if any."""
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
    """A board as YAML that `load_board` reads."""
    content: dict[str, Any] = {"kind": board.kind, "squares": list(board.squares), "square": _mm(board.square_m)}
    if board.marker_m is not None:
        content |= {"marker": _mm(board.marker_m), "dictionary": board.dictionary}
    return yaml.safe_dump(content, sort_keys=False, default_flow_style=None)


def _mm(length_m: float) -> str:
    return f"{length_m * 1e3:.10g} mm"


EXIT_NOT_TRUSTWORTHY = 1


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationResult:
    """Result of `rig calibrate camera`, `planes`, `sync` and `check`.

    line: the result in one line, such as 'at 5 m: 8 mm, 6 of them from the baseline'.
    figures: for people, (name, text).
    summary: for programs; the content of summary.json.
    model: the calibrated or checked model; None if only a camera was calibrated.
    folder, calibration: where they were written; None if they were not.
    """

    verdict: Verdict
    line: str
    figures: tuple[tuple[str, str], ...]
    summary: Mapping[str, Any]
    model: RigModel | None = None
    folder: Path | None = None
    calibration: Path | None = None

    @property
    def exit_code(self) -> int:
        """Exit code of the command line: 0 for a usable calibration, 1 if its verdict failed."""
        return 0 if self.verdict.passed else EXIT_NOT_TRUSTWORTHY

    def rows(self) -> list[tuple[str, str]]:
        """Figures for people, by name."""
        return list(self.figures)

    def as_json(self) -> Mapping[str, Any]:
        """Return what summary.json holds, as plain values."""
        return self.summary


def named(names: Sequence[str]) -> str:
    """The number of these names, followed by the names, as text."""
    return f"{len(names)} ({', '.join(names)})" if names else "0"


def true_model(live: RigConfig) -> RigModel | None:
    """The rig as its world knows it; None for a real one. Called only after everything was estimated."""
    if live.world is None:
        return None
    with open_rig(live.model_copy(update={"calibration": None})) as rig:
        return rig.world.true_model() if isinstance(rig.world, KnowsRig) else None


def true_errors(model: RigModel, live: RigConfig, at_m: float) -> DepthErrors | None:
    """True depth errors, from the rig's world; None for a real rig."""
    truth = true_model(live)
    if truth is None:
        return None
    speed = 0.0 if model.speed_range_per_s is None else float(np.mean(model.speed_range_per_s))
    return depth_errors(model, truth, at_m, speed)


def truth_content(errors: DepthErrors) -> dict[str, Any]:
    """The true errors as plain values for the summary."""
    return {
        "at_m": errors.depth_m,
        "median_m": errors.median_m,
        "worst_m": errors.worst_m,
        "ratio_to_sd": errors.ratio,
    }


VERSION: Final = 1
Arrays = Mapping[str, NDArray[Any]]


def save_view(view: View, file: Path) -> None:
    """Write a view in one step. Raises UsageError if it cannot be written."""
    stream = io.BytesIO()
    np.savez_compressed(stream, allow_pickle=False, **_arrays(view))
    part = file.with_name(f".{file.name}.part")
    try:
        part.write_bytes(stream.getvalue())
        part.replace(file)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise UsageError(
            f"cannot write {file}: {error.strerror or error}; name another folder or free the space it needs"
        ) from error


def load_view(file: Path) -> View:
    """Read a view. Raises UsageError if the file holds none."""
    try:
        with load_numpy(file) as arrays:
            version = int(arrays["format_version"])
            if version != VERSION:
                raise UsageError(f"{file} is a view of version {version}, this program reads version {VERSION}")
            return _view(arrays)
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise UsageError(f"{file} is no view of a calibration ({error}); take it out of the folder") from error


def load_views(folder: Path) -> tuple[View, ...]:
    """Read all views of a folder, in the order of their files. Raises UsageError if there are none or one is
    damaged."""
    files = sorted(folder.glob("*.npz"))
    if not files:
        raise UsageError(f"{folder} holds no view (*.npz); name the folder of an earlier calibration")
    return tuple(load_view(file) for file in files)


def _arrays(view: View) -> dict[str, NDArray[Any]]:
    arrays: dict[str, NDArray[Any]] = {"format_version": np.array(VERSION), "name": np.array(view.name)}
    if view.picture is not None:
        arrays["picture"] = view.picture
    if view.corners is not None:
        arrays |= {"corner_ids": view.corners.ids, "corner_px": view.corners.px}
        if view.corners.sd_px is not None:
            arrays["corner_sd_px"] = view.corners.sd_px
    for number, sweep in enumerate(view.passages):
        arrays[f"passages_{number}"] = np.stack([sweep.x_px, sweep.y_px, sweep.command, sweep.sd])
        arrays[f"sweep_{number}"] = np.array([sweep.direction, sweep.speed_per_s])
    return arrays


def _view(arrays: Arrays) -> View:
    corners = None
    if "corner_ids" in arrays:
        corners = Corners(arrays["corner_ids"], arrays["corner_px"], arrays.get("corner_sd_px"))
    passages: list[Passages] = []
    while (key := f"passages_{len(passages)}") in arrays:
        direction, speed_per_s = arrays[f"sweep_{len(passages)}"]
        x_px, y_px, command, sd = arrays[key]
        passages.append(Passages(x_px, y_px, command, sd, int(direction), float(speed_per_s)))
    return View(str(arrays["name"]), corners, tuple(passages), arrays.get("picture"))
