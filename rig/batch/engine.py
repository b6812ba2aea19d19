"""Runs the cases of a store with an executor, until each has a result or has failed.

The store knows which cases have a result, so an interrupted batch goes on where it stopped. However a batch ends, the
table is written with all results so far. Of several shards, only the last one writes it, once all cases have a result.
"""

import contextlib
import logging
import time
from array import array
from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, Literal, Protocol

from rig.batch.store import FAILURES, Store, failure_files, read_failures
from rig.batch.task import Ended, Status, Task, result_file
from rig.errors import UsageError
from rig.interrupts import ignore_interrupts, one_interrupt
from rig.progress import Progress, tell_stage
from rig.run_folder.disk import replace_file
from rig.run_folder.plain_json import json_line

RETRIES: Final = 2
"""Times that a case is done again if its process died, hung or took too much memory."""
LOST: Final = 20
"""Times that a case is begun again if the connection to its worker broke, which is not the fault of the case."""
SAID_S: Final = 0.5
PATIENT_S: Final = 10.0
"""Seconds without any case done after which the reason is told."""
_log = logging.getLogger(__name__)


class Executor(Protocol):
    """Something that does tasks. All methods are called by one thread."""

    @property
    def workers(self) -> int:
        """Number of cases that are done at once, now."""
        ...

    @property
    def room(self) -> int:
        """Number of tasks that it takes now."""
        ...

    @property
    def notes(self) -> Sequence[str]:
        """Sentences on what happened to workers, for the user."""
        ...

    def submit(self, task: Task) -> None:
        """Begin a task; only if there is room."""
        ...

    def wait(self) -> list[Ended]:
        """Tasks that have ended since the last call; waits for a moment if none has."""
        ...

    def close(self) -> None:
        """Give up all tasks that have not ended."""
        ...


@dataclass(frozen=True, slots=True)
class Failure:
    """A case that failed. kind: how it ended. attempts: how often it was tried. command: what repeats it alone, with
    its messages. detail: the trace of an error, or the last output of a process."""

    case: str
    labels: dict[str, object]
    kind: Status
    message: str
    attempts: int
    command: str
    detail: str = ""

    def __str__(self) -> str:
        """A line for the user."""
        return failure_line(asdict(self))


@dataclass(frozen=True, slots=True)
class Batch:
    """Result of a batch. done: cases with a result, of `total`, those of other shards included; run: those that were
    done now. failures: of the cases tried now. wall_s: time of the batch; case_s: sum of the times of its cases.
    workers: most at once.

    verdict: 'complete', 'failures' (some cases failed), 'part' (a shard, while other shards have not done all their
    cases), 'stopped' (results could not be written any more, or the code has changed; `reason` says why), or 'aborted'
    by an interrupt. packed: whether the table has been written; of several shards the last one does it. failures_file:
    name, in the batch's folder, of the file with the failures; each shard has a file for its own.
    """

    done: int
    total: int
    run: int
    failures: tuple[Failure, ...]
    verdict: Literal["complete", "failures", "part", "stopped", "aborted"]
    reason: str = ""
    wall_s: float = 0.0
    case_s: float = 0.0
    workers: int = 0
    notes: tuple[str, ...] = ()
    packed: bool = True
    failures_file: str = FAILURES


def run_batch(
    store: Store,
    executor: Executor,
    *,
    shard: tuple[int, int] = (0, 1),
    retries: int = RETRIES,
    progress: Progress | None = None,
    command: str = "rig batch",
) -> Batch:
    """Do all cases that have no result yet, close the executor, and write the table.

    shard: (i, n), only cases i, i + n, i + 2 n, ... retries: how often a case is done again if its process died, hung
    or took too much memory. progress: called with the number of finished cases and of all, both of this shard. command:
    that of the whole batch, from which the commands that repeat a failed case are made. An interrupt ends the batch,
    with verdict 'aborted'. What the executor raises is raised once the table is written.
    """
    begun = time.monotonic()
    mine = list(store.cases)[shard[0] :: shard[1]]
    try:
        finished = store.finished()
    except BaseException:
        executor.close()
        raise
    runs = _Runs(store, executor, [name for name in mine if name not in finished], retries)
    file = store.folder / (FAILURES if shard[1] == 1 else f"failures-{shard[0] + 1}-of-{shard[1]}.jsonl")
    told = _Told(len(mine) - len(runs.waiting), len(mine), progress)
    aborted = False
    with one_interrupt():
        try:
            for _ in runs.steps():
                told.tell(runs, executor)
        except KeyboardInterrupt:
            ignore_interrupts()
            aborted = True
        finally:
            try:
                executor.close()
            except KeyboardInterrupt:
                ignore_interrupts()
                aborted = True
            except Exception as error:  # the table is written all the same
                _log.warning("cannot end the workers in order: %s", error or type(error).__name__)
            there, packed = _packed(store, runs, finished, only=shard[1] == 1)
            failures = _failures(store, runs, there, command)
            all_tried = not (aborted or runs.stopped or runs.waiting or runs.under_way)
            _write_failures(file, failures, packed, None if all_tried else there)
    done, total = len(there), len(store.cases)
    verdict: Literal["complete", "failures", "part", "stopped", "aborted"]
    if aborted:
        verdict = "aborted"
    elif runs.stopped:
        verdict = "stopped"
    elif failures:
        verdict = "failures"
    else:
        verdict = "complete" if packed else "part"
    return Batch(
        done, total, runs.n_done, failures, verdict, runs.stopped, time.monotonic() - begun, sum(runs.times_s),
        runs.most, tuple(executor.notes), packed, file.name,
    )  # fmt: skip


