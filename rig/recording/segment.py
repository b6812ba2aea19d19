"""Writes one segment of a recording: SPB1 blocks one after the other, each padded with zeros to whole pages.

Blocks are written several at a time, past the page cache if the system allows it (O_DIRECT), without copying pixels if
they are aligned. This takes 0.3 s of CPU per GB, nearly all of it for the checksum, compared with 2 s through the page
cache, and a sync has little left to do. `Space` is the most room that a recorded run will take.
"""

import errno
import mmap
import os
import shutil
import threading
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from calibration.errors import digits
from drivers.frames import FrameBlock
from drivers.spb1 import block_parts
from drivers.spb1.layout import TRAILER
from rig.errors import UsageError

PAGE_BYTES: Final = 4096
"""Writes past the page cache have sizes and offsets, in the file and in memory, that are multiples of this."""
_SHARE_OF_FREE: Final = 2
"""The free space divided by this is the most that is set aside at a time: maps go to the same disk."""

_sync_data = getattr(os, "fdatasync", os.fsync)


class Staging(threading.local):
    """Page-aligned memory of each thread, for the parts of a block that are not page-aligned."""

    def __init__(self) -> None:
        self._memory = mmap.mmap(-1, PAGE_BYTES)

    def take(self, size: int) -> memoryview:
        """Memory of `size` bytes of the calling thread, valid until its next call. It still has old content."""
        if len(self._memory) < size:
            self._memory = mmap.mmap(-1, paged(size))
        return memoryview(self._memory)[:size]


class OpenSegment:
    """A segment to which blocks are written. One thread places them in order, any thread writes them."""

    def __init__(self, folder: Path, number: int, name: str, reserve_bytes: int) -> None:
        """Make a new file and set `reserve_bytes` aside for it, but at most half of the free space. Raises OSError."""
        self.number = number
        self.path = folder / name
        self.placed = 0
        """Offset of the next block, bytes."""
        self.end = 0
        """Offset in bytes up to which all blocks are written."""
        self.synced = 0
        """Value of `end` at the beginning of the last sync."""
        self._lock = threading.Lock()
        self._fd = _open_direct(self.path)
        _reserve(self.path, reserve_bytes)

    @property
    def complete(self) -> bool:
        """Whether every block that was placed is written."""
        return self.end == self.placed

    def place(self, size: int) -> int:
        """Reserve the place of the next block, of `size` bytes with padding; returns its offset."""
        offset = self.placed
        self.placed += size
        return offset

    def write(self, block: FrameBlock, offset: int, staging: Staging) -> int:
        """Write a block at its place; returns the CRC of its payload. The block's memory must not change meanwhile.
        Raises OSError."""
        pieces, crc = _pieces(block, staging)
        while pieces:
            written = self._write(pieces, offset)
            offset += written
            while pieces and written >= len(pieces[0]):
                written -= len(pieces.pop(0))
            if written:
                pieces[0] = pieces[0][written:]
        return crc

    def sync(self) -> None:
        """Make sure that the blocks before `end` survive a loss of power. Raises OSError."""
        if self.synced != self.end:
            end = self.end
            _sync_data(self._fd)
            self.synced = end

    def close(self) -> None:
        """End the file after its last whole block, or remove it if it has none; nothing if closed. Raises OSError."""
        if self._fd < 0:
            return
        fd, self._fd = self._fd, -1
        try:
            if self.end:
                os.ftruncate(fd, self.end)
                os.fsync(fd)
        finally:
            os.close(fd)
        if not self.end:
            self.path.unlink(missing_ok=True)  # Windows removes no open file

    def _write(self, pieces: Sequence[memoryview], offset: int) -> int:
        if hasattr(os, "pwritev"):
            written = os.pwritev(self._fd, pieces, offset)
        else:  # Windows: one thread at a time
            with self._lock:
                os.lseek(self._fd, offset, os.SEEK_SET)
                written = os.write(self._fd, pieces[0])
        if written == 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return written


