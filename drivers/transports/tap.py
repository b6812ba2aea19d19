"""A tap on the ports of a rig: every piece of bytes that goes out to a device or comes in from it, with its time.

`control.jsonl` has a line for each: {"t_ns": 1234, "device": "laser", "port": "serial", "dir": ">", "bytes": "3f0d"},
t_ns from the run's start on the host's monotonic clock, ">" towards the device. Several processes may write one file:
each line is one write at its end. Ports of the SPAD are not tapped; its frames are in the recording.
"""

import json
import logging
import os
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drivers.errors import ProtocolError

_log = logging.getLogger(__name__)

CONTROL_FILE = "control.jsonl"
OUT, IN = ">", "<"


@dataclass(frozen=True, slots=True)
class TapFile:
    """Where taps write, and the time that counts as 0 (`time.monotonic_ns`). Crosses processes as its two fields."""

    path: str
    start_ns: int

    @classmethod
    def begin(cls, path: Path) -> "TapFile":
        """From now on."""
        return cls(str(path.absolute()), time.monotonic_ns())

    def tap(self, device: str) -> "Tap":
        """The tap of one device, by its slot in the rig."""
        return Tap(self, device)

    def sync(self) -> None:
        """Have the disk keep what was written."""
        try:
            handle = os.open(self.path, os.O_RDONLY)
        except FileNotFoundError:
            return  # nobody has said anything yet
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


class Tap:
    """Notes what passes a device's ports. Any thread."""

    def __init__(self, file: TapFile, device: str) -> None:
        self._file = file
        self._device = device
        self._lock = threading.Lock()
        self._handle: int | None = None
        self._full = False

    def note(self, port: str, direction: str, data: bytes) -> None:
        """A piece of bytes; of none nothing is noted."""
        if not data:
            return
        t_ns = time.monotonic_ns() - self._file.start_ns
        line = (
            f'{{"t_ns": {t_ns}, "device": "{self._device}", "port": "{port}", "dir": "{direction}", '
            f'"bytes": "{bytes(data).hex()}"}}\n'
        )
        with self._lock:
            if self._full:
                return
            try:
                if self._handle is None:
                    self._handle = os.open(
                        self._file.path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o644
                    )
                os.write(self._handle, line.encode())
            except OSError as error:  # never a reason to let go of a device; the recording itself ends the run
                self._full = True
                _log.warning("%s ends here: %s", self._file.path, error.strerror or error)

    def __del__(self) -> None:
        """Closed with the last who holds it: devices are closed in any order, and their threads after them."""
        if self._handle is not None:
            os.close(self._handle)


@dataclass(frozen=True, slots=True)
class Passed:
    """A piece of bytes that passed a port."""

    t_ns: int
    device: str
    port: str
    direction: str
    data: bytes


def read_taps(file: Path) -> list[Passed]:
    """All that passed, in order of time; a torn last line is left out. `ProtocolError` for one that is none."""
    *lines, _ = file.read_bytes().split(b"\n")
    found = []
    for number, line in enumerate(lines, 1):
        try:
            found.append(_passed(json.loads(line)))
        except (KeyError, TypeError, ValueError) as error:
            raise ProtocolError(f"{file}, line {number} is not as it was written: {error!r}") from None
    return sorted(found, key=lambda passed: passed.t_ns)


def _passed(line: dict[str, Any]) -> Passed:
    if line["dir"] not in (OUT, IN):
        raise ValueError(f"direction {line['dir']!r}")
    return Passed(
        int(line["t_ns"]), str(line["device"]), str(line["port"]), str(line["dir"]), bytes.fromhex(line["bytes"])
    )
