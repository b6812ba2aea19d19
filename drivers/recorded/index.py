"""The index of a recording, `frames.idx`: one record of fixed size for each block, in the order of writing.

64 bytes of header, then records of 64 bytes, each with a CRC of its own: a torn or damaged record is known as such
and costs no other. The index tells where to look; what is there only the block itself can tell, so that a lost index is
no loss (`rig repair` writes it anew from the blocks).
"""

import struct
import zlib
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from drivers.errors import CorruptBlock
from drivers.frames import FrameBlock
from drivers.spb1 import BlockLayout

INDEX_FILE: Final = "frames.idx"
HEADER_BYTES: Final = 64
RECORD_BYTES: Final = 64
MAGIC: Final = b"SPBI"
MAJOR: Final = 1
MINOR: Final = 0

INDEX_RECORD: Final = np.dtype(
    [
        ("segment", "<u4"),
        ("flags", "<u4"),
        ("offset", "<u8"),
        ("length", "<u8"),
        ("run_id", "<u4"),
        ("block_seq", "<u4"),
        ("first_frame", "<u8"),
        ("n_frames", "<u4"),
        ("sweep", "<u4"),
        ("t0_ticks", "<u8"),
        ("reserved", "<u4"),
        ("crc", "<u4"),
    ]
)
"""Where a block is: number of its segment, offset and length in bytes (header to trailer, without the zeros behind it);
and what it holds, as its header says: flags, run_id, block_seq (low 32 bits), first_frame, n_frames, sweep and t0_ticks
of the first frame. reserved: 0. crc: CRC-32 (zlib) of the 60 bytes before."""

_HEADER: Final = struct.Struct("<4sHHI48xI")
_RECORD: Final = struct.Struct("<IIQQIIQIIQII")
_CRC: Final = struct.Struct("<I")


def segment_name(number: int) -> str:
    """File of a segment: frames-000000.spb, ..."""
    return f"frames-{number:06d}.spb"


def index_header() -> bytes:
    """The first 64 bytes of an index."""
    bare = _HEADER.pack(MAGIC, MAJOR, MINOR, RECORD_BYTES, 0)[: -_CRC.size]
    return bare + _CRC.pack(zlib.crc32(bare))


def index_of(block: FrameBlock, segment: int, offset: int, length: int | None = None) -> bytes:
    """The record, 64 bytes, of a block that begins at byte `offset` of `segment`.

    length: its bytes, where it was not written by `drivers.spb1.block_parts`.
    """
    header = block.header
    bare = _RECORD.pack(
        segment,
        int(header.flags),
        offset,
        length or BlockLayout(block.n_frames, header.width, header.height).block_bytes,
        header.run_id,
        header.block_seq & 0xFFFFFFFF,
        header.first_frame,
        block.n_frames,
        header.sweep,
        header.t0_ticks,
        0,
        0,
    )[: -_CRC.size]
    return bare + _CRC.pack(zlib.crc32(bare))


def decode_index(buffer: NDArray[np.uint8]) -> tuple[NDArray[np.void], NDArray[np.bool_]]:
    """Records (n,) of `INDEX_RECORD` over the memory of `buffer` (uint8 (bytes,)), and which of them are sound (n,).

    A torn record at the end is left out. Raises CorruptBlock where the header is no sound header of an index.
    """
    head = buffer[:HEADER_BYTES].tobytes()
    if len(head) < HEADER_BYTES or head[:4] != MAGIC or zlib.crc32(head[: -_CRC.size]) != _CRC.unpack(head[-4:])[0]:
        raise CorruptBlock(f"{INDEX_FILE} does not begin with the header of an index; 'rig repair' writes it anew")
    major, minor, record_bytes = struct.unpack_from("<HHI", head, 4)
    if major != MAJOR or record_bytes != RECORD_BYTES:
        raise CorruptBlock(
            f"{INDEX_FILE} is of version {major}.{minor} with records of {record_bytes} bytes; "
            f"this program reads {MAJOR}.x with {RECORD_BYTES}"
        )
    whole = (len(buffer) - HEADER_BYTES) // RECORD_BYTES * RECORD_BYTES
    raw = buffer[HEADER_BYTES : HEADER_BYTES + whole]
    records: NDArray[Any] = raw.view(INDEX_RECORD)
    crc = [zlib.crc32(raw.data[at : at + RECORD_BYTES - _CRC.size]) for at in range(0, whole, RECORD_BYTES)]
    return records, np.array(crc, np.uint32) == records["crc"]
