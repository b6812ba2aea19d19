"""The virtual clock stands still, never runs back and takes no time."""

from drivers.clock import SystemClock, VirtualClock, now_s
from drivers.replay.pace import Pace
from tests.stability.inventory import covers

covers(SystemClock, now_s, Pace.wait_for_step)


def test_the_system_clock_sleeps() -> None:
    clock = SystemClock()
    before = clock.now_ns()
    clock.sleep(0.002)
    clock.sleep(-1)
    assert clock.now_ns() - before >= 2_000_000


def test_a_virtual_day_passes_at_once_and_never_back() -> None:
    clock = VirtualClock(start_ns=5)
    clock.sleep(86_400)
    clock.sleep(-1)
    clock.advance_to_ns(50)
    assert clock.now_ns() == 86_400 * 10**9 + 5
    clock.advance_to_ns(86_401 * 10**9)
    assert clock.now_ns() == 86_401 * 10**9
    assert now_s(clock) == 86_401.0
