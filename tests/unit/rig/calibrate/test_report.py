"""A report is one HTML file: verdict and reasons before all pictures, nothing loaded from elsewhere."""

import re
from datetime import UTC, datetime
from html import escape

import numpy as np

from calibration.board.board import Board
from calibration.diagnosis.verdicts import judge_fit
from calibration.model.rig_model import Identity
from calibration.rig_fit.fit import fit_rig
from calibration.verdict import Verdict
from rig.calibrate.report import measured, planes_report, report_page, subject
from rig.report.page import paragraph
from tests.reference.boards.calibration_data import BOARD, TrueRig, ViewErrors, random_views


def test_the_report_of_planes_shows_text_first_then_the_four_pictures() -> None:
    views = random_views(np.random.default_rng(1), TrueRig(), 8, ViewErrors(passages=200), (35.2, -35.2))
    fit = fit_rig(views, BOARD, (512, 512))
    judged = judge_fit(fit, views, stated_baseline_m=0.3)
    report, line = planes_report(fit, views, judged), judged.uncertainty.line()
    html = report_page(report, judged.verdict, line, [("baseline", "300 mm")])
    text = html[: html.index("<img")]
    assert "PASSED" in text
    assert escape(line) in text
    assert "300 mm" in text
    for title in ("Coverage", "Residuals of the corners", "Residuals of the planes", "Expected depth error", "Views"):
        assert f"<h2>{title}</h2>" in html
    assert html.count("<figure><img") == 3
    assert html.count("<svg ") == 1
    terms = html[html.index("Terms of the model") :]
    assert '<th class="number">value</th>' in terms
    assert "<th>unit</th>" in terms
    views_head = html[html.index("<h2>Views</h2>") :]
    assert '<th class="number">depth, m</th>' in views_head
    assert not re.search(r'(src|href)="(?!data:)', html)


def test_a_report_says_what_it_is_of() -> None:
    rig = Identity("1f", "", "lab", {"spad": "spb-usb", "scanner": "helios"}, {"spad": "SN-0042"})
    board = Board("charuco", (9, 7), 0.06, 0.047, "DICT_4X4_50")
    about = subject(rig, board, {"spadrig": "1.2"}, datetime(2026, 11, 22, 9, 5, tzinfo=UTC))
    assert about == [
        ("rig", "lab"),
        ("devices", "spad spb-usb SN-0042, scanner helios"),
        ("board", "ChArUco, 9 x 7 squares of 60 mm, markers of 47 mm, DICT_4X4_50"),
        ("date", "2026-11-22 09:05 UTC"),
        ("versions", "spadrig 1.2"),
    ]
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


def test_whatever_users_name_is_escaped() -> None:
    html = report_page(("a < b", [("<b>", paragraph("<script>"))]), Verdict(True), "x & y", [("<i>", "1")])
    assert "<script>" not in html
    assert "&lt;script&gt;" in html
    assert "<title>a &lt; b</title>" in html
