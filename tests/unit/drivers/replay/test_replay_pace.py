import threading
import time
from fractions import Fraction

import pytest

from drivers.clock import VirtualClock
from drivers.replay.pace import Pace, ReplayClock


def pace(text: str, clock: VirtualClock | None = None) -> Pace:
    made = Pace(ReplayClock.parse(text), clock or VirtualClock())
    made.start()
    return made


@pytest.mark.parametrize("text", ["", "fast", "4x", "x", "x0", "x-1", "xnan", "x1e3", "x100000", "Realtime"])
def test_a_clock_that_is_none_is_refused_with_those_there_are(text: str) -> None:
    with pytest.raises(ValueError, match="realtime, max, step, or x"):
        ReplayClock.parse(text)


@pytest.mark.parametrize(("text", "taken_s"), [("realtime", 0.5), ("x4", 0.125), ("x0.1", 5.0), ("max", 0.0)])
def test_frames_come_when_they_are_due(text: str, taken_s: float) -> None:
    clock = VirtualClock()
    held = pace(text, clock)
    assert held.wait(0.5, 100.0)
    assert clock.now_ns() / 1e9 == pytest.approx(taken_s)
    assert held.report.late_max_s == pytest.approx(0, abs=1e-9)
    if text == "realtime":
        assert not held.wait(10.0, 1.0)  # not due within the time
        assert clock.now_ns() / 1e9 == pytest.approx(1.5, abs=0.03)


def test_lateness_is_reported() -> None:
    clock = VirtualClock()
    held = pace("realtime", clock)
    for due_s, late_s in ((1.0, 0.0), (2.0, 0.003), (3.0, 0.006)):
        clock.advance_to_ns(round((due_s + late_s) * 1e9))
        assert held.wait(due_s, 1.0)
    report = held.report
    assert report.blocks == 3
    assert report.late_mean_s == pytest.approx(0.003)
    assert report.late_max_s == pytest.approx(0.006)
    assert report.late_sd_s == pytest.approx(0.006 / 6**0.5)


def test_time_in_which_the_ring_was_full_moves_the_clock_on() -> None:
    clock = VirtualClock()
    held = pace("x2", clock)
    clock.advance_to_ns(3_000_000_000)
    held.hold(2.0, waited_s=1.5)  # due after 1 s, of 2 s too late 1.5 s for want of a slot
    assert held.wait(2.0, 1.0)
    assert held.report.held_s == pytest.approx(1.5)
    assert held.report.late_max_s == pytest.approx(0.5)
    assert held.wait(10.0, 10.0)
    assert clock.now_ns() / 1e9 == pytest.approx(5.0 + 1.5)


def test_at_a_slow_clock_blocks_are_cut_so_that_one_comes_every_now_and_then() -> None:
    period_s = Fraction(1, 100_000)
    assert pace("x0.001").most_frames(period_s) == pytest.approx(20)
    assert pace("x0.0001").most_frames(Fraction(1, 1000)) == 1
    assert pace("max").most_frames(period_s) > 1e9


def test_a_step_lets_one_wait_pass_running_on_all_and_a_halt_ends_them() -> None:
    steps = pace("step")
    assert not steps.wait_for_step(0.0)
    steps.step()
    assert [steps.wait_for_step(0.0) for _ in range(2)] == [True, False]
    threading.Timer(0.05, steps.halt).start()
    begun_s = time.monotonic()
    assert not steps.wait_for_step(600.0)
    assert time.monotonic() - begun_s < 60
    assert not steps.wait(0.0, 1.0)
    steps.start()
    steps.run_on()
    assert [steps.wait_for_step(0.0) for _ in range(2)] == [True, True]
