"""The report's figures 3, 4, 6, 7, 8 and 9, made anew, and its claims beside what this program gives.

    python -m tests.reference.tables.report_figures --out docs/figures
    python -m tests.reference.tables.report_figures --out /tmp/figures --scenes procedural --exposures 1,10

What each figure of the report shows is not known here; docs/how-to/tradeoff.md says what ours stand for. Counts come
from the yardstick's own simulator at the report's working point, five prepared scenes where they are there; errors are
of stripes on trusted pixels against the continuous truth, a missing answer counts as 10 px. `--measured FILE` keeps
what figures 7 to 9 are drawn from; what it holds is not measured again. The table for docs/how-to/tradeoff.md is
printed.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Collection, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean

import numpy as np

from rig.estimate.registry import ESTIMATORS, FILTERS
from rig.run_folder.charts import ChartMark, Drawable, Panel, Series, chart_svg
from rig.tradeoff.files import colour_of
from tests.reference.adapter import reconstructor_of, volume_of, windowed
from tests.reference.scene import Scene, load_scene, procedural_scene, scene_names
from tests.reference.tables.mosaics import PLACE_PX, Mosaic
from tests.reference.working_point import CLEAR, DENSE, POINTS, REPORT, WorkingPoint, score

COLUMNS, FRAME_RATE_HZ = 500, 100_000
EXPOSURES = (1, 3, 5, 10, 20)
SEED = 1
CLAIMS = (ChartMark((10, 1.0), "report: < 1 px"), ChartMark((20, 0.1), "report: about 0.1 px"))
"""Mean error of the report by exposures, on truth rounded to whole pixels."""
SHARE = "within_1px"
ROW = 250
"""Image row of figures 3 and 4."""


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


def measure(
    scenes: Sequence[Scene],
    points: Sequence[str],
    exposures: Sequence[int],
    estimators: Sequence[str],
    known: Collection[tuple[str, str, int, str]] = (),
) -> Iterator[Figure]:
    """Every combination, one map each, which the estimator learns from as well; but for those that are known."""
    for point_name in points:
        for scene in scenes:
            point = WorkingPoint(scene, POINTS[point_name])
            truth, trusted = point.truth(), point.trusted
            for k in exposures:
                wanted = [name for name in estimators if (point_name, scene.name, k, name) not in known]
                counts = point.counts(k, SEED) if wanted else None
                for estimator in wanted:
                    maker = reconstructor_of(point, estimator)
                    assert counts is not None, "drawn where any is wanted"
                    part = windowed(counts, maker.geometry.x0, maker.geometry.window)
                    volume = volume_of(maker, part, k)
                    begun = time.perf_counter()
                    stripe = maker.estimator.estimate(volume, maker.geometry)
                    estimate_s = time.perf_counter() - begun
                    for filter in FILTERS:
                        result = maker.complete(stripe, volume, filter, estimate_s)
                        found = score(result.stripe.x_px, truth, trusted)
                        yield Figure(
                            point_name, scene.name, k, estimator, filter, found["mean_abs_charged"],
                            found["within_1px"], found["mean_abs_rounded"], result.compute_s,
                        )  # fmt: skip


def figure_3(scene: Scene) -> str:
    """Expected light along one image row: haze that decays, and ends with a step at the stripe."""
    panels = []
    for name, light in (("clear air", CLEAR), ("fog of the report, 0.05 /m", REPORT), ("dense fog, 0.3 /m", DENSE)):
        point = WorkingPoint(scene, light)
        column, x = _column_of(point)
        flux = point.flux_of_column(column)[ROW]
        shown = slice(max(0, round(x) - 130), round(x) + 40)
        points = list(zip(range(shown.start, shown.stop), map(float, flux[shown]), strict=True))
        series = Series("expected photons", colour_of("likelihood"), points, marker=False, step=True)
        at = ChartMark((x, float(flux[round(x)])), "stripe")
        panels.append(
            Panel(name, "pixel of the row", "photons an exposure", [series], x_log=False, y_log=False, marks=[at])
        )
    return chart_svg(panels, title=f"One image row of scene {scene.name}: haze, step and stripe", across=3)


def figure_4(scene: Scene) -> str:
    """The same row as it is detected: one exposure, ten, a hundred."""
    point = WorkingPoint(scene, REPORT)
    column, x = _column_of(point)
    expected = -np.expm1(-point.flux_of_column(column)[ROW])
    shown = slice(max(0, round(x) - 130), round(x) + 40)
    panels = []
    for k in (1, 10, 100):
        share = point.counts(k, SEED)[column, ROW] / k
        curves = [
            Series("detected", colour_of("edge"), _points(shown, share), marker=False, step=True),
            Series("expected", colour_of("likelihood"), _points(shown, expected), marker=False),
        ]
        title = f"{k} exposure{'s' * (k > 1)}"
        mark = ChartMark((x, float(expected[round(x)])), "stripe")
        panels.append(
            Panel(title, "pixel of the row", "share of exposures", curves, x_log=False, y_log=False, marks=[mark])
        )
    return chart_svg(panels, title="The same row, detected in the fog of the report (0.05 /m)", across=3)


def figure_6(scene: Scene) -> str:
    """Depth maps: the truth, the report's way and ours."""
    point = WorkingPoint(scene, REPORT)
    known = scene.depth_m[np.isfinite(scene.depth_m)]
    limits = float(np.percentile(known, 1)), float(np.percentile(known, 99))
    panels: list[Drawable] = [Mosaic("truth", scene.depth_m, limits)]
    for k, estimator, filter in (
        (1, "edge", "median"), (10, "edge", "none"), (10, "edge", "median"),
        (1, "joint", "none"), (10, "joint", "none"),
    ):  # fmt: skip
        maker = reconstructor_of(point, estimator, filter)
        part = windowed(point.counts(k, SEED), maker.geometry.x0, maker.geometry.window)
        depth_m = maker.map(volume_of(maker, part, k)).depth_m
        filtered = "" if filter == "none" else f" + {filter}"
        panels.append(Mosaic(f"{estimator}{filtered}, {k} exposure{'s' * (k > 1)}", depth_m, limits))
    notes = [f"Scene {scene.name} in the fog of the report (0.05 /m); answers of confidence 0.5 and more enter a map."]
    return chart_svg(panels, title="Depth maps", across=3, notes=notes, panel_px=PLACE_PX)


