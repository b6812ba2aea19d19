"""A tap on the ports of a rig: every piece of bytes that goes out to a device or comes in from it, with its time.

`control.jsonl` has one line for each piece:
{"t_ns": 1234, "device": "laser", "port": "serial", "dir": ">", "bytes": "3f0d"}. t_ns counts from the run's start on
the host's monotonic clock; ">" means towards the device. Several processes may write to one file, since each line is a
single write at the file's end. For the SPAD only the control traffic is recorded here; its frames are in the recording.
"""

import logging
import os
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from drivers.errors import ProtocolError
from drivers.json_text import parse_json

_log = logging.getLogger(__name__)

CONTROL_FILE = "control.jsonl"
OUT, IN = ">", "<"
FLUSH_S = 1.0
"""Longest wait for the disk, once a device is closed."""

_Lines = SimpleQueue[bytes | threading.Event | None]


@dataclass(frozen=True, slots=True)
class TapFile:
    """The file to which taps write, and the time that counts as 0 (`time.monotonic_ns`). Any process may use it."""

    path: str
    start_ns: int

    @classmethod
    def begin(cls, path: Path) -> "TapFile":
        """A new tap file whose time 0 is now. The first `Tap` that writes creates the file."""
        return cls(str(path.absolute()), time.monotonic_ns())

    def sync(self) -> None:
        """Wait until what was written is on the disk. Raises OSError if that fails."""
        try:
            handle = os.open(self.path, os.O_RDONLY)
        except FileNotFoundError:
            return  # no tap has written yet
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


class Tap:
    """Notes what passes a device's ports, from any thread. A separate thread writes, so a slow disk never delays a
    device.
    """

    def __init__(self, file: TapFile, device: str) -> None:
        """device: the device's slot in the rig, for example "laser"."""
        self._file = file
        self._device = device
        self._lines: _Lines = SimpleQueue()
        self._writer = threading.Thread(target=_write, args=(file.path, self._lines), name="tap", daemon=True)
        self._starting = threading.Lock()

    def note(self, port: str, direction: str, data: bytes) -> None:
        """Note a piece of bytes; an empty one is not noted. Returns at once. port: "serial", "tcp" or an endpoint, for
        example. direction: `OUT` or `IN`."""
        if not data:
            return
        t_ns = time.monotonic_ns() - self._file.start_ns
        line = (
            f'{{"t_ns": {t_ns}, "device": "{self._device}", "port": "{port}", "dir": "{direction}", '
            f'"bytes": "{bytes(data).hex()}"}}\n'
        )
        self._lines.put(line.encode())
        if self._writer.ident is None:
            with self._starting:
                if self._writer.ident is None:
                    self._writer.start()

    def flush(self, timeout_s: float = FLUSH_S) -> None:
        """Wait until everything noted so far is written, at most for `timeout_s`."""
        if self._writer.ident is not None:
            written = threading.Event()
            self._lines.put(written)
            written.wait(timeout_s)

    def __del__(self) -> None:
        """End the writer once nothing refers to the tap. When its device is closed, other threads may still use it."""
        self._lines.put(None)


def _write(path: str, lines: _Lines) -> None:
    """Write each line by a single call, and set each event, until None comes. After an error, drop the lines."""
    handle: int | None = None
    full = False
    while (line := lines.get()) is not None:
        if isinstance(line, threading.Event):
            line.set()
        elif not full:
            try:
                if handle is None:
                    handle = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o644)
                os.write(handle, line)
            except OSError as error:  # no reason to give up a device; a full disk ends the run by the recording itself
                full = True
                _log.warning("%s ends here: %s", path, error.strerror or error)
    if handle is not None:
        os.close(handle)


@dataclass(frozen=True, slots=True)
class TapRecord:
    """A piece of bytes that passed a port. The fields are those of a line of `control.jsonl`."""

    t_ns: int
    device: str
    port: str
    direction: str
    data: bytes


def read_taps(file: Path) -> list[TapRecord]:
    """All pieces that passed, in order of time, without a torn last line. Raises `ProtocolError` for a line of another
    form, OSError if the file cannot be read.
    """
    *lines, _ = file.read_bytes().split(b"\n")
    found = []
    for number, line in enumerate(lines, 1):
        try:
            found.append(_record(parse_json(line)))
        except (ArithmeticError, KeyError, TypeError, ValueError) as error:
            raise ProtocolError(f"{file}, line {number} is not as it was written: {error!r}") from None
    return sorted(found, key=lambda passed: passed.t_ns)


def _record(line: dict[str, Any]) -> TapRecord:
    if line["dir"] not in (OUT, IN):
        raise ValueError(f"direction {line['dir']!r}")
    return TapRecord(
        int(line["t_ns"]), str(line["device"]), str(line["port"]), str(line["dir"]), bytes.fromhex(line["bytes"])
    )
