"""The bounded queue of maps from the counting thread to the caller's, which also says when the stream is over."""

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rig.reconstruction import MapResult
from rig.sweeps import SweepAccount


@dataclass(frozen=True, slots=True, eq=False)
class AcquiredMap:
    """A map and the account of its sweep, without the counts, which are large.

    column: float64 (columns,), where the frames of each column were bound. compute_s: wall time of binding, counting
    and estimation.
    """

    sweep: SweepAccount
    column: NDArray[np.float64]
    result: MapResult
    compute_s: float


class MapQueue:
    """At most `room` maps that wait for the caller. One thread puts, one takes; any may tell the stream's end."""

    def __init__(self, room: int) -> None:
        self.room = room
        self.high_water = 0
        """Most maps that waited at one time."""
        self._maps: deque[AcquiredMap] = deque()
        self._changed = threading.Condition()
        self._streaming = True
        self._ended = False
        self._closed = False

    @property
    def streaming(self) -> bool:
        """Whether the rig has still to be kept running."""
        return self._streaming

    @property
    def drained(self) -> bool:
        """Whether every map was taken and none will come."""
        return self._ended and not self._maps

    @property
    def closed(self) -> bool:
        """Whether nobody will take maps any more."""
        return self._closed

    def put(self, found: AcquiredMap) -> None:
        """Add a map, once there is room. Into a closed queue it goes nowhere."""
        with self._changed:
            self._changed.wait_for(lambda: len(self._maps) < self.room or self._closed)
            self._maps.append(found)
            self.high_water = max(self.high_water, len(self._maps))
            self._changed.notify_all()

    def end_stream(self) -> None:
        """The rig can be made safe: all frames are there, or something failed. Maps may still come."""
        self._set("_streaming", False)

    def end(self) -> None:
        """No more maps."""
        self._set("_ended", True)

    def close(self) -> None:
        """Nobody takes maps any more: let go of whoever waits to put one."""
        self._set("_closed", True)

    def take_streaming(self, timeout_s: float) -> AcquiredMap | None:
        """The next map; None after `timeout_s`, or at once where the stream is over, which comes before the maps."""
        return self._take(timeout_s, lambda: not self._streaming)

    def take_rest(self, timeout_s: float) -> AcquiredMap | None:
        """The next map; None after `timeout_s`, or at once where none will come."""
        return self._take(timeout_s, lambda: self._ended and not self._maps)

    def _take(self, timeout_s: float, over: Callable[[], bool]) -> AcquiredMap | None:
        with self._changed:
            self._changed.wait_for(lambda: bool(self._maps) or over(), timeout_s)
            if over() or not self._maps:
                return None
            found = self._maps.popleft()
            self._changed.notify_all()
            return found

    def _set(self, name: str, value: bool) -> None:
        with self._changed:
            setattr(self, name, value)
            self._changed.notify_all()
