"""Measures computing time without the time in which numba compiles, which only the first use of a kernel takes."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def computing() -> Iterator[Callable[[], float]]:
    """A context with a function that tells its wall time so far in seconds.

    Time in which any thread compiles a kernel is left out, that in which compiled kernels are read from the disk is
    not.
    """
    from numba.core import event

    begun_s = time.perf_counter()
    compiling, since_s, compiled_s = 0, 0.0, 0.0

    class Watch(event.Listener):
        def on_start(self, event: Any) -> None:
            nonlocal compiling, since_s
            if compiling == 0:
                since_s = time.perf_counter()
            compiling += 1

        def on_end(self, event: Any) -> None:
            nonlocal compiling, compiled_s
            compiling -= 1  # kernels that are compiled for another one lie within its time
            if compiling == 0:
                compiled_s += time.perf_counter() - since_s

    with event.install_listener("numba:compile", Watch()):
        yield lambda: time.perf_counter() - begun_s - compiled_s
