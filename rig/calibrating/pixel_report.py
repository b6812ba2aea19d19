"""The map of the pixels as pictures and as one HTML page."""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.digits import digits
from calibration.pixels.drift import PixelDrift
from calibration.pixels.pixel_file import PixelVersion
from calibration.pixels.pixel_map import PixelMap
from calibration.verdict import Verdict
from rig.calibrating.report_page import Section, page, paragraph, picture, table
from rig.svg_chart import Panel, Series, chart_svg

_NEW, _OLD, _LIMIT = "#0072b2", "#7b8896", "#d55e00"
_BINS = 60
_MOST_LISTED = 40
_DEAD_BGR = (0, 0, 0)


def dark_rate_picture(pixels: PixelMap) -> NDArray[np.uint8]:
    """Dark rates (rows, width, 3) BGR on a logarithmic scale from a third of the usual to the fastest; dead black."""
    rate = np.nan_to_num(pixels.rate_per_s, nan=0.0).astype(np.float64)
    low = max(pixels.ordinary_per_s / 3, 1e-3)
    high = max(float(rate.max(initial=0.0)), 10 * low)
    share = np.log(np.clip(rate, low, high) / low) / np.log(high / low)
    coloured = np.asarray(cv2.applyColorMap(np.round(255 * share).astype(np.uint8), cv2.COLORMAP_INFERNO), np.uint8)
    if pixels.dead is not None:
        coloured[pixels.dead] = _DEAD_BGR
    return coloured


def pixel_sections(
    pixels: PixelMap, drift: PixelDrift | None = None, against: PixelVersion | None = None
) -> list[Section]:
    """Parts of a report: the map, the distribution of the rates beside the older one, and what changed."""
    middle = pixels.ordinary_per_s
    fastest = float(np.nanmax(pixels.rate_per_s))
    caption = f"Dark rate of each pixel, {digits(middle / 3)} to {digits(fastest)} counts/s on a logarithmic scale."
    sections = [
        Section("Dark rate", picture(dark_rate_picture(pixels), caption)),
        Section("Distribution", rate_chart(pixels, None if against is None else against.pixels)),
    ]
    if drift is not None:
        rows = [
            (what, ", ".join(f"({row}, {x})" for row, x in places[:_MOST_LISTED].tolist()) or "none")
            for what, places in (("became hot", drift.became_hot), ("became dead", drift.became_dead),
                                 ("recovered", drift.recovered))
        ]  # fmt: skip
        said = paragraph(f"Row and column of up to {_MOST_LISTED} pixels each.", small=True)
        sections.append(Section("Changed since the last map", table(("", ""), rows) + said))
    return sections


def rate_chart(pixels: PixelMap, older: PixelMap | None = None) -> str:
    """SVG: how many pixels have which dark rate, and where hot begins."""
    maps = [(pixels, "this map", _NEW), *([(older, "the last one", _OLD)] if older is not None else [])]
    rates = [one.rate_per_s[np.isfinite(one.rate_per_s)].astype(np.float64) for one, _, _ in maps]
    # Pixels that never fired stand at half a count.
    floor = 0.5 / max(pixels.frames, 1) / pixels.exposure_s
    rates = [np.maximum(rate, floor) for rate in rates]
    ends = min(float(r.min()) for r in rates), max(float(r.max()) for r in rates)
    edges = np.geomspace(ends[0] * 0.9, max(ends[1], 2 * ends[0]) * 1.1, _BINS + 1)
    middles = np.sqrt(edges[1:] * edges[:-1])
    series, tallest = [], 1.0
    for (_, label, colour), rate in zip(maps, rates, strict=True):
        counts = np.histogram(rate, edges)[0].astype(np.float64)
        tallest = max(tallest, float(counts.max()))
        points = [(float(x), float(n)) for x, n in zip(middles, counts, strict=True) if n]
        series.append(Series(label, colour, points, line=False))
    limit = float(np.nanmedian(pixels.limit_per_s))
    series.append(Series("hot from here on", _LIMIT, [(limit, 1.0), (limit, tallest)], dashed=True, marker=False))
    panel = Panel("", "dark rate, counts/s", "pixels", series)
    return chart_svg([panel], title="Pixels by dark rate", across=1)


def pixel_page(
    pixels: PixelMap,
    rows: Sequence[tuple[str, str]],
    verdict: Verdict,
    drift: PixelDrift | None,
    against: PixelVersion | None,
) -> str:
    """The whole report."""
    line = f"{int(pixels.defects.sum())} of {pixels.defects.size} pixels are not to be used."
    return page("Pixels", verdict, line, rows, pixel_sections(pixels, drift, against))
