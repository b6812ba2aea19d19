"""Another process, seen from outside: has it ended, is it stopped, is any of its threads at work, and its end by force.

From /proc (proc(5), the fields of `stat`; Documentation/scheduler/sched-stats.rst of Linux, the first two numbers of
`schedstat`: nanoseconds on a processor and waiting for one) and a pidfd, which names the process for good and tells its
end at once, also where a child that it forked still holds its sockets open.
"""

import os
import select
import signal
import time
from contextlib import suppress

_STOPPED = ("T", "t")
_AT_WORK = ("R", "D")
"""Running or waiting for a processor; waiting for a disk."""
_BUSY_SHARE = 0.15
"""Share of a time that all threads together have run, or waited to, in a process at work. One that hangs wakes some
service thread for microseconds now and then."""


class WatchedProcess:
    """One process of this user. Its own pidfd is closed with `close`.

    idle_thread: number of a thread that wakes by itself. On a machine with too much to do it waits for a processor each
    time, which is no work of the process's; but while it does, others may wait for the interpreter that it holds.
    """

    def __init__(self, pid: int, idle_thread: int | None = None) -> None:
        self._pid = pid
        self._idle_task = f"/proc/{pid}/task/{idle_thread}"
        self._ended = False
        self._worked_ns: dict[str, int] = {}
        self._since = 0.0
        self._found_asleep = False
        self.handle: int | None = None
        """Readable once the process has ended; None where the kernel has no pidfd (before Linux 5.3)."""
        if hasattr(os, "pidfd_open"):
            try:
                self.handle = os.pidfd_open(pid)
            except ProcessLookupError:
                self._ended = True
            except OSError:
                self.handle = None

    @property
    def ended(self) -> bool:
        """Whether it is gone."""
        if not self._ended and self.handle is not None:
            ready = select.poll()
            ready.register(self.handle, select.POLLIN)
            self._ended = bool(ready.poll(0))
        return self._ended

    @property
    def stopped(self) -> bool:
        """Whether it is held, by a signal or a debugger."""
        return _state(f"/proc/{self._pid}/stat") in _STOPPED

    def note_progress(self) -> None:
        """Work is counted from now on."""
        self._worked_ns = {task: _work_ns(task) for task in self._tasks()}
        self._since = time.monotonic()
        self._found_asleep = False

    def busy(self) -> bool:
        """Whether its threads have worked since `note_progress`, or would have if they could, or are about to.

        It takes two looks in a row to say no: threads are looked at one after the other, and work may pass from one
        that was not yet looked at to one that was.
        """
        asleep_before, self._found_asleep = self._found_asleep, self._asleep()
        return not (asleep_before and self._found_asleep)

    def _asleep(self) -> bool:
        tasks = self._tasks()
        worked_s = 1e-9 * sum(
            max(0, _work_ns(task) - self._worked_ns.get(task, 0)) for task in tasks if task != self._idle_task
        )
        if worked_s > _BUSY_SHARE * (time.monotonic() - self._since):
            return False
        return all(_state(f"{task}/stat") not in _AT_WORK for task in tasks)

    def _tasks(self) -> list[str]:
        """Folders of its threads."""
        folder = f"/proc/{self._pid}/task"
        try:
            return [f"{folder}/{task}" for task in os.listdir(folder)]
        except OSError:
            return []

    def kill(self) -> None:
        """End it; nothing happens where it has ended."""
        if self.ended:
            return
        with suppress(ProcessLookupError):
            if self.handle is not None:
                signal.pidfd_send_signal(self.handle, signal.SIGKILL)
            else:
                os.kill(self._pid, signal.SIGKILL)

    def close(self) -> None:
        """Give the pidfd back; again: nothing happens."""
        if self.handle is not None:
            os.close(self.handle)
            self.handle = None


def _state(stat: str) -> str:
    """The state in a `stat` file; "X" of what is gone."""
    try:
        with open(stat, "rb") as file:
            return file.read().rpartition(b")")[2].split()[0].decode()
    except OSError:
        return "X"


def _work_ns(task: str) -> int:
    """Nanoseconds that a thread ran or waited to; 0 of one that is gone, or where the kernel keeps no such count."""
    try:
        with open(f"{task}/schedstat", "rb") as file:
            ran, waited, *_ = file.read().split()
    except (OSError, ValueError):
        return 0
    return int(ran) + int(waited)
