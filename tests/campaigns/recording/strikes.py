"""Recordings in processes of their own that are there to be killed, and what is left of them.

Such a process records from before the folder is made to behind the last file: a source fills a ring, the recorder
empties it, segments are small and the SPAD starts twice. It notes in shared memory how many blocks count, after each
one. Where it was killed at least so many are to be there after `repair`, each of them byte for byte what the source
made, in order, and `verify` is to find nothing wrong.
"""

import mmap
import multiprocessing
import time
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from drivers.frames import BlockFlag, BlockHeader, FrameBlock
from drivers.recorded import RunRecording
from drivers.ring import BlockRing
from drivers.spb1 import BlockLayout, block_views, seal_block
from rig.errors import RigError
from rig.recording.repair import repair
from rig.recording.writer import WRITERS, Recorder, Recording
from rig.run_folder.folder import RunFolder

WIDTH, HEIGHT = 256, 64
MOST_FRAMES = 120
"""Blocks of 2 to 250 KB."""
BLOCKS = 60
"""Blocks of each start."""
STARTS = 2
SEGMENT_BYTES = 2 << 20
STRIDE = 1 << 18
SLOTS = 16
AFTER = 1.1
"""Blows fall from before the beginning to this multiple of the time that a recording takes."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """Remains of a recording. counted: blocks that the process said were whole; found: those there after the repair."""

    folder: Path
    counted: int
    found: int
    wrong: str | None


def blocks_of(seed: int, run: int) -> list[FrameBlock]:
    """Blocks that the source makes in one start, known by its seed."""
    random = np.random.default_rng((seed, run))
    pool = random.integers(0, 256, STRIDE + BLOCKS, np.uint8)
    first, made = 0, []
    for seq in range(BLOCKS):
        n = int(random.integers(1, MOST_FRAMES + 1))
        layout = BlockLayout(n, WIDTH, HEIGHT)
        memory = np.zeros(layout.min_stride, np.uint8)
        records, bits = block_views(memory, layout)
        records["ticks"] = np.arange(n) * 1000
        bits[:] = pool[seq : seq + bits.size].reshape(bits.shape)
        flags = (BlockFlag.FIRST if seq == 0 else BlockFlag(0)) | (BlockFlag.LAST if seq == BLOCKS - 1 else 0)
        header = BlockHeader(
            flags=flags, run_id=run + 1, block_seq=seq, first_frame=first, t0_ticks=first * 1000, lost_before=0,
            tick_hz=Fraction(100_000_000), frame_period_ticks=1000, exposure_ticks=1000, sweep=0, frame_step=1,
            width=WIDTH, height=HEIGHT, sensor_width=WIDTH, sensor_height=HEIGHT,
        )  # fmt: skip
        made.append(seal_block(memory, header, layout, payload_crc=True))
        first += n
    return made


class Noted(Recording):
    """A recording that notes in shared memory how many blocks count."""

    note: mmap.mmap

    def _count(self, placed: Any) -> None:
        super()._count(placed)
        with self._lock:
            self.note[:8] = self.blocks.to_bytes(8, "little")


def record(folder: str, note_file: str, seed: int) -> None:
    """Record everything; in a process that is there to be killed."""
    runs = [blocks_of(seed, run) for run in range(STARTS)]
    with open(note_file, "rb+") as file:
        note = mmap.mmap(file.fileno(), 16)
    note[8:] = (1).to_bytes(8, "little")
    outputs = RunFolder(folder, in_place=True)
    recording = Noted(Path(folder), expected_bytes=BLOCKS * STRIDE, segment_bytes=SEGMENT_BYTES)
    recording.note = note
    outputs.write_json("manifest.json", {"verdict": "recording", "recording": recording.content()})
    for blocks in runs:
        recording.begin(1)
        _stream(blocks, recording)
    recording.close()
    outputs.write_json("manifest.json", {"verdict": "complete", "recording": recording.content()})
    outputs.publish()
    note[8:] = (2).to_bytes(8, "little")


def _stream(blocks: list[FrameBlock], recording: Recording) -> None:
    ring = BlockRing(SLOTS, STRIDE)
    recorder = Recorder(ring.reader("recorder", holds=WRITERS), recording, lambda: None)
    recorder.thread.start()
    for block in blocks:
        layout = BlockLayout(block.n_frames, WIDTH, HEIGHT)
        memory = ring.claim(10.0)
        assert memory is not None, "the recorder is at work"
        records, bits = block_views(memory, layout)
        records[:], bits[:] = block.records, block.bits
        ring.publish(seal_block(memory, block.header, layout, payload_crc=False))
    ring.finish()
    recorder.thread.join(60)
    if recorder.error is not None:
        raise recorder.error


class Striker:
    """Starts recordings and strikes them."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._context = multiprocessing.get_context("forkserver")
        self._context.set_forkserver_preload([__name__])
        self._n = 0
        self.takes_s = self._whole_s()

    def strike(self, seed: int, share: float) -> Outcome:
        """Kill one after `share` of the time that it takes; what is left of it."""
        process, note, folder = self._started(seed)
        self._wait_until(1, note, process)
        time.sleep(share * AFTER * self.takes_s)
        process.kill()
        process.join()
        counted = int.from_bytes(note[:8], "little")
        found, wrong = judge(folder, seed, counted)
        return Outcome(folder, counted, found, wrong)

    def _whole_s(self) -> float:
        """Time of a recording that nobody kills."""
        self._started(0)[0].join()  # the first process of all also imports everything
        process, note, folder = self._started(1)
        self._wait_until(1, note, process)
        begun = time.monotonic()
        self._wait_until(2, note, process)
        took_s = time.monotonic() - begun
        process.join()
        found, wrong = judge(folder, 1, BLOCKS * STARTS)
        assert (process.exitcode, found, wrong) == (0, BLOCKS * STARTS, None), wrong
        return took_s

    def _started(self, seed: int) -> tuple[Any, mmap.mmap, Path]:
        self._n += 1
        note_file, folder = self._folder / f"note-{self._n}", self._folder / f"run-{self._n}"
        note_file.write_bytes(bytes(16))
        with note_file.open("rb+") as file:
            note = mmap.mmap(file.fileno(), 16)
        process = self._context.Process(target=record, args=(str(folder), str(note_file), seed), daemon=True)
        process.start()
        return process, note, folder

    @staticmethod
    def _wait_until(stage: int, note: mmap.mmap, process: Any) -> None:
        """1: it is at work; 2: everything is written."""
        while note[8] < stage and process.is_alive():
            time.sleep(1e-4)


