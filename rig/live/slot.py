"""A file that holds the newest values of a run, mapped into memory by the run and by any number of readers.

The run writes and never waits; readers copy. Each section has two buffers, which are used in turn. `begun` is set to
the number of a value before its first byte is written, `number` after its last one. A reader copies the buffer that
belongs to `number`. The copy is whole if `begun` has advanced by less than 2 by then, and if it has the checksum that
was written with it. If a writer dies in the middle, the last whole value remains. A reader that hangs or dies holds
nothing up. Copying 5 MB takes a millisecond.

Layout (little-endian). The first page is the only one that readers write. It has four int64: time of the last heartbeat
(CLOCK_MONOTONIC, ns), image row that a reader wants to follow, time of that wish, and whether a stop is requested. The
second page has whether the run is over, then 64 bytes for each section with `begun` and `number`. Then come the length
of the description and the description as JSON, then the buffers. The file is sparse: while nobody watches, the buffers
take no memory.
"""

import json
import math
import mmap
import os
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from drivers.json_text import parse_json
from drivers.spb1.layout import crc32
from rig.errors import UsageError
from rig.live.slot_files import allocate, new_file, open_own, process_there, remove_dead, slot_folder, slots

WATCHED_S: Final = 2.0
"""Time after a reader's last heartbeat for which it counts as watching."""

_PAGE = 4096
_MAGIC = b"SPADLIV1"
_BEAT, _ROW, _ROW_BEAT, _STOP = range(4)
"""Words of the first page."""
_LINE = 8
"""Words of a section in the second page, a cache line: `begun`, `number`, and room."""
_MOST_SECTIONS = _PAGE // 64 - 1
_DESCRIPTION = 2 * _PAGE
_BUFFERS = 16 * _PAGE
_HEAD = 64
"""Bytes before a value: int64 length of all that follows, of its JSON, and CRC-32."""
_SPARE = 4096
"""Bytes of a buffer for gaps between arrays and for their description."""
_TRIES = 1000
"""Copies that a reader makes before it gives up, should each be overwritten meanwhile."""


@dataclass(frozen=True, slots=True)
class RunningSlot:
    """A run that is going on. kind: 'scan', 'replay' or 'align'. name: of its config or recording."""

    pid: int
    kind: str
    name: str
    started_unix_s: float
    path: Path


@dataclass(frozen=True, slots=True, eq=False)
class Value:
    """A value of a section. number: the first value of the section has 1, the next one 2, and so on. The arrays are
    read-only copies."""

    number: int
    header: dict[str, Any]
    arrays: dict[str, NDArray[Any]]


