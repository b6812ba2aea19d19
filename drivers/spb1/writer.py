"""Writing SPB1 blocks, either around records and pixels that are already in place or in parts for a file."""

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.frames import FRAME_RECORD, BlockFlag, BlockHeader, BlockStatus, FrameBlock
from drivers.spb1.layout import (
    CRC,
    HEADER,
    HEADER_BYTES,
    MAGIC,
    PACKED,
    PIXELS_ALIGN,
    TRAILER,
    TRAILER_BYTES,
    TRAILER_MAGIC,
    VERSION,
    BlockLayout,
    block_views,
    crc32,
    round_up,
)


def seal_block(
    buffer: NDArray[np.uint8],
    header: BlockHeader,
    layout: BlockLayout,
    *,
    status: int = BlockStatus.OK,
    payload_crc: bool,
) -> FrameBlock:
    """Write everything except records and pixels, which the source filled in through `block_views`; returns the block.

    The block is a view of `buffer`, uint8 (stride,), contiguous; nothing is copied. The bytes after the trailer are
    zeroed.
    payload_crc: whether to compute the payload's CRC, which reads every byte; else the trailer says 'not computed'.
    Raises ValueError if the header contradicts the layout or has no packed SPB1 1.0 form.
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
    """Write a control block (`REGISTER_ACK`, `IDLE`), which has no frames. buffer: uint8 (stride,), written
    completely."""
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

    Records and pixels are views of the block's memory and valid as long as that is. Reads every byte, without the
    interpreter's lock. Raises ValueError as `seal_block` does.
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
