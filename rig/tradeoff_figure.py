"""A trade-off as a picture: error over sensor time and over compute time, a pair of panels for each scene and fog."""

from collections.abc import Sequence

from rig.svg_chart import Panel, Series, chart_svg
from rig.tradeoff_rows import Clock, TradeoffRow

COLOURS = {"argmax": "#7b8896", "edge": "#d55e00", "likelihood": "#0072b2", "joint": "#009e73"}
"""Of estimators; told apart by the colour-blind too (Okabe and Ito, 'Color universal design', 2008)."""
OTHER_COLOUR = "#cc79a7"


def tradeoff_svg(rows: Sequence[TradeoffRow], ci95_by: str) -> str:
    """The SVG file. Rows with too many answers missing are left out."""
    places = list(dict.fromkeys((row.scene, row.fog) for row in rows))
    shown = [row for row in rows if row.counts]
    panels = [
        _panel([row for row in shown if (row.scene, row.fog) == place], _named(*place), of)
        for place in places
        for of in ("sensor", "compute")
    ]
    notes = [
        "Numbers at points: exposures of a column. Bars: 95 % interval of the mean, over " + ci95_by + ".",
        "Yellow: nothing else has less error in as little time. Missing answers count as 10 px.",
    ]
    if len(shown) < len(rows):
        notes.append(f"Not shown, for more than 5 % of missing answers: {len(rows) - len(shown)} of {len(rows)} rows.")
    return chart_svg(panels, title="What accuracy costs in time", notes=notes)


def colour_of(estimator: str) -> str:
    """An estimator's colour, in every picture the same."""
    return COLOURS.get(estimator, OTHER_COLOUR)


def _named(scene: str, fog: str | None) -> str:
    short = scene.rstrip("/").rsplit("/", 1)[-1]
    return short if fog is None else f"{short}, {'clear air' if fog == 'clear' else f'visibility {fog}'}"


def _panel(rows: Sequence[TradeoffRow], place: str, of: Clock) -> Panel:
    curves: dict[tuple[str, str, int], list[TradeoffRow]] = {}
    for row in sorted(rows, key=lambda row: row.exposures):
        curves.setdefault((row.estimator, row.filter, row.lines), []).append(row)
    front = sorted(
        (row.time_ms(of), row.mean_abs_px) for row in rows if (row.pareto if of == "sensor" else row.pareto_compute)
    )
    return Panel(
        title=place,
        x_label=f"{of} time of a map, ms",
        y_label="mean error, px",
        series=[_series(key, found, of) for key, found in curves.items()],
        front=front,
    )


def _series(key: tuple[str, str, int], rows: Sequence[TradeoffRow], of: Clock) -> Series:
    estimator, filter, lines = key
    label = estimator + ("" if filter == "none" else f" + {filter}") + ("" if lines == 1 else f", {lines} lines")
    return Series(
        label=label,
        colour=colour_of(estimator),
        points=[(row.time_ms(of), row.mean_abs_px) for row in rows],
        intervals=[row.ci95 for row in rows],
        names=[str(row.exposures) for row in rows],
        dashed=filter != "none",
    )
