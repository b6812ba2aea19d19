"""The table of the largest errors that the stability tests find, printed at their end (docs/results/stability.md)."""

from collections.abc import Callable

import numpy as np
import pytest

from tests.stability.exactly import relative

Worst = Callable[[str, str, object, float], None]
Digits = Callable[..., None]
_PROPERTY = "largest error"


@pytest.fixture
def worst(record_property) -> Worst:
    """worst(what, against, errors, limit): note the largest error for the table, and hold it below the limit."""

    def note(what: str, against: str, errors: object, limit: float) -> None:
        largest = float(np.max(np.abs(np.asarray(errors, np.float64)), initial=0.0))
        record_property(_PROPERTY, [what, against, largest, limit])
        assert largest <= limit, f"{what}: {largest:.3g} off {against}, more than {limit:g}"

    return note


@pytest.fixture
def digits(worst: Worst) -> Digits:
    """digits(what, limit, values, of, *arguments): hold the relative errors of values below the limit.

    of: a function of the arguments for mpmath, evaluated with 50 digits, element by element.
    """

    def note(what: str, limit: float, values: object, of: Callable[..., object], *arguments: object) -> None:
        worst(what, "mpmath, 50 digits", relative(values, of, *arguments), limit)

    return note


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    rows: dict[str, tuple[float, str, float]] = {}
    for report in terminalreporter.getreports("passed") + terminalreporter.getreports("failed"):
        for name, value in report.user_properties:
            if name == _PROPERTY:
                what, against, largest, limit = value
                rows[what] = max(rows.get(what, (0.0, against, limit)), (largest, against, limit))
    if rows:
        terminalreporter.section("largest errors")
        terminalreporter.write_line("| what | against | largest error | limit |\n|---|---|---|---|")
        for what, (largest, against, limit) in rows.items():
            terminalreporter.write_line(f"| {what} | {against} | {largest:.1e} | {limit:.0e} |")
