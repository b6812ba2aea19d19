"""An executor that sends cases to the workers of a dask cluster (dask.distributed).

A case returns only its name and how it ended; results are files in a folder that all workers must see. So a worker that
is lost takes nothing with it. One scheduler takes a few hundred tasks a second; therefore quick cases are sent in
parcels, several cases as one task of dask. Each thread of a dask worker runs its cases in a separate process, which can
be ended when a case hangs or takes too much memory. A worker with another version of the code, or without the folder,
is retired as soon as that is noticed; its cases go to others.
"""

import contextlib
import logging
import os
import re
import secrets
import shutil
import signal
import socket
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from importlib import import_module
from itertools import count
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import urlsplit

from calibration.errors import FileError
from calibration.files.sections import load_yaml
from drivers.optional_packages import install_command
from rig.batch.case import changed_file, checksum, code_digest
from rig.batch.pool import KEPT_FREE, Limits, Pool
from rig.batch.store import Store
from rig.batch.task import HEAD, Ended, Status, Task
from rig.errors import RigError, UsageError

if TYPE_CHECKING:
    from distributed import Client, Future

AHEAD: Final = 2
"""Parcels that are sent ahead for each thread of a worker, so that none waits for the network."""
PARCEL_S: Final = 2.0
"""Seconds that a parcel takes: long for a scheduler, which needs 3 ms for each, and short for somebody who waits. A
worker gives back what it has not begun by then."""
MOST_IN_PARCEL: Final = 100
"""Most cases of a parcel, however quick they are."""
NEWEST_SHARE: Final = 0.05
"""Share of the newest case in the mean time of a case."""
UNFIT: Final = frozenset({"other code", "other files", "no folder"})
"""Ends of a case that say that its worker can do none."""
PATIENCE_S: Final = 300.0
"""Seconds to wait for a scheduler that has gone away."""
NO_WORKER_S: Final = 60.0
"""Seconds to wait for other workers if all have been retired."""
ANSWER_S: Final = 10.0
"""Seconds in which something listens at a scheduler's address."""
FIRST_ANSWER_S: Final = 30.0
"""Seconds in which it answers as a scheduler."""
LOOK_S: Final = 1.0
"""Seconds from one count of the workers to the next."""
TAKEN_S: Final = 120.0
"""Seconds in which a batch system takes the first jobs."""
JOB_OVER_S: Final = 30.0
"""Seconds without any of its workers after which a job counts as over: one that has crashed starts again sooner."""
IDLE_S: Final = 120.0
"""Longest time for which a process on a worker waits for its next case."""
END_S: Final = 5.0
"""Longest time to wait for workers to end the processes of a batch."""
MOST_NAMED: Final = 5

_idle: dict[tuple[str, int], tuple[Pool, float]] = {}
"""On a worker: pools that wait for their next case, by batch and thread, with the time since when. Whoever takes a pool
out of here, in one step, is the only one to use or close it."""
_over: set[str] = set()
"""On a worker: batches that have ended, whose parcels may still be there."""
_watching = threading.Lock()
"""On a worker: held by the thread that ends pools which have waited for long."""
_log = logging.getLogger(__name__)


