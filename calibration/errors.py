"""The errors of this package, and numbers in messages and tables: as many digits as are known, never a power of ten."""

import numpy as np


class CalibrationError(ValueError):
    """A rig model that cannot be used; in one line the thing, the value, the limit and the next step."""


class Degenerate(CalibrationError):  # noqa: N818, the input is, not the program
    """Input from which no model follows. `reason` is for machines: one of the words of the verdict, as 'one-pose'."""

    def __init__(self, reason: str, message: str) -> None:
        """Take the reason, and the message: what is wrong, its value and limit, the condition number, the next step."""
        super().__init__(message)
        self.reason = reason


class FileError(CalibrationError):
    """A file that cannot be used. `problems` are all that is wrong with it, a line each; the message has the first."""

    MOST_TOLD = 5

    def __init__(self, *problems: str) -> None:
        """Take the lines, each of which names the file."""
        more = f"; and {len(problems) - self.MOST_TOLD} more" if len(problems) > self.MOST_TOLD else ""
        super().__init__("; ".join(problems[: self.MOST_TOLD]) + more)
        self.problems = problems


def digits(value: float, count: int = 3) -> str:
    """A number with so many digits that count: 1234.5 is '1230', 0.000012345 is '0.0000123'; '-' for nan."""
    if not np.isfinite(value):
        return "-" if np.isnan(value) else f"{value:g}"
    value = value + 0.0  # -0 is 0
    return np.format_float_positional(value, precision=count, unique=False, fractional=False, trim="-")


def condition_text(condition: float) -> str:
    """A condition number, which matters by its powers of ten: '3.1e+07'; 'inf' where nothing is determined."""
    return f"{condition:.1e}" if np.isfinite(condition) else "inf"


def in_mm(length_m: float) -> str:
    """A length in millimetres, for a table whose head says so."""
    return digits(1e3 * length_m)


def mm(length_m: float) -> str:
    """A length in a text, in millimetres."""
    return f"{in_mm(length_m)} mm"
