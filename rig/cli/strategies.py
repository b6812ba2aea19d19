"""Tables of `rig tradeoff --strategies` for a terminal."""

from typing import TYPE_CHECKING

from rich.table import Table

from rig.cli.command import tell
from rig.cli.tables import console

if TYPE_CHECKING:
    from rig.strategies.comparison.compare import Comparison
    from rig.strategies.comparison.tables import FiguresTable


def strategies_tables(done: "Comparison") -> None:
    """Print a comparison to stdout: a table for each scene, air and rule, then ranges, laser classes and times."""
    from rig.strategies.comparison.tables import (
        FIGURES_NOTE,
        figures_tables,
        ranges_table,
        sources_table,
        too_short_lines,
    )

    for table in figures_tables(done.rows):
        _print(table, left=1)
    tell("\n".join((FIGURES_NOTE, *too_short_lines(done.rows))) + "\n")
    if (found := ranges_table(done.rows)) is not None:
        _print(found, left=1)
    _print(sources_table(done.rows, done.seconds), left=4)
    for note in done.notes:
        tell(note)
    if done.folder is not None:
        tell(f"files: {done.folder}")


def _print(shown: "FiguresTable", left: int) -> None:
    """Print a table; its first `left` columns are aligned left."""
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0))
    for i, heading in enumerate(shown.head):
        table.add_column(heading, justify="left" if i < left else "right", no_wrap=i > 0)
    for line in shown.lines:
        table.add_row(*line)
    console().print(shown.title, style="bold", markup=False)
    console().print(table)
    tell()
