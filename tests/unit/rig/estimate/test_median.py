import math
import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rig.estimate.median import NEUTRAL, median_filter
from rig.geometry.stripe_table import StripeTable


def table(x_px):
    x = np.asarray(x_px, np.float32)
    return StripeTable(x, np.full_like(x, 0.7), np.full_like(x, 0.3), np.full_like(x, 0.5), np.full_like(x, 0.1))


def reference_median(x, reference):
    """5x5 nanmedian of x - reference, put back; NaN stays NaN."""
    disparity = np.pad(x - reference, 2, constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(disparity, (5, 5))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        result = np.nanmedian(windows, axis=(2, 3)) + reference
    return np.where(np.isnan(x), np.nan, result)


def reference_trust(x, confidence, coupled):
    """Confidence and standard deviation of each answer, from a list of its neighbours (reference 0)."""
    trust, sd_px = np.zeros(x.shape), np.full(x.shape, np.nan)
    for y, c in np.argwhere(np.isfinite(x)):
        around = np.s_[max(0, y - 2) : y + 3, max(0, c - 2) : c + 3]
        there = np.isfinite(x[around])
        values, believed = x[around][there].astype(float), confidence[around][there].astype(float)
        apart = np.abs(values - np.median(x[around][there]))
        near, sd_px[y, c] = apart <= 1, apart.min()
        share = believed[near].sum() / believed.sum() if believed.sum() else 0
        if near.any():
            right = np.mean(believed[near]) if coupled else together(np.clip(believed[near], 1e-6, 1 - 1e-6))
            trust[y, c] = share * right
            spread = np.mean((values[near] - np.median(values)) ** 2)
            sd_px[y, c] = math.sqrt(math.pi / 2 * (spread + 1 / 12) / near.sum())
    return trust, sd_px


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32), st.integers(1, 12), st.integers(1, 12), st.floats(0, 1), st.booleans())
def test_the_filter_is_the_nan_aware_median_of_disparity(seed, rows, columns, missing, coupled):
    rng = np.random.default_rng(seed)
    x = np.where(rng.random((rows, columns)) < missing, np.nan, rng.uniform(0, 500, (rows, columns)))
    reference = rng.uniform(-100, 600, (rows, columns))
    x = x.astype(np.float32)
    result = median_filter(table(x), reference).x_px
    assert result.dtype == np.float32
    np.testing.assert_allclose(result, reference_median(x, reference), atol=1e-3)
    # Closer together, some answers just within a pixel of the median; some are believed not at all, some fully.
    near = np.where(np.isnan(x), np.nan, rng.integers(0, 24, x.shape) / 8).astype(np.float32)
    before = table(near)
    before.confidence[:] = rng.choice([0, 0.05, 0.2, 0.4, 0.7, 0.95, 1], x.shape)
    after = median_filter(before, np.zeros(x.shape), coupled=coupled)
    trust, sd_px = reference_trust(near, before.confidence, coupled)
    np.testing.assert_allclose(after.confidence, trust, atol=1e-4)
    np.testing.assert_allclose(after.x_sd_px, sd_px, rtol=1e-3)


def test_light_stays_and_confidence_is_the_agreement_of_the_neighbours():
    rng = np.random.default_rng(1)
    before = table(rng.uniform(0, 100, (9, 9)))
    x = before.x_px.copy()
    after = median_filter(before, np.zeros((9, 9)))
    for name in ("signal", "haze"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
    window = before.x_px[2:7, 2:7]
    agree = np.abs(window - np.median(window)) <= 1.0
    assert after.confidence[4, 4] == pytest.approx(np.mean(agree) * together([0.7] * agree.sum()), rel=1e-5)
    even = median_filter(table(np.full((9, 9), 7.0)), np.zeros((9, 9)))
    np.testing.assert_allclose(even.confidence, 1.0, atol=1e-4)
    assert np.all(even.x_sd_px < before.x_sd_px)
    np.testing.assert_array_equal(before.x_px, x)
    assert not np.array_equal(after.x_px, x)


def together(confidences):
    """Probability by Bayes' rule of what has a prior of NEUTRAL, after independent evidence."""
    odds = [p / (1 - p) for p in confidences]
    neutral = NEUTRAL / (1 - NEUTRAL)
    ratio = neutral * math.prod(each / neutral for each in odds)
    return ratio / (1 + ratio)


def test_one_answer_keeps_its_confidence_weak_ones_that_agree_lose_it_and_others_gain():
    for confidence in (0.05, 0.3, 0.9):
        single = np.full((5, 5), np.nan)
        single[2, 2] = 7.0
        before = table(single)
        before.confidence[:] = confidence
        assert median_filter(before, np.zeros((5, 5))).confidence[2, 2] == pytest.approx(confidence, rel=1e-5)
    for confidence, least, most in ((0.0, 0, 1e-9), (0.1, 0, 1e-9), (0.3, 0.3, 0.3), (0.5, 0.999, 1), (1.0, 1, 1)):
        before = table(np.full((5, 5), 7.0))
        before.confidence[:] = confidence
        found = median_filter(before, np.zeros((5, 5))).confidence[2, 2]
        assert least - 1e-6 <= found <= most + 1e-6


def test_answers_that_go_by_each_other_are_no_surer_because_they_agree():
    before = table(np.full((9, 9), 7.0))
    before.confidence[:] = 0.1
    np.testing.assert_allclose(median_filter(before, np.zeros((9, 9)), coupled=True).confidence, 0.1, rtol=1e-5)
    before.confidence[4, 4] = 1.0
    alone = median_filter(before, np.zeros((9, 9)))
    assert alone.confidence[4, 4] == pytest.approx(together([0.1] * 24 + [0.999999]), rel=1e-2)
    assert alone.confidence[0, 0] == pytest.approx(together([0.1] * 9), rel=1e-5)
    assert median_filter(before, np.zeros((9, 9)), coupled=True).confidence[4, 4] == pytest.approx(3.4 / 25, rel=1e-5)
