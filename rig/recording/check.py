"""Reads every byte of a recording and finds which blocks are sound, what is damaged, and whether frames are missing.

`check_segments` finds the sound blocks. `Continuity` finds gaps before and between them by the numbers of blocks and
frames. A gap at the end of a start, or at the beginning of a cut part, does not show in these numbers: `lost_ends`
finds it in the index and the manifest. A `run` is here one start of the SPAD (frames without a pause). Its run id is in
every block.

The seal of a recording is one number in its manifest, of the frames of all its blocks in their order: the CRC-32 of the
payload CRCs (u32, little-endian) in the trailers. Blocks of two recordings made by the same plan fit each other in all
their numbers. If they are mixed, only the seal shows it (`seal_problem`).
"""

import struct
import zlib
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from drivers.errors import CorruptBlock
from drivers.frames import BlockHeader
from drivers.recorded import RunRecording
from drivers.recorded.contents import Contents, damage_line, index_of, payload_crc
from drivers.recorded.order import in_order
from drivers.recorded.segments import SegmentReader
from drivers.spb1 import HEADER_BYTES, TRAILER_BYTES, BlockLayout, Placed
from drivers.spb1.layout import MAX_FRAMES
from rig.errors import DamagedRecordingError
from rig.progress import tell_stage
from rig.run_folder.manifest import UNFINISHED, RunGap, device_counters, ended_early, read_manifest

CHECKING: Final = "checking every block"
CHECKERS: Final = 2
"""Number of segments checked at a time."""
_STEP_BYTES: Final = 64 * 2**20
_CLOCK_SHARE: Final = 0.01
"""Tolerance of ticks against frame numbers: this share of the frames, plus half a frame."""
_NEIGHBOURS: Final = 2
"""Number of blocks before a block, and after it, with which it is compared."""
_FEW: Final = 4
"""At most one in this many blocks of a start is left out because of its ticks or sweep (one if there are three)."""

FRAMES_SEAL: Final = "payloads_crc32"
"""Key of the manifest's section `recording`."""
_CRC: Final = struct.Struct("<I")
_NOT_ITS_OWN: Final = "bring its own segments back, or let 'rig repair' take it as it is"


@dataclass(frozen=True, slots=True)
class SoundBlock:
    """A block with correct checksums. Only the checksum of the pixels may be missing (see `objection`).

    entry: index record of the block. first_tick, last_tick: clock ticks of its first and last frame; 0 if it has no
    frame. last_sweep: number of scan markers up to its last frame. repeated: (first, last) of each stretch of frames
    whose ticks do not rise; they count as missing. payload_crc: as its trailer states it; 0 if it has none. objection:
    why the block cannot be what was recorded; None if it can.
    """

    entry: bytes
    header: BlockHeader
    n_frames: int
    last_sweep: int
    first_tick: int
    last_tick: int
    repeated: tuple[tuple[int, int], ...]
    payload_crc: int
    objection: str | None

    @property
    def block_seq(self) -> int:
        """Number of the block, low 32 bits, as in the index."""
        return self.header.block_seq & 0xFFFFFFFF

    @property
    def first_frame(self) -> int:
        """Number of its first frame."""
        return self.header.first_frame

    @property
    def end_frame(self) -> int:
        """Number of its last frame plus one."""
        return self.first_frame + self.n_frames


Run = Sequence[SoundBlock]


def check_segments(segments: Sequence[SegmentReader]) -> tuple[list[SoundBlock], list[str]]:
    """Find all sound blocks, in order of their places; returns also a line for each damaged piece of a segment."""
    if sum(segment.size for segment in segments) < _STEP_BYTES:  # threads would take longer to start
        found = list(map(_check, segments))
    else:
        with ThreadPoolExecutor(CHECKERS, "recording checker") as pool:
            found = []
            for done, each in enumerate(pool.map(_check, segments), 1):
                found.append(each)
                tell_stage(CHECKING, done, len(segments), "segments")
    return [block for blocks, _ in found for block in blocks], [line for _, lines in found for line in lines]


def merged_gaps(gaps: Iterable[RunGap]) -> list[RunGap]:
    """The gaps of each start in order. Gaps that overlap or touch are joined, and empty ones dropped."""
    merged: list[RunGap] = []
    for number, first, last in sorted(gap for gap in gaps if gap[1] <= gap[2]):
        if merged and merged[-1][0] == number and first <= merged[-1][2] + 1:
            merged[-1] = number, merged[-1][1], max(last, merged[-1][2])
        else:
            merged.append((number, first, last))
    return merged


