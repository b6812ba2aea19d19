"""Draws the figures of the explanations and tutorials, with the program's own physics, plan and simulator.

    make figures                                     # all of them: a minute or two, mostly scans
    python -m docs.generate.figures photons clocks   # only these

Figures are SVG with colours that the colour-blind can tell apart. They are part of the repository, so that pages show
them on a forge, and so that a change of the program that alters one is seen.
"""

import math
import re
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from calibration.files.rig_file import load_rig_model
from docs.generate import diagrams
from rig.api import configure, plan_scan, scan, tradeoff
from rig.plan.scan_plan import column_command
from rig.report.charts import Panel, Series, chart_svg
from rig.run_folder.pictures import depth_limits, depth_scale, intensity_picture
from rig.strategies.apparatus import Rule
from rig.strategies.comparison.compare import StrategyRow
from rig.strategies.comparison.files import time_svg
from rig.strategies.strategy import find_strategy
from rig.tradeoff.files import COLOURS
from rig.tradeoff.row_light import Array, scene_lights
from sim_backend.scenes.medium import KOSCHMIEDER

FOLDER = Path(__file__).parents[1] / "figures"
BLUE, ORANGE, GREEN, PINK = "#0072b2", "#d55e00", "#009e73", "#cc79a7"
"""Colours that the colour-blind can tell apart (Okabe and Ito, 'Color universal design', 2008)."""


def geometry() -> str:
    """Places of three columns' stripes by depth, and the depth error of a tenth of a pixel, for the bundled rig."""
    config = configure()
    assert config.calibration is not None
    model = load_rig_model(config.calibration)
    depth_m = np.geomspace(1, 15, 60)
    f_px, _, centre_px = (float(value) for value in np.asarray(model.camera.matrix)[0])
    stripes = []
    for column, colour in ((120, BLUE), (250, ORANGE), (380, GREEN)):
        command = column_command(np.array([column]), config.scan.command_range, config.scan.columns)
        nx, _, nz, d = model.planes(command)[0]
        # On the middle row y = 0: nx u z + nz z = d.
        u = (d / depth_m - nz) / nx
        points = [(z, x) for z, x in zip(depth_m, f_px * u + centre_px, strict=True) if 0 <= x < 512]
        stripes.append(Series(f"column {column}", colour, points, marker=False))
    errors = [
        Series(f"baseline {base_m:g} m", colour, [(z, 100.0 * z**2 / (f_px * base_m)) for z in depth_m], marker=False)
        for base_m, colour in ((0.1, PINK), (0.3, "#33404d"), (1.0, "#e69f00"))
    ]
    panels = [
        Panel("Where a column's stripe lies", "depth z, m", "pixel x on the middle row", stripes, y_log=False),
        Panel("Depth error of 0.1 px, by baseline", "depth z, m", "depth error, mm", errors),
    ]
    return chart_svg(
        panels, title="Depth is read off the place of the stripe", notes=["Bundled rig: f = 600 px, baseline 0.3 m."]
    )


def fog() -> str:
    """The expected light of one image row in clear air and in fog of two densities, and the light that comes back."""
    rows, back = [], []
    depth_m = np.linspace(1, 15, 50)
    for visibility, colour in (("clear", GREEN), ("50 m", BLUE), ("15 m", ORANGE)):
        flux = _row(visibility)
        label = "clear air" if visibility == "clear" else f"visibility {visibility}"
        rows.append(Series(label, colour, [(float(x), float(one)) for x, one in enumerate(flux)], marker=False))
        extinction_per_m = 0.0 if visibility == "clear" else KOSCHMIEDER / float(visibility.removesuffix(" m"))
        share = np.exp(-2 * extinction_per_m * depth_m)
        back.append(Series(label, colour, list(zip(depth_m, share, strict=True)), marker=False))
    panels = [
        Panel(
            "An image row: haze, stripe, then less", "pixel, near to far", "detections per exposure", rows, x_log=False
        ),
        Panel("Light that is not scattered on its way", "depth, m", "share", back, x_log=False),
    ]
    return chart_svg(panels, title="A laser line in fog", notes=["Expected light of one row of the simulated street."])


def _row(visibility: str) -> Array:
    """Expected light of one and the same image row of the simulated street, near to far, by visibility."""
    lights = scene_lights(configure(fog=visibility), rows=80, seed=4)
    light = min(lights, key=lambda one: abs(one.position - 0.6 * len(one.before)))
    return light.flux(np.array([light.position]))[0]


