"""Plays a recording: opens its devices, scans, and compares what drivers send with what they sent when it was taken."""

import logging
import tempfile
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from drivers.errors import DeviceError
from drivers.recorded import RunRecording
from drivers.replay.pace import Pace
from drivers.replay.spad import ReplaySpad
from drivers.transports.tap import CONTROL_FILE, TapFile
from rig.config.models import RigConfig
from rig.devices.open import open_rig
from rig.errors import DivergedError, RigError
from rig.recording.check import require_own_frames
from rig.recording.inputs import read_plan
from rig.recording.replay import RECORDED, recorded_sweeps
from rig.requests import RunRequest
from rig.run_folder.manifest import read_manifest
from rig.scan.control_check import SWAP_TOLERANCE_S, ControlCheck, check_control
from rig.scan.monitor import Listeners
from rig.scan.run import Run, RunResult
from rig.scan.scan import run_scan

_log = logging.getLogger(__name__)

Steps = Callable[[Pace], None]


def play(
    config: RigConfig, recording: Path, run: Run, request: RunRequest, listeners: Listeners, steps: Steps | None
) -> RunResult:
    """Play a recording with the rig of `replay_config`; `run` takes the maps. steps: called with the replay's pace
    before its first frame.

    If drivers take part and the recording has control traffic, what they sent is compared with that traffic once the
    rig is closed. After a failure only the bytes of the commands are compared. Nothing is compared if the recorded scan
    had planned another number of sweeps. Times are compared only if the whole recording was played in real time. Raises
    DivergedError if there is a difference; what the run wrote is kept.
    """
    drivers = [slot for slot in RECORDED if getattr(config, slot).real_time]
    compared = bool(drivers) and (recording / CONTROL_FILE).exists()
    with ExitStack() as stack:
        tap: TapFile | None = None
        if request.record:
            tap = run.start_tap()
        elif compared:
            folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="spadrig-control-"))
            tap = TapFile.begin(Path(folder) / CONTROL_FILE)
        try:
            with open_rig(config, tap=tap) as rig:
                assert isinstance(rig.spad, ReplaySpad), "replay_config says so"
                require_own_frames(rig.spad.recording)
                compared = compared and _asks_for_the_same(rig.spad.recording, request.maps)
                pace = rig.spad.pace
                if steps is not None:
                    steps(pace)
                result = run_scan(rig, run, request, listeners)
        except (DeviceError, RigError) as error:
            if tap is not None and compared:
                _require_no_difference(recording, tap, drivers, error)
            raise
        if tap is None or not compared:
            return result
        timed = pace.speed == 1.0 and request.maps is None
        check = _check(recording, tap, drivers, SWAP_TOLERANCE_S if timed else None)
    if check.problems:
        raise _diverged(check.problems, result.folder)
    return replace(result, control=check)


def _asks_for_the_same(recording: RunRecording, maps: int | None) -> bool:
    """Whether a replay plans as many sweeps as the recorded scan did, or the recording does not tell. If not, that is
    logged: either `maps` is another number (None: all), or the recorded scan ended before its last sweep.
    """
    manifest = read_manifest(recording.path) or {}
    told = sum(int(start["sweeps"]) for start in (manifest.get("recording") or {}).get("starts") or [])
    there = sum(start.sweeps for start in recorded_sweeps(recording, read_plan(recording.path), manifest))
    if told in (0, maps or there):
        return True
    _log.warning(
        "what drivers say is not compared with the recording: its devices were told of %d sweeps, those of this replay "
        "are told of %d", told, maps or there,
    )  # fmt: skip
    return False


def _check(recording: Path, tap: TapFile, drivers: Sequence[str], tolerance_s: float | None) -> ControlCheck:
    return check_control(recording / CONTROL_FILE, Path(tap.path), devices=drivers, tolerance_s=tolerance_s)


def _require_no_difference(recording: Path, tap: TapFile, drivers: Sequence[str], error: Exception) -> None:
    """Raise DivergedError if a replay that failed had sent other bytes. Commands missing or added at its end are
    ignored."""
    problems = [one for one in _check(recording, tap, drivers, None).problems if ": byte " in one]
    if problems:
        raise _diverged((*problems, str(error)), None) from error


def _diverged(problems: Sequence[str], folder: Path | None) -> DivergedError:
    error = DivergedError("\n".join(problems))
    if folder is not None:
        error.add_note(f"the maps are in {folder}")
    return error
