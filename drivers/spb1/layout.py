"""The layout of an SPB1 block (SPB1 1.0 wire layout, docs/reference/spb1.md), its checksum, and how blocks are written.

Little-endian: header 96 B, records 16 B per frame, zeros to a multiple of 64, packed pixels, trailer 32 B, zeros to the
stride. The checksum is CRC-32 as zlib defines it. It is computed by ISA-L if that is installed (12 GB/s on a core),
else by zlib (3.5 GB/s). Both release the interpreter's lock for large buffers. Blocks are written either around
records and pixels that are already in place (`seal_block`) or in parts for a file (`block_parts`).
"""

import struct
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from drivers.frames import FRAME_RECORD, BlockFlag, BlockHeader, BlockStatus, FrameBlock, packed_row_bytes

try:
    from isal.isal_zlib import crc32 as crc32
except ImportError:  # there is no wheel for this machine
    from zlib import crc32 as crc32

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
        """Raise ValueError for sizes that the header's fields cannot hold."""
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
    """Number of frames that fit into a stride. Raises ValueError if the stride is no positive multiple of `ALIGN` or
    holds no frame."""
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
    """Records and bits of `layout` as views of `buffer` at the given offsets. These differ from those of `layout` if a
    block's header is longer than `HEADER_BYTES`."""
    n = layout.n_frames
    records: NDArray[np.void] = buffer[records_offset : records_offset + n * FRAME_RECORD.itemsize].view(FRAME_RECORD)
    pixels = buffer[pixels_offset : pixels_offset + n * layout.frame_bytes]
    return records, pixels.reshape(n, layout.height, layout.row_bytes)


def check_stride(stride: int) -> None:
    """Raise ValueError unless `stride` is a positive multiple of `ALIGN`."""
    if stride < ALIGN or stride % ALIGN:
        raise ValueError(f"stride {stride} is no positive multiple of {ALIGN} bytes")


