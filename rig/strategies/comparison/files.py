"""Writes the files of a comparison: strategies.json, strategies.csv and two pictures.

`strategies.svg` shows error over time in each air, `strategies-visibility.svg` error and range over visibility (only
written if an air has a visibility). Both show the best strategy of each kind. Strategies are of one kind if the first
word of their names and their sensor (SPAD or conventional camera) are the same.
"""

import math
import statistics
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from typing import Final

from rig.geometry.stripe_table import MISSING_PX
from rig.report.charts import Panel, Series, chart_svg
from rig.report.csv_file import csv_of
from rig.run_folder.folder import RunFolder
from rig.scan.run import versions
from rig.strategies.comparison.compare import Comparison, StrategyRow
from rig.strategies.comparison.places import CLEAR, RAMP, visibility_m

COLOURS: Final = ("#009e73", "#0072b2", "#d55e00", "#cc79a7", "#e69f00", "#56b4e9", "#7b8896", "#8c564b", "#000000",
                  "#9467bd", "#b8b800")  # fmt: skip
"""Colours of kinds, in the order in which they come; the first eight can be told apart by the colour-blind."""
CAMERA: Final = "camera"
CLEAR_AT_M: Final = 300.0
"""Place of clear air on the axis of visibility."""
SHOWN_MS: Final = 50.0
"""Time of measurement in the picture over visibility: the measured time that is nearest to it is shown."""


def write_files(folder: RunFolder, done: Comparison) -> Comparison:
    """Write everything, make the folder appear and return the comparison with its folder."""
    folder.write_json("strategies.json", {**done.as_json(), "versions": versions()})
    folder.write_text("strategies.csv", csv_text(done.rows))
    folder.write_text("strategies.svg", time_svg(done.rows))
    if any(visible is not None for visible in (visibility_m(row.air) for row in done.rows)):
        folder.write_text("strategies-visibility.svg", visibility_svg(done.rows))
    return replace(done, folder=folder.publish())


def csv_text(rows: Sequence[StrategyRow]) -> str:
    """The rows as CSV, one line each, with the columns of the JSON file. rows: at least one."""
    return csv_of([asdict(row) for row in rows])


def kind_of(strategy: str) -> str:
    """Kind of a strategy: the first word of its name, and `camera` if a conventional camera looks."""
    first, *more = strategy.split("-")
    return f"{first}-{CAMERA}" if more and more[-1] == CAMERA else first


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
    shown = best_of_kinds(rows)
    panels = [
        Panel(
            title=f"{'own air' if air is None else _air_name(air)}{'' if rule == 'energy' else ', equal irradiance'}",
            x_label="time of a measurement, ms",
            y_label="mean error, px",
            series=_curves([row for row in rows if (row.air, row.rule) == (air, rule)], shown, lambda row: row.time_ms),
        )
        for rule in dict.fromkeys(row.rule for row in rows)
        for air in dict.fromkeys(row.air for row in rows)
    ]
    return chart_svg(panels, title="Ways to measure depth: error over time", across=3, notes=_notes(rows))


def visibility_svg(rows: Sequence[StrategyRow]) -> str:
    """Error and range over visibility, for the time nearest to SHOWN_MS and the rule of the first row. Raises
    ValueError if no row has a visibility."""
    rule = rows[0].rule
    some = [row for row in rows if row.rule == rule and visibility_m(row.air) is not None]
    time_ms = min((row.time_ms for row in some), key=lambda each: abs(math.log(each / SHOWN_MS)))
    some = [row for row in some if row.time_ms == time_ms]
    shown = best_of_kinds(some)
    panels = [
        Panel("error", "visibility, m (right end: clear air)", "mean error, px", _curves(some, shown, _visible)),
        Panel(
            "range: 90 % of the pixels within 2 %",
            "visibility, m (right end: clear air)",
            "depth, m",
            _curves([row for row in some if row.scene == RAMP] or some, shown, _visible, _range),
        ),
    ]
    return chart_svg(panels, title=f"Ways to measure depth: {time_ms:g} ms", notes=_notes(some))


def _curves(
    rows: Sequence[StrategyRow],
    shown: Sequence[str],
    at: Callable[[StrategyRow], float],
    value: "Callable[[StrategyRow], float | None]" = lambda row: row.mean_px,
) -> list[Series]:
    """A curve for each strategy shown, its points the means over scenes."""
    colours: dict[str, str] = {}
    curves = []
    for name in shown:
        kind = kind_of(name)
        colour = colours.setdefault(kind.removesuffix(f"-{CAMERA}"), COLOURS[len(colours) % len(COLOURS)])
        places: dict[float, list[float]] = {}
        for row in rows:
            found = value(row) if row.strategy == name else None
            if found is not None:
                places.setdefault(at(row), []).append(found)
        points = [(x, statistics.fmean(values)) for x, values in sorted(places.items())]
        curves.append(Series(name, colour, points, dashed=kind.endswith(CAMERA)))
    return curves


def _visible(row: StrategyRow) -> float:
    """Place of a row's air on the axis of visibility."""
    visible = visibility_m(row.air)
    assert visible is not None, "rows without a visibility are left out"
    return min(visible, CLEAR_AT_M)


def _range(row: StrategyRow) -> float | None:
    return row.range_m


def _air_name(air: str) -> str:
    return "clear air" if air == CLEAR else air if visibility_m(air) is None else f"visibility {air}"


def _notes(rows: Sequence[StrategyRow]) -> list[str]:
    scenes = ", ".join(dict.fromkeys(row.scene for row in rows))
    return [
        f"Scenes: {scenes}. Mean error of disparity over all pixels that camera and source see; a missing answer and "
        f"a larger error count as {MISSING_PX:g} px.",
        "Of each kind the way with the least mean error is shown. Dashed: a conventional camera looks.",
    ]
