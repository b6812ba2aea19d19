"""Tables of `rig tradeoff --strategies` for a terminal."""

from typing import TYPE_CHECKING

from rich.table import Table

from calibration.errors import digits
from rig.cli.command import tell
from rig.cli.tables import console

if TYPE_CHECKING:
    from rig.strategies.comparison.compare import Comparison, StrategyRow


def strategies_tables(done: "Comparison") -> None:
    """Print a comparison to stdout: a table for each scene, air and rule, then ranges, laser classes and times."""
    for scene, air, rule in dict.fromkeys((row.scene, row.air, row.rule) for row in done.rows):
        rows = [row for row in done.rows if (row.scene, row.air, row.rule) == (scene, air, rule)]
        named = scene if air is None else f"{scene}, {_air(air)}"
        _print(f"{named}, equal {rule}", rows)
    tell("Mean error in px, pixels within 2 % of the depth in %, confident wrong ones in %.")
    tell("A missing answer counts as 10 px. -: cannot measure in so short a time.\n")
    _print_ranges(done)
    _print_sources(done)
    for note in done.notes:
        tell(note)
    if done.folder is not None:
        tell(f"files: {done.folder}")


def _print(title: str, rows: "list[StrategyRow]") -> None:
    times = sorted({row.time_ms for row in rows})
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0))
    table.add_column("")
    for time_ms in times:
        table.add_column(f"{time_ms:g} ms", justify="right", no_wrap=True)
    found = {(row.strategy, row.time_ms): row for row in rows}
    for name in dict.fromkeys(row.strategy for row in rows):
        cells = (found.get((name, time_ms)) for time_ms in times)
        table.add_row(name, *("" if row is None else _figures(row) for row in cells))
    console().print(title, style="bold", markup=False)
    console().print(table)
    tell()


def _figures(row: "StrategyRow") -> str:
    if row.mean_px is None or row.good is None or row.confident_wrong is None:
        return "-"
    return f"{row.mean_px:.3f} {100 * row.good:.0f} {100 * row.confident_wrong:.1f}"


def _print_ranges(done: "Comparison") -> None:
    from rig.strategies.comparison.compare import ranges
    from rig.strategies.comparison.places import RAMP

    found = ranges(done.rows, RAMP)
    if not found:
        return
    airs = list(dict.fromkeys(air for of in found.values() for air in of))
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0))
    for heading in ("", "ms", "equal"):
        table.add_column(heading)
    for air in airs:
        table.add_column(_air(air), justify="right", no_wrap=True)
    for (name, time_ms, rule), of in found.items():
        if any(of.values()):
            table.add_row(name, f"{time_ms:g}", rule, *("-" if of.get(a) is None else f"{of[a]:.1f}" for a in airs))
    console().print("Range in m: 90 % of the pixels at this depth are within 2 %", style="bold", markup=False)
    console().print(table)
    tell()


def _print_sources(done: "Comparison") -> None:
    """Laser classes, for the longest time and the first rule, and seconds of the computer by scene."""
    scenes = list(dict.fromkeys(row.scene for row in done.rows))
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0))
    for heading in ("", "lights", "laser class", "if it stands", *(f"s, {scene}" for scene in scenes)):
        table.add_column(heading, justify="right" if heading.startswith("s, ") else "left", no_wrap=True)
    last = {row.strategy: row for row in done.rows if row.rule == done.rows[0].rule}
    for name, of in done.seconds.items():
        row = last[name]
        seconds = (digits(of.get(scene, 0.0), 3) for scene in scenes)
        table.add_row(name, row.light, row.laser_class or "-", row.laser_class_still or "-", *seconds)
    console().print("Sources, and seconds of this computer with the simulation", style="bold", markup=False)
    console().print(table)
    tell()


def _air(air: str) -> str:
    return f"visibility {air}" if air[:1].isdigit() else f"{air} air" if air == "clear" else air
