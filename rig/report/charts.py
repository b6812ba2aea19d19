"""Draws charts as SVG text: curves over linear or logarithmic axes, side by side, with one legend, on a white ground.

Pictures in the repository are SVG (docs/decisions/0008-pictures-are-svg.md); a handful of curves needs no library.
"""

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from rig.run_folder.pictures import round_values

INK, FAINT, GRID = "#33404d", "#7b8896", "#e3e8ed"
FRONT = "#f2cf5b"
"""Colour of a Pareto front."""
PANEL_PX = (400, 290)
"""Width and height of a panel with its axes and labels."""
_LEFT, _RIGHT, _TOP, _BOTTOM = 58, 14, 30, 46
_LEGEND_PX = 20
_TITLE_PX = 30
_NOTE_PX = 6
"""Width of a letter of small print, rather too much, by which its lines are broken."""
_DECADES_WITH_STEPS = 2.3
"""Axes over fewer decades than this are labelled at 1, 2 and 5 times their powers of ten."""

Point = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Series:
    """A curve, or single points. Points that are not finite, or that a logarithmic axis cannot show, are left out.

    intervals: (low, high) in y of each point. names: small text beside each point. gaps: whether the curve breaks where
    a point is left out.
    """

    label: str
    colour: str
    points: Sequence[Point]
    intervals: Sequence[Point] = ()
    names: Sequence[str] = ()
    dashed: bool = False
    line: bool = True
    marker: bool = True
    gaps: bool = False


@dataclass(frozen=True, slots=True)
class Axis:
    """An axis between the values `low` and `high`, from pixel `start_px` to `end_px`."""

    low: float
    high: float
    log: bool
    start_px: float
    end_px: float

    @classmethod
    def over(cls, values: Sequence[float], log: bool, start_px: float, end_px: float) -> "Axis":
        """Make an axis that shows all finite values, with some margin. A logarithmic one shows those above zero."""
        shown = [value for value in values if math.isfinite(value) and (value > 0 or not log)] or [1.0]
        low, high = min(shown), max(shown)
        if log:
            room = max(high / low, 2.0) ** 0.06
            return cls(low / room, high * room, True, start_px, end_px)
        room = 0.05 * ((high - low) or 1.0)
        return cls(0.0 if 0 <= low < room * 8 else low - room, high + room, False, start_px, end_px)

    def px(self, value: float) -> float:
        """Pixel of a value; beyond the ends of the axis for a value outside it. NaN if the value is not finite, or not
        above 0 on a logarithmic axis."""
        if not math.isfinite(value) or (self.log and value <= 0):
            return math.nan
        low, high, at = (math.log(v) if self.log else v for v in (self.low, self.high, value))
        return self.start_px + (at - low) / (high - low) * (self.end_px - self.start_px)

    def ticks(self) -> list[float]:
        """Round values at which to put labels."""
        if not self.log:
            return round_values(self.low, self.high, 5)
        first, last = math.floor(math.log10(self.low)), math.ceil(math.log10(self.high))
        steps = (1, 2, 5) if math.log10(self.high / self.low) < _DECADES_WITH_STEPS else (1,)
        values = [step * 10.0**power for power in range(first, last + 1) for step in steps]
        shown = [value for value in values if self.low <= value <= self.high]
        return shown if len(shown) > 1 else round_values(self.low, self.high, 4)


