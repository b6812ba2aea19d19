"""Is another process at work? Asked of real processes."""

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from unittest.mock import mock_open

import pytest

from drivers.guard import watch as watched_process
from drivers.guard.watch import WatchedProcess, host_overloaded
from tests.wire.emulated_lasers import eventually

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="/proc is Linux's")

SPINNING = """
import threading, time
def spin():
    while True:
        pass
spinning = threading.Thread(target=spin, daemon=True)
spinning.start()
print(spinning.native_id, flush=True)
time.sleep(60)
"""
ASLEEP = "import time; print(0, flush=True); time.sleep(60)"


@contextmanager
def running(program: str) -> Iterator[tuple[int, int]]:
    """(process, number that it says)."""
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            yield process.pid, int(process.stdout.readline())
        finally:
            process.kill()


def busy_looks(watched: WatchedProcess) -> int:
    """Of 20 in a fifth of a second."""
    watched.note_progress()
    found = 0
    for _ in range(20):
        time.sleep(0.01)
        found += watched.busy()
    watched.close()
    return found


def test_a_process_that_computes_is_at_work_and_one_asleep_is_not() -> None:
    with running(SPINNING) as (pid, _):
        assert busy_looks(WatchedProcess(pid)) == 20
    with running(ASLEEP) as (pid, _):
        eventually(lambda: busy_looks(WatchedProcess(pid)) <= 2)  # it may only be about to fall asleep


def test_what_a_thread_that_wakes_by_itself_did_does_not_count_but_that_it_is_at_work_does(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """At work it may hold the interpreter for which the others wait."""
    with running(SPINNING) as (pid, thread):
        assert busy_looks(WatchedProcess(pid, thread)) == 20
        monkeypatch.setattr(watched_process, "_AT_WORK", ())
        assert busy_looks(WatchedProcess(pid)) > 10  # on a loaded machine it may get no turn between two looks
        eventually(lambda: busy_looks(WatchedProcess(pid, thread)) <= 4)


@pytest.mark.parametrize(("per_processor", "overloaded"), [(1, False), (5, False), (6, True)])
def test_a_host_is_overloaded_while_many_threads_run_or_wait(
    per_processor: int, overloaded: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    running = per_processor * (os.cpu_count() or 1)
    monkeypatch.setattr("builtins.open", mock_open(read_data=b"0.09 0.33 0.71 %d/312 4711\n" % running))
    assert host_overloaded() is overloaded
    monkeypatch.undo()
    assert host_overloaded() in (True, False)
