"""One table, figure and page of any study, made from the folder of its batch.

The table has a line for each case, or for each of the rows that a case returns. It has a column for each setting that
varies, for each figure of the result, and for the case's name, which is also the name of the folder with its kept
files. The figure shows the numbers over the setting with the most values that are numbers.
"""

import statistics
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, TypeGuard

from calibration.errors import digits
from rig.batch.engine import failure_line
from rig.batch.store import LIST, Row, failure_files, read_failures, read_rows
from rig.batch.task import CASE
from rig.config.bundled import short_names
from rig.errors import UsageError
from rig.report.charts import Panel, Series
from rig.report.page import charts, page, paragraph, preformatted, table, verdict_box

Line = dict[str, Any]

MOST_PANELS: Final = 6
MOST_CURVES: Final = 12
SHOWN_LINES: Final = 500
"""Most lines of the page's table; the file has all."""
COLOURS: Final = "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7b8896"
"""Colours that the colour-blind can tell apart (Okabe and Ito, 'Color universal design', 2008)."""
FIRST: Final = "depth_error_m", "stripe_error_px", "mean_abs_px", "mean_px", "valid_fraction"
"""Figures that are shown before others."""
SEED: Final = "seed"
OWN_FIGURES: Final = "tradeoff", "strategies"
"""Folders of actions that draw figures of their own."""
SHARES: Final = "within_1px", "missing"
"""Figures that are shares, although they are among others with a unit."""
_UNITS: Final = {"per_m": "1/m", "px": "px", "m": "m", "mm": "mm", "s": "s", "ms": "ms", "mj": "mJ", "deg": "degrees"}
"""Units by the end of a figure's name."""


def lines_of(rows: Sequence[Row]) -> tuple[list[Line], list[str]]:
    """Lines of the table, and the names of the columns that are settings. Nested figures have dotted names."""
    lines: list[Line] = []
    labels = list(dict.fromkeys(key for row in rows for key in row.labels))
    for row in rows:
        result, measured, settings = dict(row.result), dict(row.measured), dict(_flat(row.labels))
        parts = result.pop("rows", [{}])
        for number, part in enumerate(parts):
            own = {key: value[number] for key, value in measured.items() if _is_of(value, parts)}
            figures = dict(_flat({**result, **part, **own}))
            figures = {key: figures[key] for key in figures if key not in settings}
            lines.append({**settings, **figures, CASE: row.case})
    if any("rows" in row.result for row in rows):  # what tells the rows of a case from each other is a setting too
        labels += [key for key in ("estimator", "filter", "strategy") if lines and key in lines[0]]
    return lines, list(dict.fromkeys(labels))


def _is_of(value: object, parts: Sequence[object]) -> bool:
    return isinstance(value, list) and len(value) == len(parts)


