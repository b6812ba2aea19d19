"""A report is one HTML file: verdict and reasons before all pictures, nothing loaded from elsewhere."""

import re
from dataclasses import replace
from functools import cache
from html import escape

import numpy as np
import pytest

from calibration.judging.rig import Judged, judge_fit
from calibration.rig_fit.fit import RigFit, fit_rig
from calibration.verdict import Reason, Verdict
from calibration.views import View
from rig.calibrating.report import planes_report
from rig.calibrating.report_page import Section, page, paragraph, table
from tests.reference import calibration_data as data


@cache
def _fitted() -> tuple[list[View], RigFit]:
    rng = np.random.default_rng(1)
    rig = data.TrueRig()
    views = data.random_views(rng, rig, 8, data.Seen(passages=200), (35.2, -35.2))
    return views, fit_rig(views, data.BOARD, (512, 512))


@pytest.fixture(name="judged")
def _judged() -> Judged:
    views, fit = _fitted()
    return judge_fit(fit, views, stated_baseline_m=0.3)


def test_the_report_of_planes_shows_text_first_then_the_four_pictures(judged: Judged) -> None:
    views, fit = _fitted()
    html = planes_report(fit, views, judged, judged.uncertainty.line(), [("baseline", "300 mm")])
    text = html[: html.index("<img")]
    assert "PASSED" in text
    assert escape(judged.uncertainty.line()) in text
    assert "300 mm" in text
    for title in ("Coverage", "Residuals of the corners", "Residuals of the planes", "Expected depth error", "Views"):
        assert f"<h2>{title}</h2>" in html
    assert html.count("data:image/png;base64,") == 3
    assert html.count("<svg ") == 1
    assert not re.search(r'(src|href)="(?!data:)', html)


def test_a_failed_verdict_leads_with_its_root_cause(judged: Judged) -> None:
    views, fit = _fitted()
    reasons = (
        Reason("moved-rig", "views contradict each other", 0.2, 0.01, "calibrate again"),
        Reason("poor-coverage", "corners reach 20 %", 0.2, 0.5, "show the borders"),
    )
    html = planes_report(fit, views, replace(judged, verdict=Verdict(False, reasons)), "", [])
    assert html.index("FAILED") < html.index("moved-rig") < html.index("poor-coverage") < html.index("<img")


def test_whatever_users_name_is_escaped() -> None:
    html = page("a < b", Verdict(True), "x & y", [("<i>", "1")], [Section("<b>", paragraph("<script>"))])
    assert "<script>" not in html
    assert "&lt;script&gt;" in html
    assert "<title>a &lt; b</title>" in html


def test_columns_of_numbers_stand_to_the_right() -> None:
    html = table(("name", "mm", "why"), [("a", "1.5", "3 sd from 0"), ("b", "-2e-05", "-")])
    assert '<th class="number">mm</th>' in html
    assert "<th>name</th>" in html
    assert "<th>why</th>" in html


def test_a_model_of_the_right_rig_is_found(judged: Judged) -> None:
    assert judged.evidence.baseline_m == pytest.approx(0.3, abs=6 * judged.evidence.baseline_sd_m)
    assert judged.evidence.expected_m < judged.asked.accuracy_m
