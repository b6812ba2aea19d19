"""The folder of a calibration. Views are written as they come and are kept even if the calibration fails.

    views/000.npz ...  rig.json (the rig of the views)  board.yaml (their board)  calibration.yaml (+ .npy)  camera.yaml
    report.html  summary.json

`Session` holds the views and writes all files; `CalibrationResult` is what a calibration returns. If a session was
interrupted, or if its views gave no calibration, they are kept and can be a source for the next one. A view's file,
`views/000.npz`, has all that a fit needs. It is written completely or not at all:

    format_version () int   name () str   picture (height, width) float32, if there is one
    corner_ids (n,) int32   corner_px (n, 2) float64   corner_sd_px (n,) float64, if the board was found
    passages_0 (4, m) float64: x_px, y_px, command, sd   sweep_0 (2,) float64: direction, speed_per_s   passages_1 ...
"""

import io
from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import numpy as np
import yaml
from numpy.typing import NDArray

from calibration.board.board import Board
from calibration.depth_error import DepthErrors, depth_errors
from calibration.errors import Degenerate
from calibration.files.npy_files import load_arrays
from calibration.files.rig_file import CALIBRATION_FILE, corners_digest, save_rig_model
from calibration.model.rig_model import Identity, RigModel
from calibration.rig_fit.rig_state import FEWEST_PASSAGES, shows_line
from calibration.verdict import Verdict
from calibration.views import Corners, Passages, View
from drivers.json_text import parse_json
from rig.calibrate.capture import Capture, TellLine
from rig.calibrate.report import Report, report_page, subject
from rig.calibrate.sources import VIEWS
from rig.config.models import RigConfig
from rig.devices.calibration_use import KnowsRig, carry_notes, same_rig
from rig.devices.open import open_rig
from rig.errors import UsageError
from rig.run_folder.folder import RunFolder
from rig.scan.run import OutFolder, versions

LoadedCalibration = tuple[Path, RigModel]
"""A calibration: its file, and what it holds."""

RIG_FILE = "rig.json"
BOARD_FILE = "board.yaml"


def session_rig(folder: Path) -> Identity | None:
    """The rig of a session's views, from its file rig.json; None without that. Raises UsageError if it is damaged."""
    try:
        content = parse_json((folder / RIG_FILE).read_text(encoding="utf-8"))
        return Identity(**{**content, "reasons": tuple(content["reasons"])})
    except FileNotFoundError:
        return None
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise UsageError(f"{folder / RIG_FILE} does not say which rig it is of ({error}); remove it") from error


