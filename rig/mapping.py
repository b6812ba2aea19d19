"""The counting thread: blocks in, maps out. It alone counts and estimates, one sweep after the other."""

import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Protocol

from drivers.errors import DeviceFault
from drivers.ring import RingReader
from rig.counting import Counter, FrameTally, SweepLayout
from rig.map_queue import AcquiredMap, MapQueue
from rig.reconstruction import MapResult
from rig.source import Source, blocks
from rig.stage_thread import StageThread
from rig.sweeps import SweepAssembler, SweepData


class MakesMaps(Protocol):
    """What the counting thread needs of a `Reconstructor`. It uses it from no other thread."""

    def counter(self, layout: SweepLayout) -> Counter:
        """A counter whose sweeps `map` takes."""
        ...

    def map(self, sweep: FrameTally) -> MapResult:
        """The map of one counted sweep."""
        ...


class Mapping:
    """Counts the blocks of one start of the SPAD and estimates each sweep where it ends, before any frame behind it.

    on_complete: called on this thread as soon as the marker that closes the last sweep is counted; the last map is
    estimated after that. on_sweep: shown each counted sweep before its map is made, on this thread too. sweeps: how
    many it is to be. Maps go to `queue`, which ends with this thread; `error` says why, where it was too early.
    """

    def __init__(
        self,
        reader: RingReader,
        assembler: SweepAssembler,
        sweeps: int,
        maker: MakesMaps,
        queue: MapQueue,
        source: Source,
        silence_s: float,
        on_complete: Callable[[], None],
        on_sweep: Callable[[SweepData], None] | None = None,
    ) -> None:
        self._reader = reader
        self._assembler = assembler
        self._sweeps = sweeps
        self._maker = maker
        self._queue = queue
        self._source = source
        self._silence_s = silence_s
        self._on_complete = on_complete
        self._on_sweep = on_sweep
        self._thread = StageThread(self._run, "counting")
        self.counting_s = 0.0
        self.estimation_s = 0.0
        self.wait_s = 0.0
        """Time spent waiting for the caller to take maps."""
        self.estimating = False
        """Whether the map of a counted sweep is being made just now."""
        self.error: BaseException | None = None

    def start(self) -> None:
        """Begin to count."""
        self._thread.start()

    def join(self, timeout_s: float) -> bool:
        """Wait for the thread; False where it does not end."""
        return self._thread.join(timeout_s)

    def _run(self) -> None:
        try:
            with self._reader:
                try:
                    self._count()
                finally:
                    # Threads may still be at work on blocks whose slots go back now.
                    with suppress(Exception):
                        self._assembler.settle(0)
        except BaseException as error:  # raised again on the caller's thread
            self.error = error
        self._queue.end_stream()
        self._queue.end()

    def _count(self) -> None:
        for block in blocks(self._reader, self._source, self._silence_s):
            sweeps = self._assembler.add(block)
            while (sweep := self._next(sweeps)) is not None:
                if self._assembler.complete:
                    self._reader.close()
                    self._on_complete()
                self._estimate(sweep)
            if self._assembler.complete or self._queue.closed:
                return
            self._settle()
        raise DeviceFault(
            f"{self._source.name}: the stream ended after {self._assembler.sweeps_done} of {self._sweeps} sweeps, "
            "without the scan marker that closes the last one; check the scanner and its marker line"
        )

    def _next(self, sweeps: Iterator[SweepData]) -> SweepData | None:
        begun = time.perf_counter()
        try:
            return next(sweeps, None)
        finally:
            self.counting_s += time.perf_counter() - begun

    def _settle(self) -> None:
        begun = time.perf_counter()
        self._assembler.settle(self._reader.holds - 1)
        self.counting_s += time.perf_counter() - begun

    def _estimate(self, sweep: SweepData) -> None:
        begun = time.perf_counter()
        self.estimating = True
        if self._on_sweep is not None:
            self._on_sweep(sweep)
        result = self._maker.map(sweep.volume)
        self.estimating = False
        column = sweep.volume.bound_column()
        found = AcquiredMap(sweep.account(), column, result, sweep.count_s + result.compute_s)
        estimated = time.perf_counter()
        self.estimation_s += estimated - begun
        self._queue.put(found)
        self.wait_s += time.perf_counter() - estimated