class Cluster:
    """An executor with the workers of a dask cluster; see `rig.batch.engine.Executor`.

    client: the caller's own, which stays open. close: called once by `close`, to close what else was opened. looked:
    called each time `workers` has counted the workers; what it raises is raised there. Raises UsageError if the client
    cannot be used, or if a worker that is there already cannot do the cases.
    """

    def __init__(
        self,
        store: Store,
        client: "Client",
        limits: Limits | None = None,
        *,
        close: Callable[[], object] | None = None,
        looked: Callable[[], object] | None = None,
    ) -> None:
        if not all(hasattr(client, name) for name in ("submit", "gather", "nthreads")):
            raise UsageError(f"client is {type(client).__name__}; give a distributed.Client of the cluster")
        self._store, self._client = store, client
        self._close, self._looked = close, looked
        self._limits = limits or Limits()
        self._ended: SimpleQueue[Future[Any]] = SimpleQueue()
        self._parcel: list[Task] = []
        self._sent: dict[str, tuple[Future[Any], list[str]]] = {}
        self._under_way = 0
        self._begun = False
        self._case_s = PARCEL_S
        # Other batches on the same scheduler may have the same cases, and it does each key once.
        self._batch = secrets.token_hex(8)
        self._keys = (f"parcel-{self._batch}-{number}" for number in count())
        self._threads = 0
        self._looked_s = float("-inf")
        self._with_workers_s = time.monotonic()
        self._retired: dict[str, str] = {}
        self._seen: set[str] = set()
        self._gone: set[str] = set()
        try:
            _require_able(client, store)
        except BaseException:
            self.close()
            raise

    @property
    def workers(self) -> int:
        """Number of threads of all workers that can do cases; 0 while there is no connection to the scheduler."""
        if time.monotonic() - self._looked_s >= LOOK_S:
            self._count()
            if self._looked is not None:
                self._looked()
        return self._threads

    def _count(self) -> None:
        """Count the workers, and note those that have gone."""
        self._looked_s = time.monotonic()
        try:
            connected = self._client.status == "running"
            threads = self._client.nthreads() if connected else {}
            if connected:
                self._gone |= self._seen - set(threads)
                self._seen |= set(threads)
            # A worker that holds something which no other can take stays there, retired or not.
            self._threads = sum(number for each, number in threads.items() if each not in self._retired)
        except (OSError, TimeoutError):
            self._threads = 0
        if self._threads:
            self._with_workers_s = self._looked_s

    @property
    def notes(self) -> list[str]:
        """Sentences on workers that were retired, or that went away."""
        notes = list(dict.fromkeys(self._retired.values()))
        if gone := len(self._gone - set(self._retired)):
            who = "a worker" if gone == 1 else f"{gone} workers"
            notes.append(f"{who} went away, and others were given the cases")
        return notes

    @property
    def room(self) -> int:
        """Number of cases that may be submitted now; 0 without a connection to the scheduler, and negative after
        workers have gone."""
        if self._client.status != "running":
            return 0
        return max(1, AHEAD * self.workers) * self._size - self._under_way

    @property
    def _size(self) -> int:
        """Number of cases in a parcel."""
        return max(1, int(min(MOST_IN_PARCEL, PARCEL_S / max(self._case_s, 1e-6))))

    def submit(self, task: Task) -> None:
        """Put a task into a parcel, and send the parcel if it is full; otherwise `wait` sends it."""
        self._parcel.append(task)
        self._under_way += 1
        if len(self._parcel) >= self._size:
            self._send()

    def _send(self) -> None:
        tasks, self._parcel = self._parcel, []
        self._begun = True
        key = next(self._keys)
        future = self._client.submit(_do, tasks, self._limits, self._batch, key=key, pure=False)
        self._sent[key] = future, [task.name for task in tasks]
        future.add_done_callback(self._ended.put)

    def wait(self) -> list[Ended]:
        """Tasks that have ended; empty if none does within LOOK_S. Raises RigError if the scheduler is gone, UsageError
        if all workers are."""
        self._require_client()
        if self._retired and not self.workers and time.monotonic() - self._with_workers_s > NO_WORKER_S:
            raise UsageError("no worker is left", *self.notes)
        if self._parcel and self._client.status == "running":
            self._send()
        futures: list[Future[Any]] = []
        try:
            futures.append(self._ended.get(timeout=LOOK_S))
            while True:
                futures.append(self._ended.get_nowait())
        except Empty:
            pass
        self._require_client()
        mine = [(future, sent[1]) for future in futures if (sent := self._sent.pop(str(future.key), None)) is not None]
        try:
            told = self._client.gather([f for f, _ in mine if f.status == "finished"], errors="skip")
        except (OSError, TimeoutError):
            told = []
        found = {each.name: each for parcel, _ in told for each in parcel}
        ended = [self._judged(found.get(name) or _lost(name, future)) for future, names in mine for name in names]
        self._under_way -= len(ended)
        for parcel, case_s in told:
            begun = sum(each.status != "not begun" for each in parcel)
            self._case_s += (1 - (1 - NEWEST_SHARE) ** begun) * (min(case_s, PARCEL_S) - self._case_s)
        return ended

    def _require_client(self) -> None:
        """Raise RigError if the client was closed, by its owner or since its scheduler is gone."""
        if self._client.status == "closed":
            raise RigError(
                "the client was closed, or the scheduler is gone; open a new client or start the scheduler, then run "
                "this again: it goes on where it stopped"
            )

    def close(self) -> None:
        """Give up what is under way, and close what was opened for this executor."""
        if self._client.status == "running" and self._sent:
            with contextlib.suppress(OSError, TimeoutError):
                self._client.cancel([future for future, _ in self._sent.values()], force=True)
        elif self._seen:
            self._count()  # for the notes: a worker may have gone since the last look
        if self._begun and self._client.status == "running":
            # A worker that does not answer has no processes of ours for long: they end with it.
            ending = threading.Thread(target=self._end_processes, daemon=True)
            ending.start()
            ending.join(END_S)
        self._sent.clear()
        self._parcel.clear()
        self._under_way = 0
        if self._close is not None:
            self._close()
            self._close = None

    def _end_processes(self) -> None:
        """End the processes of this batch on all workers, whatever they do."""
        with contextlib.suppress(OSError, TimeoutError, RuntimeError):
            self._client.run(_end_batch, self._batch, on_error="ignore")

    def _judged(self, ended: Ended) -> Ended:
        """A task that came back undone from a worker that cannot do any is to be begun again elsewhere, unless the
        fault is not the worker's: an input has been changed, or the code."""
        if ended.status not in UNFIT or self._changed(ended.status):
            return ended
        note = f"worker {ended.worker} was retired: {ended.message}"
        address = ended.worker.partition(" ")[0]
        if address not in self._retired:
            _log.warning("%s", note)
            with contextlib.suppress(OSError, TimeoutError):  # the connection breaks: the worker will come up again
                self._client.retire_workers([address], close_workers=True)
        self._retired[address] = note
        return Ended(ended.name, "lost", note)

    def _changed(self, status: Status) -> bool:
        """Whether a fault that a worker has found is here too."""
        if status == "other files":
            return changed_file(self._store.checksums) is not None
        fresh = code_digest.__wrapped__  # without its cache
        return status == "other code" and any(fresh(package) != code for package, code in self._store.codes.items())


