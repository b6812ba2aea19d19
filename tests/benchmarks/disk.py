"""Recording and reading beside plain sequential writing and reading: python -m tests.benchmarks.disk FOLDER.

The same bytes, on the same disk, in the same run, round after round: `record-plain` and `read-plain` are two threads
that write and read a file past the page cache (O_DIRECT) and do nothing else, `record` and `read` are what a scan and a
replay do. CPU is that of the whole process, the system's part in it.
"""

import argparse
import errno
import os
import shutil
import statistics
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from drivers.frames import BlockFlag, FrameBlock
from drivers.recorded import RunRecording
from drivers.spb1 import BlockLayout, block_views
from rig.bench.latency import PERIOD_TICKS, header_of
from rig.bench.machine import machine
from rig.cli.progress import progress
from rig.cli.tables import BENCH_WIDTH, print_machine
from rig.errors import RecordingError, UsageError
from rig.progress import counted
from rig.recording.segment import Staging, paged
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


@dataclass(frozen=True, slots=True)
class DiskRow:
    """Medians over the rounds. of_plain: as fast as plain writing or reading; None for those themselves."""

    stage: str
    mb_per_s: float
    cpu_s_per_gb: float
    of_plain: float | None


@dataclass(frozen=True, slots=True)
class DiskReport:
    """All rows. direct: whether the disk is reached past the page cache."""

    machine: dict[str, Any]
    folder: str
    gigabytes: float
    direct: bool
    rows: tuple[DiskRow, ...]


