"""Errors of the application above the devices, each with the exit code that the command line ends with.

A message names the thing, the value, the limit and the next step. Several problems found together are one error with
one line each, so that nobody repairs a config one key at a time.
"""

from collections.abc import Iterable
from typing import ClassVar


class RigError(Exception):
    """Root of the application's errors."""

    exit_code: ClassVar[int] = 1


class UsageError(RigError):
    """The user asked for something that cannot be: a wrong option, config, plan or file."""

    exit_code = 2

    def __init__(self, *problems: str) -> None:
        super().__init__("\n".join(problems))
        self.problems: tuple[str, ...] = problems

    @classmethod
    def of(cls, problems: Iterable[str]) -> "UsageError":
        """One error for several problems, each on its own line, repeated ones once."""
        return cls(*dict.fromkeys(problems))


class PlanError(UsageError):
    """The scan that was asked for cannot be done with this scanner, sensor or calibration."""


class DevicesError(RigError):
    """One or more devices could not be opened, or failed while they were being stopped; one line per device."""

    exit_code = 3


class RecordingError(RigError):
    """The recording that was asked for cannot be written; the run ends, and what was recorded is kept."""

    exit_code = 3


class DivergedError(RigError):
    """A driver sent its device something else than in the recording that is played, or sent it at another time."""


class DamagedRecordingError(RigError):
    """The files of a recording are not what was recorded; nothing is made of them before 'rig repair'."""