def connect(cluster: str, store: Store, limits: Limits) -> Cluster:
    """An executor for what `--cluster` names: the address of a scheduler, or a YAML file that describes the jobs of a
    batch system.

    Raises UsageError if a package is missing, no scheduler answers, or the file is wrong.
    """
    distributed = _distributed()
    if "://" in cluster:
        client = _client_at(cluster)
        return Cluster(store, client, limits, close=client.close)
    queue, jobs = _batch_system(Path(cluster))
    client = distributed.Client(queue, timeout=PATIENCE_S, set_as_default=False)

    def close() -> None:
        client.close()
        queue.close()

    return Cluster(store, client, limits, close=close, looked=Jobs(queue, jobs).renew)


def workers_of(cluster: str) -> int:
    """Number of cases that are done at once on what `--cluster` names: threads of the workers that are there now, or of
    all jobs that a file asks for. Raises UsageError as `connect` does, and if no worker is there."""
    if "://" not in cluster:
        content, jobs = _jobs_in(Path(cluster))
        cores = content.get("cores")
        if not isinstance(cores, int) or cores < 1:
            raise UsageError(f"{cluster}: cores is {cores!r}; it is the number of cores of a job, 1 or more")
        return jobs * cores
    _distributed()
    with _client_at(cluster) as client:
        threads = sum(map(int, client.nthreads().values()))
    if not threads:
        raise UsageError(f"no worker is at {cluster}; start some with `dask worker {cluster}`")
    return threads


def _distributed() -> Any:
    try:
        distributed = import_module("distributed")
    except ImportError as error:
        raise UsageError(f"`cluster` needs the package distributed; {install_command('distributed')}") from error
    logging.getLogger("distributed").setLevel(logging.WARNING)  # it tells of every worker that comes and goes
    return distributed


