"""Reading a recording: its runs, and their blocks by frame number. Each block is checked before it is handed out.

Threads read blocks ahead and check the CRC of their payloads without the interpreter's lock, so reading keeps up with
the disk. Damaged blocks are left out, like lost frames, and listed in `problems`.
"""

import logging
import math
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from operator import attrgetter
from pathlib import Path
from typing import Any, Final

import numpy as np

from drivers.errors import ProtocolError
from drivers.frames import BlockFlag, BlockHeader, FrameBlock
from drivers.recorded.contents import find_blocks, payload_crc, read_entry
from drivers.recorded.order import Entries
from drivers.recorded.segments import PlainSegment, open_segments

READERS: Final = 2
"""Threads that read ahead."""
BLOCKS_AHEAD: Final = 6
READ_AHEAD_BYTES: Final = 32 * 2**20
_ROUNDING_TICKS: Final = 1e-6
"""Tolerance in ticks: a time in seconds that means a whole number of ticks misses it by a rounding error."""
_MOST_TICKS: Final = 2.0**62
_WITNESSES: Final = 3
"""Blocks of a run that are read to learn its frame size and clock."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class RecordedRun:
    """The blocks of one start of the SPAD. Frame numbers count from that start, so the first one need not be 0.

    number: which run of the recording, from 0. entries: (n,) of `INDEX_RECORD`. header: the header of a sound block. Up
    to three sound blocks are read; it is that of one with the frame size and clock that most of these have.
    """

    number: int
    header: BlockHeader
    entries: Entries

    @property
    def first_frame(self) -> int:
        """Number of the first recorded frame."""
        return int(self.entries["first_frame"][0])

    @property
    def end_frame(self) -> int:
        """Number of the last recorded frame plus one."""
        return int(self.entries["first_frame"][-1]) + int(self.entries["n_frames"][-1])

    @property
    def frames(self) -> int:
        """Number of frames recorded, lost ones not included."""
        return int(self.entries["n_frames"].sum())

    def frame_at(self, seconds: float) -> int:
        """Number of the first frame, lost ones included, that begins `seconds` or more after the first recorded frame;
        `end_frame` if none does. If frames are triggered from outside: the first frame of the last block that has begun
        by then.
        """
        since = self.entries["t0_ticks"].astype(np.int64)
        since -= since[0]
        tick = max(0, math.ceil(min(seconds * float(self.header.tick_hz) - _ROUNDING_TICKS, _MOST_TICKS)))
        at = max(0, int(np.searchsorted(since, tick, "right")) - 1)
        period = self.header.frame_period_ticks
        behind = -(-(tick - int(since[at])) // period) if period else 0
        next_block = int(self.entries["first_frame"][at + 1]) if at + 1 < len(since) else self.end_frame
        return min(int(self.entries["first_frame"][at]) + behind, next_block)

    def gaps(self) -> list[tuple[int, int]]:
        """Numbers of the first and the last lost frame of each gap between two blocks of the run."""
        begins = self.entries["first_frame"].astype(np.int64)
        ends = begins + self.entries["n_frames"]
        where = np.flatnonzero(begins[1:] > ends[:-1])
        return [(int(ends[i]), int(begins[i + 1]) - 1) for i in where]


class RunRecording:
    """A recording opened for reading: a run's folder or one `.spb` file. Any number of threads may read it.

    runs: in the order in which they were taken. problems: one line for each thing that is wrong; reading may add some.
    Raises `DeviceNotFound` if there is no recording or it cannot be read, and `ProtocolError` if no frame of it is
    left, or if it is compressed and zstandard is not installed.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._segments = {segment.number: segment for segment in open_segments(path)}
        found = find_blocks(list(self._segments.values()), path)
        self.problems = found.problems
        self.runs = self._runs_of(found.entries)
        for problem in self.problems:
            _log.warning("%s: %s", path, problem)
        if not self.runs:
            raise ProtocolError(f"{path} holds no whole block of frames; 'rig verify' says what is left of it")

    @property
    def frames(self) -> int:
        """Number of frames of all runs."""
        return sum(run.frames for run in self.runs)

    def blocks(
        self, run: RecordedRun, first_frame: int | None = None, end_frame: int | None = None
    ) -> Iterator[FrameBlock]:
        """The frames of a run from `first_frame` to before `end_frame` (None: all), in the blocks in which they were
        recorded. Damaged blocks are left out and listed in `problems`.

        The first and the last block are cut to size. Blocks stay valid as long as something refers to them.
        """
        first = run.first_frame if first_frame is None else first_frame
        end = run.end_frame if end_frame is None else end_frame
        begins = run.entries["first_frame"].astype(np.int64)
        wanted = run.entries[(begins < end) & (begins + run.entries["n_frames"] > first)]
        for block in self._read(run, wanted):
            yield block_part(block, first, end)

    def payload_crcs(self) -> list[int] | None:
        """CRC of the payload of every block, as its trailer states it, in the order of `runs`; None if any segment is
        compressed. Raises CorruptBlock if a segment ends within a block."""
        if not all(isinstance(segment, PlainSegment) for segment in self._segments.values()):
            return None
        return [
            payload_crc(self._segments[int(entry["segment"])], int(entry["offset"]), int(entry["length"]))
            for run in self.runs
            for entry in run.entries
        ]

    def read(self, run: RecordedRun, entry: Any) -> FrameBlock | None:
        """The block of one entry of a run. If it is damaged, returns None and adds a line to `problems`."""
        segment = self._segments[int(entry["segment"])]
        try:
            block = read_entry(segment, entry)
            if not is_of_run(block.header, run.header):
                raise ProtocolError(f"block {block.header.block_seq} is of another size or clock than its run")
        except ProtocolError as error:
            line = f"{segment.path.name}, byte {entry['offset']}: {error}"
            if line not in self.problems:
                self.problems.append(line)
                _log.warning("%s: %s", self.path, line)
            return None
        return block

    def _read(self, run: RecordedRun, entries: Entries) -> Iterator[FrameBlock]:
        if int(entries["length"].sum()) < READ_AHEAD_BYTES:  # threads would take longer to start
            yield from (block for entry in entries if (block := self.read(run, entry)) is not None)
            return
        ahead: deque[Future[FrameBlock | None]] = deque()
        with ThreadPoolExecutor(READERS, "recording reader") as pool:
            told = 0
            for i, entry in enumerate(entries):
                told = self._expect(entries, i, told)
                ahead.append(pool.submit(self.read, run, entry))
                if len(ahead) > BLOCKS_AHEAD and (block := ahead.popleft().result()) is not None:
                    yield block
            while ahead:
                if (block := ahead.popleft().result()) is not None:
                    yield block

    def _expect(self, entries: Entries, i: int, told: int) -> int:
        """Announce the entries from `i` on to the system, `READ_AHEAD_BYTES` at a time. told: index of the first entry
        not announced yet; returns its new value.
        """
        if told > i:
            return told
        size, told = 0, i
        while told < len(entries) and size < READ_AHEAD_BYTES:
            size += int(entries["length"][told])
            told += 1
        for number in set(entries["segment"][i:told].tolist()):
            mine = entries[i:told][entries["segment"][i:told] == number]
            begin = int(mine["offset"].min())
            self._segments[number].expect(begin, int((mine["offset"] + mine["length"]).max()) - begin)
        return told

    def _runs_of(self, entries: Entries) -> list[RecordedRun]:
        begins = np.flatnonzero(np.diff(entries["run_id"].astype(np.int64), prepend=-1))
        runs: list[RecordedRun] = []
        for begin, stop in pairwise([*begins.tolist(), len(entries)]):
            mine = entries[begin:stop]
            header = self._header(mine)
            if header is None:
                self.problems.append(f"run {mine['run_id'][0]}: none of its {len(mine)} blocks is sound")
            elif mine["n_frames"].any():
                runs.append(RecordedRun(len(runs), header, mine))
        return runs

    def _header(self, entries: Entries) -> BlockHeader | None:
        """A header with the size and clock that most of several sound blocks have; None if no block is sound."""
        headers: list[BlockHeader] = []
        for at in _spread(len(entries)):
            with suppress(ProtocolError):
                headers.append(read_entry(self._segments[int(entries[at]["segment"])], entries[at]).header)
            if len(headers) == _WITNESSES:
                break
        return usual_header(headers) if headers else None


