"""The result of a calibration for people at a terminal."""

from pathlib import Path
from typing import Protocol

from rich.table import Table

from calibration.verdict import Verdict
from rig.report_text import console


class Printable(Protocol):
    """A result of any of the calibrate commands."""

    @property
    def verdict(self) -> Verdict:
        """Whether it may be used."""
        ...

    @property
    def folder(self) -> Path | None:
        """Where everything was written."""
        ...

    @property
    def calibration(self) -> Path | None:
        """The calibration's file."""
        ...

    def rows(self) -> list[tuple[str, str]]:
        """Figures by name."""
        ...


def print_result(result: Printable, line: str = "") -> None:
    """The verdict and its reasons, the one line, the figures and the files, to stdout."""
    table = Table.grid(padding=(0, 2))
    table.add_column(style="bold")
    table.add_column()
    table.add_row("verdict", "passed" if result.verdict.passed else "failed")
    for reason in result.verdict.reasons:
        table.add_row("", str(reason))
    if line:
        table.add_row("in short", line)
    for name, text in result.rows():
        table.add_row(name, text)
    if result.calibration is not None:
        table.add_row("calibration", str(result.calibration))
    if result.folder is not None:
        table.add_row("report", str(result.folder / "report.html"))
    console().print(table)
