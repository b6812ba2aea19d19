"""Opening a recording for the commands that read one: what is wrong with the folder is its user's to mend."""

from pathlib import Path
from typing import Any

from drivers.errors import DeviceNotFound, ProtocolError
from drivers.recorded import RunRecording
from rig.errors import DamagedRecordingError, UsageError
from rig.recording.manifest import read_manifest


def open_recording(folder: Path) -> RunRecording:
    """The recording of a run. UsageError where there is none, DamagedRecordingError where nothing of it is left."""
    require_folder(folder)
    try:
        return RunRecording(folder)
    except DeviceNotFound as error:
        raise UsageError(str(error)) from None
    except ProtocolError as error:
        raise DamagedRecordingError(str(error)) from None


def require_folder(path: Path) -> None:
    """UsageError for one file of a recording."""
    if path.is_file():
        raise UsageError(f"{path} is a file; name the folder that it lies in")


def manifest_or_none(folder: Path) -> tuple[dict[str, Any] | None, str | None]:
    """The manifest, or why there is none."""
    try:
        manifest = read_manifest(folder)
    except DamagedRecordingError as error:
        return None, str(error)
    return manifest, None if manifest is not None else "manifest.json is missing; 'rig repair' writes one"
