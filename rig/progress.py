"""Progress of a command: named stages, with a count where one is known, told to whoever listens.

It goes the way of a log: from where the work is done to the listener of the calling thread, if there is one, without
being handed down through calls.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass

Progress = Callable[[int, int], None]
"""A callback that gets what is done and what there is to do, in frames, maps or rows, now and then."""


PREPARING = "preparing"
"""The stage before anything else is told."""


@dataclass(frozen=True, slots=True)
class Step:
    """One moment of a command.

    total: None where the number is not known; otherwise `done` is never more.
    unit: of the counts, in the plural.
    note: anything else to say.
    part: piece of the whole that the stage belongs to, such as 'pose 3 of 12'.
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
    """Say which stage the work of this thread is at."""
    listener = _listener.get()
    if listener is not None:
        listener(Step(stage, done if total is None else min(done, total), total, unit, note, _part.get()))


def counted(stage: str, unit: str, progress: Progress | None = None) -> Progress:
    """A callback that reports the counts it gets as progress of this stage, and passes them on to `progress`."""

    def count(done: int, total: int) -> None:
        tell_stage(stage, done, total, unit)
        if progress is not None:
            progress(min(done, total), total)

    return count


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Within the context, `listener` hears all that is told on this thread."""
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)


@contextmanager
def part(name: str) -> Iterator[None]:
    """Within the context, everything told belongs to this part of the whole. It begins with the stage PREPARING."""
    token = _part.set(name)
    tell_stage(PREPARING)
    try:
        yield
    finally:
        _part.reset(token)
