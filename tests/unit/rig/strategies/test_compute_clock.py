"""Computing time leaves out the time in which numba compiles."""

import numba
import pytest
from numba.core import event

from rig.strategies.comparison import compute_clock as module
from rig.strategies.comparison.compute_clock import computing
from tests.stability.inventory import covers

covers(computing)


class Clock:
    """A clock that is set by hand."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def perf_counter(self) -> float:
        """The time that was set."""
        return self.now_s


def test_compiling_is_left_out_once_however_many_kernels_another_one_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    monkeypatch.setattr(module, "time", clock)
    with computing() as computed_s:
        clock.now_s += 1.0
        with event.trigger_event("numba:compile", data={}):
            clock.now_s += 10.0
            with event.trigger_event("numba:compile", data={}):
                clock.now_s += 20.0
        clock.now_s += 2.0
        assert computed_s() == 3.0
        with event.trigger_event("numba:compile", data={}):
            clock.now_s += 5.0
        assert computed_s() == 3.0


def test_a_kernel_that_is_compiled_takes_next_to_no_computing_time() -> None:
    @numba.njit
    def triangle(n: int) -> int:
        total = 0
        for i in range(n):
            total += i
        return total

    with computing() as computed_s:
        assert triangle(4) == 6
        first_s = computed_s()
    compile_s = triangle.get_metadata(triangle.signatures[0])["timers"]["compiler_lock"]
    assert 0 <= first_s < compile_s
