"""Progress of a command: named stages, with counts where they are known.

It works like logging: `tell_stage` reports to the listener of the calling thread, if there is one, so no callback needs
to be passed down through calls.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass

Progress = Callable[[int, int], None]
"""A callback that is called now and then with what is done and the total, in frames, maps or rows."""


PREPARING = "preparing"
"""The first stage, before any other is reported."""


@dataclass(frozen=True, slots=True)
class Step:
    """A report of progress.

    total: None if it is not known; otherwise `done` never exceeds it.
    unit: the unit of `done` and `total`, in the plural.
    note: further text.
    part: the part of the command that the stage belongs to, such as 'pose 3 of 12'.
    """

    stage: str
    done: int = 0
    total: int | None = None
    unit: str = ""
    note: str = ""
    part: str = ""


Listener = Callable[[Step], None]

_listener: ContextVar[Listener | None] = ContextVar("listener", default=None)
_part: ContextVar[str] = ContextVar("part", default="")


def tell_stage(stage: str, done: int = 0, total: int | None = None, unit: str = "", note: str = "") -> None:
    """Report the present stage of this thread's work to its listener; does nothing without one."""
    listener = _listener.get()
    if listener is not None:
        listener(Step(stage, done if total is None else min(done, total), total, unit, note, _part.get()))


def counted(stage: str, unit: str, progress: Progress | None = None) -> Progress:
    """A callback that reports its counts as progress of this stage, and passes them on to `progress`. Both get at most
    the total as what is done."""

    def count(done: int, total: int) -> None:
        tell_stage(stage, done, total, unit)
        if progress is not None:
            progress(min(done, total), total)

    return count


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """A context in which `listener` gets all reports of this thread."""
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)


@contextmanager
def part(name: str) -> Iterator[None]:
    """A context in which all reports of this thread carry the name of this part. It begins with a report of the stage
    PREPARING."""
    token = _part.set(name)
    tell_stage(PREPARING)
    try:
        yield
    finally:
        _part.reset(token)