def round_up(size: int, step: int) -> int:
    """The smallest multiple of `step` that is not less than `size`."""
    return -(-size // step) * step


def seal_block(
    buffer: NDArray[np.uint8],
    header: BlockHeader,
    layout: BlockLayout,
    *,
    status: int = BlockStatus.OK,
    payload_crc: bool,
) -> FrameBlock:
    """Write everything except records and pixels, which the source filled in through `block_views`; returns the block.

    The block is a view of `buffer`, uint8 (stride,), contiguous; nothing is copied. Bytes after the trailer are zeroed.
    payload_crc: whether to compute the payload's CRC, which reads every byte; else the trailer says 'not computed'.
    Raises ValueError if the buffer is too short, or the header contradicts the layout or has no packed SPB1 1.0 form.
    """
    _check(header, layout)
    records, bits = block_views(buffer, layout)
    raw = buffer.data
    buffer[HEADER_BYTES + FRAME_RECORD.itemsize * layout.n_frames : layout.pixels_offset] = 0
    end = HEADER_BYTES + layout.payload_bytes
    crc = crc32(raw[HEADER_BYTES:end]) if payload_crc else 0
    _pack(raw[:HEADER_BYTES], raw[end : end + TRAILER_BYTES], header, layout, status, crc)
    buffer[end + TRAILER_BYTES :] = 0
    return FrameBlock(header, records, bits, status)


def seal_control(buffer: NDArray[np.uint8], payload_type: int, run_id: int, payload: bytes) -> None:
    """Write a control block, which has no frames. payload_type: `REGISTER_ACK` or `IDLE`. buffer: uint8 (stride,),
    written completely."""
    end = HEADER_BYTES + len(payload)
    raw = buffer.data
    sizes = len(payload), round_up(end, PIXELS_ALIGN)
    HEADER.pack_into(raw, 0, MAGIC, VERSION, HEADER_BYTES, 0, 1, payload_type, run_id, *(0,) * 15, *sizes, 0, 0)
    raw[HEADER_BYTES:end] = payload
    trailer = raw[end : end + TRAILER_BYTES]
    TRAILER.pack_into(trailer, 0, TRAILER_MAGIC, BlockStatus.OK, 0, len(payload), crc32(payload), 0, 0)
    _sign(raw[:HEADER_BYTES])
    _sign(trailer)
    buffer[end + TRAILER_BYTES :] = 0


def block_parts(block: FrameBlock) -> tuple[memoryview, ...]:
    """The bytes of a block in order, for a file, with the payload's CRC and zeros up to the next multiple of `ALIGN`.

    Records and pixels are views of the block's memory if that is contiguous, and valid as long as that memory is. Reads
    every byte, without the interpreter's lock. Raises ValueError for a header that `seal_block` refuses.
    """
    header = block.header
    layout = BlockLayout(block.n_frames, header.width, header.height)
    _check(header, layout)
    records = _bytes_of(block.records)
    bits = _bytes_of(block.bits)
    gap = memoryview(bytes(layout.pixels_offset - HEADER_BYTES - records.nbytes))
    crc = crc32(bits, crc32(gap, crc32(records)))
    head, tail = memoryview(bytearray(HEADER_BYTES)), bytearray(layout.min_stride - layout.block_bytes + TRAILER_BYTES)
    trailer = memoryview(tail)[:TRAILER_BYTES]
    _pack(head, trailer, header, layout, block.status, crc)
    return head, records, gap, bits, memoryview(tail)


def _bytes_of(array: NDArray[Any]) -> memoryview:
    """The array's memory as bytes; a copy only where it is not contiguous."""
    return np.ascontiguousarray(array).reshape(-1).view(np.uint8).data


def _pack(
    head: memoryview, trailer: memoryview, header: BlockHeader, layout: BlockLayout, status: int, crc: int
) -> None:
    sort = int(header.flags), header.bits_per_px, header.payload_type
    counts = header.run_id, header.block_seq, header.first_frame, header.t0_ticks, header.lost_before
    times = header.tick_hz.numerator, header.tick_hz.denominator, header.frame_period_ticks, header.exposure_ticks
    frames = header.sweep, layout.n_frames, header.frame_step
    sizes = header.width, header.height, header.sensor_width, header.sensor_height
    places = layout.payload_bytes, layout.pixels_offset
    lost = header.lost_before & 0xFFFFFFFF
    try:
        HEADER.pack_into(head, 0, MAGIC, VERSION, HEADER_BYTES, *sort, *counts, *times, *frames, *sizes, *places, 0, 0)
        TRAILER.pack_into(trailer, 0, TRAILER_MAGIC, status, header.block_seq, layout.payload_bytes, crc, lost, 0)
    except struct.error as error:
        raise ValueError(f"block {header.block_seq}: a field does not fit SPB1 1.0: {error}") from None
    _sign(head)
    _sign(trailer)


def _sign(part: memoryview) -> None:
    CRC.pack_into(part, len(part) - CRC.size, crc32(part[: -CRC.size]))


def _check(header: BlockHeader, layout: BlockLayout) -> None:
    if (header.width, header.height) != (layout.width, layout.height):
        raise ValueError(
            f"header of a {header.width}x{header.height} window for a layout of {layout.width}x{layout.height}"
        )
    if header.width > header.sensor_width or header.height > header.sensor_height:
        raise ValueError(
            f"a window of {header.width}x{header.height} on a sensor of {header.sensor_width}x{header.sensor_height}"
        )
    if (header.payload_type, header.bits_per_px, header.frame_step) != (PACKED, 1, 1):
        raise ValueError("SPB1 1.0 writes packed payloads of 1 bit per pixel and every frame only")
    if header.flags & BlockFlag.LSB_FIRST:
        raise ValueError("blocks are written with the most significant bit first; clear BlockFlag.LSB_FIRST")
