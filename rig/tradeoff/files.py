"""Writes the files of a trade-off: tradeoff.json, .csv, .svg, report.html, and setting.yaml, the setting as a config.

The picture shows error over sensor time and over compute time, a pair of panels for each scene and fog.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any

import yaml
from pydantic import BaseModel, Field

from calibration.errors import digits
from drivers.json_text import parse_json
from rig.config.files import portable_content
from rig.config.models import RigConfig
from rig.errors import UsageError
from rig.report.charts import Panel, Series, chart_svg
from rig.report.csv_file import csv_of
from rig.report.page import charts, page, paragraph, preformatted, table, verdict_box
from rig.run_folder.folder import RunFolder
from rig.scan.run import versions
from rig.tradeoff.rows import Clock, TradeoffRow, TrialSetting
from rig.tradeoff.trials import Tradeoff

SETTING_FILE = "setting.yaml"
TRADEOFF_FILE = "tradeoff.json"


def write_files(folder: RunFolder, done: Tradeoff, setting: RigConfig | None) -> Tradeoff:
    """Write everything, make the folder appear and return the trade-off with its folder.

    setting: config with the chosen setting; None if there is none.
    """
    content = {**done.as_json(), "versions": versions()}
    folder.write_json(TRADEOFF_FILE, content)
    folder.write_text("tradeoff.csv", csv_text(done.rows))
    folder.write_text("tradeoff.svg", tradeoff_svg(done.rows, done.ci95_by))
    folder.write_text("report.html", _page(folder.path.name, content, done.rows))
    if setting is not None:
        comments = [f"rig tradeoff: {done.answer}"]
        if done.accepted_calibration:
            comments.append("its calibration was accepted all the same: scan with accept_calibration")
        head = "".join(f"# {comment}\n" for comment in comments)
        folder.write_text(
            SETTING_FILE, head + yaml.safe_dump(portable_content(setting), sort_keys=False, allow_unicode=True)
        )
    return replace(done, folder=folder.publish())


def csv_text(rows: Sequence[TradeoffRow]) -> str:
    """Rows, at least one, as CSV, one line each, with the columns of the JSON; the interval takes two columns."""
    lines = [asdict(row) for row in rows]
    for line in lines:
        line["ci95_low"], line["ci95_high"] = line.pop("ci95")
    return csv_of(lines)


class _TradeoffFile(BaseModel):
    """Parts of the file that a page needs."""

    rows: Annotated[list[TradeoffRow], Field(min_length=1)]
    verdict: str
    advice: str
    ci95_by: str
    versions: dict[str, str] | None = None


def tradeoff_report(folder: Path) -> str:
    """The text of the HTML file on a trade-off that was written to a folder. Raises UsageError if it cannot be read."""
    file = folder / TRADEOFF_FILE
    try:
        content = parse_json(file.read_bytes())
        return _page(folder.absolute().name, content, _TradeoffFile.model_validate(content).rows)
    except (OSError, ValueError, ArithmeticError) as error:
        reason = str(error).partition("\n")[0] or type(error).__name__
        raise UsageError(f"{file} is no trade-off of this version ({reason}); run rig tradeoff again") from error


def _page(name: str, content: Mapping[str, Any], rows: Sequence[TradeoffRow]) -> str:
    """The page: advice, picture, and all rows as a table."""
    word = str(content["verdict"])
    box = verdict_box(word, str(content["advice"]), [], good=word == "complete")
    head = ("place", "setting", "sensor, ms", "compute, ms", "error, px", "95 %", "within 1 px, %", "missing, %",
            "depth, mm", "best")  # fmt: skip
    cells = [
        (
            _named(row.scene, row.fog), str(TrialSetting(row.estimator, row.filter, row.exposures, row.lines)),
            digits(row.sensor_ms), digits(row.compute_ms), digits(row.mean_abs_px),
            f"{digits(row.ci95[0])} to {digits(row.ci95[1])}", f"{100 * row.within_1px:.1f}",
            f"{100 * row.missing:.1f}", "-" if row.depth_mm is None else digits(row.depth_mm),
            "; ".join(of for of, best in (("sensor", row.pareto), ("compute", row.pareto_compute)) if best),
        )
        for row in rows
    ]  # fmt: skip
    note = "Error: mean over all rows and columns with a true stripe; a missing answer counts as 10 px. Best: nothing "
    note += "else has less error in as little time of the sensor or of the computer."
    versions = [(name, str(number)) for name, number in (content.get("versions") or {}).items()]
    return page(
        f"Trade-off {name}",
        [box],
        [
            ("Error over time", _charts(rows, str(content["ci95_by"]))),
            ("All settings", table(head, cells) + paragraph(note, small=True)),
            ("Setting to use", preformatted(f"rig scan {SETTING_FILE}") if content.get("answer") else ""),
            ("Versions", table(("", ""), versions) if versions else ""),
        ],
    )


def _charts(rows: Sequence[TradeoffRow], ci95_by: str) -> str:
    """The panels of the picture, as many beside each other as fit."""
    panels = _panels(rows)
    notes = "".join(paragraph(note, small=True) for note in _notes(rows, ci95_by))
    return charts(panels) + notes


COLOURS = {"argmax": "#7b8896", "edge": "#d55e00", "likelihood": "#0072b2", "joint": "#009e73"}
"""Colours of estimators that the colour-blind can tell apart (Okabe and Ito, 'Color universal design', 2008)."""
OTHER_COLOUR = "#cc79a7"


def tradeoff_svg(rows: Sequence[TradeoffRow], ci95_by: str) -> str:
    """The picture as SVG text, without rows with too many answers missing. ci95_by: as in `Tradeoff`."""
    return chart_svg(_panels(rows), title="What accuracy costs in time", notes=_notes(rows, ci95_by))


def _panels(rows: Sequence[TradeoffRow]) -> list[Panel]:
    places = dict.fromkeys(row.place for row in rows)
    return [
        _panel([row for row in rows if row.place == place and row.counts], _named(*place), of)
        for place in places
        for of in ("sensor", "compute")
    ]


def _notes(rows: Sequence[TradeoffRow], ci95_by: str) -> list[str]:
    notes = [
        "Numbers at points: exposures of a column. Bars: 95 % interval of the mean, over " + ci95_by + ".",
        "Yellow: nothing else has less error in as little time. Missing answers count as 10 px.",
    ]
    if hidden := sum(not row.counts for row in rows):
        notes.append(f"Not shown, for more than 5 % of missing answers: {hidden} of {len(rows)} rows.")
    return notes


def colour_of(estimator: str) -> str:
    """Colour of an estimator in every picture. Estimators that are not in `COLOURS` share one."""
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
