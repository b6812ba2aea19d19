"""The figures of the explanations are what the program draws today."""

import re
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest

from docs.generate.figures import FIGURES, FOLDER

NUMBER = re.compile(r"-?\d+(?:\.\d+)?")
SCANS = {"estimators", "first-fog-map"}
"""Figures that take whole scans; `make figures` draws them anew."""


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(set(FIGURES) - SCANS))
def test_a_figure_is_what_the_program_draws(name: str) -> None:
    """Places may differ in the last digit between machines."""
    kept, drawn = (FOLDER / f"{name}.svg").read_text(encoding="utf-8"), FIGURES[name]()
    assert NUMBER.sub("N", drawn) == NUMBER.sub("N", kept), f"{name} is out of date: make figures"
    places = [np.array([float(number) for number in NUMBER.findall(text)]) for text in (drawn, kept)]
    assert np.abs(places[0] - places[1]).max() <= 0.2, f"{name} is out of date: make figures"


@pytest.mark.parametrize("name", sorted(FIGURES))
def test_a_figure_is_svg_with_a_title(name: str) -> None:
    root = ElementTree.parse(FOLDER / f"{name}.svg").getroot()
    assert root.tag == "{http://www.w3.org/2000/svg}svg"
    assert root.findtext("{http://www.w3.org/2000/svg}title")