def _flat(content: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in content.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{before}{key}.")
        elif isinstance(value, list):
            yield f"{before}{key}", "; ".join(map(str, value))
        else:
            yield f"{before}{key}", value


def study_report(folder: Path) -> str:
    """The HTML page on a study's folder. Raises UsageError if there is no study, or no case has ended yet."""
    rows = list(read_rows(folder))
    failures = read_failures(*failure_files(folder))
    if not rows and not failures:
        raise UsageError(f"{folder} has no finished case yet; run `rig batch` first")
    lines, labels = lines_of(rows)
    lines = _with_short_names(lines)
    panels = panels_of(lines, labels)
    with (folder / LIST).open(encoding="utf-8") as stream:
        total = sum(1 for _ in stream)
    whole = len(rows) == total
    said = f"{len(rows)} of {total} cases are done"
    verdict = "complete" if whole else "failures" if failures else "part"
    known = [key for line in lines for key, value in line.items() if key != CASE and value is not None and value != ""]
    columns = list(dict.fromkeys([*(label for label in labels if label in known), *known]))
    cells = [[_cell(line.get(key)) for key in columns] for line in lines[:SHOWN_LINES]]
    more = paragraph(f"{len(lines) - SHOWN_LINES} more lines are in table.csv", small=True)
    return page(
        f"Study {folder.absolute().name}",
        [verdict_box(verdict, said, list(map(failure_line, failures)), good=whole)],
        [
            ("Figures", charts(panels) if panels else ""),
            *((name.capitalize(), "".join(drawings)) for name in OWN_FIGURES if (drawings := _drawings(folder / name))),
            ("All cases", table(list(map(_in_words, columns)), cells) + (more if len(lines) > SHOWN_LINES else "")),
            ("Repeat failed cases", preformatted("\n".join(each["command"] for each in failures)) if failures else ""),
        ],
    )


def _drawings(folder: Path) -> list[str]:
    """Figures of the results of an action, in its own folder, as SVG."""
    return [file.read_text(encoding="utf-8") for file in sorted(folder.glob("*.svg"))]


def panels_of(lines: Sequence[Line], labels: Sequence[str]) -> list[Panel]:
    """Panels that show figures over the setting with the most different numbers.

    labels: names of the columns that are settings. Each of the first MOST_PANELS figures that have two different
    numbers or more gets a panel; those named in FIRST come first. A panel has a curve for each combination of the other
    settings, MOST_CURVES at most. Points are means over seeds, and a bar shows the range of the seeds. The list is
    empty if no setting has two different numbers."""
    over = max((key for key in labels if key != SEED), key=lambda key: len(_numbers(lines, key)), default=None)
    if over is None or len(_numbers(lines, over)) < 2:
        return []
    others = [key for key in labels if key not in (over, SEED) and len({str(line.get(key)) for line in lines}) > 1]
    figures = [key for key in dict.fromkeys(k for line in lines for k in line) if key not in labels]
    shown = [key for key in figures if len(_numbers(lines, key)) > 1]
    shown.sort(key=lambda key: next((i for i, first in enumerate(FIRST) if key.startswith(first)), len(FIRST)))
    panels = []
    for key in shown[:MOST_PANELS]:
        curves: dict[str, dict[float, list[float]]] = {}
        for line in lines:
            x, y = line.get(over), line.get(key)
            if _is_number(x) and _is_number(y):
                label = ", ".join(f"{_in_words(other)} {line.get(other)}" for other in others)
                curves.setdefault(label, {}).setdefault(float(x), []).append(float(y))
        series = [
            Series(
                label or _in_words(key),
                COLOURS[number % len(COLOURS)],
                [(x, statistics.fmean(values)) for x, values in sorted(points.items())],
                [(min(values), max(values)) for _, values in sorted(points.items())],
                dashed=number >= len(COLOURS),
            )
            for number, (label, points) in enumerate(list(curves.items())[:MOST_CURVES])
        ]
        positive = all(y > 0 for each in series for _, y in each.points)
        title = name = _in_words(key)
        if len(curves) > MOST_CURVES:
            title += f" (first {MOST_CURVES} of {len(curves)} curves)"
        panels.append(Panel(title, _in_words(over), name, series, x_log=min(_numbers(lines, over)) > 0, y_log=positive))
    return panels


def _with_short_names(lines: Sequence[Line]) -> list[Line]:
    """The lines with the last part of each path instead of all of it, where that says which file it is."""
    made = [dict(line) for line in lines]
    for key in dict.fromkeys(key for line in lines for key in line):
        values = {line[key] for line in lines if isinstance(line.get(key), str)}
        names = short_names(sorted(values)) if any(Path(value).is_absolute() for value in values) else {}
        for line in made:
            if line.get(key) in names:
                line[key] = names[line[key]]
    return made


def _in_words(key: str) -> str:
    """A column of the table in words: 'depth_error_m.mean_abs' is 'depth error, mean abs (m)'."""
    first, dot, rest = key.partition(".")
    unit = next((end for end in _UNITS if first.endswith(f"_{end}")), "")
    said = (first.removesuffix(f"_{unit}") + dot + rest).replace("_", " ").replace(".", ", ")
    shown = "share" if rest in SHARES else _UNITS.get(unit)
    return f"{said} ({shown})" if shown else said


def _numbers(lines: Sequence[Line], key: str) -> set[float]:
    return {float(value) for line in lines if _is_number(value := line.get(key))}


def _is_number(value: object) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _cell(value: object) -> str:
    if value is None:
        return "-"
    return digits(value) if isinstance(value, float) else str(value)
