"""A campaign ends with 1 where a figure is not what is asked for, and names it."""

from collections import Counter

import numpy as np
import pytest

from tests.campaigns.calibration import fits, mistakes
from tests.campaigns.calibration.asked import Figure, exit_code, shortfalls


def test_figures_within_their_limits_and_on_them_are_no_shortfall(capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code([Figure("ratio", 0.8, (0.8, 1.3)), Figure("share", 0.97, (0.93, 0.97))]) == 0
    assert not capsys.readouterr().err


def test_a_figure_beyond_its_limits_or_missing_is_named_with_them(capsys: pytest.CaptureFixture[str]) -> None:
    figures = [Figure("ratio", 1.31, (0.8, 1.3)), Figure("fine", 0.95, (0.93, 0.97)), Figure("px", np.nan, (0, 0.1))]
    assert exit_code(figures) == 1
    assert capsys.readouterr().err.splitlines() == [
        "short: ratio is 1.31, asked for are 0.8 to 1.3",
        "short: px was not found, asked for are 0 to 0.1",
    ]


def test_rigs_of_the_second_simulator_are_judged_by_error_and_interval() -> None:
    good = np.array([1.0, 1.1, 0.9]), np.array([0.95, 0.96, 0.94])
    assert not shortfalls(fits.figures(*good))
    assert len(shortfalls(fits.figures(1.4 * good[0], good[1]))) == 1
    assert len(shortfalls(fits.figures(good[0], good[1] - 0.03))) == 1
    assert len(shortfalls(fits.figures(np.array([]), np.array([])))) == 2


def test_a_mistake_that_is_named_in_fewer_than_nine_of_ten_trials_falls_short() -> None:
    table = {
        "moved": Counter({"moved-rig": 27, "passed": 3}),
        "not_locked": Counter({"exposure-not-locked": 25, "moved-rig": 5}),
        "no_mistake": Counter({"passed": 29, "too-few-poses": 1}),
    }
    (line,) = shortfalls(mistakes.figures(table))
    assert line == ("share of trials in which not_locked is 'exposure-not-locked' is 0.8333, asked for are 0.9 to 1")
