"""A trade-off for people: tables of at most 80 characters, the setting to use and where the files are."""

import textwrap
from collections.abc import Callable, Sequence

from rich.table import Table

from rig.report_text import console
from rig.tradeoff import Tradeoff
from rig.tradeoff_rows import TradeoffRow

WIDTH = 80
"""Characters; no line here is longer but those that name files."""

Column = tuple[str, Callable[[TradeoffRow], str]]
"""Heading and cell."""

_SETTING: tuple[Column, ...] = (
    ("estimator", lambda row: row.estimator),
    ("filter", lambda row: row.filter),
    ("K", lambda row: str(row.exposures)),
)
_FIGURES: tuple[Column, ...] = (
    *_SETTING,
    ("sensor\nms", lambda row: _short(row.sensor_ms)),
    ("compute\nms", lambda row: _short(row.compute_ms)),
    ("error\npx", lambda row: _short(row.mean_abs_px) if row.counts else f"({_short(row.mean_abs_px)})"),
    ("95 %\npx", lambda row: f"{_short(row.ci95[0])}..{_short(row.ci95[1])}"),
    ("< 1 px\n%", lambda row: f"{100 * row.within_1px:.1f}"),
    ("miss.\n%", lambda row: f"{100 * row.missing:.1f}"),
    ("depth\nmm", lambda row: _short(row.depth_mm)),
    ("", lambda row: ("*" if row.pareto else " ") + ("+" if row.pareto_compute else "")),
)
_LIMITS: tuple[Column, ...] = (
    *_SETTING,
    ("error\nx limit", lambda row: _times(row.times_limit)),
    ("> 1 px\nx limit", lambda row: _times(row.times_wrong_limit)),
    ("exponent\nnats", lambda row: _short(row.exponent_nats)),
    ("sub-pixel\npx", lambda row: _short(row.local_sd_px)),
    ("Cramer-Rao\npx", lambda row: _short(row.position_sd_px)),
    ("sub-pixel\nx limit", lambda row: _times(row.times_position_limit)),
)
_LEFT = ("estimator", "filter", "")


def tradeoff_table(done: Tradeoff) -> None:
    """Print it to stdout, the setting to take first.

    * marks what lies on the front of error over sensor time, + on that over compute time.
    """
    print(textwrap.fill(done.advice, WIDTH))
    print()
    for place in dict.fromkeys((row.scene, row.fog, row.lines) for row in done.rows):
        rows = [row for row in done.rows if (row.scene, row.fog, row.lines) == place]
        _print(_named(*place), _FIGURES, rows)
        if any(row.times_limit is not None for row in rows):
            _print(f"{_named(*place)}: beside what its light allows", _LIMITS, rows)
    print("K: exposures of a column. < 1 px, miss.: answers so near, and missing ones.")
    print(f"95 %: interval of the mean error, over {done.ci95_by}.")
    print("*, +: nothing has less error in as little sensor time (*), compute time (+).")
    if any(not row.counts for row in done.rows):
        print("In brackets: more than 5 % of the answers are missing, such an error counts for\nnothing.")
    for reason in done.accepted_calibration:
        print(f"calibration accepted in spite of {reason}")
    if done.folder is not None:
        print(f"files: {done.folder}")


def _named(scene: str, fog: str | None, lines: int) -> str:
    air = "" if fog is None else ", clear air" if fog == "clear" else f", visibility {fog}"
    return scene + air + ("" if lines == 1 else f", {lines} lines at once")


def _print(title: str, columns: Sequence[Column], rows: Sequence[TradeoffRow]) -> None:
    table = Table(title_justify="left", title_style="bold", box=None, pad_edge=False, padding=(0, 1, 0, 0))
    for name, _ in columns:
        table.add_column(name, justify="left" if name in _LEFT else "right", no_wrap=True)
    for row in rows:
        table.add_row(*(cell(row) for _, cell in columns))
    console().print(title, style="bold", markup=False)
    console().print(table)
    print()


def _short(value: float | None) -> str:
    """At most five characters below 100 000, never with an exponent."""
    if value is None:
        return "-"
    return f"{value:.{3 if value < 9.9995 else 1 if value < 999.95 else 0}f}"


def _times(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"
