"""Tables with a column for each run, and values of summaries and manifests, which may hold anything."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from calibration.errors import digits
from rig.report.page import table
from rig.report.run_facts import RunFacts

Cell = Callable[[RunFacts], str]
"""Makes the text of a table's cell for a run; '-' if the run does not say."""


def compared(runs: Sequence[RunFacts], rows: Sequence[tuple[str, Cell]]) -> str:
    """An HTML table with a column for each run; rows on which no run says anything are left out."""
    shown = [(words, *(cell(run) for run in runs)) for words, cell in rows]
    head = ("", *(run.name for run in runs)) if len(runs) > 1 else ("", "")
    return table(head, [row for row in shown if any(text not in ("-", "- x -", "- of -") for text in row[1:])])


def figure(run: RunFacts, path: str, form: Callable[[Any], str] | None = None) -> str:
    """A value of the summary as text; '-' if there is none. path: the value's keys, joined by dots.

    form: makes the text of a number; values that are no numbers then give '-'.
    """
    value = value_at(run.summary, path)
    if value is None:
        return "-"
    if form is None:
        return str(value)
    known = as_number(value)
    return "-" if known is None else form(known)


def value_at(content: Mapping[str, Any], path: str) -> Any:
    """A value of nested mappings by its keys, joined by dots; None if one is missing."""
    value: Any = content
    for key in path.split("."):
        value = value.get(key) if isinstance(value, Mapping) else None
    return value


def as_number(value: object) -> float | None:
    """The value as a float if it is a number; None for anything else, True and False included."""
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def as_whole(value: object) -> int | None:
    """The value if it is a whole number; None for anything else, True and False included."""
    return value if isinstance(value, int) and not isinstance(value, bool) else None


def seconds(value: float) -> str:
    """A time in seconds with its unit."""
    return f"{digits(value)} s"


def part_of(run: RunFacts, part: str, whole: str) -> str:
    """Two values of the summary as 'PART of WHOLE'."""
    return f"{figure(run, part)} of {figure(run, whole)}"
