"""The table of corners has a row for a method that found none, as happens with few poses."""

import numpy as np

from tests.reference.boards.corner_accuracy import figures


def test_a_method_that_found_nothing_has_a_row_that_says_so() -> None:
    assert figures(np.zeros((0, 2)), 35) == "  0.0%  none found"


def test_a_row_has_share_bias_rms_and_the_worst_corner() -> None:
    row = figures(np.array([[0.3, 0.0], [0.1, 0.0]]), 4, np.array([2.0, -2.0]))
    assert row == " 50.0%  bias +0.2000 +0.0000  rms 0.1581  worst 0.30 px  in sds 2.00"
