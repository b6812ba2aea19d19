"""Errors of the application, each with the exit code that the command line returns for it.

A message names the thing, the value, the limit and the next step. Problems found together become one error with a line
for each, so that nobody has to correct a config one key at a time. Errors of a single device are in `drivers.errors`.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from difflib import get_close_matches
from pathlib import Path
from typing import ClassVar, TypeVar

Item = TypeVar("Item")
Made = TypeVar("Made")


class RigError(Exception):
    """Base class of the application's errors."""

    exit_code: ClassVar[int] = 1


class UsageError(RigError):
    """Raised for a request that cannot be met: a wrong option, config, plan or file."""

    exit_code = 2

    def __init__(self, *problems: str) -> None:
        super().__init__("\n".join(problems))
        self.problems: tuple[str, ...] = problems

    @classmethod
    def of(cls, problems: Iterable[str]) -> "UsageError":
        """Make one error of several problems: a line for each, without duplicates."""
        return cls(*dict.fromkeys(problems))


@contextmanager
def noted(problems: list[str]) -> Iterator[None]:
    """A context that catches a UsageError and adds the error's problems to the list."""
    try:
        yield
    except UsageError as error:
        problems += error.problems


def each_or_problems(items: Iterable[Item], make: Callable[[Item], Made]) -> list[Made]:
    """Call `make` on each item and list the results. Raises one UsageError with the problems of all items."""
    made: list[Made] = []
    problems: list[str] = []
    for item in items:
        with noted(problems):
            made.append(make(item))
    if problems:
        raise UsageError.of(problems)
    return made


def absent(path: Path, step: str, among: Callable[[Path], bool] = lambda _: True) -> str:
    """Say that a path does not exist, which path beside it has a similar name, and what to do: `step`.

    among: whether a path beside it is of the right kind.
    """
    similar = similar_beside(path, among)
    meant = "" if similar is None else f"did you mean '{similar}'? "
    return f"{path} does not exist; {meant}{step}"


def similar_beside(path: Path, among: Callable[[Path], bool]) -> Path | None:
    """The path beside another one that has the most similar name; None if there is none of the right kind, `among`.
    Hidden ones do not count."""
    try:
        names = [each.name for each in path.parent.iterdir() if not each.name.startswith(".")]
    except OSError:
        return None
    close = get_close_matches(path.name, names, n=5)
    similar = map(path.with_name, close)
    return next((each for each in similar if each.exists() and among(each)), None)


class PlanError(UsageError):
    """Raised when the requested scan cannot be done with this scanner, sensor or calibration."""


class DevicesError(RigError):
    """Raised when devices could not be opened, or failed while they were being stopped; one line per device."""

    exit_code = 3


class RecordingError(RigError):
    """Raised when a recording cannot be written, cut or repaired. A scan then ends; what was recorded is kept."""

    exit_code = 3


class DivergedError(RigError):
    """Raised after a replay in which a driver sent its device something other than what was recorded, or at another
    time."""


class DamagedRecordingError(RigError):
    """Raised when the files of a recording are damaged. The message says what can help, if anything is known."""
