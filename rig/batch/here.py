"""Does cases in this process, one after the other, so that each has the whole computer for itself.

This is for cases whose computing time is a result. An error of a case is raised as it is, and ends the batch.
"""

import logging
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from rig.batch.case import Case, Result
from rig.batch.engine import run_batch
from rig.batch.store import Store
from rig.batch.task import Ended, Task, perform
from rig.errors import UsageError
from rig.interrupts import one_interrupt
from rig.progress import Progress, part

_log = logging.getLogger(__name__)


class Here:
    """An executor in this process; see `rig.batch.engine.Executor`. what: noun for a case; total: number of cases."""

    workers = 1
    notes: Sequence[str] = ()

    def __init__(self, what: str, total: int) -> None:
        self._what, self._total = what, total
        self._begun = 0
        self._task: Task | None = None

    @property
    def room(self) -> int:
        """1 if it has no task, else 0."""
        return int(self._task is None)

    def submit(self, task: Task) -> None:
        """Take a task; `wait` does it."""
        self._task = task
        self._begun += 1

    def wait(self) -> list[Ended]:
        """Do the task that was taken. Raises what the case raises."""
        task, self._task = self._task, None
        assert task is not None, "called with a task under way"
        with part(f"{self._what} {self._begun} of {self._total}"):
            # A file that changes meanwhile is read as it is: the command's own process has no other to agree with.
            return [perform(replace(task, files={}), raises=True)]

    def close(self) -> None:
        """Forget the task that was taken."""
        self._task = None


def do_here(cases: Sequence[Case], what: str, progress: Progress | None = None) -> tuple[list[Result | None], bool]:
    """Do all cases in this process.

    what: noun for a case, such as 'scan'. progress: called with the number of finished cases and of all.

    Returns the results in the order of the cases, and whether the batch ended early; results that are missing then are
    None. It ends early after an interrupt, and if there is no room for further results, which is logged. Raises what a
    case raises, and UsageError if there is no room for any result.
    """
    with one_interrupt(), tempfile.TemporaryDirectory(prefix="spadrig-batch-") as folder:
        try:
            store = Store(Path(folder) / "all", cases)
        except UsageError as error:
            if not isinstance(error.__cause__, OSError) or "cannot write" not in str(error):
                raise
            raise UsageError(f"no room for results in {tempfile.gettempdir()}; set TMPDIR to another folder") from error
        with store:
            done = run_batch(store, Here(what, len(store.cases)), progress=progress)
            ended = done.verdict != "complete"
            if done.reason and not done.done:
                raise UsageError(f"{done.reason}, or set TMPDIR to another folder")
            if done.reason:
                _log.warning("%s", done.reason)
            return store.results(), ended
