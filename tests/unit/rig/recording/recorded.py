"""Small recordings, as the application writes them, of streams that tell where their frames are from."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from drivers.frames import FrameBlock
from drivers.recorded import RunRecording
from rig.recording.writer import Recording
from rig.run_folder.manifest import MANIFEST, sealed_text
from rig.run_folder.plain_json import json_text
from tests.unit.rig.count.streams import plan_of, scan, stream_of

MAPS = 3
BLOCK_FRAMES = 16
SEGMENT_BYTES = 40_000
"""A handful of blocks to a segment."""


Runs = list[list[FrameBlock]]
"""The blocks of each start of a SPAD."""


def run_blocks(lost: Sequence[int] = (), run_id: int = 1, seed: int = 0, maps: int = MAPS) -> list[FrameBlock]:
    """The blocks of one start of a SPAD, `maps` maps long."""
    blocks = stream_of(plan_of(scan()), maps).blocks(iter([BLOCK_FRAMES] * 1000), lost, seed)
    return [replace(block, header=replace(block.header, run_id=run_id)) for block in blocks]


def record(folder: Path, runs: Sequence[Sequence[FrameBlock]], **manifest: Any) -> Path:
    """Record the blocks of some starts, with a manifest as of a run that is over; the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    recording = Recording(folder, expected_bytes=0, segment_bytes=SEGMENT_BYTES)
    frames = 0
    for blocks in runs:
        recording.begin(MAPS)
        for block in blocks:
            recording.append(block)
            frames += block.n_frames
    recording.close()
    content = {
        "verdict": "complete",
        "counters": {"delivered": frames, "lost": sum(blocks[-1].header.lost_before for blocks in runs)},
        "recording": recording.content(),
        **manifest,
    }
    (folder / MANIFEST).write_text(sealed_text(json_text(content)))
    return folder


def flip(file: Path, at: int) -> None:
    """Change a bit of a file."""
    data = bytearray(file.read_bytes())
    data[at] ^= 1
    file.write_bytes(data)


def read(recording: RunRecording) -> Runs:
    """All blocks of each run."""
    return [list(recording.blocks(run)) for run in recording.runs]


def assert_same(found: Sequence[FrameBlock], others: Sequence[FrameBlock]) -> None:
    """Blocks are the same to the last bit."""
    for block, other in zip(found, others, strict=True):
        assert block.header == other.header
        assert (block.records.tobytes(), block.bits.tobytes()) == (other.records.tobytes(), other.bits.tobytes())


def assert_all_there(recording: RunRecording, runs: Runs) -> None:
    """A recording gives the very blocks of these starts."""
    for found, written in zip(read(recording), runs, strict=True):
        assert_same(found, written)
