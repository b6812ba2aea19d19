"""How later checks of a calibration ended, noted in a file beside it: the calibration itself stays as it is."""

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from calibration.model.rig_model import RigModel
from drivers.json_text import parse_json
from rig.errors import UsageError


def note_check(file: Path, model: RigModel, what: str, *, passed: bool, reasons: tuple[str, ...] = ()) -> Path:
    """Note beside a calibration file how a check of it ended; `what`: check or pixels. Raises OSError."""
    beside = _beside(file)
    notes = _read_notes(beside)
    date = datetime.now(UTC).isoformat(timespec="seconds")
    notes[what] = {"calibration": model.fingerprint(), "date": date, "passed": passed, "reasons": list(reasons)}
    scratch = beside.with_name(f".{beside.name}.part")
    scratch.write_text(json.dumps(notes, indent=1) + "\n", encoding="utf-8")
    scratch.replace(beside)
    return beside


def carry_notes(old: Path, before: RigModel, new: Path, after: RigModel, *, new_pixels: bool = False) -> None:
    """Have what failed on a calibration speak against the one that was made from it. Raises OSError.

    new_pixels: what was said of the old ones is no longer so.
    """
    failed = {what: note for what, note in notes_on(old, before).items() if not note.get("passed", True)}
    if new_pixels:
        failed.pop("pixels", None)
    for what, note in failed.items():
        note_check(new, after, what, passed=False, reasons=tuple(note.get("reasons") or ()))


def _beside(file: Path) -> Path:
    return file.with_name(f"{file.stem}-checks.json")


def notes_on(file: Path | None, model: RigModel) -> dict[str, dict[str, Any]]:
    """Notes on this very calibration, by what was checked; none where there is no file."""
    if file is None:
        return {}
    notes = _read_notes(_beside(file))
    return {what: note for what, note in notes.items() if note.get("calibration") == model.fingerprint()}


def _read_notes(file: Path) -> dict[str, dict[str, Any]]:
    try:
        notes = parse_json(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise UsageError(f"{file} cannot be read ({error}); remove it and check the calibration again") from error
    if not isinstance(notes, dict) or not all(isinstance(note, dict) for note in notes.values()):
        raise UsageError(f"{file} holds no notes on a calibration; remove it and check the calibration again")
    return notes
