"""Decides whether an application that should be taking frames still does, and inspects its process from outside.

A single deadline on frames would either leave the laser on too long or trip on a busy machine. So there are two: a
short one for an application whose threads are all asleep, and a longer one for an application that works or waits for a
processor or a disk. Work does not count when the source thread reports that the SPAD gives no frames. If the guard
itself was held up, only a short step of that time counts: what stops the guard may have stopped the application too.

The state of a process comes from /proc (proc(5), the fields of `stat`; Documentation/scheduler/sched-stats.rst of
Linux, the first two numbers of `schedstat`: nanoseconds on a processor and waiting for one) and from a pidfd, which is
a file descriptor for a process. It always names the same process and reports its end at once, even if a child that it
forked still holds its sockets open.
"""

import os
import select
import signal
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

TICK_S = 0.01
"""Time from one look to the next."""
MAX_STEP_S = 0.03
"""Longest time that one look adds to a silence, however late it comes."""


@dataclass(frozen=True, slots=True)
class GuardLimits:
    """Longest times without a new frame number while the gate may open. The light is off within 50 ms after that.

    The defaults suit a stream with several blocks in 10 ms. A burst, which sends nothing until it is read out, and
    blocks that take longer need more: three times the time between two blocks.
    """

    frames_within_s: float = 0.05
    """Limit for an application that sleeps. Two looks confirm it (20 ms), the gate takes 30 ms: 100 ms in all."""
    busy_within_s: float = 1.5
    """Limit for an application that computes or waits for a processor or a disk. Under load, threads wake up to 0.35 s
    late and disks stall for a second; neither may end a scan. No spot is burnt meanwhile: each sweep waits, with the
    gate low, for a scan marker, so that light is out only while the mirror moves."""
    waits_within_s: float = 0.04
    """If the source thread reports no frames from the SPAD for longer, work is no excuse: `frames_within_s` holds."""
    first_wait_s: float = 0.3
    """Limit in place of `waits_within_s` before the first frame."""
    first_frame_s: float = 1.0
    """Time from `run` to the first frame: SPAD, scanner and the scan marker come in between. An application at work
    gets `busy_within_s` on top, since devices that start and a machine with too much to do may come together."""
    check_s: float = 0.05
    """Time for the gate to say whether its program has ended. After that the program counts as running."""
    help_itself_s: float = 0.5
    """Time for an application that lives but takes no frames to make its rig safe, before it is killed."""


class FrameWatch:
    """Decides whether frames come as they should, between `start` and `stop`. The caller passes in observations and
    times.
    """

    def __init__(self, limits: GuardLimits) -> None:
        self.limits = limits
        self.watching = False
        """Whether frames are expected."""
        self.last = 0
        """The last frame number seen."""
        self._begun = False
        self._silent_s = 0.0

    @property
    def quiet(self) -> bool:
        """Whether the next frame is later than allowed for an application that sleeps."""
        return self.watching and self._begun and self._silent_s > self.limits.frames_within_s

    def start(self, frame: int) -> None:
        """Note that the gate may open from now on; `frame` is the last number reported before."""
        self.last, self._begun, self._silent_s, self.watching = frame, False, 0.0, True

    def stop(self) -> None:
        """Note that the gate is low."""
        self.watching = False

    def look(
        self, elapsed_s: float, frame: int, stopped: bool, busy: Callable[[], bool], waited_s: float = 0.0
    ) -> str | None:
        """Judge the application, `elapsed_s` after the last look; returns the fault as text that follows "the
        application", or None.

        stopped: whether the process is stopped while the laser may shine. busy: tells whether the process is at work;
        called only in doubt, since it has to look at every thread. waited_s: for how long the source thread has been
        asking the SPAD for frames without getting any.
        """
        if stopped:
            return "is stopped"
        if not self.watching:
            return None
        if frame != self.last:
            self.last, self._begun, self._silent_s = frame, True, 0.0
            return None
        self._silent_s += min(elapsed_s, MAX_STEP_S)
        limits = self.limits
        in_vain = waited_s > (limits.waits_within_s if self._begun else limits.first_wait_s)
        patience_s = limits.frames_within_s if self._begun or in_vain else limits.first_frame_s
        if self._silent_s <= patience_s:
            return None
        if in_vain:
            return f"waited for the SPAD in vain for {self._silent_s * 1e3:.0f} ms after frame {frame}"
        excused_s = limits.busy_within_s if self._begun else limits.first_frame_s + limits.busy_within_s
        if self._silent_s <= excused_s and busy():
            return None
        return f"took no frame for {self._silent_s * 1e3:.0f} ms after frame {frame}"


