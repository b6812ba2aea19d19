"""Compressed segments that can be read at any place: the seekable format of zstd, one frame for each block.

A `.zst` file like any other (`zstd -d` gives the plain segment back), with a skippable frame at its end that says how
long the frames are, packed and unpacked. Source of its layout: zstd_seekable_compression_format.md, version 0.1.0, in
contrib/seekable_format of facebook/zstd. Where that table is damaged the frames are found one after the other.

The package zstandard is optional: the extra `compress`.
"""

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from drivers.errors import CorruptBlock, ProtocolError
from drivers.optional_packages import install_command

SKIPPABLE_MAGIC: Final = 0x184D2A5E
SEEKABLE_MAGIC: Final = 0x8F92EAB1
FRAME_MAGIC: Final = bytes.fromhex("28b52ffd")
MAX_FRAME_BYTES: Final = 1 << 31
"""A frame holds one block; a table that says more is damaged."""
MOST_RATIO: Final = 1 << 15
"""Plain bytes that a packed one can stand for: a block of zstd takes 4 bytes and holds 128 KiB at most (RFC 8878)."""
_PIECE_BYTES: Final = 1 << 12
"""Of a frame of unknown size, fed to the unpacker at a time: 128 MiB at most come of it."""

_HEAD: Final = struct.Struct("<II")
_FOOT: Final = struct.Struct("<IBI")
_ENTRY_BYTES: Final = 8

Bytes = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class FrameTable:
    """Where each frame begins, packed and unpacked: int64 (frames + 1,)."""

    packed: NDArray[np.int64]
    plain: NDArray[np.int64]

    @classmethod
    def read(cls, data: Bytes) -> "FrameTable":
        """Of a whole file (uint8 (bytes,)): its table, or where that is damaged what the frames themselves say."""
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
        """The frames that hold the plain bytes from `start` to `end`."""
        if start >= min(end, self.size):
            return range(0)
        first = int(np.searchsorted(self.plain, start, "right")) - 1
        return range(first, int(np.searchsorted(self.plain, min(end, self.size), "left")))

    def start(self, frame: int) -> int:
        """Plain offset at which a frame begins."""
        return int(self.plain[frame])

    def frame_bytes(self, frame: int) -> int:
        """Plain bytes of a frame."""
        return int(self.plain[frame + 1] - self.plain[frame])

    def packed_place(self, frame: int) -> tuple[int, int]:
        """Offset and length of a frame in the file."""
        return int(self.packed[frame]), int(self.packed[frame + 1] - self.packed[frame])


def table_bytes(sizes: Sequence[tuple[int, int]]) -> bytes:
    """The skippable frame that ends a file: (packed, plain) bytes of its frames."""
    entries = np.array(sizes, "<u4").reshape(-1, 2).tobytes()
    return _HEAD.pack(SKIPPABLE_MAGIC, len(entries) + _FOOT.size) + entries + _FOOT.pack(len(sizes), 0, SEEKABLE_MAGIC)


def unpack_frame(packed: Bytes, size: int) -> Bytes:
    """The `size` plain bytes of one frame; CorruptBlock where it does not hold them."""
    zstandard = zstandard_or_error()
    raw = packed.tobytes()
    try:
        if zstandard.frame_content_size(raw) != size:  # asked first: a damaged one must not order terabytes
            raise CorruptBlock(f"compressed block says that it holds other than {size} bytes")
        return np.frombuffer(zstandard.ZstdDecompressor().decompress(raw), np.uint8)
    except zstandard.ZstdError as error:
        raise CorruptBlock(f"compressed block cannot be unpacked: {error}") from None


def zstandard_or_error() -> Any:
    """The package zstandard. `ProtocolError` with the command that installs it where it is not there."""
    try:
        import zstandard
    except ImportError:
        command = install_command("zstandard", "compress")
        raise ProtocolError(f"compressed recordings need the package zstandard; install it: {command}") from None
    return zstandard


def _stated_sizes(data: Bytes) -> NDArray[np.int64] | None:
    """(packed, plain) of each frame as the table says, None where it cannot be."""
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
    if packed[-1] != begin or (sizes <= 0).any() or (sizes[:, 1] > MAX_FRAME_BYTES).any():
        return None
    if (sizes[:, 1] > MOST_RATIO * sizes[:, 0]).any():
        return None
    return sizes


def _found_sizes(data: Bytes) -> Iterator[tuple[int, int]]:
    """(packed, plain) of each frame, found by unpacking one after the other; nothing behind the first damaged one."""
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