@dataclass(slots=True)
class Continuity:
    """Gaps and problems between the blocks of a recording. A gap is (number of the start, first frame, last frame).

    known: gaps that a repair found and noted; None if there was no repair.
    gaps: those that the recording tells of, because the device lost the frames or a repair noted them as missing.
    missing: those that the recording does not tell of. problems: one line each.
    """

    known: Collection[RunGap] | None
    gaps: list[RunGap] = field(default_factory=list)
    missing: list[RunGap] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)

    @property
    def lost(self) -> int:
        """Number of frames in `gaps`, each counted once."""
        return sum(last + 1 - first for _, first, last in merged_gaps(self.gaps))

    def follow(self, number: int, run: Run, *, is_part: bool) -> None:
        """Note the gaps before and between the blocks of a start, and what is wrong with their numbers and ticks.

        number: number of the start. is_part: whether the recording was cut from another one, so that it may begin
        anywhere.
        """
        first = run[0]
        self.gaps += [
            gap
            for gap in dict.fromkeys(self.known or ())
            if gap[0] == number and (gap[2] < first.first_frame or gap[1] >= run[-1].end_frame)
        ]
        if not is_part and not any(gap[0] == number and gap[2] == first.first_frame - 1 for gap in self.gaps):
            self._join(number, (0, 0, -1), first)
        for before, block in pairwise(run):
            self._join(number, (before.end_frame, before.header.lost_before, before.block_seq), block)
            if before.n_frames and block.n_frames and block.first_tick <= before.last_tick:
                self._repeat(number, block.first_frame, block.first_frame, f"at frame {block.first_frame}")
        for block in run:
            for frames in block.repeated:
                self._repeat(number, *frames, f"within block {block.block_seq}")

    def _repeat(self, number: int, first: int, last: int, where: str) -> None:
        """Count frames whose ticks do not rise as a known gap or as missing, although they are there."""
        gap = number, first, last
        if gap in (self.known or ()):
            self.gaps.append(gap)
        else:
            self.missing.append(gap)
            self.problems.append(f"run {number}: the clock goes back {where}")

    def _join(self, number: int, before: tuple[int, int, int], block: SoundBlock) -> None:
        """Check whether `block` can follow a block. before: (end of its frames, frames lost before it, its number).

        After a repair, counts of the device that do not fit are no problem: they may be of blocks that are gone.
        """
        end_frame, lost_before, block_seq = before
        missing, lost = block.first_frame - end_frame, block.header.lost_before - lost_before
        gap = number, end_frame, block.first_frame - 1
        if gap in (self.known or ()) or missing == lost > 0:
            self.gaps.append(gap)
        elif missing > 0:
            self.missing.append(gap)
            self.problems.append(
                f"run {number}: frames {end_frame} to {block.first_frame - 1} are missing, of which the device lost "
                f"{min(max(0, lost), missing)}"
            )
        elif lost and self.known is None:
            self.problems.append(
                f"run {number}: block {block.block_seq} counts {block.header.lost_before} lost frames, the one before "
                f"{lost_before}, and none is missing between them"
            )
        gone = block.block_seq - block_seq - 1
        if gone and self.known is None and missing in (0, lost):
            self.problems.append(f"run {number}: {gone} blocks are missing before block {block.block_seq}")


def in_step(frames: int, ticks: int, header: BlockHeader) -> bool:
    """Whether frames whose numbers differ by `frames` can be `ticks` apart; True for frames triggered from outside."""
    period = header.frame_period_ticks
    return not period or abs(ticks - frames * period) <= period * (0.5 + _CLOCK_SHARE * abs(frames))


def out_of_step(run: Run) -> list[SoundBlock]:
    """Blocks of a start whose ticks or sweep disagree with their frame numbers, judged by their neighbours.

    Empty for one or two blocks, and if more than one in `_FEW` disagree, since the device then counts in another way.
    """
    votes = [0] * len(run)
    for i, block in enumerate(run):
        for j in range(max(0, i - _NEIGHBOURS), i):
            before = run[j].header
            frames, ticks = block.first_frame - before.first_frame, block.header.t0_ticks - before.t0_ticks
            agree = 0 <= block.header.sweep - before.sweep <= frames and in_step(frames, ticks, block.header)
            votes[i] += agree
            votes[j] += agree
    alone = [block for block, vote in zip(run, votes, strict=True) if not vote]
    return alone if len(run) > 2 and len(alone) * _FEW <= max(len(run), _FEW) else []


def _check(segment: SegmentReader) -> tuple[list[SoundBlock], list[str]]:
    blocks: list[SoundBlock] = []
    lines: list[str] = []
    told = 0
    for item in segment.walk(0, segment.size, check_payload=True):
        if item.offset + _STEP_BYTES > told:
            segment.expect(told, _STEP_BYTES)
            told += _STEP_BYTES
        if isinstance(item, Placed):
            blocks.append(_sound(segment, item))
        else:
            lines.append(damage_line(segment, item))
    return blocks, lines


