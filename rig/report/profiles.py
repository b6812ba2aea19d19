"""Profiles of image rows: depth along the row, light of its stripes, and the counts around one stripe.

The counts of a single column are few. So the mean over the neighbouring columns is drawn with them. For this mean, each
neighbour is shifted by whole pixels so that its stripe lies on that of the shown column.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rig.recording.map_rows import RowCounts
from rig.report.charts import FAINT, Panel, Point, Series, legend, panel_svg
from rig.report.page import side_by_side
from rig.report.run_facts import RunFacts
from rig.simd import Float32

RUN_COLOURS: Final = ("#0072b2", "#d55e00")
"""Colours of the first and the second run, and below of haze and of a mean over columns (Okabe and Ito, 2008)."""
HAZE_COLOURS: Final = ("#56b4e9", "#e69f00")
_TRUTH, _COUNTS, _MEAN = "#33404d", FAINT, "#009e73"
MOST_POINTS: Final = 400
"""Most points of a curve."""
NEIGHBOURS: Final = 15
"""Columns on either side of the shown one over which the mean is taken."""
AROUND_PX: Final = 40
"""Pixels shown on either side of a stripe."""
APART_PX: Final = 8.0
"""Stripes farther apart than this are not joined by a line."""
SURE: Final = 0.5
"""Stripes with less confidence are not drawn."""


def row_profiles(runs: Sequence[RunFacts]) -> str:
    """HTML of the profiles of all shown rows of one or two runs; empty if there is nothing to show."""
    rows = next((run.rows for run in runs if run.rows), ())
    parts: list[str] = []
    shown: dict[str, dict[str, Series]] = {}  # by the kind of chart
    for row in rows:
        panels = [panel for panel in (_depth(runs, row), _light(runs, row)) if panel is not None]
        for run in runs:
            panels += _counts(run, row, f", {run.name}" if len(runs) > 1 else "")
        for panel in panels:
            for series in panel.series:
                shown.setdefault(panel.title.split(",")[0], {}).setdefault(series.label, series)
        if panels:
            parts.append(f"<h3>Row {row}</h3>{side_by_side([panel_svg(panel) for panel in panels])}")
    return "".join([*(legend(list(curves.values()), of=kind) for kind, curves in shown.items()), *parts])


def _curve(runs: Sequence[RunFacts], run: RunFacts, what: str, colour: str, points: Sequence[Point]) -> Series:
    """A curve of a run; that of a second run is dashed, to be told from the first one's in a grey print."""
    label = what if len(runs) == 1 else f"{what}, {run.name}"
    return Series(label, colour, points, dashed=run is not runs[0], marker=False, gaps=True)


def _depth(runs: Sequence[RunFacts], row: int) -> Panel | None:
    """Depth along a row, with the truth where it is known."""
    series: list[Series] = []
    for run, colour in zip(runs, RUN_COLOURS, strict=False):
        true_m = run.truth.get("depth_m")
        if not series and true_m is not None and row < len(true_m):
            series.append(Series("true depth", _TRUTH, _along(true_m[row]), marker=False, gaps=True))
        if run.depth_m is not None and row < len(run.depth_m):
            points = _along(run.depth_m[row])
            series.append(_curve(runs, run, "depth", colour, points))
    return Panel("Depth", "x, px", "depth, m", series, x_log=False, y_log=False) if _any(series) else None


def _light(runs: Sequence[RunFacts], row: int) -> Panel | None:
    """Signal and haze of the stripes of a row over their place."""
    series = []
    for run, colour, haze_colour in zip(runs, RUN_COLOURS, HAZE_COLOURS, strict=False):
        stripe = run.stripe
        if "x_px" not in stripe or row >= len(stripe["x_px"]):
            continue
        sure = np.flatnonzero(stripe["confidence"][row] >= SURE)
        order = sure[np.argsort(stripe["x_px"][row, sure])]
        for name, each in (("signal", colour), ("haze", haze_colour)):
            points = _broken(stripe["x_px"][row, order], stripe[name][row, order])
            series.append(_curve(runs, run, name, each, points))
    return Panel("Light of the stripes", "x, px", "photons per exposure", series, x_log=False) if _any(series) else None