def _failures(store: Store, runs: "_Runs", there: set[str], command: str) -> tuple[Failure, ...]:
    """The failed cases. there: names of those that have a result."""
    for name in runs.done - there:
        runs.failed[name] = Ended(name, "lost", "its result was written, but is not there any more")
    return tuple(
        Failure(
            end.name, dict(store.cases[end.name].labels), end.status, end.message, runs.tries(end.name),
            f"{command} --case {end.name}", end.detail,
        )
        for end in runs.failed.values()
    )  # fmt: skip


def _write_failures(file: Path, failures: Sequence[Failure], packed: bool, there: set[str] | None) -> None:
    """Write the file with the failed cases in place of older ones, if there are any.

    packed: whether the table has been written; then the files of other shards go too. there: names of the cases that
    have a result, if others were not tried again: those that failed before stay listed then. None if all were tried.
    """
    with contextlib.suppress(OSError):  # the disk is full: they are returned all the same
        before = failure_files(file.parent) if packed else [file] if file.exists() else []
        listed = [asdict(failure) for failure in failures]
        if there is not None:
            again = {*there, *(failure.case for failure in failures)}
            listed += [line for line in read_failures(*before) if line["case"] not in again]
        if listed:
            replace_file(file, "".join(map(json_line, listed)).encode())
        for old in before:
            if old != file or not listed:
                old.unlink()


def _packed(store: Store, runs: "_Runs", finished: set[str], *, only: bool) -> tuple[set[str], bool]:
    """Write the table, if no other shard is at work; returns the finished cases of all shards, and whether the table
    has been written. finished: those that were there before. only: whether there is no other shard."""
    there = finished | runs.done
    try:
        # While the folder is shared nobody packs. Listed again once alone, for what others have done meanwhile.
        if not only:
            there = store.finished()
        if only or (store.alone() and len(there := store.finished()) == len(store.cases)):
            return store.pack(), True
    except OSError as error:
        runs.stopped = f"cannot write {store.folder}: {error.strerror}; make room, then run it again"
    except UsageError as error:
        runs.stopped = str(error)
    return there, False


def failure_line(failure: Mapping[str, Any]) -> str:
    """One line that says which case failed, with its settings, and how. failure: with the keys of `Failure`."""
    setting = setting_of(failure["labels"])
    times = "" if failure["attempts"] <= 1 else f", {failure['attempts']} times"
    return f"{setting or failure['case']}: {failure['kind']}{times}: {failure['message']}"


def setting_of(labels: Mapping[str, Any]) -> str:
    """The labels of a case in words."""
    return ", ".join(f"{name} {value}" for name, value in labels.items())


class _Runs:
    """The course of a batch: what waits, what is under way, what has failed."""

    def __init__(self, store: Store, executor: Executor, names: Sequence[str], retries: int) -> None:
        self._store, self._executor, self._retries = store, executor, retries
        self.waiting = deque(names)
        self.under_way: set[str] = set()
        self.attempts: Counter[str] = Counter()
        self._lost: Counter[str] = Counter()
        self.failed: dict[str, Ended] = {}
        # Made at once: a set of names that come back from workers would take more memory with each case.
        self._is_done = dict.fromkeys(names, False)
        self.n_done = 0
        self.times_s = array("d")
        self.most = 0
        self.stopped = ""

    def steps(self) -> Iterator[None]:
        """Begin and end cases until there is none left, or results cannot be written."""
        while (self.waiting or self.under_way) and not self.stopped:
            for _ in range(min(self._executor.room, len(self.waiting))):
                name = self.waiting.popleft()
                self.under_way.add(name)
                self._executor.submit(self._store.task(name))
            self.most = max(self.most, self._executor.workers)
            for ended in self._executor.wait():
                self._end(ended)
            yield

    @property
    def done(self) -> set[str]:
        """Names of the cases that are done."""
        return {name for name, done in self._is_done.items() if done}

    def tries(self, name: str) -> int:
        """Number of times that a case was tried, or else lost."""
        return self.attempts[name] or self._lost[name]

    def _end(self, ended: Ended) -> None:
        name = ended.name
        if name not in self.under_way:
            return
        self.under_way.discard(name)
        if ended.status == "not begun":
            self.waiting.appendleft(name)
            return
        self.times_s.append(ended.seconds)
        if ended.status == "done":
            self._is_done[name] = True
            self.n_done += 1
            return
        if ended.status == "lost":
            self._lost[name] += 1
            again = self._lost[name] <= LOST
        else:
            self.attempts[name] += 1
            again = ended.status in ("died", "hung", "memory") and self.attempts[name] <= self._retries
        if again:
            self.waiting.append(name)
        else:
            self.failed[name] = ended
            self.stopped = {
                "cannot write": f"{ended.message}; make room, then run it again",
                "other code": "the code has been changed since the batch began; name a new folder",
                "other files": f"{ended.message}; name a new folder, or put it back",
                "no folder": ended.message,
            }.get(ended.status, self.stopped)