def figure_of_exposures(figures: Sequence[Figure], filter: str) -> str:
    """Error over exposures, a panel for each working point, and the share within 1 px (figures 7 and 8)."""
    panels = []
    for point, light in POINTS.items():
        here = [figure for figure in figures if figure.point == point and figure.filter == filter]
        if here:
            title = f"{point}: extinction {light.extinction_per_m:g} /m"
            marks = CLAIMS if point == "report" else ()
            panels += [
                Panel(title, "exposures of a column", "mean error, px", list(_curves(here)), marks=marks),
                Panel(title, "exposures of a column", "share within 1 px", list(_curves(here, SHARE)), y_log=False),
            ]
    filtered = "without filter" if filter == "none" else "with the 5 x 5 median"
    return chart_svg(panels, title=f"Error over exposures, {filtered}", notes=_notes(figures))


def figure_9(figures: Sequence[Figure]) -> str:
    """Error over map rate, and the share within 1 px: what speed costs."""
    here = [figure for figure in figures if figure.point == "report"]
    rates = {k: FRAME_RATE_HZ / (COLUMNS * k) for k in {figure.exposures for figure in here}}
    marks = [ChartMark((20.0, 1.0), "report: 20 maps/s, < 1 px"), ChartMark((10.0, 0.1), "report: 0.1 px")]

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
        Panel("error", label, "mean error, px", curves("mean_px"), marks=marks),
        Panel("answers within 1 px", label, "share", curves(SHARE), y_log=False),
    ]
    notes = [
        f"Mean over the scenes {_scenes(figures)}. One map each.",
        "Time of columns only: dark frames and fly-back take another tenth and more ('rig tradeoff').",
    ]
    return chart_svg(panels, title="Error over map rate in the fog of the report", notes=notes)


