"""A report is one HTML file: verdict and reasons before all pictures, nothing loaded from elsewhere."""

import re
from dataclasses import replace
from datetime import UTC, datetime
from functools import cache
from html import escape

import numpy as np
import pytest

from calibration.board.board import Board
from calibration.diagnosis.rig import JudgedRig, judge_fit
from calibration.model.rig_model import Identity
from calibration.rig_fit.fit import RigFit, fit_rig
from calibration.verdict import Reason, Verdict
from calibration.views import View
from rig.calibrate.report import (
    ReportSection,
    in_mm_with_sign,
    measured,
    page,
    paragraph,
    planes_report,
    subject,
    table,
)
from tests.reference.boards import calibration_data as data


@cache
def _fitted() -> tuple[list[View], RigFit]:
    rng = np.random.default_rng(1)
    rig = data.TrueRig()
    views = data.random_views(rng, rig, 8, data.Seen(passages=200), (35.2, -35.2))
    return views, fit_rig(views, data.BOARD, (512, 512))


@pytest.fixture(name="judged")
def _judged() -> JudgedRig:
    views, fit = _fitted()
    return judge_fit(fit, views, stated_baseline_m=0.3)


def test_the_report_of_planes_shows_text_first_then_the_four_pictures(judged: JudgedRig) -> None:
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


def test_a_failed_verdict_leads_with_its_root_cause(judged: JudgedRig) -> None:
    views, fit = _fitted()
    reasons = (
        Reason("moved-rig", "views contradict each other", 0.2, 0.01, "calibrate again"),
        Reason("poor-coverage", "corners reach 20 %", 0.2, 0.5, "show the borders"),
    )
    html = planes_report(fit, views, replace(judged, verdict=Verdict(False, reasons)), "", [])
    assert html.index("FAILED") < html.index("moved-rig") < html.index("poor-coverage") < html.index("<img")


def test_a_report_says_what_it_is_of(judged: JudgedRig) -> None:
    views, fit = _fitted()
    rig = Identity("1f", "", "lab", {"spad": "spb-usb", "scanner": "helios"}, {"spad": "SN-0042"})
    board = Board("charuco", (9, 7), 0.06, 0.047, "DICT_4X4_50")
    about = subject(rig, board, {"spadrig": "1.2"}, datetime(2026, 11, 22, 9, 5, tzinfo=UTC))
    html = planes_report(fit, views, judged, "", [], about)
    text = html[: html.index("<h2>")]
    for said in (
        "lab",
        "spad spb-usb SN-0042, scanner helios",
        "ChArUco, 9 x 7 squares of 60 mm, markers of 47 mm, DICT_4X4_50",
        "2026-11-22 09:05 UTC",
        "spadrig 1.2",
    ):
        assert said in text
    assert subject(None, Board("chessboard", (10, 7), 0.0251), {}, datetime.now(UTC))[0] == (
        "board",
        "chessboard, 10 x 7 squares of 25.1 mm",
    )


def test_terms_of_the_model_have_units_and_the_digits_that_are_known() -> None:
    assert measured("lag_forward/lag_backward", 2.0012e-4, 4.7e-7) == ("200.12", "0.47", "us")
    assert measured("row_delay", -1.234e-8, 2.2e-9) == ("-12.3", "2.2", "ns/row")
    assert measured("angle_3", 1.23e-3, 2e-5) == ("1.230", "0.020", "mrad")
    assert measured("offset_1", 1e-4, 2e-4) == ("0.10", "0.20", "mm/rad^1")
    assert measured("bow", np.nan, np.nan) == ("-", "-", "mrad/rad^2")
    assert measured("lag", 1e-4, np.nan) == ("100", "-", "us")
    views, fit = _fitted()
    html = planes_report(fit, views, judge_fit(fit, views, stated_baseline_m=0.3), "", [])
    terms = html[html.index("Terms of the model") :]
    assert '<th class="number">value</th>' in terms
    assert "<td>us</td>" in terms


def test_the_shift_of_a_view_says_which_way_it_goes(judged: JudgedRig) -> None:
    assert [in_mm_with_sign(length_m) for length_m in (0.00314, -0.00314, 0.0, np.nan)] == ["+3.14", "-3.14", "0", "-"]
    views, fit = _fitted()
    first, second, *others = judged.shifts
    either_way = (replace(first, shift=1e-3), replace(second, shift=-1e-3), *others)
    html = planes_report(fit, views, replace(judged, shifts=either_way), "", [])
    rows = html[html.index("shift, mm") :].split("<tr>")[1:3]
    said = [re.findall(r"<td[^>]*>([^<]*)</td>", row)[-1] for row in rows]
    assert [one[0] for one in said] == ["+", "-"]
    assert said[0][1:] == said[1][1:]


def test_whatever_users_name_is_escaped() -> None:
    html = page("a < b", Verdict(True), "x & y", [("<i>", "1")], [ReportSection("<b>", paragraph("<script>"))])
    assert "<script>" not in html
    assert "&lt;script&gt;" in html
    assert "<title>a &lt; b</title>" in html


def test_columns_of_numbers_stand_to_the_right() -> None:
    html = table(("name", "mm", "why"), [("a", "1.5", "3 sd from 0"), ("b", "-2e-05", "-")])
    assert '<th class="number">mm</th>' in html
    assert "<th>name</th>" in html
    assert "<th>why</th>" in html


def test_a_model_of_the_right_rig_is_found(judged: JudgedRig) -> None:
    assert judged.evidence.baseline_m == pytest.approx(0.3, abs=6 * judged.evidence.baseline_sd_m)
    assert judged.evidence.expected_m < judged.asked.accuracy_m