def _counts(run: RunFacts, row: int, of: str) -> Iterator[Panel]:
    """Counts around one stripe of a row, with stripe and haze."""
    counted, column = run.counted.get(row), _middle_column(run, row)
    if counted is None or column is None or not counted.frames[column]:
        return
    x_px = run.stripe["x_px"][row]
    at = float(x_px[column])
    first = max(round(at) - AROUND_PX, 0)
    end = min(round(at) + AROUND_PX + 1, counted.counts.shape[1])
    x = np.arange(first, end)
    single = counted.counts[column, first:end] / counted.frames[column]
    mean = mean_profile(counted, run.stripe, row, column)[first:end]
    haze = float(np.nan_to_num(run.stripe["haze"][row, column]))
    levels = [1 - math.exp(-run.ambient - haze), 1 - math.exp(-run.ambient)]
    left, right = levels if run.near_is_left else reversed(levels)
    top = float(max(single.max(initial=0.0), np.nanmax(mean, initial=0.0)))
    series = [
        Series("counts of one column", _COUNTS, _pairs(x, single), line=False),
        Series(f"mean of {2 * NEIGHBOURS + 1} columns, aligned", _MEAN, _pairs(x, mean), marker=False, gaps=True),
        Series(
            "level of haze and ambient light before, ambient light behind",
            HAZE_COLOURS[1],
            [(first, left), (at, left), (at, right), (end - 1, right)],
            marker=False,
        ),
        Series("stripe", RUN_COLOURS[0], [(at, 0.0), (at, top)], dashed=True, marker=False),
    ]
    true_px = run.truth.get("x_px")
    if true_px is not None and true_px.shape == run.stripe["x_px"].shape and np.isfinite(true_px[row, column]):
        true_at = float(true_px[row, column])
        series.append(Series("true stripe", _TRUTH, [(true_at, 0.0), (true_at, 0.5 * top)], marker=False))
    yield Panel(f"Counts, column {column}{of}", "x, px", "counts per exposure", series, x_log=False, y_log=False)


def _middle_column(run: RunFacts, row: int) -> int | None:
    """The sure column nearest to the middle of the sweep; the surest one if none is sure. None without a stripe."""
    if "x_px" not in run.stripe or row >= len(run.stripe["x_px"]):
        return None
    confidence = np.where(np.isfinite(run.stripe["x_px"][row]), run.stripe["confidence"][row], -1)
    sure = np.flatnonzero(confidence >= SURE)
    if len(sure):
        return int(sure[np.argmin(np.abs(sure - len(confidence) // 2))])
    best = int(np.argmax(confidence))
    return best if confidence[best] >= 0 else None


def mean_profile(counted: RowCounts, stripe: Mapping[str, Float32], row: int, column: int) -> NDArray[np.float64]:
    """Mean counts per exposure (width,) of a column and its sure neighbours; NaN where none of them has counts.

    Sure columns are those with a confidence of at least SURE. Each is shifted so that its stripe lies on that of
    `column`, which must have a stripe.
    """
    counts, x_px = counted.counts, stripe["x_px"][row]
    columns, width = counts.shape
    ones, exposures = np.zeros(width), np.zeros(width)
    for c in range(max(column - NEIGHBOURS, 0), min(column + NEIGHBOURS + 1, columns)):
        if not stripe["confidence"][row, c] >= SURE or not counted.frames[c]:
            continue
        by = round(float(x_px[column]) - float(x_px[c]))
        begin, end = max(int(counted.begin_px[c]), 0), min(int(counted.end_px[c]), width)
        to = slice(max(begin + by, 0), min(end + by, width))
        of = slice(to.start - by, to.stop - by)
        if to.start < to.stop:
            ones[to] += counts[c, of]
            exposures[to] += counted.frames[c]
    return np.asarray(np.divide(ones, exposures, out=np.full(width, np.nan), where=exposures > 0))


def _broken(x: NDArray[np.floating], y: NDArray[np.floating]) -> list[Point]:
    """Points by rising x, with a gap where two are more than `APART_PX` apart; at most `MOST_POINTS` of them."""
    points: list[Point] = []
    for point in _pairs(x, y):
        if points and point[0] - points[-1][0] > APART_PX:
            points.append((point[0], math.nan))
        points.append(point)
    return points


def _along(values: Float32) -> list[Point]:
    """Points of a row's pixels, NaN where there is no value; at most `MOST_POINTS` of them."""
    x = np.arange(0, len(values), -(-len(values) // MOST_POINTS))
    return _pairs(x, values[x])


def _pairs(x: NDArray[np.generic], y: NDArray[np.generic]) -> list[Point]:
    step = -(-max(len(x), 1) // MOST_POINTS)
    return [(float(a), float(b)) for a, b in zip(x[::step].tolist(), y[::step].tolist(), strict=True)]


def _any(series: Sequence[Series]) -> bool:
    return any(np.isfinite([y for _, y in each.points]).any() for each in series if each.points)
