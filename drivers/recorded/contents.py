"""The contents of a recording: which blocks it holds, and where.

The index `frames.idx` has a header of 64 bytes, then a record of 64 bytes for each block, in the order of writing. Each
record has its own CRC, so a torn or damaged record is recognised and affects no other record. A record is used if its
CRC is right, its bytes exist, and no other record claims the same bytes. Stretches that no record covers are searched
for blocks. If the first or last block that the index has for a segment is not there, the index is ignored and all
segments are searched. `find_blocks` checks no payloads.

The index only tells where to look. The blocks themselves hold everything, so a lost index can be rebuilt from them
(`rig repair`).
"""

import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from drivers.errors import CorruptBlock, UnsupportedBlock
from drivers.frames import FrameBlock
from drivers.recorded.order import Entries, in_order
from drivers.recorded.segments import SegmentReader
from drivers.spb1 import ALIGN, TRAILER_BYTES, BlockLayout, Damage, Placed, parse_block
from drivers.spb1.layout import MAX_FRAMES, TRAILER
from drivers.spb1.reader import MAX_COUNT

INDEX_FILE: Final = "frames.idx"
HEADER_BYTES: Final = 64
RECORD_BYTES: Final = 64
MAGIC: Final = b"SPBI"
MAJOR: Final = 1
MINOR: Final = 0

INDEX_RECORD: Final = np.dtype(
    [
        *(("segment", "<u4"), ("flags", "<u4"), ("offset", "<u8"), ("length", "<u8")),
        *(("run_id", "<u4"), ("block_seq", "<u4"), ("first_frame", "<u8"), ("n_frames", "<u4")),
        *(("sweep", "<u4"), ("t0_ticks", "<u8"), ("reserved", "<u4"), ("crc", "<u4")),
    ]
)
"""The place of a block: number of its segment, offset and length in bytes (header to trailer, without the zeros behind
it); and its contents, as its header has them: flags, run_id, block_seq (low 32 bits), first_frame, n_frames (whole ones
only), sweep and t0_ticks of the first frame. reserved: 0. crc: CRC-32 (zlib) of the 60 bytes before it."""

_HEADER: Final = struct.Struct("<4sHHI48xI")
_RECORD: Final = struct.Struct("<IIQQIIQIIQII")
_CRC: Final = struct.Struct("<I")


def segment_name(number: int) -> str:
    """File name of a segment: frames-000000.spb, ..."""
    return f"frames-{number:06d}.spb"


def index_header() -> bytes:
    """The first 64 bytes of an index."""
    return _signed(_HEADER.pack(MAGIC, MAJOR, MINOR, RECORD_BYTES, 0))


def index_of(block: FrameBlock, segment: int, offset: int, length: int | None = None) -> bytes:
    """The 64-byte record of a block at byte `offset` of `segment`. length: bytes from header to trailer; None: those
    of the block as `drivers.spb1` writes it.
    """
    header = block.header
    length = length or BlockLayout(block.n_frames, header.width, header.height).block_bytes
    place = segment, int(header.flags), offset, length
    numbers = header.run_id, header.block_seq & 0xFFFFFFFF, header.first_frame, block.n_frames
    return _signed(_RECORD.pack(*place, *numbers, header.sweep, header.t0_ticks, 0, 0))


def _signed(record: bytes) -> bytes:
    """The record with its last field set to the CRC of all bytes before it."""
    bare = record[: -_CRC.size]
    return bare + _CRC.pack(zlib.crc32(bare))


def decode_index(buffer: NDArray[np.uint8]) -> tuple[NDArray[np.void], NDArray[np.bool_]]:
    """Records (n,) of `INDEX_RECORD`, as a view of `buffer` (uint8 (bytes,)), and which of them are sound, bool (n,).

    A torn record at the end is left out. Raises CorruptBlock if `buffer` does not start with a sound index
    header of this version.
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


PAGE_BYTES: Final = 4096
"""Blocks of a run's folder begin on multiples of this."""


@dataclass(slots=True)
class Contents:
    """The blocks of a recording and what is wrong with it.

    entries: the blocks in the order of their frames, run after run. problems: one line for each thing that is wrong.
    told: the sound records of the index, ordered by place, whether or not the blocks they describe are there.
    """

    entries: Entries
    problems: list[str] = field(default_factory=list)
    told: Entries = field(default_factory=lambda: np.empty(0, INDEX_RECORD))


def find_blocks(segments: Sequence[SegmentReader], folder: Path) -> Contents:
    """The blocks of a recording, without those that are damaged or of an unsupported kind or that contradict others
    (`in_order`). Damage raises nothing: it is listed in `problems`.
    """
    by_number = {segment.number: segment for segment in segments}
    problems: list[str] = []
    told = _told(folder, problems)
    records = None if told is None else _inside(told, by_number, problems)
    indexed = records is not None and all(_fits(records[records["segment"] == s.number], s) for s in segments)
    if not indexed:
        if records is not None:
            problems.append(f"{INDEX_FILE} does not fit the blocks; they are found without it")
        records = np.empty(0, INDEX_RECORD)
    assert records is not None
    parts = [records]
    for segment in segments:
        mine = records[records["segment"] == segment.number]
        found = list(_search(segment, mine, problems))
        if found and indexed:
            problems.append(f"{segment.path.name}: {len(found)} blocks are not in {INDEX_FILE}")
        parts.append(np.frombuffer(b"".join(found), INDEX_RECORD))
    told = np.empty(0, INDEX_RECORD) if told is None else told
    entries, in_place = in_order(np.concatenate(parts), told, problems, folder=folder.is_dir())
    if not (indexed or in_place):
        problems.append("the blocks do not lie in the order of their frames")
    return Contents(entries, problems, told)


