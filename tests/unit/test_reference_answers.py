"""Figures of the yardstick for `joint`: charges, calibration, averaged pixels, and the table of what is asked."""

import numpy as np
import pytest

from tests.reference.tables.answers import Answers, averaged_pixels, calibration_error, pooled, reliability
from tests.reference.tables.asked import Measured, findings


def answers(errors: list[float], confidence: float = 0.9) -> Answers:
    error = np.array(errors, np.float32)
    everywhere = np.ones(error.size, np.bool_)
    return Answers(error, np.full(error.size, confidence, np.float32), everywhere, everywhere, 1.0)


def test_a_missing_answer_costs_10_px_and_an_outlier_leaves_the_bias_alone() -> None:
    a = answers([0.2, -0.4, np.nan, 50.0])
    assert a.mean_px == pytest.approx((0.2 + 0.4 + 10 + 50) / 4)
    assert a.within == 0.5
    assert a.missing == 0.25
    assert a.bias_px == pytest.approx(-0.1)


def test_the_surest_are_those_of_highest_confidence() -> None:
    a = pooled([answers([0.1] * 19, 0.8), answers([30.0], 0.1)])
    assert a.mean_px > 1
    assert a.surest(0.95) == pytest.approx(0.1)


def test_calibration_error_of_honest_claims_is_small_and_of_boasts_their_excess() -> None:
    rng = np.random.default_rng(1)
    claimed = rng.random(200_000)
    honest = rng.random(claimed.size) < claimed
    assert calibration_error(claimed, honest) < 0.01
    assert calibration_error(np.full(1000, 0.95), np.arange(1000) < 700) == pytest.approx(0.25)
    assert reliability(claimed, honest)[:, 0].sum() == pytest.approx(1)


def test_an_answer_where_there_is_no_stripe_is_wrong_where_that_is_asked() -> None:
    error = np.array([0.1, np.nan], np.float32)
    lit = np.array([True, False])
    a = Answers(error, np.array([0.9, 0.8], np.float32), lit, lit, 1.0)
    assert a.claims()[1].tolist() == [True]
    assert a.claims(empty=True)[1].tolist() == [True, False]


@pytest.mark.parametrize("side", [1, 5])
def test_averaged_pixels_counts_those_of_a_box(side: int) -> None:
    noise = np.random.default_rng(4).standard_normal((420, 420))
    boxed = sum(np.roll(noise, (i, j), (0, 1)) for i in range(side) for j in range(side)) / side**2
    boxed[::7, ::11] = np.nan
    assert averaged_pixels(np.asarray(boxed), 8) == pytest.approx(side**2, rel=0.25)


def test_what_is_asked_stands_beside_what_came_out() -> None:
    measured = [
        Measured("report", "a", 3, "joint", answers([0.2] * 100)),
        Measured("report", "b", 3, "joint", answers([0.4] * 100)),
        Measured("hot", "a", 3, "joint", answers([0.2] * 100)),
        Measured("halo", "b", 5, "joint", answers([-0.3] * 100)),
    ]
    rows = {one.what: one for one in findings(measured)}
    assert rows["report: mean error, px"].verdict == "short"
    assert rows["report: mean error, px"].worst == "0.400 (b)"
    assert rows["report: within 1 px"].verdict == "pass"
    assert rows["hot pixels 1 %: error over that without"].mean == "1.0000"
    assert rows["halo: bias, px"].verdict == "short"
    assert rows["all points: calibration error, stripes"].verdict == "short"
