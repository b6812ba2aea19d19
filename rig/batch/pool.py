"""Processes of this computer that do cases, each with one thread, limited time and limited memory.

A process that dies, hangs or takes too much memory is replaced, and only its own case has failed. The memory that
processes take is watched only on Linux.
"""

import contextlib
import json
import os
import selectors
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Final

from drivers.cores import VARIABLE, cores
from rig.batch.task import Ended, Status, Task

LOOK_S: Final = 0.2
"""Seconds from one look at memory and time to the next."""
START_S: Final = 300.0
"""Longest time in which a process starts. It does not count as the case's: imports may take seconds on a busy disk."""
USUAL_BYTES: Final = 2 << 30
"""Memory of a case, if nobody says how much it needs: there are no more workers than have room for it."""
KEPT_FREE: Final = 0.1
"""Share of this computer's memory that is left to others."""
TRACE: Final = 2000
"""Bytes from the end of what a process printed that are kept if it dies."""
ONE_THREAD: Final = {
    name: "1" for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", VARIABLE)
}


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of a case: wall time in seconds, and memory in bytes (None for a fair share of this computer's).

    memory_of: what the memory is, and how to get more, for the message of a case that takes too much.
    """

    time_s: float = 3600.0
    memory_bytes: int | None = None
    memory_of: str = "the study's memory_limit; raise it"


def memory_bytes() -> int:
    """Memory of this computer in bytes, or less if the control group of this process, such as that of a job, or one
    above it has a lower limit. 8 GiB where the system does not tell."""
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else 8 << 30
    top, files = Path("/sys/fs/cgroup"), []
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/cgroup").read_text().splitlines():
            _, kinds, group = line.split(":", 2)  # version 2 has no kinds
            place, name = (top, "memory.max") if not kinds else (top / "memory", "memory.limit_in_bytes")
            if not kinds or "memory" in kinds.split(","):
                own = Path(group.lstrip("/"))
                files += [place / each / name for each in (own, *own.parents)]
    for file in files:
        with contextlib.suppress(OSError, ValueError):
            total = min(total, int(file.read_text()))
    return total


def usual_workers(limits: Limits) -> int:
    """Number of workers for which there are cores and memory; at least 1."""
    room = int((1 - KEPT_FREE) * memory_bytes() // (limits.memory_bytes or USUAL_BYTES))
    return max(1, min(cores(), room))


class Pool:
    """An executor with its own processes; see `rig.batch.engine.Executor`.

    workers: number of processes; None for `usual_workers`. name: the workers are called `name` 1, `name` 2, and so on.
    """

    def __init__(self, workers: int | None = None, limits: Limits | None = None, name: str = "worker") -> None:
        limits = limits or Limits()
        self.workers = usual_workers(limits) if workers is None else workers
        share = int((1 - KEPT_FREE) * memory_bytes() / self.workers)
        if limits.memory_bytes is None:
            whose = "its share of this computer's; do fewer cases at once"
            limits = replace(limits, memory_bytes=share, memory_of=whose)
        self._limits = limits
        self._replaced: Counter[str] = Counter()
        self._idle = [f"{name} {number}" for number in range(self.workers, 0, -1)]
        self._free: list[_Process] = []
        self._busy: list[_Process] = []

    @property
    def room(self) -> int:
        """Number of tasks that can be begun now."""
        return self.workers - len(self._busy)

    @property
    def notes(self) -> list[str]:
        """A sentence on processes that had to be replaced, if there were any."""
        how = {"died": "died", "hung": "hung", "memory": "took too much memory"}
        said = [f"{number} {how[kind]}" for kind, number in sorted(self._replaced.items())]
        return [f"processes that were replaced: {', '.join(said)}"] if said else []

    def submit(self, task: Task) -> None:
        """Begin a task, in a new process if none is free. Call it only if there is room. Raises OSError if the system
        refuses another process."""
        if self._free:
            process = self._free.pop()
        else:
            process = _Process(self._idle[-1], self._limits)
            self._idle.pop()  # only now: the system may have refused another process
        self._busy.append(process)
        process.begin(task)

    def wait(self) -> list[Ended]:
        """Tasks that have ended: empty if none does within LOOK_S."""
        ended: list[Ended] = []
        with selectors.DefaultSelector() as selector:
            for process in self._busy:
                selector.register(process.answers, selectors.EVENT_READ, process)
            ready = {key.data for key, _ in selector.select(LOOK_S)}
        for process in list(self._busy):
            end = process.answer() if process in ready else process.overdrawn()
            if end is None:
                continue
            ended.append(end)
            self._busy.remove(process)
            if process.alive:
                self._free.append(process)
            else:
                self._replaced[end.status] += 1
                self._idle.append(process.name)
        return ended

    def __del__(self) -> None:
        """Close, since a thread of a dask worker may end without saying so."""
        self.close()

    def close(self) -> None:
        """End all processes, even those at work."""
        for process in [*self._busy, *self._free]:
            process.kill()
        self._busy.clear()
        self._free.clear()


class _Process:
    """A process `rig.batch.worker`, and its present task."""

    def __init__(self, name: str, limits: Limits) -> None:
        self.name = name
        self._limits = limits
        self._printed: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115  # closed by kill
        self._task: Task | None = None
        self._begun_s = 0.0
        self._part = b""
        self._ready = False
        self.alive = True
        path = os.pathsep.join(each or os.getcwd() for each in sys.path)
        # Modules are those of this process, not what lies in the current folder.
        env = {**os.environ, **ONE_THREAD, "PYTHONPATH": path, "PYTHONSAFEPATH": "1"}
        try:
            # A session of its own: Ctrl-C at the terminal is for the process that started this one.
            self._process = subprocess.Popen(
                [sys.executable, "-m", "rig.batch.worker", name], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                stderr=self._printed, env=env, start_new_session=True,
            )  # fmt: skip
        except BaseException:
            self._printed.close()
            raise
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._stdin, self.answers = self._process.stdin, self._process.stdout

    def begin(self, task: Task) -> None:
        """Send a task."""
        self._task = task
        self._begun_s = time.monotonic()
        self._printed.seek(0)  # the process writes at the same place
        self._printed.truncate()
        try:
            self._stdin.write(task.as_line().encode())
            self._stdin.flush()
        except OSError:  # it has just died: `answer` finds out
            pass

    def answer(self) -> Ended | None:
        """The end of the task, once the process has said or died; None if only a part of the line is there, or if the
        process has just become ready."""
        data = os.read(self.answers.fileno(), 1 << 16)
        if not data:
            self._process.wait()
            return self._end("died", f"the process ended with {_in_words(self._process.returncode)}")
        *lines, self._part = (self._part + data).split(b"\n")
        for line in lines:
            if line:
                return Ended(**json.loads(line))
            self._ready = True
            self._begun_s = time.monotonic()
        return None

    def overdrawn(self) -> Ended | None:
        """The end of a task that has taken too long or too much memory; None if it has not."""
        limits = self._limits
        longest_s = limits.time_s if self._ready else START_S
        if time.monotonic() - self._begun_s > longest_s:
            return self._end("hung", f"the {'case' if self._ready else 'process'} took longer than {longest_s:g} s")
        assert limits.memory_bytes is not None, "the pool has set it"
        used = resident_bytes(self._process.pid)
        if used > limits.memory_bytes:
            took, most = (f"{each / 1e9:.3g} GB" for each in (used, limits.memory_bytes))
            return self._end("memory", f"the case took {took} with its process, more than {most}, {limits.memory_of}")
        return None

    def kill(self) -> None:
        """End the process at once, and those that its case has started."""
        self.alive = False
        if hasattr(os, "killpg"):
            with contextlib.suppress(OSError):  # all of them have ended
                os.killpg(self._process.pid, signal.SIGKILL)
        self._process.kill()
        self._process.wait()
        for stream in (self._stdin, self.answers, self._printed):
            with contextlib.suppress(OSError):
                stream.close()

    def _end(self, status: Status, message: str) -> Ended:
        assert self._task is not None, "a task is at work"
        self._printed.seek(max(0, self._printed.seek(0, os.SEEK_END) - TRACE))
        detail = self._printed.read().decode(errors="replace")
        self.kill()
        return Ended(self._task.name, status, message, detail, time.monotonic() - self._begun_s, self.name)


def resident_bytes(pid: int) -> int:
    """Resident memory of a process in bytes; 0 where the system does not tell."""
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, IndexError):
        return 0


def _in_words(code: int) -> str:
    return f"signal {-code}" if code < 0 else f"exit code {code}"