def read_entry(segment: SegmentReader, entry: Any) -> FrameBlock:
    """The block that an entry describes, payload checked. Raises a ProtocolError if no such sound block is there."""
    block = _block_at(segment, entry, check_payload=True)
    if block is None:
        raise CorruptBlock(f"not block {entry['block_seq']} of run {entry['run_id']}, of which {INDEX_FILE} tells")
    return block


def payload_crc(segment: SegmentReader, offset: int, length: int) -> int:
    """CRC of a block's payload, as the trailer states it at the end of its `length` bytes. offset: place of the block
    in its segment. Raises CorruptBlock if the segment ends before the block does, or cannot be unpacked."""
    raw = segment.at(offset + length - TRAILER_BYTES, TRAILER_BYTES)
    if len(raw) < TRAILER_BYTES:
        raise CorruptBlock(f"{segment.path.name} ends within the block at byte {offset}")
    return int(TRAILER.unpack(raw.tobytes())[4])


def _told(folder: Path, problems: list[str]) -> Entries | None:
    """Sound index records, sorted by place; None if there is no index that can be read."""
    if not folder.is_dir():  # a single file has none
        return None
    try:
        data = np.fromfile(folder / INDEX_FILE, np.uint8)
        records, sound = decode_index(data)
    except FileNotFoundError:
        problems.append(f"{INDEX_FILE} is missing")
        return None
    except OSError as error:
        problems.append(f"{INDEX_FILE} cannot be read: {error.strerror or error}")
        return None
    except CorruptBlock as error:
        problems.append(str(error))
        return None
    if len(data) % INDEX_RECORD.itemsize:
        problems.append(f"{INDEX_FILE} ends in the middle of a record")
    if not sound.all():
        problems.append(f"{INDEX_FILE}: {int((~sound).sum())} of {len(sound)} records are damaged")
    records = records[sound]
    by_place = np.lexsort((records["offset"], records["segment"]))
    if (np.diff(by_place) < 0).any():
        problems.append(f"{INDEX_FILE}: its records are not in the order in which they were written")
    return records[by_place]


def _inside(records: Entries, segments: dict[int, SegmentReader], problems: list[str]) -> Entries:
    """The records whose place and numbers are possible. If two records claim the same bytes, both are left out."""
    sizes = np.zeros(max(segments) + 2)
    sizes[list(segments)] = [segment.size for segment in segments.values()]
    room = sizes[np.minimum(records["segment"], len(sizes) - 1)]
    inside = records["offset"].astype(np.float64) + records["length"] <= room
    inside &= (records["offset"] % ALIGN == 0) & (records["length"] > 0) & (records["n_frames"] <= MAX_FRAMES)
    inside &= (records["first_frame"] <= MAX_COUNT) & (records["t0_ticks"] <= MAX_COUNT)
    if not inside.all():
        problems.append(f"{INDEX_FILE}: {int((~inside).sum())} blocks lie beyond the end of their segments")
    records = records[inside]
    end = records["offset"] + records["length"]
    close = (records["segment"][1:] == records["segment"][:-1]) & (records["offset"][1:] < end[:-1])
    apart = np.ones(len(records), bool)
    apart[1:] &= ~close
    apart[:-1] &= ~close
    if not apart.all():
        problems.append(f"{INDEX_FILE}: {int((~apart).sum())} records tell of the same bytes as others")
    return records[apart]


def _fits(records: Entries, segment: SegmentReader) -> bool:
    """Whether the first and the last block that the index has for a segment are there."""
    ends = (records[0], records[-1]) if len(records) else ()
    try:
        return all(_block_at(segment, entry, check_payload=False) is not None for entry in ends)
    except (CorruptBlock, UnsupportedBlock):
        return False


def _block_at(segment: SegmentReader, entry: Any, *, check_payload: bool) -> FrameBlock | None:
    """The block at an entry's place; None if its header is not what the entry says."""
    offset, length = int(entry["offset"]), int(entry["length"])
    block = parse_block(segment.at(offset, length), check_payload=check_payload)
    return block if index_of(block, segment.number, offset, length) == entry.tobytes() else None


def _search(segment: SegmentReader, known: Entries, problems: list[str]) -> Iterator[bytes]:
    """Index records of the blocks in those parts of a segment that no record of `known` (sorted by offset) covers."""
    ends = round_up_to_page(known["offset"] + known["length"])
    starts = np.concatenate([np.zeros(1, np.int64), ends.astype(np.int64)])
    stops = np.concatenate([known["offset"].astype(np.int64), np.array([segment.size], np.int64)])
    for i in np.flatnonzero(stops > starts):
        for item in segment.walk(int(starts[i]), int(stops[i]), check_payload=False):
            if isinstance(item, Placed):
                yield index_of(item.block, segment.number, item.offset, item.length)
            else:
                problems.append(damage_line(segment, item))


def round_up_to_page(size: Any) -> Any:
    """The smallest multiple of `PAGE_BYTES` that is at least `size`, a number or an array."""
    return -(-size // PAGE_BYTES) * PAGE_BYTES


def damage_line(segment: SegmentReader, damage: Damage) -> str:
    """The line of text that tells the user of a piece of damage."""
    return f"{segment.path.name}, bytes {damage.offset} to {damage.offset + damage.length}: {damage.reason}"
