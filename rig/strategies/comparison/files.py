"""Writes the files of a comparison: strategies.json, strategies.csv, two pictures, and report.html with all tables.

`strategies.svg` shows error over time in each air, `strategies-visibility.svg` error and range over visibility (only
written if an air has a visibility). Of more than MOST_CURVES strategies both show only the best of each kind.
Strategies are of one kind if the first word of their names and their sensor (SPAD or conventional camera) are the same.
"""

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any, Final

from pydantic import BaseModel, Field

from drivers.json_text import parse_json
from rig.errors import UsageError
from rig.geometry.stripe_table import MISSING_PX
from rig.report.charts import Panel, Series, chart_svg
from rig.report.csv_file import csv_of
from rig.report.page import Section, charts, page, paragraph, table, verdict_box
from rig.run_folder.folder import RunFolder
from rig.scan.run import versions
from rig.strategies.comparison.compare import Comparison, StrategyRow
from rig.strategies.comparison.places import RAMP, USUAL_LUX, visibility_m
from rig.strategies.comparison.tables import (
    FIGURES_NOTE,
    air_name,
    figures_tables,
    ranges_table,
    sources_table,
    too_short_lines,
)

COMPARISON_FILE: Final = "strategies.json"
COLOURS: Final = ("#009e73", "#0072b2", "#d55e00", "#cc79a7", "#e69f00", "#56b4e9", "#7b8896", "#8c564b", "#000000",
                  "#9467bd", "#b8b800")  # fmt: skip
"""Colours of kinds, in the order in which they come; the first eight can be told apart by the colour-blind."""
MOST_CURVES: Final = len(COLOURS)
"""Largest number of strategies that are all drawn."""
CAMERA: Final = "camera"
CLEAR_AT_M: Final = 300.0
"""Place of clear air on the axis of visibility."""
SHOWN_MS: Final = 50.0
"""Time of measurement in the picture over visibility: the measured time that is nearest to it is shown."""


def write_files(folder: RunFolder, done: Comparison, settings: Mapping[str, Any]) -> Comparison:
    """Write everything, make the folder appear and return the comparison with its folder. settings: what was asked for,
    plain values."""
    content = {**done.as_json(), "settings": dict(settings), "versions": versions()}
    folder.write_json(COMPARISON_FILE, content)
    folder.write_text("strategies.csv", csv_text(done.rows))
    folder.write_text("strategies.svg", time_svg(done.rows))
    if _at_shown_time(done.rows):
        folder.write_text("strategies-visibility.svg", visibility_svg(done.rows))
    folder.write_text("report.html", _page(folder.path.name, _ComparisonFile.model_validate(content)))
    return replace(done, folder=folder.publish())


class _ComparisonFile(BaseModel):
    """Parts of the file that a page needs."""

    rows: Annotated[list[StrategyRow], Field(min_length=1)]
    verdict: str
    notes: list[str]
    strategies: dict[str, str]
    seconds: dict[str, dict[str, float]]
    settings: dict[str, Any] = {}
    versions: dict[str, str]


def comparison_report(folder: Path) -> str:
    """The text of the HTML file on a comparison in a folder. Raises UsageError if it cannot be read."""
    file = folder / COMPARISON_FILE
    try:
        return _page(folder.absolute().name, _ComparisonFile.model_validate(parse_json(file.read_bytes())))
    except (OSError, ValueError, ArithmeticError) as error:
        reason = str(error).partition("\n")[0] or type(error).__name__
        raise UsageError(
            f"{file} is no comparison of this version ({reason}); run rig tradeoff with strategies again"
        ) from error


def _page(name: str, content: _ComparisonFile) -> str:
    rows = content.rows
    ways = {row.strategy for row in rows}
    sections: list[Section] = [("Error over time", _charts(_time_panels(rows), _notes(rows)))]
    if some := _at_shown_time(rows):
        title = f"Error and range over visibility, {some[0].time_ms:g} ms"
        sections.append((title, _charts(_visibility_panels(some), _notes(some))))
    sections.append(("Each figure in the tables", "".join(map(paragraph, (FIGURES_NOTE, *too_short_lines(rows))))))
    sections += [(each.title, table(each.head, each.lines)) for each in figures_tables(rows)]
    if (found := ranges_table(rows)) is not None:
        sections.append((found.title, table(found.head, found.lines)))
    sources = sources_table(rows, content.seconds)
    sections += [
        (sources.title, table(sources.head, sources.lines)),
        ("What they do", table(("", ""), list(content.strategies.items()))),
        ("Settings", table(("", ""), [(name, _in_words(value)) for name, value in content.settings.items()])),
        ("Versions", table(("", ""), list(content.versions.items()))),
    ]
    said = f"{len(rows)} measurement{'s' * (len(rows) != 1)}, {len(ways)} way{'s' * (len(ways) != 1)} to measure depth."
    box = verdict_box(content.verdict, said, content.notes, good=content.verdict == "complete")
    return page(f"Comparison {name}", [box], sections)


def _in_words(setting: Any) -> str:
    """A setting as text. Only the ambient light can be None."""
    if setting is None:
        return f"the scene's, else {USUAL_LUX:g}"
    return ", ".join(map(str, setting)) if isinstance(setting, list) else str(setting)


def _charts(panels: Sequence[Panel], notes: Sequence[str]) -> str:
    return charts(panels) + "".join(paragraph(note, small=True) for note in notes)


def csv_text(rows: Sequence[StrategyRow]) -> str:
    """The rows as CSV, one line each, with the columns of the JSON file. rows: at least one."""
    return csv_of([asdict(row) for row in rows])