_AT_WORK = ("R", "D")
"""States of a thread at work: running or waiting for a processor; waiting for a disk."""
_BUSY_SHARE = 0.15
"""A process is at work if its threads together ran, or waited for a processor, for more than this share of the time. A
process that hangs still wakes some service thread for microseconds now and then."""


class WatchedProcess:
    """Another process of the same user, seen from outside. `close` closes the pidfd.

    idle_thread: number of a thread that wakes up regularly by itself. On an overloaded machine it waits for a processor
    each time. Its time is not counted as work. But while it runs or waits for a processor, the process does not count
    as asleep, since other threads may wait for the interpreter's lock, which it holds. None: there is no such thread.
    """

    def __init__(self, pid: int, idle_thread: int | None = None) -> None:
        self._pid = pid
        self._idle_task = f"/proc/{pid}/task/{idle_thread}"
        self._ended = False
        self._worked_ns: dict[str, int] = {}
        self._since = 0.0
        self._found_asleep = False
        self.handle: int | None = None
        """Handle that is readable once the process has ended; None if there is no pidfd (before Linux 5.3)."""
        if hasattr(os, "pidfd_open"):
            try:
                self.handle = os.pidfd_open(pid)
            except OSError as error:
                self._ended = isinstance(error, ProcessLookupError)

    @property
    def ended(self) -> bool:
        """Whether the process has ended. Without a pidfd its end is not noticed."""
        if not self._ended and self.handle is not None:
            ready = select.poll()
            ready.register(self.handle, select.POLLIN)
            self._ended = bool(ready.poll(0))
        return self._ended

    @property
    def stopped(self) -> bool:
        """Whether the process is stopped by a signal or a debugger."""
        return _state(f"/proc/{self._pid}/stat") in ("T", "t")

    def note_progress(self) -> None:
        """Count work from now on: `busy` judges the time since this call."""
        self._worked_ns = {task: _work_ns(task) for task in self._tasks()}
        self._since = time.monotonic()
        self._found_asleep = False

    def busy(self) -> bool:
        """Whether the process's threads worked for a good part of the time since `note_progress`, or now run or wait
        for a processor or a disk.

        The answer is False only if this call and the one before both find the process asleep: threads are looked at one
        after the other, and work may pass from a thread not yet looked at to one that already was.
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
        """Kill the process by SIGKILL. Does nothing if it has ended."""
        if self.ended:
            return
        with suppress(ProcessLookupError):
            if self.handle is not None:
                signal.pidfd_send_signal(self.handle, signal.SIGKILL)
            else:
                os.kill(self._pid, signal.SIGKILL)

    def close(self) -> None:
        """Give the pidfd back; a second call does nothing."""
        if self.handle is not None:
            os.close(self.handle)
            self.handle = None


def _state(stat: str) -> str:
    """The state in a `stat` file; "X" for a process or thread that is gone."""
    try:
        with open(stat, "rb") as file:
            return file.read().rpartition(b")")[2].split()[0].decode()
    except OSError:
        return "X"


def _work_ns(task: str) -> int:
    """Nanoseconds for which a thread ran or waited to run; 0 if it is gone, or the kernel keeps no such count."""
    try:
        with open(f"{task}/schedstat", "rb") as file:
            ran, waited, *_ = file.read().split()
    except (OSError, ValueError):
        return 0
    return int(ran) + int(waited)


BUSY_THREADS = 5
"""A host is overloaded while more threads than this run or wait for each of its processors."""


def host_overloaded() -> bool:
    """Whether this host is overloaded now. Many threads that wake at once look like that for some milliseconds."""
    with open("/proc/loadavg", "rb") as file:
        running = int(file.read().split()[3].partition(b"/")[0])
    return running > BUSY_THREADS * (os.cpu_count() or 1)