def photons() -> str:
    """Saturation of a binary pixel, the error of the flux, and counts drawn for few and for many frames."""
    flux = np.geomspace(0.02, 8, 70)
    fires = [Series("share of frames with a 1", BLUE, list(zip(flux, 1 - np.exp(-flux), strict=True)), marker=False)]
    errors = [
        Series(f"K = {k}", colour, [(f, math.sqrt(math.expm1(f) / k) / f) for f in flux], marker=False)
        for k, colour in ((3, PINK), (10, ORANGE), (100, GREEN))
    ]
    expected = -np.expm1(-_row("50 m"))
    place = np.arange(len(expected))
    rng = np.random.default_rng(5)
    rows = [Series("expected", "#33404d", [(float(x), float(expected[x])) for x in place], marker=False)]
    for k, colour in ((3, PINK), (100, GREEN)):
        drawn = rng.binomial(k, expected) / k
        rows.append(Series(f"drawn, K = {k}", colour, list(zip(place.astype(float), drawn, strict=True)), line=False))
    panels = [
        Panel("A pixel fires with 1 - exp(-flux)", "flux, detections per exposure", "share", fires, y_log=False),
        Panel("Relative error of the flux", "flux, detections per exposure", "error / flux", errors),
        Panel("Counts of a row / K, in fog", "pixel, near to far", "count / K", rows, x_log=False, y_log=False),
    ]
    return chart_svg(panels, title="Counts of single photons", across=3)


def estimators() -> str:
    """Errors of all estimators by the number of exposures in the default scene."""
    names = ("argmax", "edge", "likelihood", "joint")
    rows = tradeoff(exposures=(1, 2, 3, 5, 10, 20), estimators=names, filters=("none",), limits=False).rows
    series = [
        Series(name, COLOURS[name], [(row.exposures, row.mean_abs_px) for row in rows if row.estimator == name])
        for name in names
    ]
    panel = Panel("", "exposures K, frames per column", "mean error of the stripe, px", series)
    return chart_svg(
        [panel],
        title="Estimators in the default street, visibility 45 m",
        notes=["One scan for each K."],
        across=1,
    )


def clocks() -> str:
    """One sweep over time, out of a plan with few columns: mirror, markers, gate and frames."""
    config = configure(exposures=40)
    few = config.model_copy(update={"scan": config.scan.model_copy(update={"columns": 12})})
    return diagrams.sweep(plan_scan(few))


def safety() -> str:
    """What can end the light, and who watches whom."""
    return diagrams.light_chain()


def pictures() -> str:
    """Counts and depth of the default scan, as the tutorial's reader gets them."""
    result = scan(seed=0)
    assert result.last is not None
    assert result.last.depth_m is not None
    depth_m = result.last.depth_m
    colours = depth_scale(depth_limits(depth_m)).colours(_smaller(depth_m.astype(np.float64)))
    grey = _smaller(intensity_picture(result.last.intensity).astype(np.float64)).astype(np.uint8)
    named = (
        ("counts of all frames", np.repeat(grey[..., None], 3, axis=-1)),
        ("depth: near is bright, black is none", colours),
    )
    return diagrams.pictures(named)


def other_ways_scenes() -> str:
    """Error over time by the tables of docs/results/strategies-scenes.md, equal energy and equal irradiance, for the
    ways that are there for both rules and light one column at a time or a pattern."""
    page = (FOLDER.parent / "results" / "strategies-scenes.md").read_text(encoding="utf-8")
    cells: dict[tuple[Rule, str, str, float], str] = {}
    for title, table in re.findall(r"^##+ ([^\n]* ms)$(.*?)(?=^#)", page, re.MULTILINE | re.DOTALL):
        rule: Rule = "irradiance" if title.startswith("Equal irradiance") else "energy"
        head, _, *lines = (line.strip("| ").split(" | ") for line in table.split("\n") if line.startswith("|"))
        time_ms = float(title.removesuffix(" ms").split()[-1])
        for way, *values in lines:
            cells.update(
                ((rule, air, way.strip("`"), time_ms), value)
                for air, value in zip(head, values, strict=True)
                if value != "-"
            )
    both = {way for rule, _, way, _ in cells if rule == "irradiance"} - {"line-2-joint", "line-4-joint"}
    return time_svg([
        StrategyRow(way, find_strategy(way).light, "five scenes of 1.5 to 6 m", air, rule, time_ms, 1,
                    mean_px=float(value.split(" / ")[0]))
        for (rule, air, way, time_ms), value in cells.items()
        if way in both
    ])  # fmt: skip


def _smaller(values: Array, times: int = 7) -> Array:
    """Medians of squares of `times` pixels; NaN where most pixels have none."""
    rows, width = (size // times for size in values.shape)
    squares = values[: rows * times, : width * times].reshape(rows, times, width, times).swapaxes(1, 2)
    squares = squares.reshape(rows, width, -1)
    known = np.isfinite(squares).sum(axis=-1) * 2 > times**2
    filled = np.where(known[..., None], squares, 0.0)
    return np.where(known, np.nanmedian(filled, axis=-1), np.nan)


FIGURES: Mapping[str, Callable[[], str]] = {
    "geometry": geometry,
    "fog": fog,
    "photons": photons,
    "estimators": estimators,
    "clocks": clocks,
    "laser-safety": safety,
    "first-fog-map": pictures,
    "other-ways-scenes": other_ways_scenes,
}
"""Makers of figures by the name of their file."""


def main(names: list[str]) -> None:
    """Draw the figures of these names, all if there are none, into docs/figures/."""
    for name in names or FIGURES:
        (FOLDER / f"{name}.svg").write_text(FIGURES[name](), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