def _sound(segment: SegmentReader, placed: Placed) -> SoundBlock:
    block, header = placed.block, placed.block.header
    ticks = block.start_ticks
    return SoundBlock(
        index_of(block, segment.number, placed.offset, placed.length),
        header,
        block.n_frames,
        header.sweep + ((int(block.records["sweep"][-1]) - header.sweep) & 0xFFFF if len(ticks) else 0),
        int(ticks[0]) if len(ticks) else 0,
        int(ticks[-1]) if len(ticks) else 0,
        tuple(_stretches(header.first_frame + 1 + np.flatnonzero(np.diff(ticks) <= 0))),
        payload_crc(segment, placed.offset, placed.length),
        _objection(segment, placed),
    )


def _stretches(numbers: NDArray[np.int64]) -> Iterator[tuple[int, int]]:
    """(first, last) of each stretch of consecutive numbers."""
    for piece in np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1):
        if len(piece):
            yield int(piece[0]), int(piece[-1])


def _objection(segment: SegmentReader, placed: Placed) -> str | None:
    """Reason why a block without a wrong checksum cannot be what was recorded; None if it can."""
    if not payload_crc(segment, placed.offset, placed.length):  # 0: no CRC, or a CRC of 0
        payload = segment.at(placed.offset + HEADER_BYTES, placed.length - HEADER_BYTES - TRAILER_BYTES)
        if zlib.crc32(payload.tobytes()) != 0:
            return "has no checksum of its pixels"
    block = placed.block
    markers = (block.records["sweep"].astype(np.int64) - block.header.sweep) & 0xFFFF
    if block.n_frames and int(np.sort(markers)[(block.n_frames - 1) // 2]) > block.n_frames:
        return f"says that it begins in sweep {block.header.sweep}, its frames do not"
    return None


def lost_ends(
    contents: Contents, runs: Sequence[Run], joined: Continuity, manifest: dict[str, Any] | None
) -> list[RunGap]:
    """Frames that are missing at the end of each start and, in a cut part, at its beginning.

    They show in index records of missing blocks, in the range of frames that the manifest of a part states, and in the
    number of frames that the device delivered. Starts of which nothing is left get the numbers after those of `runs`.
    """
    cut = (manifest or {}).get("cut")
    ranges = _told_ranges(contents, runs)
    blocks = ((manifest or {}).get("recording") or {}).get("blocks")
    if cut is not None and isinstance(blocks, int) and blocks > sum(map(len, runs)):
        for run_id, first, end in cut.get("frames") or ():
            _extend(ranges, run_id, first, end)
    gaps: list[RunGap] = []
    for number, run in enumerate(runs):
        first, end = ranges.pop(run[0].header.run_id, (run[0].first_frame, run[-1].end_frame))
        if cut is not None and first < run[0].first_frame:  # a whole start begins with frame 0
            gaps.append((number, first, run[0].first_frame - 1))
        if end > run[-1].end_frame:
            gaps.append((number, run[-1].end_frame, end - 1))
    for number, (first, end) in enumerate(ranges.values(), len(runs)):
        gaps.append((number, first if cut is not None else 0, end - 1))
    return gaps + _delivered_behind(runs, [*joined.missing, *gaps], manifest)


def _told_ranges(contents: Contents, runs: Sequence[Run]) -> dict[int, tuple[int, int]]:
    """(first frame, last + 1) by run id, of index records beyond the ends of a start, or of a start of which nothing
    is left. Empty if the index names fewer than half of the sound blocks."""
    sound = {block.entry for run in runs for block in run}
    if len(contents.told) == 0 or 2 * sum(entry.tobytes() in sound for entry in contents.told) < len(sound):
        return {}
    of_run = {run[0].header.run_id: run for run in runs}
    ranges: dict[int, tuple[int, int]] = {}
    told = contents.told
    believed = told[(told["first_frame"] < 1 << 62) & (told["t0_ticks"] < 1 << 62)]
    for entry in in_order(believed, told, [], folder=True)[0]:
        run_id, first = int(entry["run_id"]), int(entry["first_frame"])
        if run_id not in of_run or _reaches_beyond(entry, of_run[run_id]):
            _extend(ranges, run_id, first, first + int(entry["n_frames"]))
    return ranges


def _extend(ranges: dict[int, tuple[int, int]], run_id: int, first: int, end: int) -> None:
    """Extend the range of a start's frames so that it includes first to end - 1."""
    began, ended = ranges.get(run_id, (first, end))
    ranges[run_id] = min(began, first), max(ended, end)


def _reaches_beyond(entry: Any, run: Run) -> bool:
    """Whether an index record is of frames beyond the ends of a start, of the right size and at the right time."""
    n_frames, first = int(entry["n_frames"]), int(entry["first_frame"])
    near = run[-1] if first >= run[-1].end_frame else run[0]
    if near is run[0] and first + n_frames > near.first_frame:
        return False
    header = near.header
    return (
        n_frames <= MAX_FRAMES
        and int(entry["length"]) == BlockLayout(n_frames, header.width, header.height).block_bytes
        and in_step(first - near.first_frame, int(entry["t0_ticks"]) - header.t0_ticks, header)
    )


def _delivered_behind(runs: Sequence[Run], missing: Sequence[RunGap], manifest: dict[str, Any] | None) -> list[RunGap]:
    """The gap after the last start's end, if the device delivered more frames than are there or known as missing."""
    if manifest is None or not runs or ended_early(manifest) is not None:
        return []
    delivered = device_counters(manifest)[0].get("delivered", 0)
    there = sum(block.n_frames for run in runs for block in run)
    left = delivered - there - sum(last + 1 - first for _, first, last in missing)
    number = len(runs) - 1
    end = max([runs[-1][-1].end_frame, *(last + 1 for of, _, last in missing if of == number)])
    return [(number, end, end + left - 1)] if left > 0 else []


def sealed(payload_crcs: Iterable[int], before: int = 0) -> int:
    """The seal of blocks with these CRCs of their payloads. before: seal of the blocks before them."""
    for crc in payload_crcs:
        before = zlib.crc32(_CRC.pack(crc), before)
    return before


def seal_problem(payload_crcs: Iterable[int], manifest: Mapping[str, Any]) -> str | None:
    """A line if there are as many blocks as the manifest says, but not those of its seal. Otherwise None, as it is
    without a seal and before the run's end."""
    crcs, recording = list(payload_crcs), manifest.get("recording") or {}
    told = recording.get(FRAMES_SEAL)
    if told is None or manifest.get("verdict") == UNFINISHED or recording.get("blocks") != len(crcs):
        return None
    if told == sealed(crcs):
        return None
    return "the frames are not those that this run recorded: segments of another recording may lie among its own"


def require_own_frames(recording: RunRecording) -> None:
    """Raise DamagedRecordingError if a recording holds other frames than its run recorded: more blocks or frames, fewer
    blocks with as many frames, or a different seal. Without a manifest nothing is checked.

    Reads the trailers of its blocks, not their pixels. Compressed blocks would have to be unpacked for that, so only
    `rig verify` compares their seal.
    """
    manifest = read_manifest(recording.path) if recording.path.is_dir() else None
    if manifest is None:
        return
    if (problem := _other_blocks(recording, manifest)) is not None:
        raise DamagedRecordingError(f"{recording.path}: {problem}; {_NOT_ITS_OWN}")
    try:
        crcs = recording.payload_crcs()
    except CorruptBlock:
        return  # reading it says what is wrong
    if crcs is not None and (problem := seal_problem(crcs, manifest)) is not None:
        raise DamagedRecordingError(f"{recording.path}: {problem}; {_NOT_ITS_OWN}")


def _other_blocks(recording: RunRecording, manifest: Mapping[str, Any]) -> str | None:
    """A line if a recording of a finished run has more blocks or frames than that had, or fewer blocks of as many
    frames; None if not."""
    told, delivered = _told(manifest)
    if told is None:
        return None
    blocks, frames = sum(len(run.entries) for run in recording.runs), recording.frames
    if blocks > told or (delivered is not None and (frames > delivered or (frames == delivered and blocks < told))):
        of_frames = "" if delivered is None else f" with {delivered} frames"
        return f"there are {blocks} blocks with {frames} frames, the run recorded {told} blocks{of_frames}"
    return None


def frames_never_told(recording: RunRecording, manifest: Mapping[str, Any]) -> int:
    """Number of frames that a finished run recorded, in blocks of which neither index nor segments tell; 0 if that is
    unknown."""
    told, delivered = _told(manifest)
    if told is None or delivered is None or recording.problems or "cut" in manifest:
        return 0
    fewer = sum(len(run.entries) for run in recording.runs) < told
    return max(0, delivered - recording.frames) if fewer else 0


def _told(manifest: Mapping[str, Any]) -> tuple[int | None, int | None]:
    """Blocks that a finished run recorded and frames that its SPAD delivered, by its manifest; None if unknown."""
    blocks = (manifest.get("recording") or {}).get("blocks")
    if not isinstance(blocks, int) or manifest.get("verdict") == UNFINISHED or ended_early(manifest) is not None:
        return None, None
    return blocks, None if "cut" in manifest else device_counters(manifest)[0].get("delivered")