def _client_at(address: str) -> "Client":
    try:
        _require_answer(address)
        client: Client = _distributed().Client(address, timeout=FIRST_ANSWER_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise UsageError(
            f"no scheduler answers at {address} ({error}); correct the address, or start one with `dask scheduler`"
        ) from error
    return client


class Jobs:
    """The jobs of a batch system, whose number is kept: when the time of one is over, another is asked for.

    dask-jobqueue itself replaces no job that has ended, so that a batch would wait for ever once all of them had ended.
    A job that never had a worker is not replaced: it is still in the queue, or fails each time.
    """

    def __init__(self, queue: Any, number: int) -> None:
        self._queue, self._number = queue, number
        self._begun_s = time.monotonic()
        self._taken = False
        self._worked_s: dict[str, float] = {}

    def renew(self) -> None:
        """Ask for new jobs in place of those that are over. Raises RigError if the system has taken none at all within
        TAKEN_S."""
        now_s = time.monotonic()
        self._taken |= any(job.job_id is not None for job in list(self._queue.workers.values()))
        if not self._taken and now_s - self._begun_s > TAKEN_S:
            raise RigError("the batch system takes no job; its reason is above. Correct the file, then run this again")
        workers = [str(each["name"]) for each in list(self._queue.scheduler_info["workers"].values())]
        over = []
        for job in list(self._queue.worker_spec):
            if any(worker == job or worker.startswith(f"{job}-") for worker in workers):
                self._worked_s[job] = now_s
            elif now_s - self._worked_s.get(job, now_s) > JOB_OVER_S:
                over.append(job)
        for job in over:
            del self._queue.worker_spec[job], self._worked_s[job]
        there = set(self._queue.worker_spec)
        if over:
            self._queue.scale(jobs=len(there))
        elif len(there) < self._number and there >= set(self._queue.workers):  # a new job may have the old one's name
            self._queue.scale(jobs=self._number)


def _require_answer(address: str) -> None:
    """Raise OSError unless something listens at an address: a client would try again and again for PATIENCE_S."""
    parts = urlsplit(address)
    if parts.scheme in ("tcp", "tls"):
        if parts.port is None:
            raise ValueError("the port is missing")
        socket.create_connection((parts.hostname or "", parts.port), ANSWER_S).close()


SYSTEMS: Final = {
    "slurm": "SLURMCluster",
    "pbs": "PBSCluster",
    "sge": "SGECluster",
    "lsf": "LSFCluster",
    "htcondor": "HTCondorCluster",
    "oar": "OARCluster",
    "local": "local.LocalCluster",
}
"""Batch systems, by the class of dask-jobqueue; `local` starts the jobs as processes of this computer, for trials."""
SUBMITS: Final = {
    "slurm": "sbatch", "pbs": "qsub", "sge": "qsub", "lsf": "bsub", "htcondor": "condor_submit", "oar": "oarsub",
}  # fmt: skip
"""Commands with which dask-jobqueue hands in jobs."""


def _jobs_in(file: Path) -> tuple[dict[str, Any], int]:
    """The content of a file that describes jobs, without their number, and that. Raises UsageError."""
    try:
        content = dict(load_yaml(file, "a cluster", "system: slurm").content)
    except FileError as error:
        if re.fullmatch(r"[\w.-]+:\d+", str(file), re.ASCII):
            raise UsageError(f"`cluster={file}` is no cluster; the address of a scheduler is tcp://{file}") from error
        raise UsageError(
            f"`cluster={file}` is no cluster ({'; '.join(error.problems)}); name local, tcp://HOST:PORT or a YAML file"
        ) from error
    system, jobs = content.get("system"), content.pop("jobs", None)
    problems = []
    if system not in SYSTEMS:
        problems.append(f"{file}: system is {system!r}; it is one of {', '.join(SYSTEMS)}")
    if not isinstance(jobs, int) or jobs < 1:
        problems.append(f"{file}: jobs is {jobs!r}; it is the number of jobs to ask for, 1 or more")
    if problems:
        raise UsageError.of(problems)
    return content, jobs


def _batch_system(file: Path) -> tuple[Any, int]:
    """The jobs that a file describes, as a cluster of dask-jobqueue, and their number. Raises UsageError."""
    content, jobs = _jobs_in(file)
    try:
        module = _dask_jobqueue()
    except ImportError as error:
        raise UsageError(f"{file} needs the package dask-jobqueue; {install_command('dask-jobqueue')}") from error
    system = content.pop("system")
    if (command := SUBMITS.get(system)) and shutil.which(command) is None:
        raise UsageError(f"{file}: {system} needs the command {command}, which is not here; start this where it is")
    place, _, name = SYSTEMS[system].rpartition(".")
    kind = getattr(import_module(f"dask_jobqueue.{place}") if place else module, name)
    try:
        made = kind(**content)
    except (TypeError, ValueError) as error:
        raise UsageError(f"{file}: {error}; its other keys are those of dask_jobqueue.{name}") from error
    made.scale(jobs=jobs)
    return made, jobs


def _dask_jobqueue() -> Any:
    """The package, without the handler of SIGINT that it installs: that ends the process with exit code 0."""
    before = signal.getsignal(signal.SIGINT)
    try:
        return import_module("dask_jobqueue")
    finally:
        if before is not None and threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, before)


def _do(parcel: Sequence[Task], limits: Limits, batch: str) -> tuple[list[Ended], float]:
    """Do the tasks of a parcel on a worker, one after the other, as long as PARCEL_S allows to begin one.

    batch: a text that no other batch has.

    Also returns the wall time that each took, in seconds, with all that is done around it.
    """
    begun_s = time.monotonic()
    done: list[Ended] = []
    for task in parcel:
        if batch in _over or (done and (time.monotonic() - begun_s > PARCEL_S or done[-1].status in UNFIT)):
            break
        try:
            done.append(_on_worker(task, limits, batch))
        except Exception as error:  # too many open files, no room for another process: the next may succeed
            time.sleep(LOOK_S)  # others take cases meanwhile
            done.append(Ended(task.name, "lost", f"its worker could not begin it: {error or type(error).__name__}"))
    case_s = (time.monotonic() - begun_s) / max(1, len(done))
    return [*done, *(Ended(task.name, "not begun") for task in parcel[len(done) :])], case_s


