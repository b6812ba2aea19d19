"""The report's figures 3, 4, 6, 7, 8 and 9, made anew, and its claims beside what this program gives.

    python -m tests.reference.tables.report_figures --out docs/figures
    python -m tests.reference.tables.report_figures --out /tmp/figures --scenes procedural --exposures 1,10

What each figure of the report shows is not known here; docs/how-to/tradeoff.md says what ours stand for. Counts come
from the yardstick's own simulator at the report's working point, five prepared scenes where they are there; errors are
of stripes on trusted pixels against the continuous truth, a missing answer counts as 10 px. `--kept FOLDER` keeps
what figures 7 to 9 are drawn from; what is there is not measured again. The table for docs/how-to/tradeoff.md is
printed.
"""

from __future__ import annotations

import sys
from base64 import b64encode
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path
from statistics import fmean
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rig.batch.case import Case
from rig.estimate.registry import ESTIMATORS, FILTERS
from rig.report.charts import INK, Panel, Point, Series, chart_svg
from rig.run_folder.pictures import depth_scale, png_bytes
from rig.tradeoff.files import colour_of
from tests.campaigns.studies import results_of
from tests.reference.adapter import reconstruct
from tests.reference.scene import Scene
from tests.reference.tables.accuracy import Measurement, named
from tests.reference.tables.printed import Table, parser_of, scene_of, scenes_asked
from tests.reference.working_point import CLEAR, DENSE, POINTS, REPORT, WorkingPoint

COLUMNS, FRAME_RATE_HZ = 500, 100_000
EXPOSURES = (1, 3, 5, 10, 20)
SEED = 1
CLAIMS = (((10, 1.0), "report: < 1 px"), ((20, 0.1), "report: about 0.1 px"))
"""Mean error of the report by exposures, on truth rounded to whole pixels."""
SHARE = "within_1px"
ROW = 250
"""Image row of figures 3 and 4."""

SIDE_PX = 246
"""Side of a depth map."""
COLOURS = 32
"""Different colours of a depth map: more would make a much larger file."""
PLACE_PX = (SIDE_PX + 24, SIDE_PX + 50)
"""Width and height that it takes with its words."""


@dataclass(frozen=True, slots=True)
class Figure:
    """Error of one estimator and filter on one scene: px, share within 1 px; rounded: on whole-pixel truth."""

    point: str
    scene: str
    exposures: int
    estimator: str
    filter: str
    mean_px: float
    within_1px: float
    rounded_px: float
    compute_s: float


def one_map(scene: str, point: str, exposures: int, estimators: Sequence[str]) -> dict[str, Any]:
    """The figures of a map as a case: one map, from which each estimator learns as well."""
    world, figures, times_s = WorkingPoint(scene_of(scene), POINTS[point]), [], []
    counts = world.counts(exposures, SEED)
    for estimator, filter, found, compute_s in Measurement(estimators, FILTERS).of(world, counts, exposures):
        px = found["mean_abs_charged"], found["within_1px"], found["mean_abs_rounded"]
        figures.append([point, scene, exposures, estimator, filter, *px])
        times_s.append(compute_s)
    return {"figures": figures, "measured": {"compute_s": times_s}}


def figure_3(scene: Scene) -> str:
    """Expected light along one image row: haze that decays, and ends with a step at the stripe."""
    panels = []
    for name, light in (("clear air", CLEAR), ("fog of the report, 0.05 /m", REPORT), ("dense fog, 0.3 /m", DENSE)):
        point = WorkingPoint(scene, light)
        column, x = _column_of(point)
        flux = point.flux_of_column(column)[ROW]
        series = Series("expected photons", colour_of("likelihood"), _stepped(_around(x, flux)), marker=False)
        panels.append(_row_panel(name, "photons an exposure", [series], (x, float(flux[round(x)]))))
    return chart_svg(panels, title=f"One image row of scene {scene.name}: haze, step and stripe", across=3)


