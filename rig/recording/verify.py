"""Verifies a recording: every byte of it, its index, its manifest and the device's own counts."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from drivers.errors import DeviceNotFound
from drivers.frames import BlockHeader
from drivers.recorded.contents import INDEX_FILE, INDEX_RECORD, Contents, find_blocks, round_up_to_page
from drivers.recorded.order import in_order
from drivers.recorded.reader import is_of_run, usual_header
from drivers.recorded.segments import PACKED_SUFFIX, SegmentReader, open_segments
from rig.config.overrides import PathLike
from rig.errors import DamagedRecordingError, UsageError
from rig.progress import tell_stage
from rig.recording.check import (
    CHECKING,
    Continuity,
    Run,
    SoundBlock,
    check_segments,
    lost_ends,
    out_of_step,
    seal_problem,
)
from rig.recording.open import require_recording
from rig.run_folder.manifest import (
    MANIFEST,
    UNFINISHED,
    RunGap,
    device_counters,
    ended_early,
    inputs_problems,
    known_missing,
    read_manifest,
)


class Integrity(StrEnum):
    """Verdict on a recording."""

    INTACT = "intact"
    GAPS = "gaps"
    """Undamaged, but the device lost frames, or a repair noted frames as missing."""
    UNFINISHED = "unfinished"
    """Undamaged, but the run is not over, was killed, or went on after the recording had ended. Gaps are possible."""
    DAMAGED = "damaged"


@dataclass(frozen=True, slots=True)
class Verification:
    """Verdict on a recording, with its evidence.

    runs: number of starts of the SPAD. blocks, frames, bytes: number of sound blocks, of frames and bytes in them (with
    padding). lost: number of frames that the device lost or a repair noted as missing. gaps: ranges of these frames,
    (number of the start, first, last). problems: one line each. run: verdict of the run that was recorded, None if
    unknown.
    ended: why the recording ended before the run; None if it did not.
    """

    verdict: Integrity
    segments: int
    runs: int
    blocks: int
    frames: int
    bytes: int
    lost: int
    gaps: list[RunGap]
    problems: list[str]
    run: str | None
    ended: str | None

    @property
    def exit_code(self) -> int:
        """Exit code of the command line: 0 only for an intact recording."""
        return 0 if self.verdict is Integrity.INTACT else 1


@dataclass(frozen=True, slots=True)
class Examination:
    """Everything found out about a recording.

    runs: the sound blocks of each start of the SPAD, in order. joined: the gaps. manifest: None if missing or damaged.
    """

    segments: list[SegmentReader]
    runs: list[list[SoundBlock]]
    joined: Continuity
    manifest: dict[str, Any] | None
    problems: list[str]

    @property
    def bytes(self) -> int:
        """Bytes that the sound blocks take in their segments, with padding."""
        return int(round_up_to_page(self.entries["length"]).sum())

    @property
    def entries(self) -> np.ndarray[Any, Any]:
        """Index records of the sound blocks, (n,) of INDEX_RECORD."""
        return np.frombuffer(b"".join(block.entry for run in self.runs for block in run), INDEX_RECORD)


def verify(run: PathLike) -> Verification:
    """Read every byte of a recording and report whether it is what was recorded (`rig verify`).

    Raises UsageError if there is no recording.
    """
    found = examine(Path(run))
    blocks = [block for run in found.runs for block in run]
    manifest = found.manifest or {}
    ended = ended_early(manifest)
    verdict = Integrity.GAPS if found.joined.gaps else Integrity.INTACT
    if found.problems or not found.runs:
        verdict = Integrity.DAMAGED
    elif manifest.get("verdict") == UNFINISHED or ended is not None:
        verdict = Integrity.UNFINISHED
    return Verification(
        verdict=verdict,
        segments=len(found.segments),
        runs=len(found.runs),
        blocks=len(blocks),
        frames=sum(block.n_frames for block in blocks),
        bytes=found.bytes,
        lost=found.joined.lost,
        gaps=found.joined.gaps,
        problems=found.problems,
        run=manifest.get("verdict"),
        ended=ended,
    )


def examine(folder: Path) -> Examination:
    """Find out everything that `verify` and `repair` need to know. Raises UsageError if there is no recording."""
    require_recording(folder)
    try:
        segments = open_segments(folder)
    except DeviceNotFound as error:
        raise UsageError(str(error)) from None
    tell_stage(CHECKING)
    contents = find_blocks(segments, folder)
    sound, damage = check_segments(segments)
    problems = list(dict.fromkeys([*contents.problems, *damage]))
    manifest = None
    try:
        manifest = read_manifest(folder)
        if manifest is None:
            problems.append(f"{MANIFEST} is missing")
    except DamagedRecordingError as error:
        problems.append(str(error))
    runs = _runs(contents, sound, problems)
    joined = Continuity(known_missing(manifest))
    for number, run in enumerate(runs):
        joined.follow(number, run, is_part="cut" in (manifest or {}))
    problems += joined.problems
    if problems:  # without any, no frame is missing at the ends
        joined.missing += lost_ends(contents, runs, joined, manifest)
    if manifest is not None:
        if manifest.get("verdict") != UNFINISHED:
            problems += _against_manifest(manifest, segments, runs, joined)
        problems += inputs_problems(folder, manifest)
    return Examination(segments, runs, joined, manifest, problems)


def _runs(contents: Contents, sound: Sequence[SoundBlock], problems: list[str]) -> list[list[SoundBlock]]:
    """The sound blocks of each start, in order. Adds lines on the blocks that are left out or gone to `problems`."""
    headers: dict[int, list[BlockHeader]] = {}
    for block in sound:
        headers.setdefault(block.header.run_id, []).append(block.header)
    usual = {run_id: usual_header(of_run) for run_id, of_run in headers.items()}
    by_entry = {}
    for block in sound:
        why = block.objection
        if why is None and not is_of_run(block.header, usual[block.header.run_id]):
            why = "is of another size or clock than its run"
        if why is None:
            by_entry[block.entry] = block
        else:
            problems.append(_left_out(block, why))
    told = {entry.tobytes(): entry for entry in contents.entries}
    for raw, entry in told.items():
        if raw not in by_entry:
            last = int(entry["first_frame"]) + int(entry["n_frames"]) - 1
            problems.append(
                f"block {entry['block_seq']} of run {entry['run_id']} (frames {entry['first_frame']} to {last}) is "
                f"damaged or gone: segment {entry['segment']}, byte {entry['offset']}"
            )
    if others := sum(raw not in told for raw in by_entry):
        problems.append(
            f"{others} blocks are not where {INDEX_FILE} tells of them, come twice or do not fit the others"
        )
    entries = np.frombuffer(b"".join(by_entry), INDEX_RECORD)
    runs: dict[int, list[SoundBlock]] = {}
    for entry in in_order(entries, contents.told, [], folder=True)[0]:
        block = by_entry[entry.tobytes()]
        runs.setdefault(block.header.run_id, []).append(block)
    for run in runs.values():
        for block in out_of_step(run):
            problems.append(_left_out(block, "is not in step with those around it"))
            run.remove(block)
    return list(runs.values())


def _left_out(block: SoundBlock, why: str) -> str:
    frames = f"frames {block.first_frame} to {block.end_frame - 1}"
    return f"block {block.block_seq} of run {block.header.run_id} ({frames}) {why}"


def _against_manifest(
    manifest: dict[str, Any], segments: Sequence[SegmentReader], runs: Sequence[Run], joined: Continuity
) -> list[str]:
    """Lines on blocks, segments and frames that are not as many as a finished run's manifest or the device says."""
    recording = manifest.get("recording") or {}
    frames = sum(block.n_frames for run in runs for block in run)
    there = {
        "blocks": sum(len(run) for run in runs),
        "files": [segment.path.name.removesuffix(PACKED_SUFFIX) for segment in segments],
    }
    problems = [
        f"{MANIFEST} tells of {stated} {'segments' if key == 'files' else key}, there are {found}"
        for key, found in there.items()
        if (stated := recording.get(key)) is not None and stated != found
    ]
    if (problem := seal_problem((block.payload_crc for run in runs for block in run), manifest)) is not None:
        problems.append(problem)
    counters, absurd = device_counters(manifest)
    delivered, lost = counters.get("delivered"), counters.get("lost")
    if delivered is not None and delivered != frames and (delivered < frames or ended_early(manifest) is None):
        problems.append(f"the device delivered {delivered} frames, {frames} are recorded")
    if lost is not None and lost < joined.lost:
        problems.append(f"the device says that it lost {lost} frames, its blocks say {joined.lost}")
    return problems + absurd