EXIT_NOT_TRUSTWORTHY = 1


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationResult:
    """Result of `rig calibrate camera`, `planes`, `sync` and `check`.

    line: the result in one line, such as 'at 5 m: 8 mm, 6 of them from the baseline'.
    figures: for people, (name, text).
    summary: for programs; the content of summary.json.
    model: the calibrated or checked model; None if only a camera was calibrated, or lags without a calibration.
    folder, calibration: paths of the session's folder and calibration file; None if they were not written.
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
        """Exit code of the command line: 0 if the verdict passed, else 1."""
        return 0 if self.verdict.passed else EXIT_NOT_TRUSTWORTHY

    def rows(self) -> list[tuple[str, str]]:
        """Figures for people, by name."""
        return list(self.figures)

    def as_json(self) -> Mapping[str, Any]:
        """Return what summary.json holds, as plain values."""
        return self.summary


class Session:
    """The views of a calibration, written one by one as they are taken, and then its result.

    views: those taken so far. refused: why no corners were found in a view, by the view's name. identity: the rig of
    the views; None if unknown.
    """

    def __init__(
        self,
        out: OutFolder,
        board: Board | None = None,
        tell: TellLine | None = None,
        of_camera: Collection[str] = (),
    ) -> None:
        """Claim the folder `out`; if it is None, nothing is written. Raises UsageError if it cannot be claimed.

        board: what the views show. tell: gets a line on each view. of_camera: digests of the views from which a known
        camera was made; they must not be used again.
        """
        self.views: list[View] = []
        self.refused: dict[str, Degenerate] = {}
        self.identity: Identity | None = None
        self.board = board
        self.tell = tell
        self._of_camera = of_camera
        self._seen: dict[str, str] = {}
        self._folder = None if out is None else RunFolder(out, in_place=True)

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the pictures. Raises UsageError if they differ in size or there are none."""
        sizes = {view.picture.shape[::-1] for view in self.views if view.picture is not None}
        if len(sizes) != 1:
            named = ", ".join(f"{width} x {height}" for width, height in sorted(sizes)) or "none"
            raise UsageError(f"pictures of the views have sizes {named}; views of one sensor make a calibration")
        width, height = sizes.pop()
        return width, height

    def __enter__(self) -> Self:
        """The session itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Keep the folder if it has a view, else remove it. A note on the error, if any, says where the views are."""
        if self._folder is None:
            return
        if self.views:
            self._folder.keep()
            if error is not None:
                kept = "1 view is" if len(self.views) == 1 else f"{len(self.views)} views are"
                error.add_note(f"{kept} in {self._folder.path}, which can be given as a source")
        self._folder.discard()

    def add_capture(self, capture: Capture, source: Path | None = None) -> None:
        """Add the view of a scan. source: the run, if it was recorded."""
        self.add(capture.view, capture.refused, capture.identity, source)

    def say(self, line: str) -> None:
        """Pass a line on to `tell`, if there is one."""
        if self.tell is not None:
            self.tell(line)

    def add(
        self,
        view: View,
        refused: Degenerate | None = None,
        identity: Identity | None = None,
        source: Path | None = None,
    ) -> None:
        """Add a view and write it; if its name is taken, it gets another. Raises UsageError for a view that would count
        twice or is of another rig, and if it cannot be written. source: file or run that the view comes from."""
        self._require_new(view, str(source or view.name))
        if view.name in [known.name for known in self.views]:
            view = replace(view, name=f"{view.name}-{len(self.views)}")
        if identity is not None:
            self._require_of_rig(identity)
        self._write(view)
        self.views.append(view)
        if refused is not None:
            self.refused[view.name] = refused
        self.say(told(view, refused))

    def _require_new(self, view: View, where: str) -> None:
        if view.corners is None:
            return
        digest = corners_digest(view)
        if digest in self._of_camera:
            raise UsageError(
                f"{where} holds a view that the camera was made of; a view must not count twice: give other views "
                "(of a simulated rig: another `seed`), or leave the camera out"
            )
        if digest in self._seen:
            raise UsageError(
                f"{where} holds the very corners of {self._seen[digest]}; a view must not count twice: name it once, "
                "or show the board again"
            )
        self._seen[digest] = where

    def _require_of_rig(self, identity: Identity) -> None:
        known = self.identity
        if known is None and self._folder is not None:
            self._folder.write_json(RIG_FILE, asdict(identity))
        if known is not None and not same_rig(known, identity):
            one, other = (f"{each.name} ({', '.join(_devices(each))})" for each in (known, identity))
            raise UsageError(f"views are of two rigs: {one} and {other}; calibrate each with its own")
        self.identity = identity

    def _write(self, view: View) -> None:
        if self._folder is not None:
            folder = self._folder.place(VIEWS)
            folder.mkdir(exist_ok=True)
            if self.board is not None and not self.views:
                self.write_text(BOARD_FILE, _board_text(self.board))
            save_view(view, folder / f"{len(self.views):03d}.npz")

    def write_text(self, name: str, text: str) -> None:
        """Write a file of text, if there is a folder."""
        if self._folder is not None:
            self._folder.write_text(name, text)

    def finish(
        self, command: str, result: CalibrationResult, report: Report, made_from: LoadedCalibration | None = None
    ) -> CalibrationResult:
        """Write the result, its report and its model, if it has one. Notes on failed checks of `made_from` are copied.

        Returns the result with its whole summary and, if there is a folder, the paths of what was written.
        """
        summary = {"command": command, **result.summary, "versions": versions()}
        result = replace(result, summary=summary)
        if self._folder is None:
            return result
        if result.model is not None:
            file = self._folder.place(CALIBRATION_FILE)
            save_rig_model(result.model, file)
            if made_from is not None:
                carry_notes(*made_from, file, result.model)
            result = replace(result, calibration=self._folder.path / CALIBRATION_FILE)
        about = subject(self.identity, self.board, summary["versions"], datetime.now(UTC))
        self._folder.write_text(
            "report.html", report_page(report, result.verdict, result.line, [*result.figures, *about])
        )
        self._folder.write_json("summary.json", summary)
        self._folder.publish()
        return replace(result, folder=self._folder.path)


