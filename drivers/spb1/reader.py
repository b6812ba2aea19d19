"""Reading SPB1 blocks: a single one in its memory, or a stream of them that may be damaged.

Header and trailer are always checked in full. The payload's CRC is checked on request, since it reads every byte, which
for a live stream at full rate would take much of a processor core. A block that is found damaged is never passed on and
always reported.
"""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.errors import CorruptBlock, UnsupportedBlock
from drivers.frames import FRAME_RECORD, BlockFlag, BlockHeader, FrameBlock
from drivers.spb1.layout import (
    ALIGN,
    CRC,
    HEADER,
    HEADER_BYTES,
    IDLE,
    MAGIC,
    MAJOR,
    PACKED,
    PIXELS_ALIGN,
    REGISTER_ACK,
    SPARSE,
    SUMMED,
    TRAILER,
    TRAILER_BYTES,
    TRAILER_MAGIC,
    BlockLayout,
    check_stride,
    crc32,
    round_up,
    views_at,
)

_PAYLOADS: Final = {
    SPARSE: "a sparse payload",
    SUMMED: "summed frames",
    REGISTER_ACK: "a register acknowledgement, no frames",
    IDLE: "an idle heartbeat, no frames",
}

MAX_COUNT: Final = 2**63 - 2**32
"""Largest `first_frame` and `t0_ticks` of a block: the number and tick of its last frame then fit int64 too."""

_LSB_FIRST: Final = int(BlockFlag.LSB_FIRST)
"""A plain integer: arithmetic with flags takes microseconds, and this is done for every block."""

_BITS_REVERSED: Final = np.packbits(np.unpackbits(np.arange(256, dtype=np.uint8), bitorder="little"))


@dataclass(frozen=True, slots=True)
class HeaderFields:
    """A header whose magic and CRC are right, with the places of the block's parts. Offsets and sizes are in bytes."""

    block: BlockHeader
    version: int
    lsb_first: bool
    n_frames: int
    header_bytes: int
    payload_bytes: int
    pixels_offset: int

    @property
    def trailer_offset(self) -> int:
        """Offset of the trailer, which follows the payload directly."""
        return self.header_bytes + self.payload_bytes

    @property
    def block_bytes(self) -> int:
        """Bytes of header, payload and trailer together."""
        return self.trailer_offset + TRAILER_BYTES

    @property
    def is_control(self) -> bool:
        """Whether this is one of the control blocks that a live link sends between blocks of frames."""
        return self.version >> 8 == MAJOR and self.block.payload_type in (REGISTER_ACK, IDLE)


def parse_block(buffer: NDArray[np.uint8], *, check_payload: bool) -> FrameBlock:
    """The block at the start of `buffer` (uint8 (bytes,), contiguous, may be longer), as views of the same memory.

    Raises `UnsupportedBlock` if its header is sound but states another major version, another payload than packed
    frames, other than 1 bit per pixel, or every k-th frame only. Raises `CorruptBlock` if anything else is wrong with
    the block; the payload is checked only if `check_payload`, and if the block states its CRC.
    A truncated block gives its complete frames. A block with the least significant bit first is copied and delivered
    like all others, without that flag.
    """
    return read_frames(buffer, read_header(buffer), check_payload=check_payload)


def read_header(buffer: NDArray[np.uint8]) -> HeaderFields:
    """The header at the start of `buffer`. Raises `CorruptBlock` if it is cut off, or magic or CRC is wrong; nothing
    else is checked."""
    if len(buffer) < HEADER_BYTES:
        raise CorruptBlock(f"{len(buffer)} bytes left, too few for a block header of {HEADER_BYTES}")
    raw = buffer.data[:HEADER_BYTES]
    magic = bytes(raw[: len(MAGIC)])
    if magic != MAGIC:
        raise CorruptBlock(f"no block: starts with 0x{magic.hex()}, not 0x{MAGIC.hex()} ({MAGIC.decode()})")
    fields = HEADER.unpack(raw)
    _check_crc("header", crc32(raw[: -CRC.size]), fields[-1])
    (_, version, header_bytes, flags, bits_per_px, payload_type, run_id, block_seq, first_frame, t0_ticks) = fields[:10]
    (lost_before, tick_hz, tick_hz_den, period, exposure, sweep, n_frames, frame_step, width, height) = fields[10:20]
    (sensor_width, sensor_height, payload_bytes, pixels_offset) = fields[20:24]
    counts = run_id, block_seq, first_frame, t0_ticks, lost_before
    times = _rate(tick_hz, tick_hz_den), period, exposure, sweep, frame_step
    sizes = width, height, sensor_width, sensor_height
    header = BlockHeader(BlockFlag(flags & ~_LSB_FIRST), *counts, *times, *sizes, bits_per_px, payload_type)
    lsb_first = bool(flags & _LSB_FIRST)
    return HeaderFields(header, version, lsb_first, n_frames, header_bytes, payload_bytes, pixels_offset)