@dataclass(frozen=True, slots=True)
class Panel:
    """Curves over one pair of axes. front: points, by rising x, of a broad band that is drawn behind the curves."""

    title: str
    x_label: str
    y_label: str
    series: Sequence[Series]
    x_log: bool = True
    y_log: bool = True
    front: Sequence[Point] = ()

    def axes(self) -> tuple[Axis, Axis]:
        """The axes of x and y, which show all points of the curves, and their intervals as far as they are above 0."""
        points = [point for series in self.series for point in series.points]
        ends = [(math.nan, y) for series in self.series for interval in series.intervals for y in interval if y > 0]
        width, height = PANEL_PX
        x = Axis.over([point[0] for point in points], self.x_log, _LEFT, width - _RIGHT)
        return x, Axis.over([point[1] for point in points + ends], self.y_log, height - _BOTTOM, _TOP)

    def svg(self) -> str:
        """Axes, band and curves as SVG elements; the panel's upper left corner is at (0, 0)."""
        x, y = self.axes()
        parts = [_axes(x, y, self)]
        if self.front:
            parts.append(f'<path d="{_path(x, y, self.front)}" stroke="{FRONT}" stroke-width="9" {_ROUND}/>')
        parts += [_curve(x, y, series) for series in self.series]
        return "".join(parts)


_ROUND = 'fill="none" stroke-linejoin="round" stroke-linecap="round" opacity="0.75"'


