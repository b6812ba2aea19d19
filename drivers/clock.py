"""The clock that devices and the application share: real time, or a virtual time that tests and simulation advance."""

import threading
import time
from typing import Protocol, runtime_checkable

NS_PER_S = 1_000_000_000


@runtime_checkable
class Clock(Protocol):
    """Monotonic time and waiting. Code that waits is given a clock, so that its tests take no real time."""

    def now_ns(self) -> int:
        """Nanoseconds since an arbitrary start; never decreases."""
        ...

    def sleep(self, seconds: float) -> None:
        """Wait for `seconds`; zero and negative values return at once."""
        ...


def now_s(clock: Clock) -> float:
    """The present time of a clock, in seconds."""
    return clock.now_ns() / NS_PER_S


class SystemClock:
    """The host's monotonic clock."""

    def now_ns(self) -> int:
        """Nanoseconds of `time.monotonic_ns`."""
        return time.monotonic_ns()

    def sleep(self, seconds: float) -> None:
        """Block this thread for `seconds`; zero and negative values return at once."""
        if seconds > 0:
            time.sleep(seconds)


class VirtualClock:
    """A clock whose time changes only when it is advanced. Thread-safe. `sleep` advances it and takes no real time."""

    def __init__(self, start_ns: int = 0) -> None:
        self._lock = threading.Lock()
        self._now_ns = start_ns

    def now_ns(self) -> int:
        """The present virtual time in nanoseconds."""
        with self._lock:
            return self._now_ns

    def sleep(self, seconds: float) -> None:
        """Advance the time by `seconds`, rounded to the nanosecond. Zero and negative values do nothing."""
        if seconds > 0:
            with self._lock:
                self._now_ns += round(seconds * NS_PER_S)

    def advance_to_ns(self, t_ns: int) -> None:
        """Advance to `t_ns`, in nanoseconds. A time that has already passed changes nothing: the clock never runs
        backwards."""
        with self._lock:
            self._now_ns = max(self._now_ns, t_ns)