def claims_table(figures: Sequence[Figure]) -> str:
    """The report's claims and ours, as Markdown."""
    lines = ["| K | maps/s | the report | " + " | ".join(_named(*method) for method in _methods(figures)) + " |"]
    lines.append("|---" * (3 + len(_methods(figures))) + "|")
    claims = {1: "cannot do", 10: "< 1 px", 20: "about 0.1 px"}
    for k in sorted({figure.exposures for figure in figures if figure.point == "report"}):
        cells = []
        for method in _methods(figures):
            here = [f for f in figures if (f.point, f.exposures, (f.estimator, f.filter)) == ("report", k, method)]
            cells.append(
                f"{fmean(f.mean_px for f in here):.2f} ({fmean(f.rounded_px for f in here):.2f})" if here else "-"
            )
        lines.append(f"| {k} | {FRAME_RATE_HZ / COLUMNS / k:g} | {claims.get(k, '')} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _methods(figures: Sequence[Figure]) -> list[tuple[str, str]]:
    return sorted(
        {(figure.estimator, figure.filter) for figure in figures},
        key=lambda m: (ESTIMATORS.index(m[0]), m[1] != "none"),
    )


def _named(estimator: str, filter: str) -> str:
    return estimator if filter == "none" else f"{estimator} + {filter}"


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


def _points(shown: slice, values: np.ndarray) -> list[tuple[float, float]]:
    return list(zip(range(shown.start, shown.stop), map(float, values[shown]), strict=True))


def _column_of(point: WorkingPoint) -> tuple[int, float]:
    """A column whose stripe on ROW is trusted, as far right as any with room behind it, and where it stands."""
    width = point.scene.shape[1]
    good = point.trusted[ROW] & (point.x_true[ROW] > 150) & (point.x_true[ROW] < width - 60)
    column = int(np.flatnonzero(good)[good.sum() * 2 // 3])
    return column, float(point.x_true[ROW, column])


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, draw and print."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.reference.tables.report_figures", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--out", type=Path, required=True, help="folder for the SVG files")
    parser.add_argument("--scenes", help="comma-separated; 'procedural' is the built-in one; default: all prepared")
    parser.add_argument("--points", default="report,dense,clear")
    parser.add_argument("--exposures", default=",".join(map(str, EXPOSURES)))
    parser.add_argument("--estimators", default=",".join(ESTIMATORS))
    parser.add_argument("--measured", type=Path, help="file of measurements: read where it is there, else written")
    options = parser.parse_args(arguments)
    names = options.scenes.split(",") if options.scenes else list(scene_names()) or ["procedural"]
    scenes = [procedural_scene() if name == "procedural" else load_scene(name) for name in names]
    found = [scene for scene in scenes if scene is not None]
    if len(found) < len(scenes):
        parser.error(f"a scene of {options.scenes} is absent; present: {', '.join([*scene_names(), 'procedural'])}")
    options.out.mkdir(parents=True, exist_ok=True)
    kept: Path | None = options.measured
    figures = [] if kept is None or not kept.exists() else [Figure(**one) for one in json.loads(kept.read_text())]
    known = {(figure.point, figure.scene, figure.exposures, figure.estimator) for figure in figures}
    exposures = [int(k) for k in options.exposures.split(",")]
    for figure in measure(found, options.points.split(","), exposures, options.estimators.split(","), known):
        figures.append(figure)
        print(figure, file=sys.stderr, flush=True)
        if kept is not None and figure.filter == FILTERS[-1]:
            kept.write_text(json.dumps([asdict(one) for one in figures]))
    first = next((scene for scene in found if scene.name == "cones"), found[0])
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
    print(claims_table(figures))
    return 0


if __name__ == "__main__":
    sys.exit(main())