def block_part(block: FrameBlock, first_frame: int, end_frame: int) -> FrameBlock:
    """The frames of a block from `first_frame` to before `end_frame`, as a block; the block itself if that is all of
    it. At least one of these frames must be in the block."""
    header = block.header
    begin = max(0, first_frame - header.first_frame)
    end = min(block.n_frames, end_frame - header.first_frame)
    if (begin, end) == (0, block.n_frames):
        return block
    records = block.records[begin:end].copy()
    flags = header.flags
    if begin:
        flags &= ~(BlockFlag.FIRST | BlockFlag.LOST_BEFORE)
    if end < block.n_frames:
        flags &= ~BlockFlag.LAST
    skipped = int(records["ticks"][0])
    records["ticks"] -= np.uint32(skipped)
    header = replace(
        header,
        flags=flags,
        first_frame=header.first_frame + begin,
        t0_ticks=header.t0_ticks + skipped,
        sweep=(header.sweep + ((int(records["sweep"][0]) - header.sweep) & 0xFFFF)) & 0xFFFFFFFF,
    )
    return FrameBlock(header, records, block.bits[begin:end], block.status)


def is_of_run(header: BlockHeader, other: BlockHeader) -> bool:
    """Whether a block with this header can belong to the same run as a block with the other header."""
    return _run_kind(header) == _run_kind(other)


def usual_header(headers: Sequence[BlockHeader]) -> BlockHeader:
    """The first header among those with the most frequent combination of run id, sizes and clock. Raises ValueError if
    there are no headers."""
    kinds = Counter(map(_run_kind, headers))
    return max(headers, key=lambda header: kinds[_run_kind(header)])


def _spread(n: int) -> Iterator[int]:
    """The numbers 0 to n - 1, beginning with the first, the middle and the last one."""
    asked = np.unique(np.linspace(0, n - 1, _WITNESSES).astype(int)).tolist()
    yield from asked
    yield from (at for at in range(n) if at not in asked)


_run_kind: Final = attrgetter(
    *("run_id", "width", "height", "sensor_width", "sensor_height", "tick_hz", "frame_period_ticks", "exposure_ticks")
)
"""The values that all blocks of a run share: its id, frame size and clock."""
