"""Compiled work on image rows, shared out between threads; kernels release the interpreter's lock while they run."""

import threading
from collections.abc import Callable
from itertools import pairwise
from queue import SimpleQueue
from types import TracebackType
from typing import Self

import numpy as np

Work = Callable[[int, int], None]
"""Called with the first row and the one behind the last."""


class RowWorkers:
    """Threads that share the rows of a picture, each one always the same: what it touched is still in its cache.

    Work can be left with them (`post`): each goes through it in order, none waits for the others, and handing over
    costs the caller little. Work that fails is raised again at the next call. With one thread all is done at once.
    """

    def __init__(self, threads: int) -> None:
        self.threads = max(1, threads)
        self._queues: list[SimpleQueue[tuple[Work, int, int] | None]] = []
        self._done = [0] * self.threads
        self._posted = 0
        self._changed = threading.Condition()
        self._error: BaseException | None = None
        if self.threads > 1:
            self._queues = [SimpleQueue() for _ in range(self.threads)]
            for i in range(self.threads):
                threading.Thread(target=self._run, args=(i,), name=f"rows {i}", daemon=True).start()

    def over(self, rows: int, work: Work) -> None:
        """Call work(first, last) for ranges that cover rows 0..rows-1 once, behind all that was posted before."""
        self.post(rows, work)
        self.settle()

    def post(self, rows: int, work: Work) -> None:
        """The same without waiting for it."""
        if not self._queues:
            if rows:
                work(0, rows)
            return
        self._raise_error()
        edges = np.linspace(0, rows, self.threads + 1).astype(int).tolist()
        self._posted += 1
        for queue, (first, last) in zip(self._queues, pairwise(edges), strict=True):
            queue.put((work, first, last))

    def settle(self, under_way: int = 0) -> None:
        """Wait until no more than the last `under_way` posts are not done."""
        if not self._queues:
            return
        wanted = self._posted - under_way
        if min(self._done) < wanted:
            with self._changed:
                self._changed.wait_for(lambda: min(self._done) >= wanted)
        self._raise_error()

    def close(self) -> None:
        """End the threads once all is done."""
        for queue in self._queues:
            queue.put(None)

    def __enter__(self) -> Self:
        """The workers themselves."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close."""
        self.close()

    def _run(self, i: int) -> None:
        while (job := self._queues[i].get()) is not None:
            work, first, last = job
            try:
                if first < last and self._error is None:
                    work(first, last)
            except BaseException as error:  # raised again on the caller's thread
                self._error = error
            # Frames that the work holds must not outlive it.
            del work, job
            with self._changed:
                self._done[i] += 1
                self._changed.notify_all()

    def _raise_error(self) -> None:
        error, self._error = self._error, None
        if error is not None:
            raise error
