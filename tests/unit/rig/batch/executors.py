"""Executors for tests, which do the cases of tests.unit.rig.batch.tiny in this process or not at all."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rig.batch import cluster
from rig.batch.case import Case
from rig.batch.pool import Limits
from rig.batch.task import Ended, Task, perform

TINY = "tests.unit.rig.batch.tiny"


def squares(count: int) -> list[Case]:
    """Quick cases, which end well."""
    return [Case(f"{TINY}:square", {"x": x}, {"x": x}) for x in range(count)]


def troubles(kind: str, counter: Path, xs: Sequence[int] = (1,), **inputs: Any) -> list[Case]:
    """Cases that end badly."""
    counter.mkdir(exist_ok=True)
    given = {"kind": kind, "counter": str(counter), **inputs}
    return [Case(f"{TINY}:trouble", {"x": x, **given}, {"x": x}) for x in xs]


class Inline:
    """An executor that does tasks in this process, several at a time, and the newest first.

    instead: called with each task before it is done; what it returns is the end of the task.
    """

    def __init__(self, instead: Callable[[Task], Ended | None] = lambda task: None, workers: int = 3) -> None:
        self.workers = workers
        self.notes: list[str] = []
        self.closed = False
        self.given: list[str] = []
        self._instead = instead
        self._tasks: list[Task] = []

    @property
    def room(self) -> int:
        """Number of tasks that it takes now."""
        return self.workers - len(self._tasks)

    def submit(self, task: Task) -> None:
        """Take a task."""
        assert self.room > 0
        self.given.append(task.name)
        self._tasks.append(task)

    def wait(self) -> list[Ended]:
        """Do the newest task."""
        task = self._tasks.pop()
        return [self._instead(task) or perform(task, "inline")]

    def close(self) -> None:
        """Forget all tasks."""
        self.closed = True
        self._tasks.clear()


WITH_OLD_CODE: set[str] = set()
"""Addresses of dask workers that have another version of the code, for `on_worker`."""
_really = cluster._on_worker


def on_worker(task: Task, limits: Limits, batch: str) -> Ended:
    """What a dask worker does with a task, if some have old code."""
    from distributed import get_worker

    address = get_worker().address
    if address in WITH_OLD_CODE:
        return Ended(task.name, "other code", "another version of the code is installed", worker=f"{address} host")
    return _really(task, limits, batch)