def figure_4(scene: Scene) -> str:
    """The same row as it is detected: one exposure, ten, a hundred."""
    point = WorkingPoint(scene, REPORT)
    column, x = _column_of(point)
    expected = -np.expm1(-point.flux_of_column(column)[ROW])
    panels = []
    for k in (1, 10, 100):
        share = point.counts(k, SEED)[column, ROW] / k
        curves = [
            Series("detected", colour_of("edge"), _stepped(_around(x, share)), marker=False),
            Series("expected", colour_of("likelihood"), _around(x, expected), marker=False),
        ]
        title = f"{k} exposure{'s' * (k > 1)}"
        panels.append(_row_panel(title, "share of exposures", curves, (x, float(expected[round(x)]))))
    return chart_svg(panels, title="The same row, detected in the fog of the report (0.05 /m)", across=3)


def figure_6(scene: Scene) -> str:
    """Depth maps: the truth, the report's way and ours."""
    point = WorkingPoint(scene, REPORT)
    known = scene.depth_m[np.isfinite(scene.depth_m)]
    limits = float(np.percentile(known, 1)), float(np.percentile(known, 99))
    panels = [DepthMap("truth", scene.depth_m, limits)]
    for k, estimator, filter in (
        (1, "edge", "median"), (10, "edge", "none"), (10, "edge", "median"),
        (1, "joint", "none"), (10, "joint", "none"),
    ):  # fmt: skip
        (result,) = reconstruct(point, point.counts(k, SEED), k, estimator=estimator, filters=(filter,))
        panels.append(DepthMap(f"{named(estimator, filter)}, {k} exposure{'s' * (k > 1)}", result.depth_m, limits))
    notes = [f"Scene {scene.name} in the fog of the report (0.05 /m); answers of confidence 0.5 and more enter a map."]
    return chart_svg(panels, title="Depth maps", across=3, notes=notes, panel_px=PLACE_PX)


def figure_of_exposures(figures: Sequence[Figure], filter: str) -> str:
    """Error over exposures, a panel for each working point, and the share within 1 px (figures 7 and 8)."""
    panels = []
    for point, light in POINTS.items():
        here = [figure for figure in figures if figure.point == point and figure.filter == filter]
        if here:
            title = f"{point}: extinction {light.extinction_per_m:g} /m"
            error = Panel(title, "exposures of a column", "mean error, px", list(_curves(here)))
            panels += [
                _marked(error, CLAIMS) if point == "report" else error,
                Panel(title, "exposures of a column", "share within 1 px", list(_curves(here, SHARE)), y_log=False),
            ]
    filtered = "without filter" if filter == "none" else "with the 5 x 5 median"
    return chart_svg(panels, title=f"Error over exposures, {filtered}", notes=_notes(figures))


def figure_9(figures: Sequence[Figure]) -> str:
    """Error over map rate, and the share within 1 px: what speed costs."""
    here = [figure for figure in figures if figure.point == "report"]
    rates = {k: FRAME_RATE_HZ / (COLUMNS * k) for k in {figure.exposures for figure in here}}
    marks = [((20.0, 1.0), "report: 20 maps/s, < 1 px"), ((10.0, 0.1), "report: 0.1 px")]

    def curves(value: str) -> list[Series]:
        found = []
        for filter in FILTERS:
            for series in _curves([figure for figure in here if figure.filter == filter], value):
                label = series.label + ("" if filter == "none" else f" + {filter}")
                points = [(rates[round(k)], y) for k, y in series.points]
                found.append(Series(label, series.colour, points, dashed=filter != "none"))
        return found

    label = "maps a second of 500 columns at 100 kHz"
    panels = [
        _marked(Panel("error", label, "mean error, px", curves("mean_px")), marks),
        Panel("answers within 1 px", label, "share", curves(SHARE), y_log=False),
    ]
    notes = [
        f"Mean over the scenes {_scenes(figures)}. One map each.",
        "Time of columns only: dark frames and fly-back take another tenth and more ('rig tradeoff').",
    ]
    return chart_svg(panels, title="Error over map rate in the fog of the report", notes=notes)