class _Told:
    """Progress with the time that is left."""

    def __init__(self, before: int, total: int, progress: Progress | None) -> None:
        self._before, self._total, self._progress = before, total, progress
        self._begun_s = time.monotonic()
        self._said_s = float("-inf")

    def tell(self, runs: _Runs, executor: Executor) -> None:
        """Tell how many cases are done, not more often than every SAID_S."""
        now_s = time.monotonic()
        over = not runs.waiting and not runs.under_way
        if now_s - self._said_s < SAID_S and not over:
            return
        self._said_s = now_s
        done = self._before + runs.n_done
        ended = runs.n_done + len(runs.failed)
        notes = []
        if ended and not over:
            left_s = (now_s - self._begun_s) / ended * (len(runs.waiting) + len(runs.under_way))
            notes.append(f"{in_words(left_s)} left")
        if runs.failed:
            kinds = Counter(ended.status for ended in runs.failed.values()).most_common()
            notes.append(f"{len(runs.failed)} failed ({', '.join(f'{number} {kind}' for kind, number in kinds)})")
        # A line for each stage goes to where there is no terminal: one for each tenth of the cases.
        stage = f"cases, {10 * (10 * done // max(1, self._total))} %"
        if not executor.workers:
            stage = "no workers"
            notes.append("waiting for workers")
        elif not ended and runs.under_way and now_s - self._begun_s > PATIENT_S:
            stage = "the first cases load compiled code, which takes minutes where it is new"
        tell_stage(stage, done, self._total, "done", ", ".join(notes))
        if self._progress is not None:
            self._progress(done, self._total)


def in_words(seconds: float) -> str:
    """A time in words, such as '12 min'."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"


@dataclass(frozen=True, slots=True)
class Probed:
    """Wall times of cases that were tried, in seconds. again_s: of a second try of each. opening_s: longest time that a
    first try took more, to load compiled code and to open what many cases share, such as a scene."""

    again_s: tuple[float, ...]
    opening_s: float


def probe(scratch: Store, executor: Executor, names: Sequence[str], most: int = 3) -> Probed:
    """Try a few cases, each twice, and close the executor.

    scratch: a store of all cases, in a folder that nobody needs. executor: with one worker, so that both tries of a
    case are in one process. names: of the cases of which some are tried. most: number of those at most. Raises
    UsageError if one of them fails.
    """
    # One of each part of the list, and any of it: their names are digests. With equal steps through a list that goes
    # around a few settings, all cases tried could have the same one.
    ends = [i * len(names) // most for i in range(most + 1)]
    some = [min(names[first:end]) for first, end in pairwise(ends) if first < end]
    first_s, again_s = [], []
    with closing(executor):
        for number, name in enumerate(some):
            tell_stage(f"trying case {number + 1} of {len(some)}, which loads compiled code first")
            first_s.append(_try(scratch, executor, name))
            result_file(scratch.folder, name).unlink()
            again_s.append(_try(scratch, executor, name))
    opening_s = max(max(0.0, first - again) for first, again in zip(first_s, again_s, strict=True))
    return Probed(tuple(again_s), opening_s)


def _try(scratch: Store, executor: Executor, name: str) -> float:
    """Do a case once; returns its wall time in seconds. Raises UsageError if it fails."""
    runs = _Runs(scratch, executor, [name], 0)
    for _ in runs.steps():
        pass
    for ended in runs.failed.values():
        if ended.status == "other code":
            raise UsageError("the program was changed while cases were tried; run the command again")
        setting = setting_of(scratch.cases[name].labels)
        raise UsageError(f"case {name} ({setting}) fails: {ended.message}; `--case {name}` does it alone")
    return runs.times_s[-1]
