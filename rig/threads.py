"""Threads of a scan: `RowWorkers` share compiled work on image rows, `StageThread` is one stage of the pipeline.

Kernels release the interpreter's lock while they run, so row threads work at the same time.
"""

import os
import sys
import threading
import time
import weakref
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from queue import SimpleQueue
from typing import Self

import numpy as np

Work = Callable[[int, int], None]
"""A callback that works on a range of rows, called with the first row and the row after the last."""
_Job = tuple[Work, int, int]
_LEAST_URGENT = 19
_LOOK_S = 0.01
_BEGIN_S = 60.0
_stages: "weakref.WeakSet[threading.Thread]" = weakref.WeakSet()
_workers: "weakref.WeakSet[_State]" = weakref.WeakSet()


class _Begun(threading.Event):
    """The event for which `Thread.start` waits. Python waits for ever if a thread finds no memory to begin with."""

    def wait(self, timeout: float | None = None) -> bool:
        """Wait as usual; without a timeout raises MemoryError after `_BEGIN_S`."""
        if super().wait(_BEGIN_S if timeout is None else timeout):
            return True
        if timeout is None:
            raise MemoryError("a thread did not begin")
        return False


class _Thread(threading.Thread):
    """A thread for which nobody waits when the program ends."""

    def __init__(self, run: Callable[[], None], name: str) -> None:
        super().__init__(target=run, name=name, daemon=True)
        self._started = _Begun()


class RowWorkers:
    """Threads that share the rows of a picture. Each always gets the same rows, which may still be in its core's cache.

    `post` queues work: each thread does its part in order and none waits for the others. If work fails, all that has
    not begun is dropped, and the next call of `over`, `post` or `settle` raises the error. With one thread, `post` does
    the work itself, at once. The threads end with `close`, or when nothing refers to the workers any more.
    """

    def __init__(self, threads: int) -> None:
        self.threads = max(1, threads)
        self._state = _State(self.threads if self.threads > 1 else 0)
        self._ended = weakref.finalize(self, _end, self._state)
        for i, queue in enumerate(self._state.queues):
            _Thread(partial(_run, self._state, queue, i), f"rows {i}").start()

    def over(self, rows: int, work: Work) -> None:
        """Call work(first, last) for ranges that together cover rows 0..rows-1; wait for them and all earlier posts."""
        self.post(rows, work)
        self.settle()

    def post(self, rows: int, work: Work) -> None:
        """Queue work as for `over`, without waiting until it is done."""
        state = self._state
        if not state.queues:
            if rows:
                work(0, rows)
            return
        if state.error is not None:
            self.settle()
        edges = np.linspace(0, rows, self.threads + 1).astype(int).tolist()
        state.posted += 1
        for queue, (first, last) in zip(state.queues, pairwise(edges), strict=True):
            queue.put((work, first, last))

    def settle(self, under_way: int = 0) -> None:
        """Wait until all posts but the last `under_way` are done. If one failed, wait for all and raise its error."""
        state = self._state
        if not state.queues:
            return
        wanted = state.posted - under_way
        if min(state.done) < wanted or state.error is not None:
            with state.changed:
                state.wanted = wanted
                state.changed.wait_for(lambda: min(state.done) >= (wanted if state.error is None else state.posted))
        if state.error is not None:
            error, state.error = state.error, None
            raise error

    def close(self) -> None:
        """End the threads once all queued work is done, without waiting for it. Post nothing afterwards."""
        self._ended()

    def __enter__(self) -> Self:
        """The workers themselves."""
        return self

    def __exit__(self, *error: object) -> None:
        """Close."""
        self.close()


class _State:
    """State that the threads share. It must not refer to the workers, so that they can be deleted."""

    def __init__(self, threads: int) -> None:
        self.queues: list[SimpleQueue[_Job | None]] = [SimpleQueue() for _ in range(threads)]
        self.done = [0] * threads
        self.posted = 0
        self.wanted = 0
        """Number of posts that must be done before the waiting caller goes on."""
        self.changed = threading.Condition()
        self.error: BaseException | None = None
        """The first failure. It is kept until all posted work is over and the caller has received it."""
        _workers.add(self)

    @property
    def at_work(self) -> bool:
        """Whether a thread has not yet done all that was posted."""
        return bool(self.done) and min(self.done) < self.posted


def yield_to_others() -> None:
    """Give the calling thread the lowest priority: it hardly works while no core is idle. Does nothing except on Linux.

    Every map waits for the slowest row thread, so less urgent work on the core of one of them would delay the map.
    """
    if sys.platform == "linux":
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _LEAST_URGENT)


def _run(state: _State, queue: "SimpleQueue[_Job | None]", i: int) -> None:
    while (job := queue.get()) is not None:
        work, first, last = job
        try:
            if first < last and state.error is None:
                work(first, last)
        except BaseException as error:  # raised again on the caller's thread
            with state.changed:
                state.error = state.error or error
        # Frames that the work holds must not outlive it.
        del work, job
        with state.changed:
            state.done[i] += 1
            # The caller is woken only when all that it waits for is done, or after a failure.
            if min(state.done) >= state.wanted or state.error is not None:
                state.changed.notify_all()


def _end(state: _State) -> None:
    for queue in state.queues:
        queue.put(None)


class StageThread:
    """A thread that calls `run` once. A program that ends does not wait for it.

    `run` must handle all its own errors. `join` may be called without `start`, since a scan may fail before its threads
    are started.
    """

    def __init__(self, run: Callable[[], None], name: str) -> None:
        self._thread = _Thread(run, name)

    def start(self) -> None:
        """Start the thread."""
        _stages.add(self._thread)
        self._thread.start()

    def join(self, timeout_s: float) -> bool:
        """Wait at most `timeout_s` for the thread's end. Returns False if it still runs, True if it ended or was never
        started."""
        if self._thread.ident is not None:
            self._thread.join(timeout_s)
        return not self._thread.is_alive()


def all_at_rest(within_s: float) -> bool:
    """Wait until no thread of this module is at work, at most `within_s` seconds; returns False if one still is.

    The interpreter must not end before that: it takes away what compiled code still uses, and the process would crash.
    """
    ends_s = time.monotonic() + within_s
    while any(each.is_alive() for each in list(_stages)) or any(each.at_work for each in list(_workers)):
        if time.monotonic() > ends_s:
            return False
        time.sleep(_LOOK_S)
    return True
