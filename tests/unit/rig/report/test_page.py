"""The page of all reports: alone, escaped, wide tables that scroll."""

import base64
import re

import cv2
import numpy as np
import pytest

from rig.report.page import (
    GENERATOR,
    is_report,
    no_picture,
    page,
    paragraph,
    photograph,
    picture,
    pictures,
    preformatted,
    scaled_picture,
    table,
    verdict_box,
)
from rig.run_folder.pictures import Scale
from tests.unit.rig.report.pages import words_of

NASTY = '<script>"&'


def test_a_page_has_its_verdict_first_and_leaves_out_sections_without_content():
    box = verdict_box("failed", "a line", ["first reason.", "second"], good=False)
    html = page("Title", [box], [("Full", paragraph("text")), ("Empty", "")])
    words = words_of(html)
    assert words.startswith("Title FAILED a line first reason. second. Full text")
    assert "Empty" not in words
    assert 'class="bad"' in html
    assert 'class="good"' in verdict_box("passed", "", [], good=True)


@pytest.mark.parametrize(
    "html",
    [
        page(NASTY, [], [(NASTY, paragraph(NASTY))]),
        page("", [verdict_box(NASTY, NASTY, [NASTY], good=True)], []),
        page("", [], [("s", table((NASTY, ""), [(NASTY, "1")]) + preformatted(NASTY) + no_picture(NASTY))]),
        page("", [], [("s", picture(np.zeros((4, 4, 3), np.uint8), NASTY))]),
    ],
)
def test_whatever_users_name_is_escaped(html):
    assert words_of(html).lower().count(NASTY) >= (0 if "<img" in html and NASTY not in words_of(html) else 1)
    assert NASTY not in html


def test_columns_of_numbers_are_aligned_right_and_wide_tables_keep_their_lines():
    html = table(("name", "value", "range"), [("a", "1.5", "2 to 3.5"), ("b", "-", "1 of 2")])
    assert html.count('<td class="number">') == 4
    assert '<th class="number">value</th>' in html
    assert html.startswith('<div class="wide">')
    assert "many" not in html
    assert 'class="many short"' in table(["x"] * 6, [["1"] * 6])


def embedded(html, kind):
    data = re.search(rf'src="data:image/{kind};base64,([^"]*)"', html)[1]
    return cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_UNCHANGED)


def test_pictures_are_embedded_as_they_are_and_photographs_made_smaller():
    rgb = np.random.default_rng(0).integers(0, 255, (30, 40, 3), dtype=np.uint8)
    html = pictures([picture(rgb, "a caption")])
    np.testing.assert_array_equal(embedded(html, "png")[..., ::-1], rgb)
    assert html.count("a caption") == 2  # below it, and for those who do not see it
    grey = np.full((600, 900), 120, np.uint8)
    small = embedded(photograph(grey, "counts", 300), "jpeg")
    assert small.shape == (200, 300)
    assert abs(int(small.mean()) - 120) <= 2
    assert embedded(photograph(grey[:50, :60], "counts", 300), "jpeg").shape == (50, 60)


@pytest.mark.parametrize(("bright", "dark"), [(1.0, 3.0), (3.0, 1.0)])
def test_the_scale_of_a_picture_is_text_of_the_page_and_begins_with_the_smallest_value(bright, dark):
    scale = Scale(bright, dark, "m", absent="<none>")
    values = np.linspace(1, 3, 200, dtype=np.float32).reshape(10, 20)
    html = scaled_picture(values, scale, "a caption")
    np.testing.assert_array_equal(embedded(html, "png")[..., ::-1], scale.colours(values))
    drawn = [embedded(each, "png") for each in html.split("<img ")[1:]]
    assert drawn[1].shape == (1, 255, 3)
    np.testing.assert_array_equal(drawn[1][0, [0, -1], ::-1], scale.colours(np.array([1.0, 3.0])))
    marks = {text: float(at) for at, text in re.findall(r'left:([\d.]+)%">([^<]*)<', html)}
    assert marks == {"1 m": 0, "1.5 m": 25, "2 m": 50, "2.5 m": 75, "3 m": 100}
    assert "&lt;none&gt;" in html


def test_on_paper_short_tables_stay_whole_and_long_ones_repeat_their_head():
    assert 'class="short"' in table(["x"], [["1"]] * 5)
    long = table(["x"], [["1"]] * 100)
    assert "short" not in long
    assert long.index("<thead>") < long.index("</thead>") < long.index("<tbody>")
    assert "<thead>" not in table(["", ""], [["a", "1"]])
    assert 'class="long"' in preformatted("line\n" * 100)
    assert "class" not in preformatted("a command")


def test_a_report_is_recognised(tmp_path):
    file = tmp_path / "report.html"
    file.write_text(page("t", [], []))
    assert is_report(file)
    file.write_text("<!DOCTYPE html><html><head><title>spadrig</title></head></html>")
    assert not is_report(file)
    assert GENERATOR == "spadrig"
