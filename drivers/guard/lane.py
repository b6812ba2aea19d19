"""A thread that does one job after the other for one device, urgent ones first."""

import itertools
import queue
import threading
from collections.abc import Callable

Job = Callable[[], object]


class Lane:
    """Jobs must not raise. The thread is a daemon: a job that hangs in a driver does not keep the process alive."""

    def __init__(self, name: str) -> None:
        self._jobs: queue.PriorityQueue[tuple[int, int, Job]] = queue.PriorityQueue()
        self._order = itertools.count()
        self._open = 0
        self._lock = threading.Lock()
        threading.Thread(target=self._work, name=name, daemon=True).start()

    def do(self, job: Job, *, first: bool = False) -> None:
        """Queue a job; `first`: ahead of all that are not."""
        with self._lock:
            self._open += 1
        self._jobs.put((0 if first else 1, next(self._order), job))

    @property
    def idle(self) -> bool:
        """Whether nothing is queued or under way."""
        with self._lock:
            return self._open == 0

    def _work(self) -> None:
        while True:
            _, _, job = self._jobs.get()
            try:
                job()
            finally:
                with self._lock:
                    self._open -= 1