def main() -> int:
    """Print the rows; the exit code, 1 where the folder is of no use."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="on the disk to measure; takes some 2 GB, which are removed again")
    folder = parser.parse_args().folder
    try:
        with progress():
            report = measure_disk(folder)
    except (UsageError, RecordingError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    disk_table(report)
    return 0


def disk_table(report: DiskReport) -> None:
    """Print the rows to stdout."""
    console = Console(highlight=False, width=BENCH_WIDTH)
    print_machine(console, report.machine)
    past = "past the page cache" if report.direct else "through the page cache, which this disk cannot be had without"
    console.print(f"{report.gigabytes:.1f} GB in {report.folder}; plain: two threads {past}")
    table = Table(box=None, pad_edge=False)
    for title in ("row", "MB/s", "CPU s/GB", "of plain"):
        table.add_column(title, justify="left" if title == "row" else "right")
    for row in report.rows:
        of_plain = "" if row.of_plain is None else f"{row.of_plain:.2f}"
        table.add_row(row.stage, f"{row.mb_per_s:.0f}", f"{row.cpu_s_per_gb:.2f}", of_plain)
    console.print(table)


def measure_disk(folder: Path) -> DiskReport:
    """Measure the disk of `folder`.

    UsageError where there is none, or not room for the bytes twice; RecordingError where it does not take them.
    """
    if not folder.is_dir():
        raise UsageError(f"{folder} is no folder; name one on the disk that scans are recorded to")
    if not hasattr(os, "pwritev"):
        raise UsageError("the bench needs a system that writes a file at several places at once; this one does not")
    need, free = 2 * GIGABYTES, shutil.disk_usage(folder).free / 1e9
    if need > free:
        raise UsageError(f"the bench needs {need:.3g} GB in {folder}, the disk has {free:.3g} GB free; free some")
    try:
        return _measured(folder)
    except OSError as error:
        raise RecordingError(
            f"cannot measure the disk of {folder}: {error.strerror or error}; name another folder"
        ) from error


def _measured(folder: Path) -> DiskReport:
    told = counted("measuring", "rows", None)
    source = _Source(round(GIGABYTES * 1e9))
    found: dict[str, list[tuple[float, float]]] = {}
    with tempfile.TemporaryDirectory(prefix="spadrig-disk-", dir=folder) as name:
        plain = _Plain(Path(name) / "plain", source)
        stages: dict[str, Callable[[], None]] = {
            "record-plain": plain.write,
            "record": lambda: source.record(Path(name) / "run"),
            "read-plain": plain.read,
            "read": lambda: _read(Path(name) / "run"),
        }
        for index in range(ROUNDS * len(stages)):
            stage = list(stages)[index % len(stages)]
            if stage == "record-plain":  # where the disk is told of freed space, that is no part of writing
                plain.path.unlink(missing_ok=True)
                shutil.rmtree(Path(name) / "run", ignore_errors=True)
                (Path(name) / "run").mkdir()
            _settle(Path(name))
            found.setdefault(stage, []).append(_timed(stages[stage]))
            told(index + 1, ROUNDS * len(stages))
    rows = [_row(stage, found, source.bytes) for stage in found]
    return DiskReport(machine(), str(folder), source.bytes / 1e9, plain.direct, tuple(rows))


class _Source:
    """Blocks of random frames in memory as a ring's, as many as are asked for."""

    def __init__(self, n_bytes: int) -> None:
        layout = BlockLayout(FRAMES, 512, 512)
        size = paged(layout.block_bytes)
        self.count = max(BLOCKS, n_bytes // size)
        self.bytes = self.count * size
        self.memory = np.frombuffer(Staging().take(BLOCKS * size), np.uint8)
        self._blocks = [_block(memory, layout) for memory in self.memory.reshape(BLOCKS, size)]

    def record(self, folder: Path) -> None:
        """Record them, as many at a time as the recorder of a scan does."""
        under_way: deque[Future[None]] = deque()
        with closing(Recording(folder, expected_bytes=self.bytes)) as recording:
            for seq in range(self.count):
                under_way.append(recording.submit(self._numbered(seq)))
                if len(under_way) >= WRITERS:
                    under_way.popleft().result()

    def _numbered(self, seq: int) -> FrameBlock:
        block = self._blocks[seq % BLOCKS]
        first = seq * FRAMES
        flags = BlockFlag.FIRST if seq == 0 else BlockFlag(0)
        return replace(
            block,
            header=replace(block.header, flags=flags, block_seq=seq, first_frame=first, t0_ticks=first * PERIOD_TICKS),
        )


def _block(memory: NDArray[np.uint8], layout: BlockLayout) -> FrameBlock:
    records, bits = block_views(memory, layout)
    records["ticks"] = np.arange(FRAMES) * PERIOD_TICKS
    bits[:] = np.random.default_rng(0).integers(0, 256, bits.shape, np.uint8)
    return FrameBlock(header_of(0, FRAMES, 512), records, bits)


class _Plain:
    """One file, written and read in order by two threads; past the page cache where the disk can."""

    def __init__(self, path: Path, source: _Source) -> None:
        self.path = path
        self._size = source.bytes
        self._source = source.memory.data
        path.touch()
        self._flag = getattr(os, "O_DIRECT", 0)
        try:
            os.close(os.open(path, os.O_RDONLY | self._flag))
        except OSError:
            self._flag = 0
        self.direct = bool(self._flag)

    def write(self) -> None:
        """Write all, from the same memory as the recording, and sync."""
        with _opened(self.path, os.O_WRONLY | os.O_CREAT | self._flag) as fd:
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(fd, 0, self._size)

            def write(offset: int, size: int, thread: int) -> int:
                at = offset % len(self._source)
                return os.pwritev(fd, [self._source[at : at + size]], offset)

            self._in_threads(write)
            os.fsync(fd)

    def read(self) -> None:
        """Read all."""
        memories = [Staging().take(PLAIN_BYTES) for _ in range(PLAIN_THREADS)]
        with _opened(self.path, os.O_RDONLY | self._flag) as fd:
            self._in_threads(lambda offset, size, thread: os.preadv(fd, [memories[thread][:size]], offset))

    def _in_threads(self, work: Callable[[int, int, int], int]) -> None:
        """Call work(offset, size, thread), which returns the bytes done, for all of the file; OSError if too few."""
        pieces = iter(self._pieces())
        lock = threading.Lock()
        failures: list[BaseException] = []

        def run(thread: int) -> None:
            try:
                while not failures:
                    with lock:
                        piece = next(pieces, None)
                    if piece is None:
                        return
                    if (done := work(*piece, thread)) != piece[1]:
                        raise OSError(errno.EIO, f"{done} of {piece[1]} bytes done at {piece[0]}", str(self.path))
            except BaseException as error:  # raised again on the caller's thread
                failures.append(error)

        threads = [threading.Thread(target=run, args=(number,)) for number in range(PLAIN_THREADS)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        if failures:
            raise failures[0]

    def _pieces(self) -> Iterator[tuple[int, int]]:
        """Offset and size of what is written or read at a time."""
        for offset in range(0, self._size, PLAIN_BYTES):
            size = min(PLAIN_BYTES, self._size - offset)
            # The source's memory ends on no multiple of that.
            first = min(size, len(self._source) - offset % len(self._source))
            yield offset, first
            if first < size:
                yield offset + first, size - first


@contextmanager
def _opened(path: Path, flags: int) -> Iterator[int]:
    fd = os.open(path, flags)
    try:
        yield fd
    finally:
        os.close(fd)


def _read(folder: Path) -> None:
    recording = RunRecording(folder)
    for run in recording.runs:
        for _ in recording.blocks(run):
            pass


def _settle(folder: Path) -> None:
    """Let the disk come to rest, and take files out of the page cache, so that they are read from the disk."""
    os.sync()
    if not hasattr(os, "posix_fadvise"):
        return
    for file in _files(folder):
        with _opened(file, os.O_RDONLY) as fd:
            os.posix_fadvise(fd, 0, 0, os.POSIX_FADV_DONTNEED)


def _files(folder: Path) -> Iterator[Path]:
    return (file for file in folder.rglob("*") if file.is_file())


def _timed(work: Callable[[], None]) -> tuple[float, float]:
    """Wall and CPU seconds."""
    cpu = time.process_time()
    begun = time.perf_counter()
    work()
    return time.perf_counter() - begun, time.process_time() - cpu


def _row(stage: str, found: dict[str, list[tuple[float, float]]], n_bytes: int) -> DiskRow:
    wall_s = statistics.median(wall for wall, _ in found[stage])
    cpu_s = statistics.median(cpu for _, cpu in found[stage])
    plain = found.get(f"{stage}-plain")
    of_plain = None
    if plain is not None:  # each round's quotient: disks have moods
        of_plain = statistics.median(p / w for (p, _), (w, _) in zip(plain, found[stage], strict=True))
    return DiskRow(stage, n_bytes / 1e6 / wall_s, cpu_s / (n_bytes / 1e9), of_plain)


if __name__ == "__main__":
    sys.exit(main())