class SlotWriter:
    """The run's side of a slot, a context manager that removes the file at its end. Make one with `create`.

    Several threads may write; while one copies, the others wait.
    """

    def __init__(self, path: Path, fd: int, described: Mapping[str, Any]) -> None:
        self.path = path
        self._fd = fd
        self._sections = _places(described["sections"])
        text = json.dumps(described).encode()
        size = max((at + 2 * room for _, at, room in self._sections.values()), default=_BUFFERS)
        os.truncate(fd, size)
        allocate(fd, 0, _BUFFERS)
        self._map = mmap.mmap(fd, size)
        self._control, self._words = _pages(self._map)
        self._map[_DESCRIPTION + 16 : _DESCRIPTION + 16 + len(text)] = text
        self._map[_DESCRIPTION + 8 : _DESCRIPTION + 16] = len(text).to_bytes(8, "little")
        self._map[_DESCRIPTION : _DESCRIPTION + 8] = _MAGIC
        self._allocated: set[str] = set()
        self._lock = threading.Lock()
        self._closed = False

    @classmethod
    def create(cls, kind: str, name: str, capacities: Mapping[str, int]) -> Self:
        """Make the slot of a run of this process. Slots that dead processes left are removed.

        capacities: for each section, the most bytes of a value, including its header as JSON.
        Raises UsageError if others than this user can enter the folder, OSError if the file cannot be made, ValueError
        for too many sections or too long a name.
        """
        if len(capacities) > _MOST_SECTIONS:
            raise ValueError(f"{len(capacities)} sections; a slot has room for {_MOST_SECTIONS}")
        folder = slot_folder()
        for old in slots(folder):
            remove_dead(old)
        sections, at = {}, _BUFFERS
        for section, most in capacities.items():
            room = math.ceil((_HEAD + most + _SPARE) / _PAGE) * _PAGE
            sections[section] = (at, room)
            at += 2 * room
        described = {
            "kind": kind,
            "name": name,
            "pid": os.getpid(),
            "started_unix_s": time.time(),
            "sections": sections,
        }
        if len(json.dumps(described).encode()) > _BUFFERS - _DESCRIPTION - 16:
            raise ValueError("the slot's name is too long")
        path, fd = new_file(folder)
        try:
            return cls(path, fd, described)
        except BaseException:
            os.close(fd)
            path.unlink(missing_ok=True)
            raise

    @property
    def watched(self) -> bool:
        """Whether a reader has called `touch` within the last WATCHED_S."""
        return _recent(int(self._control[_BEAT]))

    @property
    def wanted_row(self) -> int | None:
        """Image row that a reader asked for last; None if nobody asked within WATCHED_S. It may be beyond the image."""
        return int(self._control[_ROW]) if _recent(int(self._control[_ROW_BEAT])) else None

    @property
    def stop_requested(self) -> bool:
        """Whether a reader asked the run to end."""
        return bool(self._control[_STOP])

    def write(self, section: str, header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]] | None = None) -> None:
        """Replace the value of a section. Does nothing once the slot is closed.

        Raises KeyError for an unknown section, ValueError for a value above the section's capacity or a header that is
        no JSON, OSError if there is no memory for the section.
        """
        _, _, room = self._sections[section]
        plain = {name: np.ascontiguousarray(array) for name, array in (arrays or {}).items()}
        places, length = {}, 0
        for key, array in plain.items():
            places[key] = (array.dtype.str, array.shape, length)
            length += _padded(array.nbytes)
        text = json.dumps({"header": header, "arrays": places}, allow_nan=False).encode()
        first = _padded(len(text))
        if _HEAD + first + length > room:
            raise ValueError(f"a value of section {section} takes {first + length} bytes; the slot has {room - _HEAD}")
        with self._lock:
            if self._closed:
                return
            body = self._begin(section, first + length)
            body[: len(text)] = np.frombuffer(text, np.uint8)
            for key, array in plain.items():
                place = first + places[key][2]
                body[place : place + array.nbytes] = array.reshape(-1).view(np.uint8)
            self._end(section, body, len(text))

    def _begin(self, section: str, length: int) -> NDArray[np.uint8]:
        """The bytes in which the next value is to be put."""
        line, at, room = self._sections[section]
        if section not in self._allocated:  # a page that cannot be had later would kill the process
            allocate(self._fd, at, 2 * room)
            self._allocated.add(section)
        number = int(self._words[line + 1]) + 1
        self._words[line] = number
        return np.frombuffer(self._map, np.uint8, length, at + (number % 2) * room + _HEAD)

    def _end(self, section: str, body: NDArray[np.uint8], text: int) -> None:
        line, at, room = self._sections[section]
        number = int(self._words[line])
        head = np.frombuffer(self._map, np.int64, 3, at + (number % 2) * room)
        head[:] = len(body), text, crc32(body.data)
        self._words[line + 1] = number

    def close(self) -> None:
        """Tell the readers that the run is over and remove the file. A second call does nothing."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
            self._words[0] = 1
            with suppress(OSError):  # Windows removes no file that is mapped; the next slot does
                self.path.unlink()
            os.close(self._fd)

    def __enter__(self) -> Self:
        """The writer itself."""
        return self

    def __exit__(self, *error: object) -> None:
        """Close."""
        self.close()


class SlotReader:
    """A reader's side of a slot, a context manager. Make one with `open`. What was written stays readable after the end
    of the run, until `close`."""

    def __init__(self, path: Path, fd: int) -> None:
        self.slot, self._sections = _read_description(fd, path)
        self._map = mmap.mmap(fd, os.fstat(fd).st_size, access=mmap.ACCESS_READ)
        _, self._words = _pages(self._map)
        self._first_page = mmap.mmap(fd, _PAGE)
        self._control = np.frombuffer(self._first_page, np.int64, 4)

    @staticmethod
    def running() -> list[RunningSlot]:
        """All runs of this user that are going on, the newest first.

        Raises UsageError if others than this user can enter the folder of the slots.
        """
        found = [_describe(path) for path in slots(slot_folder())]
        there = [slot for slot in found if slot is not None and process_there(slot.path, slot.pid)]
        return sorted(there, key=lambda slot: slot.started_unix_s, reverse=True)

    @staticmethod
    def newest(pid: int | None = None) -> RunningSlot | None:
        """The run that began last, of those that are going on; None if there is none. pid: of a run of this process
        alone. Raises UsageError as `running` does."""
        return next((slot for slot in SlotReader.running() if pid in (None, slot.pid)), None)

    @classmethod
    def open(cls, path: Path) -> Self:
        """Open a slot. Raises UsageError if the file is no slot, or if others can use it; OSError if it cannot be
        opened."""
        fd = open_own(path, os.O_RDWR)
        try:
            return cls(path, fd)
        finally:
            os.close(fd)

    @property
    def alive(self) -> bool:
        """Whether the run is still going on: its process exists and has not closed the slot."""
        return not self._words[0] and process_there(self.slot.path, self.slot.pid)

    @property
    def ended(self) -> bool:
        """Whether the run has said that it is over; a process that was killed says nothing."""
        return bool(self._words[0])

    def read(self, section: str, newer_than: int = 0) -> Value | None:
        """The newest value of a section; None if it has none with a number above `newer_than`.

        Raises KeyError for a section that the slot does not have.
        """
        line, at, room = self._sections[section]
        for _ in range(_TRIES):
            number = int(self._words[line + 1])
            if number <= newer_than:
                return None
            value = self._copy(number, at + (number % 2) * room, room)
            if int(self._words[line]) < number + 2 and value is not None:
                return value
        return None

    def touch(self, row: int | None = None) -> None:
        """Tell the run that somebody watches. Call it at least twice a second. row: image row to follow, if any."""
        now = time.monotonic_ns()
        if row is not None:
            self._control[_ROW] = row
            self._control[_ROW_BEAT] = now
        self._control[_BEAT] = now

    def request_stop(self) -> None:
        """Ask the run to end as with Ctrl-C."""
        self._control[_STOP] = 1

    def close(self) -> None:
        """Let go of the slot; copies stay valid. A second call does nothing."""
        self._words = self._control = np.ones(2 * _LINE, np.int64)
        self._sections = {}
        for each in (self._map, self._first_page):
            with suppress(BufferError):  # another thread is still reading; the map goes when it is done
                each.close()

    def __enter__(self) -> Self:
        """The reader itself."""
        return self

    def __exit__(self, *error: object) -> None:
        """Close."""
        self.close()

    def _copy(self, number: int, begin: int, room: int) -> Value | None:
        length, text, crc = np.frombuffer(self._map[begin : begin + 24], np.int64).tolist()
        if not 0 <= text <= length <= room - _HEAD:
            return None
        body = self._map[begin + _HEAD : begin + _HEAD + length]
        if crc32(body) != crc:
            return None
        content = json.loads(body[:text])
        first = _padded(text)
        arrays = {
            name: np.frombuffer(body, kind, math.prod(shape), first + place).reshape(shape)
            for name, (kind, shape, place) in content["arrays"].items()
        }
        return Value(number, content["header"], arrays)


def _describe(path: Path) -> RunningSlot | None:
    """The description of a slot; None if it has none (yet), is closed or gone, or is not this user's alone."""
    try:
        fd = open_own(path, os.O_RDONLY)
    except (OSError, UsageError):
        return None
    try:
        slot, _ = _read_description(fd, path)
        os.lseek(fd, _PAGE, os.SEEK_SET)
        return None if any(os.read(fd, 8)) else slot
    except UsageError:
        return None
    finally:
        os.close(fd)