def chart_svg(
    panels: Sequence[Panel],
    *,
    title: str,
    across: int = 2,
    notes: Sequence[str] = (),
    panel_px: tuple[int, int] = PANEL_PX,
) -> str:
    """The text of an SVG file: panels in rows of up to `across`, with a legend and `notes`, small print, below.

    panel_px: width and height of the place for each panel; a `Panel` itself is always drawn in PANEL_PX.
    """
    across = min(across, len(panels))
    down = -(-len(panels) // across)
    width, panel_height = across * panel_px[0], panel_px[1]
    entries = list({series.label: series for panel in panels for series in panel.series if series.label}.values())
    in_row = max(1, width // 190)
    legend_top = _TITLE_PX + down * panel_height
    notes_top = legend_top + -(-len(entries) // in_row) * _LEGEND_PX + 8
    lines = [line for note in notes for line in textwrap.wrap(note, width // _NOTE_PX)]
    height = notes_top + 15 * len(lines) + 8
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}" '
        'font-family="Helvetica, Arial, sans-serif" font-size="12">',
        f"<title>{escape(title)}</title>",
        f'<rect width="{width}" height="{height}" rx="8" fill="#ffffff"/>',
        f'<text x="14" y="21" font-size="14" font-weight="bold" fill="{INK}">{escape(title)}</text>',
    ]
    for i, panel in enumerate(panels):
        at = f"{i % across * panel_px[0]} {_TITLE_PX + i // across * panel_height}"
        parts.append(f'<g transform="translate({at})">{panel.svg()}</g>')
    for i, series in enumerate(entries):
        left, top = 20 + i % in_row * 190, legend_top + i // in_row * _LEGEND_PX + 8
        line = Series(series.label, series.colour, ((0, 0), (1, 0)), dashed=series.dashed, line=series.line,
                      marker=series.marker)  # fmt: skip
        short = _curve(Axis(0, 1, False, left, left + 26), Axis(0, 1, False, top, top - 1), line)
        parts.append(f'{short}<text x="{left + 34}" y="{top + 4}" fill="{INK}">{escape(series.label)}</text>')
    for i, words in enumerate(lines):
        parts.append(f'<text x="20" y="{notes_top + 15 * i + 8}" font-size="11" fill="{FAINT}">{escape(words)}</text>')
    return "\n".join([*parts, "</svg>\n"])


def legend(series: Sequence[Series], *, of: str = "") -> str:
    """HTML of a legend of curves, for charts that stand beside each other. of: title of the charts it is for."""
    parts = [f"<b>{escape(of)}:</b> "] if of else []
    for each in series:
        line = Series("", each.colour, ((0, 0), (1, 0)), dashed=each.dashed, line=each.line, marker=each.marker)
        drawn = _curve(Axis(0, 1, False, 4, 28), Axis(0, 1, False, 7, 6), line)
        sample = f'<svg class="key" viewBox="0 0 32 14" width="32" height="14">{drawn}</svg>'
        parts.append(f"<span>{sample} {escape(each.label)}</span>")
    return f'<p class="legend">{"".join(parts)}</p>'


def panel_svg(panel: Panel) -> str:
    """A single panel as SVG text, under the panel's own title and without a legend."""
    width, height = PANEL_PX
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}" '
        f'font-family="Helvetica, Arial, sans-serif" font-size="12"><title>{escape(panel.title)}</title>'
        f"{panel.svg()}</svg>"
    )


def _axes(x: Axis, y: Axis, panel: Panel) -> str:
    right, bottom = x.end_px, y.start_px
    parts = [_text(x.start_px, 18, panel.title, weight="bold")]
    for value in x.ticks():
        at = x.px(value)
        parts.append(f'<path d="M{at:.1f} {y.end_px}V{bottom}" stroke="{GRID}"/>')
        parts.append(_text(at, bottom + 15, f"{value:g}", anchor="middle"))
    for value in y.ticks():
        at = y.px(value)
        parts.append(f'<path d="M{x.start_px} {at:.1f}H{right}" stroke="{GRID}"/>')
        parts.append(_text(x.start_px - 6, at + 4, f"{value:g}", anchor="end"))
    parts.append(f'<path d="M{x.start_px} {y.end_px}V{bottom}H{right}" fill="none" stroke="{INK}"/>')
    parts.append(_text((x.start_px + right) / 2, bottom + 34, panel.x_label, anchor="middle"))
    middle = (y.end_px + bottom) / 2
    turned = f'<g transform="translate(16 {middle:.0f}) rotate(-90)">{_text(0, 0, panel.y_label, anchor="middle")}</g>'
    return "".join([*parts, turned])


def _curve(x: Axis, y: Axis, series: Series) -> str:
    parts = []
    dashes = ' stroke-dasharray="5 4"' if series.dashed else ""
    if series.line and len(series.points) > 1:
        path = _path(x, y, series.points, gaps=series.gaps)
        parts.append(f'<path d="{path}" fill="none" stroke="{series.colour}" stroke-width="1.8"{dashes}/>')
    for (at, _), (low, high) in zip(series.points, series.intervals, strict=False):
        ends = x.px(at), y.px(max(low, y.low)), y.px(high)
        if all(map(math.isfinite, ends)):
            parts.append(f'<path d="M{ends[0]:.1f} {ends[1]:.1f}V{ends[2]:.1f}" stroke="{series.colour}"/>')
    for point in series.points if series.marker else ():
        px = x.px(point[0]), y.px(point[1])
        if all(map(math.isfinite, px)):
            inside = "#ffffff" if series.dashed else series.colour
            parts.append(
                f'<circle cx="{px[0]:.1f}" cy="{px[1]:.1f}" r="3.2" fill="{inside}" stroke="{series.colour}"/>'
            )
    for point, name in zip(series.points, series.names, strict=False):
        px = x.px(point[0]), y.px(point[1])
        if all(map(math.isfinite, px)):
            parts.append(_text(px[0] + 5, px[1] - 5, name, size=10, colour=series.colour))
    return "".join(parts)


def _path(x: Axis, y: Axis, points: Sequence[Point], *, gaps: bool = False) -> str:
    """Steps of a path through the points that can be shown; with gaps a new one begins behind each that cannot."""
    steps, begins = [], True
    for a, b in ((x.px(point[0]), y.px(point[1])) for point in points):
        if math.isfinite(a) and math.isfinite(b):
            steps.append(f"{'M' if begins else 'L'}{a:.1f} {b:.1f}")
            begins = False
        elif gaps:
            begins = True
    return "".join(steps)


def _text(
    x: float, y: float, text: str, *, anchor: str = "start", size: int = 12, weight: str = "", colour: str = INK
) -> str:
    bold = f' font-weight="{weight}"' if weight else ""
    placed = "" if anchor == "start" else f' text-anchor="{anchor}"'
    return f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size}"{placed}{bold} fill="{colour}">{escape(text)}</text>'
