"""Switches the recording of a scan from another process, with two small files in the folder of the run.

The scan holds a lock on `record.state` as long as it goes on, and writes there what the recording does. `record` writes
`record.wish`; a thread of the scan looks for that file fifty times a second. A wish that is not fulfilled does no harm.
"""

import json
import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol

from drivers.json_text import parse_json
from rig.errors import UsageError
from rig.run_folder.disk import hold, is_held, replace_file

STATE: Final = "record.state"
WISH: Final = "record.wish"
LOOK_S: Final = 0.02
ANSWER_S: Final = 5.0
"""Longest wait for a scan to do what was asked: its SPAD may be silent meanwhile."""


class Switch(Protocol):
    """A `rig.scan.on_request.RecordingSwitch`, which is not imported here: 'rig record' has to start quickly."""

    parts: list[Any]

    @property
    def wanted(self) -> bool:
        """Whether it is switched on."""
        ...

    @property
    def recording(self) -> bool:
        """Whether blocks are being written."""
        ...

    def on(self) -> None:
        """Begin to record."""
        ...

    def off(self) -> None:
        """End the part that is being recorded."""
        ...


@dataclass(frozen=True, slots=True)
class RecordState:
    """The recording of a scan that goes on.

    on: whether it is switched on. recording: whether blocks are being written. parts: number of parts so far.
    """

    run: Path
    on: bool
    recording: bool
    parts: int


@contextmanager
def followed(folder: Path | None, switch: Switch | None) -> Iterator[None]:
    """A context in which `record` can switch the recording of the run in this folder. Does nothing without a folder or
    a switch. Raises OSError if the file of the state cannot be written or is locked."""
    if folder is None or switch is None:
        yield
        return
    over = threading.Event()
    try:
        with (folder / STATE).open("wb", buffering=0) as state:
            hold(state.fileno())
            thread = threading.Thread(
                target=_follow, args=(folder, switch, state, over), name="record switch", daemon=True
            )
            thread.start()
            try:
                yield
            finally:
                over.set()
                thread.join()
    finally:
        for name in (STATE, WISH):
            with suppress(OSError):
                (folder / name).unlink(missing_ok=True)


def record(
    on: bool | None, run: str | os.PathLike[str] | None = None, *, runs: str | os.PathLike[str] = "runs"
) -> RecordState:
    """Switch the recording of a scan that was begun with `record_on_request` on or off, or ask for its state (`rig
    record`).

    on: None only asks.
    run: folder of the scan; None: the only one that goes on in the folder `runs`.

    Returns once the scan has begun or ended its part; a part ends with the sweep under way. Raises UsageError if there
    is no such scan, or several, or it does not answer within five seconds, and OSError if the wish cannot be written.
    """
    folder = _only_one(Path(runs)) if run is None else Path(run)
    _require_running(folder)
    if on is None:
        return _state(folder)
    before = _state(folder)
    replace_file(folder / WISH, json.dumps({"on": on, "id": os.urandom(8).hex()}).encode())
    ends = time.monotonic() + ANSWER_S
    while time.monotonic() < ends:
        time.sleep(LOOK_S)
        now = _state(folder)
        if now.on == on and (now.recording == on or now.parts > before.parts or not _goes_on(folder)):
            return now
    raise UsageError(
        f"{folder} did not begin or end its part within {ANSWER_S:g} s, but may do so yet; do its frames come? "
        "'rig record state' tells"
    )


def _follow(folder: Path, switch: Switch, state: Any, over: threading.Event) -> None:
    told: object = None
    seen = ""
    while not over.wait(LOOK_S):
        with suppress(OSError, ValueError):
            wish = parse_json((folder / WISH).read_bytes())
            if isinstance(wish, dict) and wish.get("id") != seen:
                seen = str(wish.get("id"))
                switch.on() if wish.get("on") is True else switch.off()
        now = {"on": switch.wanted, "recording": switch.recording, "parts": len(switch.parts)}
        if now != told:
            with suppress(OSError):  # a full disk: the recording itself tells of it
                state.seek(0)
                state.write(json.dumps(now).encode().ljust(80))
            told = now


def _state(folder: Path) -> RecordState:
    try:
        content = parse_json((folder / STATE).read_bytes())
        return RecordState(folder, bool(content["on"]), bool(content["recording"]), int(content["parts"]))
    except (OSError, ValueError, KeyError, TypeError):
        return RecordState(folder, False, False, 0)


def _goes_on(folder: Path) -> bool:
    return (folder / STATE).exists() if os.name == "nt" else is_held(folder / STATE)  # files have no locks on Windows


def _require_running(folder: Path) -> None:
    if not _goes_on(folder):
        what = "is no scan that goes on with `record_on_request`" if folder.is_dir() else "does not exist"
        raise UsageError(f"{folder} {what}; name the folder of one")


def _only_one(runs: Path) -> Path:
    going = sorted(file.parent for file in runs.glob(f"*/{STATE}") if _goes_on(file.parent))
    if len(going) == 1:
        return going[0]
    found = f"{len(going)} go on in {runs}: {', '.join(map(str, going))}" if going else f"none goes on in {runs}"
    raise UsageError(f"of scans with `record_on_request`, {found}; name the folder of one")