def _read_description(fd: int, path: Path) -> tuple[RunningSlot, dict[str, tuple[int, int, int]]]:
    """The description of a slot; of each section its words' place in the second page, and its buffers' place and size.
    Raises UsageError if the file is no slot."""
    try:
        os.lseek(fd, _DESCRIPTION, os.SEEK_SET)
        head = os.read(fd, 16)
        if head[:8] != _MAGIC:
            raise ValueError("it does not begin as one")
        content = parse_json(os.read(fd, min(int.from_bytes(head[8:], "little"), _BUFFERS)))
        slot = RunningSlot(
            int(content["pid"]), content["kind"], content["name"], float(content["started_unix_s"]), path
        )
        sections = _places(content["sections"])
        if any(at + 2 * room > os.fstat(fd).st_size for _, at, room in sections.values()):
            raise ValueError("it is too short")
        return slot, sections
    except (ValueError, KeyError, TypeError) as error:
        raise UsageError(f"{path} is no slot of a live view: {error}") from None


def _places(described: Mapping[str, tuple[int, int]]) -> dict[str, tuple[int, int, int]]:
    return {name: (_LINE * (index + 1), *place) for index, (name, place) in enumerate(described.items())}


def _recent(beat_ns: int) -> bool:
    return beat_ns > 0 and 0 <= time.monotonic_ns() - beat_ns < WATCHED_S * 1e9


def _pages(mapped: mmap.mmap) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The words of the first and of the second page. Numpy writes each in one step, other than `struct`."""
    return np.frombuffer(mapped, np.int64, 4), np.frombuffer(mapped, np.int64, _PAGE // 8, _PAGE)


def _padded(length: int) -> int:
    return math.ceil(length / 64) * 64