def _devices(identity: Identity) -> list[str]:
    return [*identity.kinds.values(), *identity.serials.values()]


def _board_text(board: Board) -> str:
    """A board as YAML that `load_board` reads."""
    content: dict[str, Any] = {"kind": board.kind, "squares": list(board.squares), "square": _mm(board.square_m)}
    if board.marker_m is not None:
        content |= {"marker": _mm(board.marker_m), "dictionary": board.dictionary}
    return yaml.safe_dump(content, sort_keys=False, default_flow_style=None)


def _mm(length_m: float) -> str:
    return f"{length_m * 1e3:.10g} mm"


def told(view: View, refused: Degenerate | None) -> str:
    """Describe a view in one line: what is seen in it or, if it was `refused`, why it has no corners."""
    if refused is not None:
        return f"view {view.name}: {refused}"
    parts = [] if view.corners is None else [f"{len(view.corners.ids)} corners"]
    if view.passages:
        parts.append(f"{', '.join(str(len(sweep.command)) for sweep in view.passages)} passages of the line")
        if not shows_line(view):  # so few are as good as none
            where = "" if view.corners is None else ", or hold the board where the line passes"
            parts.append(
                f"too few to count (limit {FEWEST_PASSAGES} a sweep): the line does not stand out in single pixels; "
                f"give it more exposures per column (2 to 5 do in a dark room) or more power{where}"
            )
    return f"view {view.name}: {', '.join(parts) or 'neither corners nor passages'}"


def true_model(live: RigConfig | None) -> RigModel | None:
    """The true rig model, from a world that knows it; None for a real rig, or if its world does not know. Call it only
    after all estimates."""
    if live is None or live.world is None:
        return None
    with open_rig(live.model_copy(update={"calibration": None})) as rig:
        return rig.world.true_model() if isinstance(rig.world, KnowsRig) else None


def true_errors(model: RigModel, live: RigConfig | None, at_m: float) -> DepthErrors | None:
    """True depth errors of `model` at the distance `at_m`, against `true_model`; None if that is None."""
    truth = true_model(live)
    if truth is None:
        return None
    speed = 0.0 if model.speed_range_per_s is None else float(np.mean(model.speed_range_per_s))
    return depth_errors(model, truth, at_m, speed)


def truth_content(errors: DepthErrors | None) -> dict[str, Any] | None:
    """The true errors as plain values for the summary; None if there are none."""
    if errors is None:
        return None
    return {"at_m": errors.depth_m, "median_m": errors.median_m, "worst_m": errors.worst_m, "ratio_to_sd": errors.ratio}


VERSION: Final = 1
Arrays = Mapping[str, NDArray[Any]]


def save_view(view: View, file: Path) -> None:
    """Write a view, completely or not at all. Raises UsageError if it cannot be written."""
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
        arrays = load_arrays(file)
        version = int(arrays["format_version"])
        if version != VERSION:
            raise UsageError(f"{file} is a view of version {version}, this program reads version {VERSION}")
        return _view(arrays)
    except (OSError, ArithmeticError, KeyError, TypeError, ValueError) as error:
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
