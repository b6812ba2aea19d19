"""Work that runs at the same time shares the time; the sum is the time during which anything ran."""

from contextlib import ExitStack

import pytest

from rig import shared_time
from rig.shared_time import SharedTime


def test_pieces_of_work_are_charged_their_share_of_each_moment(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(shared_time.time, "perf_counter", lambda: now[0])
    shared = SharedTime()

    def let_pass(seconds):
        now[0] += seconds

    let_pass(5.0)  # nothing runs
    with shared.charge() as alone:
        let_pass(2.0)
    counting, one, other = ExitStack(), ExitStack(), ExitStack()
    counted = counting.enter_context(shared.charge())
    let_pass(1.0)
    mapped = one.enter_context(shared.charge())
    let_pass(4.0)
    last = other.enter_context(shared.charge())
    let_pass(3.0)
    counting.close()
    let_pass(6.0)
    one.close()
    let_pass(7.0)
    other.close()
    let_pass(9.0)
    assert alone.seconds == pytest.approx(2.0)
    assert counted.seconds == pytest.approx(1 + 4 / 2 + 3 / 3)
    assert mapped.seconds == pytest.approx(4 / 2 + 3 / 3 + 6 / 2)
    assert last.seconds == pytest.approx(3 / 3 + 6 / 2 + 7)
    assert alone.seconds + counted.seconds + mapped.seconds + last.seconds == pytest.approx(2 + 1 + 4 + 3 + 6 + 7)


def test_work_that_fails_is_charged_too_and_ends():
    shared = SharedTime()
    with pytest.raises(ZeroDivisionError), shared.charge() as failed:
        raise ZeroDivisionError
    assert failed.seconds > 0.0
    assert shared._running == 0
