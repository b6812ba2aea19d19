"""Walking a stream of SPB1 blocks, damage and all: nothing damaged is passed on, nothing is passed over in silence."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.errors import CorruptBlock, UnsupportedBlock
from drivers.frames import FrameBlock
from drivers.spb1.layout import ALIGN, MAGIC, check_stride, round_up
from drivers.spb1.reader import read_control, read_frames, read_header

_SEARCH_BYTES = 16 * 2**20
"""A search looks at this much at a time, so that a big file mapped into memory is not read to its end for one gap."""


@dataclass(frozen=True, slots=True)
class Damage:
    """A piece of a stream that gave no block: where, how much (0 where only padding is missing) and why.

    unsupported: a header with the right CRC tells of a block that this reader does not take.
    """

    offset: int
    length: int
    reason: str
    unsupported: bool = False


def walk_blocks(buffer: NDArray[np.uint8], stride: int | None, *, check_payload: bool) -> Iterator[FrameBlock | Damage]:
    """Blocks and damage of `buffer` (uint8 (bytes,), contiguous) in order, the blocks over the same memory.

    stride: bytes from block to block; None where it is not known or changes: each block ends then at its own size and
    zeros up to the next one are padding. After damage the next header with the right CRC on a multiple of `ALIGN`
    counts. A block whose number does not rise within its run was sent or written twice: damage too. Control blocks
    are passed over. `UnsupportedBlock` where the stream is of another sort than this reader takes.
    """
    last: FrameBlock | None = None
    for item in walk_placed(buffer, stride, check_payload=check_payload):
        if isinstance(item, Damage):
            if item.unsupported:
                raise UnsupportedBlock(item.reason)
            yield item
        elif last is None or not _repeats(item.block, last):
            last = item.block
            yield item.block
        else:
            seq, run = item.block.header.block_seq, item.block.header.run_id
            reason = f"block {seq} of run {run} comes after block {last.header.block_seq}"
            yield Damage(item.offset, min(item.end, len(buffer)) - item.offset, reason)


@dataclass(frozen=True, slots=True)
class Placed:
    """A sound block and where it lies: from byte `offset` on, `length` bytes, the next one at `end` or behind it."""

    offset: int
    length: int
    end: int
    block: FrameBlock


def walk_placed(buffer: NDArray[np.uint8], stride: int | None, *, check_payload: bool) -> Iterator[Placed | Damage]:
    """As `walk_blocks`, with the places of the blocks and in whatever order they come, twice too.

    A block of another sort is damage here: it costs what is behind it nothing.
    """
    if stride is not None:
        check_stride(stride)
    offset = 0
    rest = 0  # where the block before really ended: a piece lost from its padding brings the next one forward
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
    """Bytes, whole pieces of `ALIGN`, that are zero from `offset` on; what is only allocated is passed quickly."""
    end, step = offset, ALIGN
    while end < len(buffer):
        piece = buffer[end : end + step]
        if piece.any():
            return end - offset + int((piece != 0).argmax()) // ALIGN * ALIGN
        end, step = end + step, _SEARCH_BYTES
    return end - offset


def _repeats(block: FrameBlock, last: FrameBlock) -> bool:
    return block.header.run_id == last.header.run_id and block.header.block_seq <= last.header.block_seq


def _next_header(buffer: NDArray[np.uint8], start: int, *, passed_over: int) -> int:
    """Offset of the next sound header at or after `start`, or the buffer's end."""
    for window in range(start, len(buffer), _SEARCH_BYTES):
        first_bytes = buffer[window : window + _SEARCH_BYTES : ALIGN]
        for index in np.flatnonzero(first_bytes == MAGIC[0]):
            offset = window + int(index) * ALIGN
            if offset != passed_over and _has_header(buffer[offset:]):
                return offset
    return len(buffer)


def _has_header(buffer: NDArray[np.uint8]) -> bool:
    try:
        read_header(buffer)
    except CorruptBlock:
        return False
    return True
