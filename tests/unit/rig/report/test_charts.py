"""Curves that break, and charts that stand beside each other with one legend."""

import math
import re

from rig.report.charts import Axis, Panel, Series, chart_svg, legend, panel_svg

POINTS = [(0.0, 1.0), (1.0, 2.0), (2.0, math.nan), (3.0, 1.0), (4.0, 2.0)]


def paths(svg):
    return re.findall(r'<path d="([^"]*)" fill="none" stroke="#123456"', svg)


def test_a_curve_joins_what_it_leaves_out_unless_it_has_gaps():
    joined = Panel("", "x", "y", [Series("a", "#123456", POINTS, marker=False)], x_log=False, y_log=False)
    broken = Panel("", "x", "y", [Series("a", "#123456", POINTS, marker=False, gaps=True)], x_log=False, y_log=False)
    (path,) = paths(panel_svg(joined))
    assert (path.count("M"), path.count("L")) == (1, 3)
    (path,) = paths(panel_svg(broken))
    assert (path.count("M"), path.count("L")) == (2, 2)


def test_a_panel_alone_has_axes_and_its_name_and_no_legend():
    panel = Panel("A <title>", "x, px", "y, m", [Series("curve", "#123456", POINTS)], x_log=False, y_log=False)
    svg = panel_svg(panel)
    assert "<title>A &lt;title&gt;</title>" in svg
    assert ("x, px" in svg, "y, m" in svg, ">curve<" in svg) == (True, True, False)
    assert ">curve<" in chart_svg([panel], title="t")
    html = legend(panel.series)
    assert html.startswith('<p class="legend">')
    assert "curve" in html
    assert html.count("<svg") == 1


def test_a_logarithmic_axis_has_two_labels_at_least():
    """Also between two and five, where no power of ten nor half of one lies."""
    for low, high in ((5.1, 8.3), (2.05, 4.9), (0.12, 0.13), (3.0, 30.0), (1e-3, 1e3), (7.0, 7.0)):
        ticks = Axis.over([low, high], True, 0, 100).ticks()
        assert len(ticks) >= 2
        assert all(0 <= Axis.over([low, high], True, 0, 100).px(value) <= 100 for value in ticks)
