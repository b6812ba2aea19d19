"""The layout of an SPB1 block (SPB1 1.0 wire layout, docs/reference/spb1.md) and its checksum.

Little-endian: header 96 B, records 16 B per frame, zeros to a multiple of 64, packed pixels, trailer 32 B, zeros to the
stride. The checksum is CRC-32 as zlib defines it. It is computed by ISA-L if that is installed (12 GB/s on a core),
else by zlib (3.5 GB/s). Both release the interpreter's lock for large buffers.
"""

import struct
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.frames import FRAME_RECORD, packed_row_bytes

HEADER_BYTES: Final = 96
TRAILER_BYTES: Final = 32
ALIGN: Final = 1024
"""Strides are multiples of this, and blocks are searched for at multiples of it after damage."""
PIXELS_ALIGN: Final = 64
MAX_FRAMES: Final = 0xFFFF

MAGIC: Final = b"SPB1"
TRAILER_MAGIC: Final = b"SPE1"
MAJOR: Final = 1
VERSION: Final = MAJOR << 8 | 0

HEADER: Final = struct.Struct("<4sHHIBBHQQQQIIIIIHHHHHHIIII")
TRAILER: Final = struct.Struct("<4sIQIIII")
CRC: Final = struct.Struct("<I")
"""CRC-32 of zlib; the last field of header and trailer, over all bytes before it."""

PACKED: Final = 0
SPARSE: Final = 1
SUMMED: Final = 2
REGISTER_ACK: Final = 0x7E
IDLE: Final = 0x7F


@dataclass(frozen=True, slots=True)
class BlockLayout:
    """A block of `n_frames` windows of width x height pixels. Offsets and sizes are in bytes."""

    n_frames: int
    width: int
    height: int

    def __post_init__(self) -> None:
        """Raises ValueError for sizes that the header's fields cannot say."""
        if not 0 <= self.n_frames <= MAX_FRAMES:
            raise ValueError(f"{self.n_frames} frames in a block; SPB1 holds 0 to {MAX_FRAMES}")
        if not (1 <= self.width <= 0xFFFF and 1 <= self.height <= 0xFFFF):
            raise ValueError(f"a window of {self.width}x{self.height} pixels; SPB1 holds 1 to 65535 each way")

    @property
    def row_bytes(self) -> int:
        """Bytes of one packed row, padded to whole 64-bit words."""
        return packed_row_bytes(self.width)

    @property
    def frame_bytes(self) -> int:
        """Bytes of the pixels of one frame."""
        return self.height * self.row_bytes

    @property
    def pixels_offset(self) -> int:
        """Offset of the pixels from the block's start; a multiple of `PIXELS_ALIGN`."""
        return round_up(HEADER_BYTES + FRAME_RECORD.itemsize * self.n_frames, PIXELS_ALIGN)

    @property
    def payload_bytes(self) -> int:
        """Bytes of records, padding and pixels together."""
        return self.pixels_offset - HEADER_BYTES + self.n_frames * self.frame_bytes

    @property
    def block_bytes(self) -> int:
        """Bytes of header, payload and trailer together."""
        return HEADER_BYTES + self.payload_bytes + TRAILER_BYTES

    @property
    def min_stride(self) -> int:
        """The smallest stride that holds the block."""
        return round_up(self.block_bytes, ALIGN)


def frames_per_block(stride: int, width: int, height: int) -> int:
    """Number of frames that fit into a stride. Raises ValueError if the stride is bad or holds no frame."""
    check_stride(stride)
    one = BlockLayout(1, width, height)
    room = stride - HEADER_BYTES - TRAILER_BYTES
    frames = min(room // (FRAME_RECORD.itemsize + one.frame_bytes), MAX_FRAMES)
    while frames and BlockLayout(frames, width, height).block_bytes > stride:  # zeros before the pixels take room too
        frames -= 1
    if frames == 0:
        raise ValueError(f"stride {stride} holds no frame of {width}x{height}; use at least {one.min_stride} bytes")
    return frames


def block_views(buffer: NDArray[np.uint8], layout: BlockLayout) -> tuple[NDArray[np.void], NDArray[np.uint8]]:
    """The parts of `buffer` (uint8 (bytes,)) that a source fills: records (n,) and bits (n, height, row bytes).

    They are views, not copies. The source must clear the pad bits. Raises ValueError if the buffer is too short.
    """
    if len(buffer) < layout.block_bytes:
        raise ValueError(f"a buffer of {len(buffer)} bytes for a block of {layout.block_bytes}")
    return views_at(buffer, layout, HEADER_BYTES, layout.pixels_offset)


def views_at(
    buffer: NDArray[np.uint8], layout: BlockLayout, records_offset: int, pixels_offset: int
) -> tuple[NDArray[np.void], NDArray[np.uint8]]:
    """Records and bits at given offsets, which differ from ours if a block's header is longer."""
    n = layout.n_frames
    records: NDArray[np.void] = buffer[records_offset : records_offset + n * FRAME_RECORD.itemsize].view(FRAME_RECORD)
    pixels = buffer[pixels_offset : pixels_offset + n * layout.frame_bytes]
    return records, pixels.reshape(n, layout.height, layout.row_bytes)


def check_stride(stride: int) -> None:
    """Raises ValueError unless `stride` is a positive multiple of `ALIGN`."""
    if stride < ALIGN or stride % ALIGN:
        raise ValueError(f"stride {stride} is no positive multiple of {ALIGN} bytes")


def round_up(size: int, step: int) -> int:
    """The smallest multiple of `step` that is not less than `size`."""
    return -(-size // step) * step


try:
    from isal.isal_zlib import crc32
except ImportError:  # there is no wheel for this machine
    from zlib import crc32

__all__ = ["crc32"]
