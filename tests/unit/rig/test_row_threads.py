import threading

import pytest

from rig.row_threads import RowWorkers


@pytest.mark.parametrize("threads", [-1, 0, 1, 2, 3, 16])
@pytest.mark.parametrize("rows", [0, 1, 2, 7, 512])
def test_every_row_is_worked_on_once(threads, rows):
    pieces = []
    with RowWorkers(threads) as workers:
        workers.over(rows, lambda first, last: pieces.append((first, last)))
    assert sorted(y for first, last in pieces for y in range(first, last)) == list(range(rows))
    assert all(last > first for first, last in pieces)
    assert len(pieces) <= max(threads, 1)


def test_the_callers_thread_takes_part():
    names = set()
    with RowWorkers(2) as workers:
        workers.over(10, lambda first, last: names.add(threading.current_thread().name))
    assert threading.current_thread().name in names
    assert len(names) == 2


@pytest.mark.parametrize("failing", [0, 5])
def test_an_error_in_any_piece_reaches_the_caller(failing):
    def work(first, last):
        if first == failing:
            raise RuntimeError("broken")

    with RowWorkers(2) as workers, pytest.raises(RuntimeError, match="broken"):
        workers.over(10, work)
