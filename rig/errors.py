"""Errors of the application above the devices, each with the exit code with which the command line ends.

A message names the thing, the value, the limit and the next step. Several problems found together are one error with
one line each, so that nobody has to correct a config one key at a time.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import ClassVar, TypeVar

Item = TypeVar("Item")
Made = TypeVar("Made")


class RigError(Exception):
    """Base class of the application's errors."""

    exit_code: ClassVar[int] = 1


class UsageError(RigError):
    """Raised when the user asked for something impossible: a wrong option, config, plan or file."""

    exit_code = 2

    def __init__(self, *problems: str) -> None:
        super().__init__("\n".join(problems))
        self.problems: tuple[str, ...] = problems

    @classmethod
    def of(cls, problems: Iterable[str]) -> "UsageError":
        """One error for several problems, each on its own line and only once."""
        return cls(*dict.fromkeys(problems))


@contextmanager
def noted(problems: list[str]) -> Iterator[None]:
    """A context that a UsageError leaves without being raised; its problems are added to the list."""
    try:
        yield
    except UsageError as error:
        problems += error.problems


def each_or_problems(items: Iterable[Item], make: Callable[[Item], Made]) -> list[Made]:
    """Make something of each item. Raises UsageError with all problems of all of them."""
    made: list[Made] = []
    problems: list[str] = []
    for item in items:
        with noted(problems):
            made.append(make(item))
    if problems:
        raise UsageError.of(problems)
    return made


class PlanError(UsageError):
    """Raised when the requested scan cannot be done with this scanner, sensor or calibration."""


class DevicesError(RigError):
    """Raised when devices could not be opened, or failed while they were being stopped; one line per device."""

    exit_code = 3


class RecordingError(RigError):
    """Raised when a recording cannot be written, cut or mended. A run then ends, and what was recorded is kept."""

    exit_code = 3


class DivergedError(RigError):
    """Raised when a driver sent its device something different from the recording that is played, or at another
    time."""


class DamagedRecordingError(RigError):
    """Raised when the files of a recording are damaged. The message says what can help."""