def paged(size: int) -> int:
    """`size` bytes, rounded up to whole pages."""
    return -(-size // PAGE_BYTES) * PAGE_BYTES


def _pieces(block: FrameBlock, staging: Staging) -> tuple[list[memoryview], int]:
    """A block's bytes with its padding, and the CRC of its payload. Whole pages of pixels stay in place if aligned; the
    rest is in `staging`."""
    *front, bits, tail = block_parts(block)
    front_bytes = sum(len(part) for part in front)
    before = min(paged(front_bytes) - front_bytes, len(bits))
    inside = (len(bits) - before) // PAGE_BYTES * PAGE_BYTES
    if (np.asarray(bits).ctypes.data + before) % PAGE_BYTES:
        inside = 0
    parts = [*front, bits[:before], bits[before + inside :], tail]
    used = sum(len(part) for part in parts)
    memory = staging.take(paged(used))
    at = 0
    for part in parts:
        memory[at : at + len(part)] = part
        at += len(part)
    memory[at:] = bytes(len(memory) - at)
    split = front_bytes + before
    pieces = memory[:split], bits[before : before + inside], memory[split:]
    return [piece for piece in pieces if len(piece)], TRAILER.unpack_from(tail)[4]


def _open_direct(path: Path) -> int:
    """Create a file and open it past the page cache if the system and the file system allow that."""
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
    direct = getattr(os, "O_DIRECT", 0)
    fd = os.open(path, flags, 0o644)
    if not direct:
        return fd
    try:
        direct_fd = os.open(path, os.O_WRONLY | direct)
    except OSError:  # EINVAL: the file system does not allow it
        return fd
    os.close(fd)
    return direct_fd


def _reserve(path: Path, size: int) -> None:
    """Set space aside, so that the file system need not find it while frames come. A failure does no harm."""
    if not hasattr(os, "posix_fallocate"):
        return
    fd = os.open(path, os.O_WRONLY)
    try:
        free = os.fstatvfs(fd)
        size = min(size, free.f_bavail * free.f_frsize // _SHARE_OF_FREE) // PAGE_BYTES * PAGE_BYTES
        if size:
            os.posix_fallocate(fd, 0, size)
    except OSError:
        os.ftruncate(fd, 0)
    finally:
        os.close(fd)


@dataclass(frozen=True, slots=True)
class Space:
    """Largest number of bytes that the frames and the maps of a run will take, and the free space on its disk."""

    folder: Path
    recording_bytes: int
    map_bytes: int
    free_bytes: int

    @classmethod
    def on_disk_of(cls, folder: Path, recording_bytes: int, map_bytes: int) -> "Space":
        """Determine the space on the disk of a folder. The folder is an absolute path and need not exist."""
        there = next(path for path in (folder, *folder.parents) if path.is_dir())
        return cls(folder, recording_bytes, map_bytes, shutil.disk_usage(there).free)

    def require(self) -> None:
        """Raise UsageError if the disk has too little room."""
        if self.recording_bytes + self.map_bytes > self.free_bytes:
            raise UsageError(
                f"the recording will take at most {_gb(self.recording_bytes)} and the maps {_gb(self.map_bytes)}, the "
                f"disk of {self.folder} has {_gb(self.free_bytes)} free; free some, name a folder on another disk as "
                "`out`, or lower `maps`"
            )

    def content(self) -> dict[str, Any]:
        """The folder and the numbers as plain values."""
        return {**asdict(self), "folder": str(self.folder)}

    def __str__(self) -> str:
        """Say in words that there is enough room, as `require` has found."""
        return (
            f"at most {_gb(self.recording_bytes)} of frames and {_gb(self.map_bytes)} of maps, which fit: the disk of "
            f"{self.folder} has {_gb(self.free_bytes)} free"
        )


def _gb(size: int) -> str:
    return f"{digits(size / 1e9)} GB"