def _on_worker(task: Task, limits: Limits, batch: str) -> Ended:
    """Do a task in the process that belongs to this batch and this thread of a dask worker."""
    mine = batch, threading.get_ident()
    pool = _idle.pop(mine, (None, 0.0))[0] or _new_pool(limits)
    ended: list[Ended] = []
    try:
        pool.submit(task)
        while not ended and batch not in _over:
            ended = pool.wait()
    finally:
        if not ended:
            pool.close()
    if not ended:
        return Ended(task.name, "lost", "its batch has ended")
    _idle[mine] = pool, time.monotonic()
    if batch in _over:  # since a moment ago: `_end_batch` may have looked before the pool was put back
        _close_idle(mine)
    return ended[0]


def _new_pool(limits: Limits) -> Pool:
    """A process of its own for a thread of this dask worker, with at most the thread's share of its memory."""
    from distributed import get_worker

    worker = get_worker()
    if _watching.acquire(blocking=False):
        threading.Thread(target=_end_idle, daemon=True, name="spadrig-idle").start()
    share = shared_limits(limits, worker.memory_manager.memory_limit, worker.state.nthreads)
    return Pool(1, share, f"{worker.address} {socket.gethostname()}")


def shared_limits(limits: Limits, worker_bytes: int | None, threads: int) -> Limits:
    """Limits of a case on a dask worker: at most a thread's share of its memory, if it has a limit."""
    share = int((1 - KEPT_FREE) * (worker_bytes or 0) / threads)
    if not share or (limits.memory_bytes is not None and limits.memory_bytes <= share):
        return limits
    whose = "the share of one thread of its dask worker; start workers with more memory or fewer threads"
    return replace(limits, memory_bytes=share, memory_of=whose)


def _end_batch(batch: str) -> None:
    """End the processes of a batch on this worker. A thread that waits for its process ends that itself."""
    _over.add(batch)
    for name in [name for name in list(_idle) if name[0] == batch]:
        _close_idle(name)


def _close_idle(name: tuple[str, int]) -> None:
    pool, _ = _idle.pop(name, (None, 0.0))
    if pool is not None:
        pool.close()


def _end_idle() -> None:
    """End processes that have waited for a case longer than IDLE_S: whoever leads their batch may be gone."""
    while True:
        time.sleep(IDLE_S / 10)
        for name, (_, since_s) in list(_idle.items()):
            if time.monotonic() - since_s > IDLE_S:
                _close_idle(name)


def _lost(name: str, future: "Future[Any]") -> Ended:
    said = f"its worker is gone ({future.status})"
    if future.status == "error":
        with contextlib.suppress(OSError, TimeoutError):
            said = f"its worker failed ({future.exception(timeout=1)})"
    return Ended(name, "lost", said)


def _require_able(client: "Client", store: Store) -> None:
    """Raise UsageError if the client cannot be used, or if a worker does not see the folder or an input, or has another
    version of the code."""
    if client.asynchronous:
        raise UsageError("client is asynchronous; open it with asynchronous=False")
    if client.status in ("closed", "closing"):
        raise UsageError(f"client is {client.status}; open a new one")
    head = checksum(str(store.folder / HEAD))
    files = store.checksums
    found = client.run(_problems, str(store.folder), head, files, store.codes, on_error="return")
    problems = [
        f"worker {worker}: {problem}"
        for worker, said in found.items()
        for problem in (said if isinstance(said, list) else [f"{said}; install the same version of spadrig there"])
    ]
    if problems:
        more = [f"and {len(problems) - MOST_NAMED} more"] if len(problems) > MOST_NAMED else []
        raise UsageError.of([*problems[:MOST_NAMED], *more])


def _problems(folder: str, head: str, files: Mapping[str, str], codes: Mapping[str, str]) -> list[str]:
    """Reasons why this computer cannot do the cases of a batch."""
    problems = []
    for path, wanted, what in ((str(Path(folder) / HEAD), head, folder), *((p, s, p) for p, s in files.items())):
        try:
            seen = checksum(path)
        except UsageError:
            seen = ""
        if seen != wanted:
            problems.append(f"does not see {what}; share it under the same path, with the same content")
    if os.path.isdir(folder) and not os.access(folder, os.W_OK):
        problems.append(f"cannot write {folder}; share it for writing")
    if any(code_digest(package) != code for package, code in codes.items()):
        problems.append(
            "has another version of the code, a plugin or a package; install the same one and restart the worker"
        )
    return problems