def claims_table(figures: Sequence[Figure]) -> Table:
    """The report's claims and ours."""
    table = Table(["K", "maps/s", "the report", *(named(*method) for method in _methods(figures))])
    claims = {1: "cannot do", 10: "< 1 px", 20: "about 0.1 px"}
    for k in sorted({figure.exposures for figure in figures if figure.point == "report"}):
        cells = []
        for method in _methods(figures):
            here = [f for f in figures if (f.point, f.exposures, (f.estimator, f.filter)) == ("report", k, method)]
            cells.append(
                f"{fmean(f.mean_px for f in here):.2f} ({fmean(f.rounded_px for f in here):.2f})" if here else "-"
            )
        table.add([k, f"{FRAME_RATE_HZ / COLUMNS / k:g}", claims.get(k, ""), *cells])
    return table


def _methods(figures: Sequence[Figure]) -> list[tuple[str, str]]:
    return sorted(
        {(figure.estimator, figure.filter) for figure in figures},
        key=lambda m: (ESTIMATORS.index(m[0]), m[1] != "none"),
    )


def _curves(figures: Sequence[Figure], value: str = "mean_px") -> Iterator[Series]:
    """A curve for each estimator: mean over scenes, worst scene as the bar's end."""
    for estimator in ESTIMATORS:
        by_k: dict[int, list[float]] = {}
        for figure in figures:
            if figure.estimator == estimator:
                by_k.setdefault(figure.exposures, []).append(getattr(figure, value))
        if by_k:
            points = [(float(k), fmean(found)) for k, found in sorted(by_k.items())]
            spread = [(min(found), max(found)) for _, found in sorted(by_k.items())]
            yield Series(estimator, colour_of(estimator), points, intervals=spread)


def _notes(figures: Sequence[Figure]) -> list[str]:
    return [f"Mean over the scenes {_scenes(figures)}; bars: best and worst of them. One map each."]


def _scenes(figures: Sequence[Figure]) -> str:
    return ", ".join(sorted({figure.scene for figure in figures}))


def _around(x: float, values: np.ndarray) -> list[tuple[float, float]]:
    """Points of the pixels of a row around x."""
    return list(enumerate(map(float, values)))[max(0, round(x) - 130) : round(x) + 40]


def _stepped(points: Sequence[Point]) -> list[Point]:
    return [(x + side, y) for x, y in points for side in (-0.5, 0.5)]


@dataclass(frozen=True, slots=True)
class MarkedPanel:
    """A panel with crosses at places of it, and text beside each."""

    panel: Panel
    marks: Sequence[tuple[Point, str]]

    @property
    def series(self) -> Sequence[Series]:
        """The curves."""
        return self.panel.series

    def svg(self) -> str:
        """The panel, and above it the marks, which can be read on curves."""
        x, y = self.panel.axes()
        parts = [self.panel.svg()]
        for at, words in self.marks:
            left, top = x.px(at[0]), y.px(at[1])
            parts.append(f'<path d="M{left - 4:.1f} {top - 4:.1f}l8 8m0 -8l-8 8" stroke="{INK}" stroke-width="2"/>')
            side = 8 if left < (x.start_px + x.end_px) / 2 else -8
            place = f'x="{left + side:.1f}" y="{top + 4:.1f}" text-anchor="{"start" if side > 0 else "end"}"'
            around = 'paint-order="stroke" stroke="#ffffff" stroke-width="3" stroke-linejoin="round"'
            parts.append(f'<text {place} font-size="11" fill="{INK}" {around}>{escape(words)}</text>')
        return "".join(parts)