def judge(folder: Path, seed: int, counted: int) -> tuple[int, str | None]:
    """Repair what is left; how many blocks there are, and what is wrong with them, if anything."""
    try:
        after = repair(folder).after
        recording = RunRecording(folder)
    except (RigError, OSError, ValueError) as error:  # as it is where there is no segment yet
        return 0, None if counted == 0 else f"{counted} blocks counted, but {type(error).__name__}: {error}"
    if after.problems:
        return after.blocks, "; ".join(after.problems)
    found = [block for run in recording.runs for block in recording.blocks(run)]
    made = {(run + 1, block.header.block_seq): block for run in range(STARTS) for block in blocks_of(seed, run)}
    order = list(made)
    ids = [(block.header.run_id, block.header.block_seq) for block in found]
    if [one for one in order if one in set(ids)] != ids:
        return len(found), "blocks come twice, out of order or from nowhere"
    if ids[:counted] != order[:counted]:
        return len(found), f"{counted} blocks counted, not all of them are there"
    for block, one in zip(found, ids, strict=True):
        original = made[one]
        same = block.header == original.header and block.records.tobytes() == original.records.tobytes()
        if not same or block.bits.tobytes() != original.bits.tobytes():
            return len(found), f"block {one[1]} of run {one[0]} is not as it was made"
    return len(found), None
