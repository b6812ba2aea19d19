"""The virtual clock stands still, never runs back and takes no time; ticks become nanoseconds without drift."""

import threading
from fractions import Fraction

from drivers.clock import Clock, SystemClock, VirtualClock, ticks_to_ns


def test_both_clocks_are_clocks() -> None:
    assert isinstance(SystemClock(), Clock)
    assert isinstance(VirtualClock(), Clock)


def test_the_system_clock_sleeps() -> None:
    clock = SystemClock()
    before = clock.now_ns()
    clock.sleep(0.002)
    clock.sleep(-1)
    assert clock.now_ns() - before >= 2_000_000


def test_a_virtual_day_passes_at_once() -> None:
    clock = VirtualClock(start_ns=5)
    clock.sleep(86_400)
    assert clock.now_ns() == 86_400 * 10**9 + 5


def test_a_virtual_clock_never_runs_back() -> None:
    clock = VirtualClock(start_ns=100)
    clock.advance_to_ns(50)
    clock.sleep(-1)
    assert clock.now_ns() == 100
    clock.advance_to_ns(200)
    assert clock.now_ns() == 200


def test_threads_that_sleep_on_a_virtual_clock_add_up() -> None:
    clock = VirtualClock()

    def doze() -> None:
        for _ in range(2000):
            clock.sleep(1e-9)

    threads = [threading.Thread(target=doze) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert clock.now_ns() == 8000


def test_ticks_become_nanoseconds_without_drift_over_years() -> None:
    tick_hz = Fraction(97_700)
    assert ticks_to_ns(97_700 * 10**9, tick_hz) == 10**18
    assert ticks_to_ns(1, tick_hz) == 10235
    assert ticks_to_ns(3, Fraction(100_000_000, 3)) == 90