def read_frames(buffer: NDArray[np.uint8], fields: HeaderFields, *, check_payload: bool) -> FrameBlock:
    """The block at the start of `buffer`, whose header was read already. Errors as in `parse_block`."""
    _refuse_unsupported(fields)
    layout = _checked_layout(fields, len(buffer))
    status, valid_bytes, payload_crc = _read_trailer(buffer, fields)
    if check_payload and payload_crc:
        found = crc32(buffer.data[fields.header_bytes : fields.trailer_offset])
        _check_crc(f"payload of block {fields.block.block_seq}", found, payload_crc)
    records, bits = views_at(buffer, layout, fields.header_bytes, fields.pixels_offset)
    if valid_bytes < fields.payload_bytes:
        valid_pixel_bytes = fields.header_bytes + valid_bytes - fields.pixels_offset
        whole = max(0, valid_pixel_bytes) // layout.frame_bytes
        records, bits = records[:whole], bits[:whole]
    return FrameBlock(fields.block, records, _BITS_REVERSED[bits] if fields.lsb_first else bits, status)


def read_control(buffer: NDArray[np.uint8], fields: HeaderFields) -> bytes:
    """The payload of a control block whose header was read. Raises `CorruptBlock` if it is cut off or damaged."""
    if fields.block_bytes > len(buffer):
        raise CorruptBlock(f"control block cut off: {len(buffer)} of {fields.block_bytes} bytes")
    _, valid_bytes, payload_crc = _read_trailer(buffer, fields)
    payload = buffer.data[fields.header_bytes : fields.trailer_offset]
    if payload_crc:
        _check_crc("control block", crc32(payload), payload_crc)
    return bytes(payload[:valid_bytes])


@lru_cache(maxsize=16)
def _rate(tick_hz: int, denominator: int) -> Fraction:
    """Ticks per second; 0 if the denominator is 0. Cached, since a fraction takes microseconds and few values occur."""
    return Fraction(tick_hz, denominator) if denominator else Fraction(0)


def _refuse_unsupported(fields: HeaderFields) -> None:
    block = fields.block
    what = None
    if fields.version >> 8 != MAJOR:
        what = f"version {fields.version >> 8}.{fields.version & 0xFF}"
    elif block.payload_type != PACKED:
        what = _PAYLOADS.get(block.payload_type, f"payload type {block.payload_type}")
    elif block.bits_per_px != 1:
        what = f"{block.bits_per_px} bits per pixel"
    elif block.frame_step != 1:
        what = f"every {block.frame_step}th frame only"
    if what is not None:
        raise UnsupportedBlock(
            f"block {block.block_seq} has {what}; this reader takes SPB1 {MAJOR}.x with packed single frames"
        )


def _checked_layout(fields: HeaderFields, room: int) -> BlockLayout:
    """The layout, once every size and offset in the header agrees with the others and with the room there is."""
    block = fields.block
    where = f"block {block.block_seq}"
    if not (1 <= block.width <= block.sensor_width and 1 <= block.height <= block.sensor_height):
        raise CorruptBlock(
            f"{where}: window of {block.width}x{block.height} on a sensor of {block.sensor_width}x{block.sensor_height}"
        )
    if block.tick_hz <= 0:
        raise CorruptBlock(f"{where}: tick rate of 0 Hz")
    if max(block.first_frame, block.t0_ticks) > MAX_COUNT:
        raise CorruptBlock(f"{where}: frame {block.first_frame} at tick {block.t0_ticks} is beyond 63 bits")
    layout = BlockLayout(fields.n_frames, block.width, block.height)
    records_end = fields.header_bytes + FRAME_RECORD.itemsize * fields.n_frames
    pixels_end = fields.pixels_offset + fields.n_frames * layout.frame_bytes
    if (
        fields.header_bytes < HEADER_BYTES
        or fields.pixels_offset < records_end
        or fields.pixels_offset % PIXELS_ALIGN
        or pixels_end != fields.trailer_offset
    ):
        raise CorruptBlock(
            f"{where}: {fields.n_frames} frames, header of {fields.header_bytes} bytes, payload of "
            f"{fields.payload_bytes} bytes and pixels at {fields.pixels_offset} contradict each other"
        )
    if fields.block_bytes > room:
        raise CorruptBlock(f"{where}: cut off, {room} of {fields.block_bytes} bytes")
    return layout


def _read_trailer(buffer: NDArray[np.uint8], fields: HeaderFields) -> tuple[int, int, int]:
    """Status, valid payload bytes and payload CRC (0 = not computed)."""
    where = f"block {fields.block.block_seq}"
    raw = buffer.data[fields.trailer_offset : fields.block_bytes]
    magic, status, block_seq, valid_bytes, payload_crc, _, crc = TRAILER.unpack(raw)
    if magic != TRAILER_MAGIC:
        raise CorruptBlock(f"{where}: no trailer behind the pixels, but 0x{magic.hex()}")
    _check_crc(f"trailer of {where}", crc32(raw[: -CRC.size]), crc)
    if block_seq != fields.block.block_seq:
        raise CorruptBlock(f"{where}: ends with the trailer of block {block_seq}")
    if valid_bytes > fields.payload_bytes:
        raise CorruptBlock(f"{where}: {valid_bytes} valid bytes in a payload of {fields.payload_bytes}")
    return status, valid_bytes, payload_crc