def kind_of(strategy: str) -> str:
    """Kind of a strategy: the first word of its name, and `camera` if a conventional camera looks."""
    first, *more = strategy.split("-")
    return f"{first}-{CAMERA}" if more and more[-1] == CAMERA else first


def shown_ways(rows: Sequence[StrategyRow]) -> list[str]:
    """The strategies that a figure shows: all, or the best of each kind if there are more than MOST_CURVES."""
    ways = list(dict.fromkeys(row.strategy for row in rows))
    return ways if len(ways) <= MOST_CURVES else best_of_kinds(rows)


def best_of_kinds(rows: Sequence[StrategyRow]) -> list[str]:
    """The strategy of each kind with the least mean error over all rows. A row without a measurement counts as if all
    its answers were missing."""
    errors: dict[str, dict[str, list[float]]] = {}
    for row in rows:
        error = MISSING_PX if row.mean_px is None else row.mean_px
        errors.setdefault(kind_of(row.strategy), {}).setdefault(row.strategy, []).append(error)
    return [min((statistics.fmean(each), name) for name, each in of.items())[1] for of in errors.values()]


def time_svg(rows: Sequence[StrategyRow]) -> str:
    """Error over time: a panel for each air and rule, the mean over all scenes."""
    return chart_svg(_time_panels(rows), title="Ways to measure depth: error over time", across=3, notes=_notes(rows))


def _time_panels(rows: Sequence[StrategyRow]) -> list[Panel]:
    shown, rules = shown_ways(rows), list(dict.fromkeys(row.rule for row in rows))
    return [
        Panel(
            title=("own air" if air is None else air_name(air)) + (f", equal {rule}" if len(rules) > 1 else ""),
            x_label="time of a measurement, ms",
            y_label="mean error, px",
            series=_curves([row for row in rows if (row.air, row.rule) == (air, rule)], shown, lambda row: row.time_ms),
        )
        for rule in rules
        for air in dict.fromkeys(row.air for row in rows)
    ]


def visibility_svg(rows: Sequence[StrategyRow]) -> str:
    """Error and range over visibility, for the time nearest to SHOWN_MS and the first rule. At least one row must have
    a visibility."""
    some = _at_shown_time(rows)
    title = f"Ways to measure depth: {some[0].time_ms:g} ms"
    return chart_svg(_visibility_panels(some), title=title, notes=_notes(some))


def _at_shown_time(rows: Sequence[StrategyRow]) -> list[StrategyRow]:
    """The rows that are shown over visibility: of those with one, those of the first rule and of one time. Empty if no
    row has a visibility."""
    some = [row for row in rows if visibility_m(row.air) is not None]
    some = [row for row in some if row.rule == some[0].rule]
    time_ms = min((row.time_ms for row in some), key=lambda each: abs(math.log(each / SHOWN_MS)), default=None)
    return [row for row in some if row.time_ms == time_ms]


def _visibility_panels(some: Sequence[StrategyRow]) -> list[Panel]:
    shown = shown_ways(some)
    return [
        Panel("error", "visibility, m (right end: clear air)", "mean error, px", _curves(some, shown, _visible)),
        Panel(
            "range: 90 % of the pixels within 2 %",
            "visibility, m (right end: clear air)",
            "depth, m",
            _curves([row for row in some if row.scene == RAMP] or some, shown, _visible, _range),
        ),
    ]


def _curves(
    rows: Sequence[StrategyRow],
    shown: Sequence[str],
    at: Callable[[StrategyRow], float],
    value: "Callable[[StrategyRow], float | None]" = lambda row: row.mean_px,
) -> list[Series]:
    """A curve for each strategy shown, its points the means over scenes."""
    colours: dict[str, str] = {}
    curves = []
    kinds = list(map(kind_of, shown))
    alone = len(set(kinds)) == len(kinds)
    for name, kind in zip(shown, kinds, strict=True):
        # The same patterns seen by the SPAD and by a camera have one colour.
        like = (kind if alone else name.removesuffix("-spad")).removesuffix(f"-{CAMERA}")
        colour = colours.setdefault(like, COLOURS[len(colours) % len(COLOURS)])
        places: dict[float, list[float]] = {}
        for row in rows:
            found = value(row) if row.strategy == name else None
            if found is not None:
                places.setdefault(at(row), []).append(found)
        points = [(x, statistics.fmean(values)) for x, values in sorted(places.items())]
        curves.append(Series(name, colour, points, dashed=kind.endswith(f"-{CAMERA}")))
    return curves


def _visible(row: StrategyRow) -> float:
    """Place of a row's air on the axis of visibility."""
    visible = visibility_m(row.air)
    assert visible is not None, "rows without a visibility are left out"
    return min(visible, CLEAR_AT_M)


def _range(row: StrategyRow) -> float | None:
    return row.range_m


def _notes(rows: Sequence[StrategyRow]) -> list[str]:
    scenes = ", ".join(dict.fromkeys(row.scene for row in rows))
    left_out = len({row.strategy for row in rows}) - len(shown_ways(rows))
    of_kinds = (
        "The way with the least mean error is shown of each kind (first word of a name, and camera), "
        f"{left_out} are left out. "
    )
    return [
        f"Scenes: {scenes}. Mean error of disparity over all pixels that camera and source see; a missing answer and "
        f"a larger error count as {MISSING_PX:g} px.",
        f"{of_kinds if left_out else ''}Dashed: a conventional camera looks.",
    ]
