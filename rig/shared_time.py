"""Wall time, divided among the work that goes on at each moment.

Counting and several maps run at the same time. If each stated its own wall time, the sum would be longer than the scan.
So while n pieces of work run, each is charged an n-th of the time. The sum is the time during which any of them ran.
"""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager


class ChargedTime:
    """Time in s that was charged to a piece of work; 0 until the work is over."""

    seconds = 0.0


class SharedTime:
    """Charges pieces of work on any threads. A piece must not contain another one."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._running = 0
        self._each_s = 0.0
        """Time charged to a piece of work that has run all along."""
        self._at_s = 0.0

    @contextmanager
    def charge(self) -> Iterator[ChargedTime]:
        """A context whose work is charged. It gives a `ChargedTime`, which holds the time after the context has
        ended."""
        spent = ChargedTime()
        begun_s = self._step(1)
        try:
            yield spent
        finally:
            spent.seconds = self._step(-1) - begun_s

    def _step(self, more: int) -> float:
        with self._lock:
            now_s = time.perf_counter()
            if self._running:
                self._each_s += (now_s - self._at_s) / self._running
            self._at_s = now_s
            self._running += more
            return self._each_s
