"""Which blocks a recording holds, and where: from its index as far as that fits, else from the blocks themselves.

Index records count where their CRC is right, their place exists and the first and last block of their segment are what
they say. What they leave out is searched for blocks; where they do not fit, everything is. Payloads are not read here.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from drivers.errors import CorruptBlock, UnsupportedBlock
from drivers.frames import FrameBlock
from drivers.recorded.index import INDEX_FILE, INDEX_RECORD, decode_index, index_of
from drivers.recorded.segments import Segment
from drivers.spb1 import ALIGN, Damage, Placed, parse_block

PAGE_BYTES: Final = 4096
"""Blocks of a recording begin on multiples of this."""
MOST_FRAMES: Final = 0xFFFF
"""Of a block."""

Entries = NDArray[Any]
"""(n,) of INDEX_RECORD."""


@dataclass(slots=True)
class Contents:
    """entries: the blocks in the order of their frames, run after run. problems: a line for each thing that is wrong.

    indexed: whether the index told where they are. run_order: ids of the runs as far as the index tells of them.
    """

    entries: Entries
    problems: list[str] = field(default_factory=list)
    indexed: bool = True
    run_order: list[int] = field(default_factory=list)


def find_blocks(segments: Sequence[Segment], folder: Path) -> Contents:
    """The blocks of a recording. Nothing is raised for damage: it is in `problems`, and costs what it hit."""
    by_number = {segment.number: segment for segment in segments}
    problems: list[str] = []
    records, order = _index_records(folder, by_number, problems)
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
    entries, in_place = in_order(np.concatenate(parts), order, problems)
    if not (indexed or in_place):
        problems.append("the blocks do not lie in the order of their frames")
    return Contents(entries, problems, indexed, order)


def read_entry(segment: Segment, entry: Any) -> FrameBlock:
    """The block that an entry tells of, its payload checked. CorruptBlock where there is another one, or none."""
    block = _block_at(segment, entry, check_payload=True)
    if block is None:
        raise CorruptBlock(f"not block {entry['block_seq']} of run {entry['run_id']}, of which {INDEX_FILE} tells")
    return block


def _index_records(folder: Path, segments: dict[int, Segment], problems: list[str]) -> tuple[Entries | None, list[int]]:
    """Sound index records, sorted by place, and the runs in their order; None where there is no index."""
    try:
        data = np.fromfile(folder / INDEX_FILE, np.uint8) if folder.is_dir() else None
    except FileNotFoundError:
        problems.append(f"{INDEX_FILE} is missing")
        return None, []
    except OSError as error:
        problems.append(f"{INDEX_FILE} cannot be read: {error.strerror or error}")
        return None, []
    if data is None:  # a single file has none
        return None, []
    try:
        records, sound = decode_index(data)
    except CorruptBlock as error:
        problems.append(str(error))
        return None, []
    if len(data) % INDEX_RECORD.itemsize:
        problems.append(f"{INDEX_FILE} ends in the middle of a record")
    if not sound.all():
        problems.append(f"{INDEX_FILE}: {int((~sound).sum())} of {len(sound)} records are damaged")
    records = records[sound]
    by_place = np.lexsort((records["offset"], records["segment"]))
    if (np.diff(by_place) < 0).any():
        problems.append(f"{INDEX_FILE}: its records are not in the order in which they were written")
    records = records[by_place]
    order = list(dict.fromkeys(records["run_id"].tolist()))
    sizes = np.zeros(max(segments) + 2)
    sizes[list(segments)] = [segment.size for segment in segments.values()]
    room = sizes[np.minimum(records["segment"], len(sizes) - 1)]
    inside = records["offset"].astype(np.float64) + records["length"] <= room
    inside &= (records["offset"] % ALIGN == 0) & (records["length"] > 0) & (records["n_frames"] <= MOST_FRAMES)
    if not inside.all():
        problems.append(f"{INDEX_FILE}: {int((~inside).sum())} blocks lie beyond the end of their segments")
    records = records[inside]
    end = records["offset"] + records["length"]
    apart = np.ones(len(records), bool)
    apart[1:] = (records["segment"][1:] != records["segment"][:-1]) | (records["offset"][1:] >= end[:-1])
    if not apart.all():
        problems.append(f"{INDEX_FILE}: {int((~apart).sum())} records tell of the same bytes as others")
    return records[apart], order


def _fits(records: Entries, segment: Segment) -> bool:
    """Whether the first and the last block that the index tells of in a segment are there."""
    return len(records) == 0 or all(_is_there(segment, entry) for entry in (records[0], records[-1]))


def _is_there(segment: Segment, entry: Any) -> bool:
    try:
        return _block_at(segment, entry, check_payload=False) is not None
    except (CorruptBlock, UnsupportedBlock):
        return False


def _block_at(segment: Segment, entry: Any, *, check_payload: bool) -> FrameBlock | None:
    """The block at an entry's place; None where its header is not what the entry says."""
    offset, length = int(entry["offset"]), int(entry["length"])
    block = parse_block(segment.at(offset, length), check_payload=check_payload)
    return block if index_of(block, segment.number, offset, length) == entry.tobytes() else None


def _search(segment: Segment, known: Entries, problems: list[str]) -> Iterator[bytes]:
    """Index records of the blocks that lie where `known` (sorted by offset) has none."""
    ends = round_up_to_page(known["offset"] + known["length"])
    starts = np.concatenate([np.zeros(1, np.int64), ends.astype(np.int64)])
    stops = np.concatenate([known["offset"].astype(np.int64), np.array([segment.size], np.int64)])
    for i in np.flatnonzero(stops > starts):
        try:
            for item in segment.walk(int(starts[i]), int(stops[i]), check_payload=False):
                if isinstance(item, Placed):
                    yield index_of(item.block, segment.number, item.offset, item.length)
                else:
                    problems.append(damage_line(segment, item))
        except UnsupportedBlock as error:
            problems.append(f"{segment.path.name}: {error}")


def round_up_to_page(size: Any) -> Any:
    """The next multiple of `PAGE_BYTES`, of a number or of each of an array."""
    return -(-size // PAGE_BYTES) * PAGE_BYTES


def damage_line(segment: Segment, damage: Damage) -> str:
    """What people are told of a damage."""
    return f"{segment.path.name}, bytes {damage.offset} to {damage.offset + damage.length}: {damage.reason}"


def in_order(entries: Entries, runs: list[int], problems: list[str]) -> tuple[Entries, bool]:
    """The blocks run after run, with rising numbers, without what comes twice or goes back; whether they lie so too."""
    if len(entries) == 0:
        return entries, True
    by_place = np.sort(entries, order=["segment", "offset"], kind="stable")
    runs = list(dict.fromkeys([*runs, *by_place["run_id"].tolist()]))
    rank_of = {run: rank for rank, run in enumerate(runs)}
    rank = np.array([rank_of[run] for run in by_place["run_id"].tolist()])
    order = np.lexsort((by_place["block_seq"], rank))
    ordered = by_place[order]
    keep = np.ones(len(ordered), bool)
    begins = np.flatnonzero(np.diff(rank[order], prepend=-1))
    for begin, stop in pairwise([*begins.tolist(), len(ordered)]):
        run = ordered[begin:stop]
        end = np.maximum.accumulate(run["first_frame"] + run["n_frames"])
        keep[begin + 1 : stop] = (run["block_seq"][1:] > run["block_seq"][:-1]) & (run["first_frame"][1:] >= end[:-1])
    if not keep.all():
        problems.append(f"{int((~keep).sum())} blocks come twice or tell of frames of others")
    return ordered[keep], bool((np.diff(order) > 0).all())