def _marked(panel: Panel, marks: Sequence[tuple[Point, str]]) -> MarkedPanel:
    """The panel with marks, for which its axes have room."""
    room = Series("", INK, [at for at, _ in marks], line=False, marker=False)
    return MarkedPanel(replace(panel, series=[*panel.series, room]), marks)


def _row_panel(title: str, light: str, curves: Sequence[Series], stripe: tuple[float, float]) -> MarkedPanel:
    return _marked(Panel(title, "pixel of the row", light, curves, x_log=False, y_log=False), [(stripe, "stripe")])


def _column_of(point: WorkingPoint) -> tuple[int, float]:
    """A column whose stripe on ROW is trusted, as far right as any with room behind it, and where it stands."""
    width = point.scene.shape[1]
    good = point.trusted[ROW] & (point.x_true[ROW] > 150) & (point.x_true[ROW] < width - 60)
    column = int(np.flatnonzero(good)[good.sum() * 2 // 3])
    return column, float(point.x_true[ROW, column])


@dataclass(frozen=True, slots=True)
class DepthMap:
    """A depth map (rows, width) in metres, black where it is NaN; limits: near, far."""

    title: str
    depth_m: NDArray[np.floating]
    limits: tuple[float, float]

    series: Sequence[Series] = ()

    def svg(self) -> str:
        """The map in a place of a chart, depth in words below it."""
        near, far = self.limits
        scale = replace(depth_scale(self.limits), steps=COLOURS)
        shown = cv2.resize(self.depth_m.astype(np.float32), (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_NEAREST)
        png = png_bytes(scale.colours(shown), small=True)
        return (
            f'<text x="16" y="18" font-weight="bold" fill="{INK}">{escape(self.title)}</text>'
            f'<image x="16" y="28" width="{SIDE_PX}" height="{SIDE_PX}" '
            f'href="data:image/png;base64,{b64encode(png).decode()}"/>'
            f'<text x="16" y="{SIDE_PX + 41}" font-size="10" fill="{INK}">yellow {near:.1f} m, dark blue {far:.1f} m, '
            "black: no answer</text>"
        )


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, draw and print. 1 where a map failed."""
    parser = parser_of("tests.reference.tables.report_figures", __doc__, points="report,dense,clear")
    parser.add_argument("--out", type=Path, required=True, help="folder for the SVG files")
    parser.add_argument("--exposures", default=",".join(map(str, EXPOSURES)))
    parser.add_argument("--estimators", default=",".join(ESTIMATORS))
    parser.add_argument("--workers", type=int, default=1, help="processes")
    parser.add_argument("--kept", type=Path, help="folder that keeps measurements: the same command goes on from there")
    options = parser.parse_args(arguments)
    scenes = scenes_asked(parser, options.scenes)
    options.out.mkdir(parents=True, exist_ok=True)
    maps = [
        {"point": point, "scene": scene, "exposures": int(exposures)}
        for point in options.points.split(",") for scene in scenes for exposures in options.exposures.split(",")
    ]  # fmt: skip
    fixed = {"estimators": options.estimators.split(",")}
    cases = [Case("tests.reference.tables.report_figures:one_map", {**each, **fixed}, each) for each in maps]
    results = results_of(cases, options.workers, options.kept)
    figures = [
        Figure(*figure, compute_s)
        for result in results
        if result is not None
        for figure, compute_s in zip(result["figures"], result["measured"]["compute_s"], strict=True)
    ]
    first = scene_of("cones" if "cones" in scenes else scenes[0])
    drawn = {
        "3-row": figure_3(first),
        "4-exposures": figure_4(first),
        "6-depth": figure_6(first),
        "7-error": figure_of_exposures(figures, "none"),
        "8-median": figure_of_exposures(figures, "median"),
        "9-rate": figure_9(figures),
    }
    for name, text in drawn.items():
        (options.out / f"report-{name}.svg").write_text(text)
    claims_table(figures).write(options.markdown)
    return int(None in results)


if __name__ == "__main__":
    sys.exit(main())
