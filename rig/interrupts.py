"""Interrupts that wait while results are being written."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

ENDING = "SIGINT", "SIGTERM", "SIGHUP"


@contextmanager
def interrupts_ignored(when: bool = True) -> Iterator[None]:
    """A context in which signals that end a program are ignored, for the moments after a first one.

    when: whether they are at all. Outside the main thread, which alone gets signals, the context does nothing.
    """
    if not when or threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = [getattr(signal, name) for name in ENDING if hasattr(signal, name)]
    before = {number: handler for number in numbers if (handler := signal.getsignal(number)) is not None}
    try:
        for number in before:
            signal.signal(number, signal.SIG_IGN)
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
