"""The segments of a recording: `frames-000000.spb`, or `frames-000000.spb.zst` where it was compressed after the run.

Offsets are those of the plain segment in both, so that one index holds for both. A plain segment is mapped into memory
and its blocks are used where they lie.
"""

import mmap
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from drivers.errors import CorruptBlock, DeviceNotFound
from drivers.recorded.seekable import FrameTable, unpack_frame
from drivers.spb1 import Damage, Placed, walk_placed

_NAME: Final = re.compile(r"frames-(\d{6})\.spb(\.zst)?")
PACKED_SUFFIX: Final = ".zst"
NO_SEGMENT: Final = "holds no recording (frames-000000.spb); name the folder of a run taken with --record"

Bytes = NDArray[np.uint8]


class Segment(Protocol):
    """A segment, plain or compressed."""

    path: Path
    number: int
    size: int
    """Bytes of the plain segment."""

    def at(self, offset: int, length: int) -> Bytes:
        """Bytes from `offset` on, fewer at the end; valid as long as somebody holds them. CorruptBlock: unreadable."""
        ...

    def walk(self, start: int, end: int, *, check_payload: bool) -> Iterator[Placed | Damage]:
        """Blocks and damage between two offsets."""
        ...

    def expect(self, offset: int, length: int) -> None:
        """Say that so much will be read soon."""
        ...


class PlainSegment:
    """A segment as it was recorded, mapped into memory."""

    def __init__(self, path: Path, number: int) -> None:
        self.path = path
        self.number = number
        try:
            with path.open("rb") as file:
                self.size = path.stat().st_size
                self._map = mmap.mmap(file.fileno(), self.size, access=mmap.ACCESS_READ) if self.size else None
        except OSError as error:
            raise DeviceNotFound(f"{path} cannot be read: {error.strerror or error}") from None
        self._bytes: Bytes = np.frombuffer(self._map or b"", np.uint8)

    def at(self, offset: int, length: int) -> Bytes:
        """Bytes from `offset` on, over the file's memory."""
        return self._bytes[offset : offset + length]

    def walk(self, start: int, end: int, *, check_payload: bool) -> Iterator[Placed | Damage]:
        """Blocks and damage between two offsets."""
        return _shifted(self._bytes[start:end], start, check_payload)

    def expect(self, offset: int, length: int) -> None:
        """Let the system read ahead."""
        if self._map is not None and hasattr(mmap, "MADV_WILLNEED") and offset < self.size:
            begin = offset - offset % mmap.PAGESIZE
            self._map.madvise(mmap.MADV_WILLNEED, begin, min(length + offset - begin, self.size - begin))


class PackedSegment:
    """A segment that was compressed after the run, block by block (`drivers.recorded.seekable`)."""

    def __init__(self, path: Path, number: int) -> None:
        self.path = path
        self.number = number
        self._file = PlainSegment(path, number)
        self._table = FrameTable.read(self._file.at(0, self._file.size))
        self.size = self._table.size

    def at(self, offset: int, length: int) -> Bytes:
        """The bytes, unpacked."""
        parts = []
        for frame in self._table.frames_at(offset, offset + length):
            data = self._unpacked(frame)
            start = self._table.start(frame)
            parts.append(data[max(0, offset - start) : offset + length - start])
        return parts[0] if len(parts) == 1 else np.concatenate([np.empty(0, np.uint8), *parts])

    def walk(self, start: int, end: int, *, check_payload: bool) -> Iterator[Placed | Damage]:
        """Blocks and damage between two offsets, at the beginnings of which there are frames of the compression."""
        for frame in self._table.frames_at(start, end):
            begin, stop = self._table.start(frame), self._table.start(frame + 1)
            try:
                data = self._unpacked(frame)
            except CorruptBlock as error:
                yield Damage(begin, stop - begin, str(error))
                continue
            yield from _shifted(data[max(0, start - begin) : end - begin], max(start, begin), check_payload)

    def expect(self, offset: int, length: int) -> None:
        """Let the system read ahead."""
        for frame in self._table.frames_at(offset, offset + 1):
            self._file.expect(*self._table.packed_place(frame))

    def _unpacked(self, frame: int) -> Bytes:
        return unpack_frame(self._file.at(*self._table.packed_place(frame)), self._table.frame_bytes(frame))


def open_segments(path: Path) -> list[Segment]:
    """The segments of a recording's folder in order, or of one file. `DeviceNotFound` where there are none."""
    files = segment_files(path)
    if not files:
        raise DeviceNotFound(f"{path} {NO_SEGMENT}")
    return [
        (PackedSegment if file.name.endswith(PACKED_SUFFIX) else PlainSegment)(file, number)
        for number, file in sorted(files.items())
    ]


def segment_files(path: Path) -> dict[int, Path]:
    """Files of the segments by their numbers; of a segment that is there twice the plain one."""
    if path.is_file():
        return {0: path}
    found: dict[int, Path] = {}
    for file in sorted(path.glob("frames-*.spb*"), reverse=True) if path.is_dir() else ():
        if (name := _NAME.fullmatch(file.name)) is not None:
            found[int(name[1])] = file
    return found


def _shifted(data: Bytes, start: int, check_payload: bool) -> Iterator[Placed | Damage]:
    for item in walk_placed(data, None, check_payload=check_payload):
        if isinstance(item, Damage):
            yield replace(item, offset=start + item.offset)
        else:
            yield replace(item, offset=start + item.offset, end=start + item.end)
