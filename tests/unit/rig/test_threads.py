import threading

import pytest

from rig.threads import RowWorkers


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
