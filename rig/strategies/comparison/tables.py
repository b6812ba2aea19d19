"""The tables of a comparison, for the terminal and the page alike: titles, heads and cells as text."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from calibration.errors import digits
from rig.geometry.stripe_table import MISSING_PX
from rig.strategies.comparison.compare import StrategyRow, ranges
from rig.strategies.comparison.places import CLEAR, RAMP, visibility_m

FIGURES_NOTE: Final = (
    "Mean error in px / pixels within 2 % of the depth in % / confident wrong ones in %. A missing answer and a larger "
    f"error count as {MISSING_PX:g} px. -: cannot measure in so short a time."
)


@dataclass(frozen=True, slots=True)
class FiguresTable:
    """A table as text: its title, the heads of its columns, and its lines."""

    title: str
    head: tuple[str, ...]
    lines: list[tuple[str, ...]]


def figures_tables(rows: Sequence[StrategyRow]) -> Iterator[FiguresTable]:
    """A table for each scene, air and rule: a line for each strategy, a column for each time. A cell is empty where
    nothing was measured."""
    for scene, air, rule in dict.fromkeys((row.scene, row.air, row.rule) for row in rows):
        some = [row for row in rows if (row.scene, row.air, row.rule) == (scene, air, rule)]
        times = sorted({row.time_ms for row in some})
        found = {(row.strategy, row.time_ms): _figures(row) for row in some}
        yield FiguresTable(
            f"{scene if air is None else f'{scene}, {air_name(air)}'}, equal {rule}",
            ("", *(f"{time_ms:g} ms" for time_ms in times)),
            [(way, *(found.get((way, at), "") for at in times)) for way in dict.fromkeys(row.strategy for row in some)],
        )


def _figures(row: StrategyRow) -> str:
    if row.mean_px is None or row.good is None or row.confident_wrong is None:
        return "-"
    return f"{row.mean_px:.3f} / {100 * row.good:.0f} / {100 * row.confident_wrong:.1f}"


def ranges_table(rows: Sequence[StrategyRow]) -> FiguresTable | None:
    """The range of each strategy on the slanted wall; None if that scene was not measured."""
    found = ranges(rows, RAMP)
    if not found:
        return None
    airs = list(dict.fromkeys(air for of in found.values() for air in of))
    lines = [
        (name, f"{time_ms:g}", rule, *("-" if of.get(air) is None else f"{of[air]:.1f}" for air in airs))
        for (name, time_ms, rule), of in found.items()
        if any(of.values())
    ]
    title = "Range in m: 90 % of the pixels at this depth are within 2 %"
    return FiguresTable(title, ("", "ms", "equal", *map(air_name, airs)), lines)


def sources_table(rows: Sequence[StrategyRow], seconds: Mapping[str, Mapping[str, float]]) -> FiguresTable:
    """A line for each strategy: what it lights, its laser classes, and the computing time.

    Classes are those of the longest time, and of the first rule by which the strategy was measured. seconds: by
    strategy and scene.
    """
    scenes = list(dict.fromkeys(row.scene for row in rows))
    by_rule = [{row.strategy: row for row in rows if row.rule == rule} for rule in dict.fromkeys(r.rule for r in rows)]
    lines = []
    for way in dict.fromkeys(row.strategy for row in rows):
        row = next(of[way] for of in by_rule if way in of)
        spent = (digits(seconds.get(way, {}).get(scene, 0.0), 3) for scene in scenes)
        lines.append((way, row.light, row.laser_class or "-", row.laser_class_still or "-", *spent))
    head = ("", "lights", "laser class", "if it stood still", *(f"{scene}, s" for scene in scenes))
    return FiguresTable("Sources at the longest time, and computing time with the simulation", head, lines)


def too_short_lines(rows: Sequence[StrategyRow]) -> list[str]:
    """A line for each strategy that cannot measure in one of the times, with the longest such time and the reason."""
    too_short = sorted((row for row in rows if row.too_short is not None), key=lambda row: row.time_ms)
    longest = {row.strategy: row for row in too_short}
    return [f"{way}, {row.time_ms:g} ms: {row.too_short}" for way, row in longest.items()]


def air_name(air: str) -> str:
    """A kind of air in words: `20m` is 'visibility 20m'."""
    return "clear air" if air == CLEAR else air if visibility_m(air) is None else f"visibility {air}"
