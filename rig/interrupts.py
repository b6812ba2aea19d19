"""Interrupts that do not get in the way of an orderly end: the first ends the work, later ones are ignored."""

import signal
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from contextvars import ContextVar

ENDING = "SIGTERM", "SIGHUP", "SIGBREAK"
"""Signals that end a program, besides Ctrl-C; no system has all of them."""
_at_end: ContextVar[ExitStack | None] = ContextVar("_at_end", default=None)
"""Callbacks of the outermost `one_interrupt`, which give the signals back at its end."""


@contextmanager
def one_interrupt() -> Iterator[None]:
    """A context for work that an interrupt ends in order. The work calls `ignore_interrupts` once it has been
    interrupted.

    From then until the outermost of nested contexts ends, further interrupts are ignored, so that results can still be
    written: the command `timeout` sends its signal twice, and impatient people press Ctrl-C again.
    """
    if _at_end.get() is not None:
        yield
        return
    with ExitStack() as at_end:
        token = _at_end.set(at_end)
        try:
            yield
        finally:
            _at_end.reset(token)


def ignore_interrupts() -> None:
    """Ignore Ctrl-C and the signals ENDING from now to the end of the outermost `one_interrupt`, or, if there is none,
    of the program.

    Outside the main thread, which alone gets signals, nothing changes.
    """
    if threading.current_thread() is not threading.main_thread():
        return
    at_end = _at_end.get()
    for name in ("SIGINT", *ENDING):
        number = getattr(signal, name, None)
        if number is None or (before := signal.getsignal(number)) is None:  # set by something other than Python
            continue
        if at_end is not None:
            at_end.callback(signal.signal, number, before)
        signal.signal(number, signal.SIG_IGN)