def _check_crc(what: str, found: int, stated: int) -> None:
    if found != stated:
        raise CorruptBlock(f"{what}: CRC is {found:08x}, stated {stated:08x}")


_SEARCH_BYTES = 16 * 2**20
"""Bytes that a search reads at a time: one piece of damage must not cause a big mapped file to be read to its end."""


@dataclass(frozen=True, slots=True)
class Damage:
    """A piece of a stream that gave no block: where it is, its length (0 if only padding is missing) and why.

    unsupported: whether a header with the right CRC describes a block that this reader does not support.
    """

    offset: int
    length: int
    reason: str
    unsupported: bool = False


def walk_blocks(buffer: NDArray[np.uint8], stride: int | None, *, check_payload: bool) -> Iterator[FrameBlock | Damage]:
    """Blocks and damage of `buffer` (uint8 (bytes,), contiguous) in order, the blocks as views of the same memory.

    stride: bytes from block to block. None if it is unknown or changes: then each block ends at its own size, and zeros
    up to the next one are padding. After damage, reading resumes at the next header with the right CRC on a multiple of
    `ALIGN`. A block whose number does not rise within its run counts as damage: it was sent or written twice. Control
    blocks are skipped. Raises `UnsupportedBlock` at a block of a kind that this reader does not support, and ValueError
    for a bad stride.
    """
    last: FrameBlock | None = None
    for item in walk_placed(buffer, stride, check_payload=check_payload):
        if isinstance(item, Damage):
            if item.unsupported:
                raise UnsupportedBlock(item.reason)
            yield item
            continue
        seq, run = item.block.header.block_seq, item.block.header.run_id
        if last is not None and last.header.run_id == run and last.header.block_seq >= seq:
            reason = f"block {seq} of run {run} comes after block {last.header.block_seq}"
            yield Damage(item.offset, min(item.end, len(buffer)) - item.offset, reason)
        else:
            last = item.block
            yield last


@dataclass(frozen=True, slots=True)
class Placed:
    """A sound block and its place: `length` bytes from byte `offset` on; the next block is sought from `end` on."""

    offset: int
    length: int
    end: int
    block: FrameBlock


def walk_placed(buffer: NDArray[np.uint8], stride: int | None, *, check_payload: bool) -> Iterator[Placed | Damage]:
    """Blocks with their places, and damage, in the order of their places. Block numbers may fall or repeat. Unsupported
    blocks are reported as damage. stride: as in `walk_blocks`."""
    if stride is not None:
        check_stride(stride)
    offset = 0
    rest = 0  # where the last block really ended: if a piece of its padding got lost, the next block begins early
    while offset < len(buffer):
        if stride is None and (zeros := _zeros(buffer, offset)):
            offset += zeros
            continue
        try:
            fields = read_header(buffer[offset:])
            room = buffer[offset:] if stride is None else buffer[offset : offset + stride]
            block = None
            if fields.is_control:
                read_control(room, fields)  # only one that is sound to its end says where the next block begins
            else:
                block = read_frames(room, fields, check_payload=check_payload)
        except (CorruptBlock, UnsupportedBlock) as error:
            found = _next_header(buffer, rest, passed_over=offset)
            start = min(offset, found)
            yield Damage(start, found - start, str(error), isinstance(error, UnsupportedBlock))
            offset = rest = found
            continue
        rest = offset + round_up(fields.block_bytes, ALIGN)
        end = rest if stride is None else offset + stride
        if block is not None:
            yield Placed(offset, fields.block_bytes, end, block)
        offset = end


def _zeros(buffer: NDArray[np.uint8], offset: int) -> int:
    """Number of zero bytes from `offset` on, in whole pieces of `ALIGN` bytes or up to the end of the buffer."""
    end, step = offset, ALIGN
    while end < len(buffer):
        piece = buffer[end : end + step]
        if piece.any():
            return end - offset + int((piece != 0).argmax()) // ALIGN * ALIGN
        end, step = end + step, _SEARCH_BYTES
    return end - offset


def _next_header(buffer: NDArray[np.uint8], start: int, *, passed_over: int) -> int:
    """Offset of the next sound header at or after `start`, except at `passed_over`; the buffer's end without one."""
    for window in range(start, len(buffer), _SEARCH_BYTES):
        first_bytes = buffer[window : window + _SEARCH_BYTES : ALIGN]
        for index in np.flatnonzero(first_bytes == MAGIC[0]):
            offset = window + int(index) * ALIGN
            if offset != passed_over:
                with suppress(CorruptBlock):
                    read_header(buffer[offset:])
                    return offset
    return len(buffer)
