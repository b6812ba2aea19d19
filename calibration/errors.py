"""The errors of this package."""


class CalibrationError(ValueError):
    """A rig model that cannot be used: unreadable, inconsistent, for another sensor, or asked outside its range.

    The message is one line that names the thing, the value, the limit and the next step.
    """


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
