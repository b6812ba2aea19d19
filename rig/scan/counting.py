"""The counting thread, which turns blocks into maps: it counts sweep after sweep, and `MapsAtOnce` makes the maps.

`MapQueue` is the bounded queue of maps from this thread to the caller. It also tells the caller when the frames have
ended.
"""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DeviceFault
from drivers.ring import RingReader
from rig.count.sweeps import SweepAccount, SweepAssembler, SweepData
from rig.depth.maps_at_once import MapsAtOnce
from rig.depth.reconstruct import MakesMaps, MapResult
from rig.scan.source import Source, blocks
from rig.threads import StageThread


@dataclass(frozen=True, slots=True, eq=False)
class AcquiredMap:
    """A map and the account of its sweep, without the counts, which are large.

    column: float64 (columns,), mean fractional column of each column's frames; for a column without frames, its own
    number.
    compute_s: seconds of binding, counting and estimation, as `SharedTime` charges them.
    taken: when the map's first and last frame were taken, as in the manifest (`utc`, `utc_uncertainty_s`), by the
    arrivals so far; empty if that is not known.
    """

    sweep: SweepAccount
    column: NDArray[np.float64]
    result: MapResult
    compute_s: float
    taken: Mapping[str, Any] = field(default_factory=dict)


class MapQueue:
    """At most `room` maps that wait for the caller. One thread puts maps, one takes them; any may end the stream.

    streaming: whether the rig still has to be kept running.
    closed: whether nobody will take maps any more.
    high_water: largest number of maps that waited at one time.
    """

    def __init__(self, room: int) -> None:
        self.room = room
        self.high_water = 0
        self.streaming = True
        self.closed = False
        self._maps: deque[AcquiredMap] = deque()
        self._changed = threading.Condition()
        self._ended = False

    @property
    def drained(self) -> bool:
        """Whether every map was taken and no more will come."""
        return self._ended and not self._maps

    def put(self, found: AcquiredMap) -> None:
        """Add a map once there is room, or at once if the queue is closed and nobody will take it."""
        with self._changed:
            self._changed.wait_for(lambda: len(self._maps) < self.room or self.closed)
            self._maps.append(found)
            self.high_water = max(self.high_water, len(self._maps))
            self._changed.notify_all()

    def end_stream(self) -> None:
        """Note that the rig can be made safe, because all frames have come or something failed. Maps may still come."""
        with self._changed:
            self.streaming = False
            self._changed.notify_all()

    def end(self) -> None:
        """Note that no more maps will come."""
        with self._changed:
            self.streaming, self._ended = False, True
            self._changed.notify_all()

    def close(self) -> None:
        """Note that nobody takes maps any more. This frees a thread that waits to put one."""
        with self._changed:
            self.closed = True
            self._changed.notify_all()

    def take_streaming(self, timeout_s: float) -> AcquiredMap | None:
        """The next map. None after `timeout_s`, or at once when the stream is over: the caller then makes the rig safe
        before it takes the other maps."""
        return self._take(timeout_s, lambda: not self.streaming)

    def take_rest(self, timeout_s: float) -> AcquiredMap | None:
        """The next map; None after `timeout_s`, or at once if no more will come."""
        return self._take(timeout_s, lambda: self.drained)

    def _take(self, timeout_s: float, over: Callable[[], bool]) -> AcquiredMap | None:
        with self._changed:
            self._changed.wait_for(lambda: bool(self._maps) or over(), timeout_s)
            if over() or not self._maps:
                return None
            found = self._maps.popleft()
            self._changed.notify_all()
            return found


@dataclass(frozen=True, slots=True)
class CountingRequest:
    """The work of one start of the SPAD.

    assembler: makes `sweeps` sweeps from the blocks. maker: makes their maps. silence_s: longest silence of the SPAD,
    in seconds. on_sweep: called on the counting thread with each counted sweep before its map is made.
    """

    assembler: SweepAssembler
    sweeps: int
    maker: MakesMaps
    silence_s: float
    on_sweep: Callable[[SweepData], None] | None = None


class CountingThread:
    """Thread that counts the blocks of one start of the SPAD, and has each sweep made into a map at its end.

    on_complete: called on this thread as soon as the marker that closes the last sweep is counted; the last map is
      begun after that.

    Maps go to `queue`, which ends with this thread. If the thread ended too early, `error` says why.
    """

    def __init__(
        self,
        reader: RingReader,
        request: CountingRequest,
        queue: MapQueue,
        source: Source,
        on_complete: Callable[[], None],
    ) -> None:
        self._reader = reader
        self._asked = request
        self._queue = queue
        self._source = source
        self._on_complete = on_complete
        self.thread = StageThread(self._run, "counting")
        self.counting_s = 0.0
        self.estimation_s = 0.0
        self.wait_s = 0.0
        """Time spent waiting for the caller to take maps."""
        self.error: BaseException | None = None
        self._counted = False
        self._maps = MapsAtOnce(request.maker, self._deliver, request.assembler.time)

    @property
    def estimating(self) -> bool:
        """Whether maps are being made while nothing is counted."""
        return self._maps.alone or (self._counted and self._maps.under_way)

    def _run(self) -> None:
        try:
            with self._reader:
                try:
                    self._count()
                finally:
                    # Threads may still be at work on blocks whose slots go back now.
                    with suppress(Exception):
                        self._asked.assembler.settle(0)
        except BaseException as error:  # raised again on the caller's thread
            self.error = error
        self._counted = True
        try:
            while not self._queue.closed and self._maps.deliver_next():
                pass
        except BaseException as error:
            self.error = self.error or error
        # This thread and the pipeline refer to each other: hundreds of megabytes must not wait for garbage collection.
        self._maps.close()
        del self._asked
        self._queue.end()

    def _count(self) -> None:
        assembler = self._asked.assembler
        for block in blocks(self._reader, self._source, self._asked.silence_s, self._maps.deliver_ready):
            sweeps = assembler.add(block)
            while (sweep := self._next(sweeps)) is not None:
                if assembler.complete:
                    self._reader.close()
                    self._on_complete()
                if self._asked.on_sweep is not None:
                    self._asked.on_sweep(sweep)
                self._maps.put(sweep, last=assembler.complete)
            if assembler.complete or self._queue.closed:
                return
            self._settle()
        raise DeviceFault(
            f"{self._source.name}: the stream ended after {assembler.sweeps_done} of {self._asked.sweeps} sweeps, "
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
        self._asked.assembler.settle(self._reader.holds - 1)
        self.counting_s += time.perf_counter() - begun

    def _deliver(self, sweep: SweepData, result: MapResult) -> None:
        column = sweep.tally.bound_column()
        found = AcquiredMap(sweep.account(), column, result, sweep.count_s + result.compute_s)
        self.estimation_s += result.compute_s
        begun = time.perf_counter()
        self._queue.put(found)
        self.wait_s += time.perf_counter() - begun
