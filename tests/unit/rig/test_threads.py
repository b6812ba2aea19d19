import subprocess
import sys
import threading

import pytest

from rig import threads
from rig.threads import RowWorkers, StageThread, all_at_rest


@pytest.mark.parametrize("threads", [-1, 0, 1, 2, 3, 16])
@pytest.mark.parametrize("rows", [0, 1, 2, 7, 512])
def test_every_row_is_worked_on_once(threads, rows):
    pieces = []
    with RowWorkers(threads) as workers:
        workers.over(rows, lambda first, last: pieces.append((first, last)))
    assert sorted(y for first, last in pieces for y in range(first, last)) == list(range(rows))
    assert all(last > first for first, last in pieces)
    assert len(pieces) <= max(threads, 1)


def test_the_threads_share_the_work():
    names = set()
    with RowWorkers(2) as workers:
        workers.over(10, lambda first, last: names.add(threading.current_thread().name))
    assert len(names) == 2


def test_work_that_is_left_is_done_in_order_and_waited_for():
    begun, go, done = threading.Event(), threading.Event(), []

    def slow(first, last):
        begun.set()
        assert go.wait(10.0)
        done.append(("slow", first))

    with RowWorkers(2) as workers:
        workers.post(2, slow)
        workers.post(2, lambda first, last: done.append(("quick", first)))
        assert begun.wait(10.0)
        workers.settle(2)  # both may still be under way
        assert not done
        go.set()
        workers.settle(1)
        assert {("slow", 0), ("slow", 1)} <= set(done)
        workers.settle()
    for row in (0, 1):
        assert [name for name, first in done if first == row] == ["slow", "quick"]


def test_one_thread_leaves_nothing_over():
    done = []
    with RowWorkers(1) as workers:
        workers.post(3, lambda first, last: done.append((first, last)))
        assert done == [(0, 3)]
        workers.settle()


def test_work_behind_a_failure_is_not_begun_and_the_workers_go_on_afterwards():
    go, behind, done = threading.Event(), [], []

    def fail(first, last):
        assert go.wait(10.0)
        raise RuntimeError("broken")

    with RowWorkers(2) as workers:
        workers.post(2, fail)
        workers.post(2, lambda first, last: behind.append(first))
        go.set()
        with pytest.raises(RuntimeError, match="broken"):
            workers.settle()
        assert not behind
        workers.over(2, lambda first, last: done.append(first))
    assert sorted(done) == [0, 1]


@pytest.mark.parametrize("failing", [0, 5])
def test_an_error_in_any_piece_reaches_the_caller(failing):
    def work(first, last):
        if first == failing:
            raise RuntimeError("broken")

    with RowWorkers(2) as workers, pytest.raises(RuntimeError, match="broken"):
        workers.over(10, work)


def test_threads_at_work_are_known_until_they_rest():
    go = threading.Event()
    stage = StageThread(go.wait, "stage")
    assert all_at_rest(10.0)
    stage.start()
    assert not all_at_rest(0.0)
    go.set()
    assert all_at_rest(10.0)
    go.clear()
    with RowWorkers(2) as workers:
        workers.post(2, lambda first, last: go.wait(10.0))
        assert not all_at_rest(0.0)
        go.set()
        assert all_at_rest(10.0)


@pytest.mark.parametrize("start", [StageThread(print, "stage").start, lambda: RowWorkers(2)])
def test_a_thread_without_memory_to_begin_with_is_not_waited_for(start, monkeypatch):
    monkeypatch.setattr(threads, "_BEGIN_S", 0.1)
    monkeypatch.setattr(threading.Thread, "_bootstrap", lambda thread: None)  # dies before it tells that it has begun
    with pytest.raises(MemoryError, match="did not begin"):
        start()
    assert all_at_rest(10.0)


_ENDING = """
import atexit, sys, time
import rig.cli.main as cli
from rig.threads import StageThread

def run():
    while {goes_on}:
        time.sleep(0.01)
    time.sleep(0.3)
    print("stage ended", flush=True)

def app(**_):
    atexit.register(print, "interpreter ends", flush=True)
    StageThread(run, "stage").start()
    print("aborted")
    return 4

cli.app, cli._AT_REST_S, sys.argv = app, {within_s}, ["rig"]
cli.main()
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("goes_on", "within_s", "said"),
    [(False, 60.0, ["aborted", "stage ended", "interpreter ends"]), (True, 0.2, ["aborted"])],
)
def test_the_interpreter_of_a_command_never_ends_under_a_thread_at_work(goes_on, within_s, said):
    program = _ENDING.format(goes_on=goes_on, within_s=within_s)
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout.splitlines(), done.stderr) == (4, said, "")
