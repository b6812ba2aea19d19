"""Recording and reading beside plain sequential writing and reading: python -m tests.benchmarks.disk FOLDER.

As many bytes, on the same disk, in the same run, round after round: `record-plain` and `read-plain` are two threads
that write and read a file past the page cache (O_DIRECT) and do nothing else, `record` and `read` are what a scan and a
replay do. CPU is that of the whole process, the system's part in it.
"""

import argparse
import mmap
import os
import shutil
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from drivers.frames import BlockFlag, FrameBlock
from drivers.recorded import RunRecording
from drivers.spb1 import BlockLayout, block_views
from rig.bench.latency import PERIOD_TICKS, header_of
from rig.bench.machine import machine
from rig.cli.progress import progress
from rig.cli.tables import BENCH_WIDTH, print_machine
from rig.progress import tell_stage
from rig.recording.segment import paged
from rig.recording.writer import WRITERS, Recording

GIGABYTES = 2.0
ROUNDS = 3
FRAMES = 512
"""Of a block: 16 MiB, as of a scan of whole frames at 100 kHz."""
BLOCKS = 8
"""Different blocks, which come in turn."""
PLAIN_BYTES = 4 << 20
"""At a time and thread: what is fastest on the disks it was tried on, 1 to 16 MiB being much the same."""
PLAIN_THREADS = 2


def main() -> None:
    """Print the rows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="on the disk to measure; takes some 4 GB, which are removed again")
    folder = parser.parse_args().folder
    with progress():
        rows = measure_disk(folder)
    console = Console(highlight=False, width=BENCH_WIDTH)
    print_machine(console, machine())
    table = Table("row", "MB/s", "CPU s/GB", "of plain", box=None, pad_edge=False)
    for stage, (mb_per_s, cpu_s_per_gb, of_plain) in rows.items():
        table.add_row(stage, f"{mb_per_s:.0f}", f"{cpu_s_per_gb:.2f}", f"{of_plain:.2f}")
    console.print(table)


def measure_disk(folder: Path) -> dict[str, tuple[float, float, float]]:
    """Medians over the rounds of each row: MB a second, CPU seconds a GB, and how fast beside the plain row."""
    layout = BlockLayout(FRAMES, 512, 512)
    size = paged(layout.block_bytes)
    count = max(BLOCKS, round(GIGABYTES * 1e9) // size)
    blocks = [_block(layout) for _ in range(BLOCKS)]
    found: dict[str, list[tuple[float, float]]] = {}
    with tempfile.TemporaryDirectory(prefix="spadrig-disk-", dir=folder) as name:
        plain, run = Path(name) / "plain", Path(name) / "run"
        stages: dict[str, Callable[[], None]] = {
            "record-plain": lambda: _write_plain(plain, count * size),
            "record": lambda: _record(run, blocks, count, size),
            "read-plain": lambda: _read_plain(plain),
            "read": lambda: _read(run),
        }
        for number in range(ROUNDS):
            tell_stage("measuring", number, ROUNDS, "rounds")
            plain.unlink(missing_ok=True)  # where the disk is told of freed space, that is no part of writing
            shutil.rmtree(run, ignore_errors=True)
            run.mkdir()
            for stage, work in stages.items():
                _settle(Path(name))
                found.setdefault(stage, []).append(_timed(work))
    return {stage: _medians(found[stage], found[f"{stage.split('-')[0]}-plain"], count * size / 1e9) for stage in found}


def _block(layout: BlockLayout) -> FrameBlock:
    records, bits = block_views(np.frombuffer(mmap.mmap(-1, paged(layout.block_bytes)), np.uint8), layout)
    records["ticks"] = np.arange(FRAMES) * PERIOD_TICKS
    bits[:] = np.random.default_rng(0).integers(0, 256, bits.shape, np.uint8)
    return FrameBlock(header_of(0, FRAMES, 512), records, bits)


def _record(folder: Path, blocks: list[FrameBlock], count: int, size: int) -> None:
    """Record them in turn, as many at a time as the recorder of a scan does."""
    under_way: deque[Future[None]] = deque()
    with closing(Recording(folder, expected_bytes=count * size)) as recording:
        for seq in range(count):
            block, first = blocks[seq % BLOCKS], seq * FRAMES
            flags = BlockFlag(0) if seq else BlockFlag.FIRST
            header = replace(block.header, flags=flags, block_seq=seq, first_frame=first, t0_ticks=first * PERIOD_TICKS)
            under_way.append(recording.submit(replace(block, header=header)))
            if len(under_way) >= WRITERS:
                under_way.popleft().result()


def _read(folder: Path) -> None:
    recording = RunRecording(folder)
    for run in recording.runs:
        for _ in recording.blocks(run):
            pass


def _write_plain(path: Path, size: int) -> None:
    """Write a file and sync it."""
    memory = mmap.mmap(-1, PLAIN_BYTES)
    memory[:] = np.random.default_rng(0).bytes(PLAIN_BYTES)
    with _opened(path, os.O_WRONLY | os.O_CREAT) as fd, ThreadPoolExecutor(PLAIN_THREADS) as pool:
        os.posix_fallocate(fd, 0, size)
        pieces = [(offset, min(PLAIN_BYTES, size - offset)) for offset in range(0, size, PLAIN_BYTES)]
        list(pool.map(lambda piece: os.pwritev(fd, [memoryview(memory)[: piece[1]]], piece[0]), pieces))
        os.fsync(fd)


def _read_plain(path: Path) -> None:
    """Read a file."""
    memories: deque[mmap.mmap] = deque(mmap.mmap(-1, PLAIN_BYTES) for _ in range(PLAIN_THREADS))

    def read(offset: int) -> None:
        memory = memories.popleft()
        os.preadv(fd, [memory], offset)
        memories.append(memory)

    with _opened(path, os.O_RDONLY) as fd, ThreadPoolExecutor(PLAIN_THREADS) as pool:
        list(pool.map(read, range(0, path.stat().st_size, PLAIN_BYTES)))


@contextmanager
def _opened(path: Path, flags: int) -> Iterator[int]:
    """The open file, past the page cache where the disk can."""
    try:
        fd = os.open(path, flags | os.O_DIRECT)
    except OSError:
        fd = os.open(path, flags)
    try:
        yield fd
    finally:
        os.close(fd)


def _settle(folder: Path) -> None:
    """Let the disk come to rest, and take files out of the page cache, so that they are read from the disk."""
    os.sync()
    for file in folder.rglob("*"):
        if file.is_file():
            with _opened(file, os.O_RDONLY) as fd:
                os.posix_fadvise(fd, 0, 0, os.POSIX_FADV_DONTNEED)


def _timed(work: Callable[[], None]) -> tuple[float, float]:
    """Wall and CPU seconds."""
    cpu = time.process_time()
    begun = time.perf_counter()
    work()
    return time.perf_counter() - begun, time.process_time() - cpu


def _medians(
    seen: list[tuple[float, float]], plain: list[tuple[float, float]], gigabytes: float
) -> tuple[float, float, float]:
    wall_s, cpu_s = np.median(seen, axis=0).tolist()
    # Each round's quotient: disks have moods.
    of_plain = float(np.median([p / w for (p, _), (w, _) in zip(plain, seen, strict=True)]))
    return 1e3 * gigabytes / wall_s, cpu_s / gigabytes, of_plain


if __name__ == "__main__":
    main()
