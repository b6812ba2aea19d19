"""The errors of this package, and text for messages: numbers with few digits and, except for condition numbers, without
powers of ten; text that a terminal can show."""

import numpy as np


def plain_text(text: str) -> str:
    """Text from a file, for a message of one line: characters that cannot be printed, such as line breaks and those
    that command a terminal, are shown as their escapes."""
    return text if text.isprintable() else "".join(each if each.isprintable() else repr(each)[1:-1] for each in text)


class CalibrationError(ValueError):
    """Raised for input that cannot be used. Its text is one line: what is wrong and, if possible, value, limit and next
    step."""


class Degenerate(CalibrationError):  # noqa: N818, the input is, not the program
    """Raised for input from which no model follows. reason: a code for programs, such as 'one-pose'."""

    def __init__(self, reason: str, message: str) -> None:
        """Take the reason, and the message as in `CalibrationError`."""
        super().__init__(message)
        self.reason = reason


class FileError(CalibrationError):
    """Raised for a file that cannot be used. `problems`: one line each; the message has the first MOST_TOLD."""

    MOST_TOLD = 5

    def __init__(self, *problems: str) -> None:
        """Take the problems. Each is one line that names the file or the option."""
        more = f"; and {len(problems) - self.MOST_TOLD} more" if len(problems) > self.MOST_TOLD else ""
        super().__init__("; ".join(problems[: self.MOST_TOLD]) + more)
        self.problems = problems


def digits(value: float, count: int = 3) -> str:
    """A number rounded to `count` significant digits: 1234.5 is '1230', 0.000012345 is '0.0000123'; '-' for NaN, 'inf'
    for infinity."""
    if not np.isfinite(value):
        return "-" if np.isnan(value) else f"{value:g}"
    value = value + 0.0  # -0 is 0
    return np.format_float_positional(value, precision=count, unique=False, fractional=False, trim="-")


def condition_text(condition: float) -> str:
    """The text of a condition number with two digits and a power of ten, such as '3.1e+07'; 'inf' if it is not
    finite."""
    return f"{condition:.1e}" if np.isfinite(condition) else "inf"


def in_mm(length_m: float) -> str:
    """A length in millimetres without the unit, for a table whose head gives it."""
    return digits(1e3 * length_m)


def mm(length_m: float) -> str:
    """A length in millimetres with the unit, for a text."""
    return f"{in_mm(length_m)} mm"
