"""Reading every byte of a recording: which blocks are sound, what is damaged, and whether frames follow on frames."""

import zlib
from collections.abc import Collection, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Final

import numpy as np

from drivers.errors import UnsupportedBlock
from drivers.recorded.contents import damage_line
from drivers.recorded.index import INDEX_RECORD, index_of
from drivers.recorded.segments import Segment
from drivers.spb1 import HEADER_BYTES, TRAILER_BYTES, Placed
from drivers.spb1.layout import TRAILER
from rig.progress import tell_stage

CHECKING: Final = "checking every block"
"""The stage's name."""
CHECKERS: Final = 2
"""Segments checked at a time."""
_STEP_BYTES: Final = 64 * 2**20


@dataclass(frozen=True, slots=True)
class SoundBlock:
    """A block whose every byte is right. entry: its index record. lost_before: as the device counted. sweep,
    last_sweep: scan markers up to its first and its last frame.

    first_tick, last_tick: of its frames, 0 where it has none. rises: whether their ticks rise. checked: whether the
    payload has a checksum at all.
    """

    entry: bytes
    run_id: int
    block_seq: int
    first_frame: int
    n_frames: int
    lost_before: int
    sweep: int
    last_sweep: int
    first_tick: int
    last_tick: int
    rises: bool
    checked: bool

    @property
    def end_frame(self) -> int:
        """One behind its last frame."""
        return self.first_frame + self.n_frames


def check_segments(segments: Sequence[Segment]) -> tuple[list[SoundBlock], list[str]]:
    """All sound blocks by place, and a line for each piece that is damaged."""
    if sum(segment.size for segment in segments) < _STEP_BYTES:  # threads would take longer to start
        found = list(map(_check, segments))
    else:
        with ThreadPoolExecutor(CHECKERS, "recording checker") as pool:
            found = []
            for done, each in enumerate(pool.map(_check, segments), 1):
                found.append(each)
                tell_stage(CHECKING, done, len(segments), "segments")
    return [block for blocks, _ in found for block in blocks], [line for _, lines in found for line in lines]


Gap = tuple[int, int, int]
"""Number of the run, first and last frame that is not there."""


@dataclass(slots=True)
class Continuity:
    """What joins the blocks of a recording. gaps: frames that the device lost; missing: others; lost: as it counted."""

    gaps: list[Gap] = field(default_factory=list)
    missing: list[Gap] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    lost: int = 0


def continuity(runs: Iterable[Sequence[SoundBlock]], *, is_part: bool, known: Collection[Gap] | None) -> Continuity:
    """Whether the blocks of each run follow on each other, but for what the device says that it lost.

    is_part: the recording was cut from another one, so that it need not begin with the first block. known: what a
    repair found missing, and said so; None where there was none.
    """
    found = Continuity()
    for number, run in enumerate(runs):
        _follow(number, run, is_part, known, found)
    return found


def _check(segment: Segment) -> tuple[list[SoundBlock], list[str]]:
    blocks: list[SoundBlock] = []
    lines: list[str] = []
    told = 0
    try:
        for item in segment.walk(0, segment.size, check_payload=True):
            if item.offset + _STEP_BYTES > told:
                segment.expect(told, _STEP_BYTES)
                told += _STEP_BYTES
            if isinstance(item, Placed):
                blocks.append(_sound(segment, item))
            else:
                lines.append(damage_line(segment, item))
    except UnsupportedBlock as error:
        lines.append(f"{segment.path.name}: {error}")
    return blocks, lines


def _sound(segment: Segment, placed: Placed) -> SoundBlock:
    block, header = placed.block, placed.block.header
    ticks = block.start_ticks
    entry = np.frombuffer(index_of(block, segment.number, placed.offset, placed.length), INDEX_RECORD)[0]
    return SoundBlock(
        entry.tobytes(),
        header.run_id,
        int(entry["block_seq"]),
        header.first_frame,
        block.n_frames,
        header.lost_before,
        header.sweep,
        header.sweep + ((int(block.records["sweep"][-1]) - header.sweep) & 0xFFFF if len(ticks) else 0),
        int(ticks[0]) if len(ticks) else 0,
        int(ticks[-1]) if len(ticks) else 0,
        bool((np.diff(ticks) > 0).all()),
        _has_checksum(segment, placed),
    )


def _has_checksum(segment: Segment, placed: Placed) -> bool:
    """Whether the trailer states a payload CRC: 0 says none, unless it is 0."""
    trailer = segment.at(placed.offset + placed.length - TRAILER_BYTES, TRAILER_BYTES)
    if TRAILER.unpack(trailer.tobytes())[4]:
        return True
    payload = segment.at(placed.offset + HEADER_BYTES, placed.length - HEADER_BYTES - TRAILER_BYTES)
    return zlib.crc32(payload.tobytes()) == 0


def _follow(
    number: int, run: Sequence[SoundBlock], is_part: bool, known: Collection[Gap] | None, found: Continuity
) -> None:
    first = run[0]
    if not is_part:
        _join(number, (0, 0, -1), first, known, found)
    for before, block in pairwise(run):
        _join(number, (before.end_frame, before.lost_before, before.block_seq), block, known, found)
        if before.n_frames and block.n_frames and block.first_tick <= before.last_tick:
            found.problems.append(f"run {number}: the clock goes back at frame {block.first_frame}")
    found.lost += run[-1].lost_before - (first.lost_before if is_part else 0)
    for block in run:
        if not block.rises:
            found.problems.append(f"run {number}: the clock goes back within block {block.block_seq}")
        if not block.checked:
            found.problems.append(
                f"run {number}: block {block.block_seq} (frames {block.first_frame} to {block.end_frame - 1}) has no "
                "checksum of its pixels"
            )


def _join(
    number: int, before: tuple[int, int, int], block: SoundBlock, known: Collection[Gap] | None, found: Continuity
) -> None:
    """Whether `block` can come behind what was before: its end, the frames lost by then, the number of its block."""
    end_frame, lost_before, block_seq = before
    missing, lost = block.first_frame - end_frame, block.lost_before - lost_before
    gap = number, end_frame, block.first_frame - 1
    if (known is not None and gap in known) or missing == lost > 0:
        found.gaps.append(gap)
    elif missing > 0:
        found.missing.append(gap)
        found.problems.append(
            f"run {number}: frames {end_frame} to {block.first_frame - 1} are missing, of which the device lost "
            f"{max(0, lost)}"
        )
    elif lost:
        found.problems.append(f"run {number}: the device says that it lost {lost} frames before {block.first_frame}")
    gone = block.block_seq - block_seq - 1
    if gone and known is None and missing in (0, lost):
        found.problems.append(f"run {number}: {gone} blocks are missing before block {block.block_seq}")
