"""The segments of a recording: `frames-000000.spb`, or `frames-000000.spb.zst` if it was compressed after the run.

In both cases offsets are those of the plain segment, so one index serves both. A plain segment is mapped into memory,
and its blocks are used there without a copy.

A compressed segment is in the seekable format of zstd, one zstd frame for each block, so that reading can start
anywhere. It is a `.zst` file like any other (`zstd -d` gives the plain segment back), with a skippable frame at its end
that lists the packed and unpacked lengths of the frames. If that table is damaged, the frames are found one after the
other. Source of the layout: zstd_seekable_compression_format.md, version 0.1.0, in contrib/seekable_format of
facebook/zstd. The package zstandard is optional: the extra `compress`.
"""

import mmap
import re
import struct
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from drivers.errors import CorruptBlock, DeviceNotFound, ProtocolError
from drivers.optional_packages import install_command
from drivers.spb1 import Damage, Placed, walk_placed

SKIPPABLE_MAGIC: Final = 0x184D2A5E
SEEKABLE_MAGIC: Final = 0x8F92EAB1
FRAME_MAGIC: Final = bytes.fromhex("28b52ffd")
MAX_FRAME_BYTES: Final = 1 << 31
"""Most plain bytes of a zstd frame, which holds one block; a table that states more is damaged."""
MOST_RATIO: Final = 1 << 15
"""Most plain bytes for one packed byte: a block of zstd takes at least 4 bytes and holds at most 128 KiB (RFC 8878)."""
_PIECE_BYTES: Final = 1 << 12
"""Bytes of a frame of unknown size that are fed to the unpacker at a time: they unpack to 128 MiB at most."""

_HEAD: Final = struct.Struct("<II")
_FOOT: Final = struct.Struct("<IBI")
_ENTRY_BYTES: Final = 8

Bytes = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class FrameTable:
    """Starts of the zstd frames in the file (packed) and in the plain segment: int64 (frames + 1,). The last value of
    each is the end.
    """

    packed: NDArray[np.int64]
    plain: NDArray[np.int64]

    @classmethod
    def read(cls, data: Bytes) -> "FrameTable":
        """Read the table of a whole file (uint8 (bytes,)). If the table is damaged, make one from the frames, up to the
        first damaged frame; raises `ProtocolError` if zstandard is not installed for that."""
        sizes = _stated_sizes(data)
        if sizes is None:
            sizes = np.array(list(_found_sizes(data)), np.int64).reshape(-1, 2)
        starts = np.zeros((len(sizes) + 1, 2), np.int64)
        np.cumsum(sizes, axis=0, out=starts[1:])
        return cls(starts[:, 0].copy(), starts[:, 1].copy())

    @property
    def size(self) -> int:
        """Bytes of the plain segment."""
        return int(self.plain[-1])

    def frames_at(self, start: int, end: int) -> range:
        """Indices of the zstd frames that hold the plain bytes from `start` to before `end`."""
        if start >= min(end, self.size):
            return range(0)
        first = int(np.searchsorted(self.plain, start, "right")) - 1
        return range(first, int(np.searchsorted(self.plain, min(end, self.size), "left")))

    def places(self, frame: int) -> tuple[int, int, int, int]:
        """Begin and end of a frame in the file, then in the plain segment, in bytes. frame: its index."""
        return (*self.packed[frame : frame + 2].tolist(), *self.plain[frame : frame + 2].tolist())


def table_bytes(sizes: Sequence[tuple[int, int]]) -> bytes:
    """The bytes of the skippable frame at the end of a file. sizes: (packed, plain) bytes of each frame."""
    entries = np.array(sizes, "<u4").reshape(-1, 2).tobytes()
    return _HEAD.pack(SKIPPABLE_MAGIC, len(entries) + _FOOT.size) + entries + _FOOT.pack(len(sizes), 0, SEEKABLE_MAGIC)


def unpack_frame(packed: Bytes, size: int) -> Bytes:
    """Unpack one zstd frame, uint8 (bytes,), that holds `size` plain bytes; returns these, read-only. Raises
    CorruptBlock if the frame does not state that size or cannot be unpacked, and ProtocolError if the package zstandard
    is not installed."""
    zstandard = zstandard_or_error()
    raw = packed.tobytes()
    try:
        if zstandard.frame_content_size(raw) != size:  # first of all: a damaged frame may state terabytes
            raise CorruptBlock(f"compressed block says that it holds other than {size} bytes")
        return np.frombuffer(zstandard.ZstdDecompressor().decompress(raw), np.uint8)
    except zstandard.ZstdError as error:
        raise CorruptBlock(f"compressed block cannot be unpacked: {error}") from None


def zstandard_or_error() -> Any:
    """The package zstandard. If it is not installed, raises `ProtocolError` with the command that installs it."""
    try:
        import zstandard
    except ImportError:
        command = install_command("zstandard")
        raise ProtocolError(f"compressed recordings need the package zstandard; install it: {command}") from None
    return zstandard


def _stated_sizes(data: Bytes) -> NDArray[np.int64] | None:
    """(packed, plain) bytes of each frame, int64 (frames, 2), as the table says; None if that cannot be right."""
    if len(data) < _HEAD.size + _FOOT.size:
        return None
    frames, descriptor, magic = _FOOT.unpack(data[-_FOOT.size :].tobytes())
    entries_bytes = frames * _ENTRY_BYTES
    begin = len(data) - _FOOT.size - entries_bytes - _HEAD.size
    if magic != SEEKABLE_MAGIC or descriptor != 0 or begin < 0:
        return None
    if _HEAD.unpack(data[begin : begin + _HEAD.size].tobytes()) != (SKIPPABLE_MAGIC, entries_bytes + _FOOT.size):
        return None
    entries = data[begin + _HEAD.size : len(data) - _FOOT.size].tobytes()
    sizes = np.frombuffer(entries, "<u4").reshape(-1, 2).astype(np.int64)
    packed = np.concatenate([[0], np.cumsum(sizes[:, 0])])
    possible = (sizes > 0).all() and (sizes[:, 1] <= np.minimum(MAX_FRAME_BYTES, MOST_RATIO * sizes[:, 0])).all()
    return sizes if packed[-1] == begin and possible else None


