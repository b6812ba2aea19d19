"""The call that makes one page of a run, of two runs, a calibration, a trade-off, a comparison or a study: `report`.

Most reports are of runs, and somebody waits for them. So modules that only other reports need are imported late.
"""

from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from calibration.errors import CalibrationError
from calibration.files.rig_file import CALIBRATION_FILE, load_rig_model
from rig.config.overrides import PathLike
from rig.errors import UsageError, absent
from rig.report.calibration import calibration_report
from rig.report.page import is_report
from rig.report.run import run_report
from rig.report.run_facts import read_run
from rig.run_folder.disk import replace_file
from rig.run_folder.runs import is_run

STUDY_FILE: Final = "study.json"
_WHAT: Final = "name the folder of a run, a calibration, a trade-off, a comparison or a study, or a calibration.yaml"


@dataclass(frozen=True, slots=True)
class ReportResult:
    """A written report. kind: run, runs, calibration, tradeoff, comparison or study. missing: sentences on what the
    shown runs lack."""

    file: Path
    kind: str
    bytes: int
    missing: tuple[str, ...] = ()


def report(
    run: PathLike, other: PathLike | None = None, *, out: PathLike | None = None, map: int | None = None
) -> ReportResult:
    """Write one HTML page, which needs no other file: on a run or recording, on two of them side by side, on a
    calibration, a trade-off, a comparison of strategies, or a study (`rig report`).

    run: the folder; for a calibration also its file.
    other: a second run.
    out: the file to write; None: NAME-report.html beside the folder or file. An older report is replaced.
    map: number of the map that is shown; None: the last one.

    The page names whatever is missing in a run. Raises UsageError for any other folder or file, for a map that does not
    exist, and if `out` cannot be written or exists and is no report.
    """
    folder, second = Path(run), None if other is None else Path(other)
    kind = _kind(folder)
    missing: tuple[str, ...] = ()
    if kind != "run" and (second is not None or map is not None):
        what = f"beside {second}" if second is not None else f"with map {map}"
        raise UsageError(f"{folder} is a {kind}, which cannot be shown {what}; name the folder of a run first")
    if kind == "run":
        if second is not None and _kind(second) != "run":
            raise UsageError(f"{second} is no run, so it cannot stand beside {folder}; name the folder of a run")
        runs = [read_run(each, map) for each in ([folder] if second is None else [folder, second])]
        kind = "run" if second is None else "runs"
        text = run_report(runs)
        missing = tuple(line if second is None else f"{each.folder}: {line}" for each in runs for line in each.missing)
    elif kind == "calibration":
        text = _calibration(folder)
    elif kind == "study":
        from rig.study.tables import study_report

        text = study_report(folder)
    elif kind == "comparison":
        from rig.strategies.comparison.files import comparison_report

        text = comparison_report(folder)
    else:
        from rig.tradeoff.files import tradeoff_report

        text = tradeoff_report(folder)
    file = Path(out) if out is not None else _beside(folder, second)
    _write(file, text)
    return ReportResult(file, kind, len(text.encode()), missing)


def _kind(path: Path) -> str:
    if not path.exists():
        raise UsageError(absent(path, _WHAT, _can_be_shown))
    if path.is_dir():
        if is_run(path):
            return "run"
        if (path / CALIBRATION_FILE).exists():
            return "calibration"
        if (path / STUDY_FILE).exists():
            return "study"
        from rig.tradeoff.files import TRADEOFF_FILE

        if (path / TRADEOFF_FILE).exists():
            return "tradeoff"
        from rig.strategies.comparison.files import COMPARISON_FILE

        if (path / COMPARISON_FILE).exists():
            return "comparison"
        raise UsageError(f"{path} holds no run, no calibration, no trade-off, no comparison and no study; {_WHAT}")
    if path.suffix in (".yaml", ".yml"):
        return "calibration"
    raise UsageError(f"{path} is a file; {_WHAT}")


def _can_be_shown(path: Path) -> bool:
    try:
        _kind(path)
    except UsageError:
        return False
    return True


def _calibration(path: Path) -> str:
    from rig.devices.calibration_use import notes_on

    file = path / CALIBRATION_FILE if path.is_dir() else path
    try:
        model = load_rig_model(file)
    except CalibrationError as error:
        raise UsageError(str(error)) from error
    more = []
    if path.is_dir() and (path / "report.html").exists():
        more.append(f"{path / 'report.html'}   # views, residuals and terms, as the calibration wrote them")
    more.append(f"rig calibrate check --calibration {file}   # is it still true?")
    return calibration_report(file, model, notes_on(file, model), datetime.now(UTC), more)


def _beside(path: Path, other: Path | None) -> Path:
    whole = path.absolute()
    name = whole.stem if whole.is_file() else whole.name
    second = "" if other is None else f"-and-{other.absolute().name}"
    return whole.with_name(f"{name}{second}-report.html")


def _write(file: Path, text: str) -> None:
    """Write the page. Only an older report may be replaced."""
    try:
        if file.is_dir():
            raise UsageError(f"`out={file}` is a folder; name a file, such as {file / 'report.html'}")
        if file.exists() and not is_report(file):
            raise UsageError(f"`out={file}` exists and is no report; name another file, or remove this one")
        replace_file(file, text.encode())
    except OSError as error:
        raise UsageError(f"cannot write {file}: {error.strerror or error}; name another file as `out`") from error
