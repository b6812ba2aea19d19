"""Makes the maps of counted sweeps, several at once if the estimator allows it, and delivers them in the sweeps' order.

A map made on one thread takes less processor time in total than one that several threads share, since parts of the work
cannot be shared. So in a stream each thread makes a map of its own. The results are those that one map after the other
would give: before a map is begun, the estimator says whether its model is fixed already although earlier maps are
unfinished (`Reconstructor.may_begin`). If no other map can be made at the same time, all threads share the one map.
"""

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Generic, Protocol, TypeVar

from rig.count.volume import FrameTally
from rig.depth.reconstruct import Lane, MakesMaps, MapResult, MapUnderWay, Reconstructor
from rig.shared_time import SharedTime


class Counted(Protocol):
    """A counted sweep. tally: what the maker's counter gave for it."""

    @property
    def tally(self) -> FrameTally:
        """Counts and frames of the sweep."""
        ...


AnyCounted = TypeVar("AnyCounted", bound=Counted)


@dataclass(slots=True, eq=False)
class _UnderWay(Generic[AnyCounted]):
    sweep: AnyCounted
    work: MapUnderWay
    lane: Lane
    result: Future[MapResult]


class MapsAtOnce(Generic[AnyCounted]):
    """Makes maps with `maker`. All methods are called by one thread; `deliver` is called on it, with each sweep and its
    map. The `compute_s` of maps that are made at the same time is what `time` charges them.
    """

    def __init__(
        self, maker: MakesMaps, deliver: Callable[[AnyCounted, MapResult], None], time: SharedTime | None = None
    ) -> None:
        self._maker = maker
        self._deliver = deliver
        self._free = maker.lanes() if isinstance(maker, Reconstructor) else []
        self._pool = ThreadPoolExecutor(len(self._free), "map") if self._free else None
        self._maps: deque[_UnderWay[AnyCounted]] = deque()
        self.alone = False
        """Whether a map is being made that all threads share. May be read from any thread."""
        self._failed = False
        self.time = time or SharedTime()

    @property
    def under_way(self) -> bool:
        """Whether a map is being made, or waits to be delivered. May be called from any thread."""
        return self.alone or bool(self._maps)

    def put(self, sweep: AnyCounted, *, last: bool) -> None:
        """Begin the map of a sweep, or make and deliver it if no other map may be made at the same time.

        Earlier maps that are ready are delivered first. Waits for earlier maps, and delivers them, if this one needs
        what is learned from them, or if all threads are at work. last: whether no other sweep follows soon. Raises what
        making a map raises, of this sweep or of an earlier one.
        """
        self.deliver_ready()
        maker, pool = self._maker, self._pool
        if pool is not None and isinstance(maker, Reconstructor):
            while self._maps and not (self._free and maker.may_begin(self._frames())):
                self._deliver_next()
            # If no map may run beside this one, all threads share it.
            if self._maps or (not last and maker.may_begin(int(sweep.tally.n_frames.sum()))):
                lane = self._free.pop()
                work = maker.begin(sweep.tally, lane)
                self._maps.append(_UnderWay(sweep, work, lane, pool.submit(self._charged, work.run)))
                return
        self.alone = True
        try:
            result = maker.map(sweep.tally)
        finally:
            self.alone = False
        self._deliver(sweep, result)

    def deliver_ready(self) -> bool:
        """Deliver the maps that are ready; returns whether others are under way. Raises what making a map raised."""
        while self._maps and self._maps[0].result.done():
            self._deliver_next()
        return bool(self._maps)

    def deliver_next(self) -> bool:
        """Wait for the next map and deliver it; returns whether others are under way afterwards. Raises what making the
        map raised. After a map that failed, none is delivered any more."""
        if self._maps and not self._failed:
            self._deliver_next()
        return bool(self._maps) and not self._failed

    def close(self) -> None:
        """Let go of everything that maps are made with, without waiting for maps under way; none can be made
        afterwards."""
        if self._pool is not None:
            self._pool.shutdown(wait=False)
        self._free.clear()
        del self._maker, self._deliver

    def _charged(self, make: Callable[[], MapResult]) -> MapResult:
        with self.time.charge() as spent:
            result = make()
        return replace(result, compute_s=spent.seconds)

    def _frames(self) -> int:
        return sum(int(each.sweep.tally.n_frames.sum()) for each in self._maps)

    def _deliver_next(self) -> None:
        first = self._maps[0]
        try:
            result = first.result.result()
            first.work.end()
        except BaseException:
            self._failed = True
            raise
        finally:
            self._maps.popleft()
            self._free.append(first.lane)
        self._deliver(first.sweep, result)