def _found_sizes(data: Bytes) -> Iterator[tuple[int, int]]:
    """(packed, plain) bytes of each frame, found by unpacking one after the other; up to the first damaged one."""
    zstandard = zstandard_or_error()
    at = 0
    while at < len(data) and data[at : at + len(FRAME_MAGIC)].tobytes() == FRAME_MAGIC:
        unpacker = zstandard.ZstdDecompressor().decompressobj()
        plain, fed = 0, at
        try:
            while not unpacker.eof and fed < len(data) and plain <= MAX_FRAME_BYTES:
                piece = data[fed : fed + _PIECE_BYTES].tobytes()
                plain += len(unpacker.decompress(piece))
                fed += len(piece)
        except zstandard.ZstdError:
            return
        if not unpacker.eof or plain == 0:
            return
        end = fed - len(unpacker.unused_data)
        yield end - at, plain
        at = end


_NAME: Final = re.compile(r"frames-(\d{6})\.spb(\.zst)?")
PACKED_SUFFIX: Final = ".zst"
NO_SEGMENT: Final = "holds no recording (frames-000000.spb); name the folder of a run taken with --record"


class PlainSegment:
    """A segment as it was recorded, mapped into memory. Raises `DeviceNotFound` if the file cannot be read."""

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
        """`length` bytes from `offset` on, fewer at the segment's end, as a view of the file; valid as long as
        something refers to them."""
        return self._bytes[offset : offset + length]

    def walk(self, start: int, end: int, *, check_payload: bool) -> Iterator[Placed | Damage]:
        """Blocks and damage between two offsets. check_payload: whether the CRCs of payloads are checked."""
        return _shifted(self._bytes[start:end], start, check_payload)

    def expect(self, offset: int, length: int) -> None:
        """Announce that these bytes will be read soon, so that the system reads ahead."""
        if self._map is not None and hasattr(mmap, "MADV_WILLNEED") and offset < self.size:
            begin = offset - offset % mmap.PAGESIZE
            self._map.madvise(mmap.MADV_WILLNEED, begin, min(length + offset - begin, self.size - begin))

    def release(self) -> None:
        """Unmap the file, since Windows neither removes nor renames a mapped one. The segment cannot be read any more.
        The file stays mapped while something still refers to its bytes."""
        self._bytes = np.empty(0, np.uint8)
        with suppress(BufferError):
            if self._map is not None:
                self._map.close()
        self._map = None


class PackedSegment:
    """A segment that was compressed after the run, block by block. Raises `DeviceNotFound` if the file cannot be read,
    and `ProtocolError` if its table is damaged and zstandard is not installed."""

    def __init__(self, path: Path, number: int) -> None:
        self.path = path
        self.number = number
        self._file = PlainSegment(path, number)
        self._table = FrameTable.read(self._file.at(0, self._file.size))
        self.size = self._table.size

    def at(self, offset: int, length: int) -> Bytes:
        """`length` bytes, unpacked, from `offset` on, fewer at the end. Raises CorruptBlock if they are damaged."""
        parts = []
        for frame in self._table.frames_at(offset, offset + length):
            _, _, start, _ = self._table.places(frame)
            parts.append(self._unpacked(frame)[max(0, offset - start) : offset + length - start])
        return parts[0] if len(parts) == 1 else np.concatenate([np.empty(0, np.uint8), *parts])

    def walk(self, start: int, end: int, *, check_payload: bool) -> Iterator[Placed | Damage]:
        """Blocks and damage between two offsets. Each compressed frame is searched alone; one that cannot be unpacked
        is reported as damage."""
        for frame in self._table.frames_at(start, end):
            _, _, begin, stop = self._table.places(frame)
            try:
                data = self._unpacked(frame)
            except CorruptBlock as error:
                yield Damage(begin, stop - begin, str(error))
                continue
            yield from _shifted(data[max(0, start - begin) : end - begin], max(start, begin), check_payload)

    def expect(self, offset: int, length: int) -> None:
        """Announce that the compressed frame with byte `offset` will be read soon; later ones are not announced."""
        for frame in self._table.frames_at(offset, offset + 1):
            begin, end, _, _ = self._table.places(frame)
            self._file.expect(begin, end - begin)

    def release(self) -> None:
        """Unmap the file, as `PlainSegment.release` does."""
        self._file.release()

    def _unpacked(self, frame: int) -> Bytes:
        begin, end, start, stop = self._table.places(frame)
        return unpack_frame(self._file.at(begin, end - begin), stop - start)


SegmentReader = PlainSegment | PackedSegment
"""A segment of either form; its `size` and all offsets are in plain bytes."""


def open_segments(path: Path) -> list[SegmentReader]:
    """The segments of a recording's folder in order, or of a single file. Raises `DeviceNotFound` if there is none, and
    what `PlainSegment` and `PackedSegment` raise."""
    files = segment_files(path)
    if not files:
        raise DeviceNotFound(f"{path} {NO_SEGMENT}")
    return [
        (PackedSegment if file.name.endswith(PACKED_SUFFIX) else PlainSegment)(file, number)
        for number, file in sorted(files.items())
    ]


def segment_files(path: Path) -> dict[int, Path]:
    """The segment files of a recording by number; a single file has the number 0. If a segment exists both plain and
    compressed, the plain one is used."""
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
