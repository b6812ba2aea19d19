"""Opening a recording for the commands that read one: what is wrong with the folder is its user's to mend."""

from pathlib import Path
from typing import Any, Final

from drivers.errors import DeviceNotFound, ProtocolError
from drivers.recorded import RunRecording
from drivers.recorded.segments import segment_files
from rig.errors import DamagedRecordingError, UsageError
from rig.recording.manifest import MANIFEST, read_manifest

SEGMENTS: Final = "frames-*.spb"
"""Files that the frames of a recording lie in."""


def open_recording(folder: Path) -> RunRecording:
    """The recording of a run. UsageError where there is none, DamagedRecordingError where nothing of it is left."""
    require_recording(folder)
    try:
        return RunRecording(folder)
    except DeviceNotFound as error:
        raise UsageError(str(error)) from None
    except ProtocolError as error:
        raise DamagedRecordingError(str(error)) from None


def require_recording(path: Path) -> None:
    """UsageError where a path is no folder with a recording, saying what it is instead."""
    if not (path.is_dir() and segment_files(path)):
        raise UsageError(f"{path} {_instead(path)}")


def _instead(path: Path) -> str:
    """What a path without a recording is, and the next step."""
    if path.is_file():
        recorded = path.match(f"{SEGMENTS}*")
        then = "the folder that it lies in" if recorded else "the folder of a run taken with --record"
        return f"is a file; name {then}"
    if not path.exists():
        return "does not exist; name the folder of a run taken with --record"
    inside = sorted(part for part in path.iterdir() if part.is_dir() and segment_files(part))
    if inside:
        more = "" if len(inside) == 1 else f" or another of {len(inside)} in it"
        return f"is a folder without a recording ({SEGMENTS}) of its own; name {inside[0]}{more}"
    if (path / MANIFEST).exists() or (path / "stripe").is_dir():
        return (
            f"holds no recording ({SEGMENTS}): the frames of this run were not recorded; take it again with "
            "'rig scan --record'"
        )
    for suffix, kind in ((".npy", "photoncube"), (".bin", "swissspad2 (or pi-imaging)")):
        if any(path.glob(f"*{suffix}")):
            return (
                f"is a folder without a recording: no {SEGMENTS}, but {suffix} files; if these are frames, "
                f"'rig import {kind} {path} --out DIR' makes a recording of them"
            )
    what = "a folder without a recording" if any(path.iterdir()) else "an empty folder"
    return f"is {what}: no {SEGMENTS}; name the folder of a run taken with --record"


def manifest_or_none(folder: Path) -> tuple[dict[str, Any] | None, str | None]:
    """The manifest, or why there is none."""
    try:
        manifest = read_manifest(folder)
    except DamagedRecordingError as error:
        return None, str(error)
    return manifest, None if manifest is not None else "manifest.json is missing; 'rig repair' writes one"
