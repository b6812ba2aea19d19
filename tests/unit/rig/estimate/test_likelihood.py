from functools import cache

import numpy as np
import pytest

from rig.estimate import online_learning as lessons
from rig.estimate.likelihood import Likelihood
from tests.reference.tables.answers import calibration_error
from tests.unit.small_maps import assert_same, simulated, volume_of

pytestmark = pytest.mark.slow


@cache
def estimated(light="report", exposures=10, rig="left"):
    """Stripe table of a fresh estimator, and the estimator afterwards."""
    sweep = simulated(light, exposures, rig)
    estimator = Likelihood(2)
    return estimator.estimate(sweep.volume, sweep.geometry), estimator


@pytest.mark.parametrize(
    ("light", "share", "rig"), [("report", 0.85, "left"), ("dense", 0.6, "right"), ("clear", 0.8, "turned")]
)
def test_stripes_are_found_from_ten_exposures(light, share, rig):
    table, _ = estimated(light, 10, rig)
    errors = simulated(light, 10, rig).errors(table.x_px)
    assert np.isfinite(errors).all()
    assert np.mean(errors <= 1) > share
    assert np.median(errors) < 0.5


def test_the_saved_model_gives_the_very_same_table_again(monkeypatch):
    _, estimator = estimated()
    monkeypatch.setattr(lessons, "TEACH_FRAMES", 1)
    monkeypatch.setattr(lessons, "LAG_FRAMES", 1)
    saved, later = estimator.model, simulated(seed=2)
    again, twice = Likelihood(model=saved), Likelihood(3, model=saved)
    for _ in range(3):
        assert_same(*(one.estimate(later.volume, later.geometry) for one in (again, twice)))
        for name, value in again.model.arrays().items():
            np.testing.assert_array_equal(twice.model.arrays()[name], value, err_msg=name)
    assert again.used is not saved


def test_with_a_given_model_every_row_is_judged_alone_and_only_confidence_comes_from_the_neighbours():
    sweep, model = simulated(seed=2), estimated()[1].model
    rng = np.random.default_rng(1)
    other = sweep.counts.copy()
    kept = np.arange(len(other[0])) % 3 == 1
    other[:, ~kept] = rng.integers(0, 11, other[:, ~kept].shape)
    plain = Likelihood(model=model).estimate(sweep.volume, sweep.geometry)
    mixed = Likelihood(model=model).estimate(volume_of(other, sweep.geometry, 10), sweep.geometry)
    for name, values in plain.arrays().items():
        if name != "confidence":
            np.testing.assert_array_equal(getattr(mixed, name)[kept], values[kept])
    assert not np.array_equal(mixed.x_px[~kept], plain.x_px[~kept])
    assert mixed.confidence[kept].mean() < plain.confidence[kept].mean() - 0.2


def test_counts_outside_the_search_windows_and_margins_do_not_matter():
    sweep, model = simulated(seed=2), estimated()[1].model
    g = sweep.geometry
    noisy = sweep.counts.copy()
    x = np.arange(512)
    outside = (x < g.x_lo.T[:, :, None] - 12) | (x > g.x_hi.T[:, :, None] + 12)
    noisy[outside] = 10
    plain = Likelihood(model=model).estimate(sweep.volume, g)
    assert_same(plain, Likelihood(model=model).estimate(volume_of(noisy, g, 10), g))


def test_hot_pixels_do_not_capture_stripes():
    clean = simulated()
    rng = np.random.default_rng(7)
    hot = rng.random((32, 512)) < 0.005
    rate = np.where(hot, rng.uniform(0.1, 0.9, hot.shape), 0.0)
    # A hot pixel fires in some of the frames in which light did not.
    extra = rng.binomial(10 - clean.counts.astype(np.int64), rate)
    volume = volume_of((clean.counts + extra).astype(np.uint8), clean.geometry, 10)
    table = Likelihood().estimate(volume, clean.geometry)
    plain, dirty = clean.errors(estimated()[0].x_px), clean.errors(table.x_px)
    assert hot.sum() > 50
    assert np.mean(dirty <= 1) > np.mean(plain <= 1) - 0.03
    assert np.mean(dirty) < 1.3 * np.mean(plain) + 0.3
    # No pixel attracts answers: a stripe passes each hot pixel of a row once or twice.
    y, c = np.nonzero(clean.point.trusted)
    at = np.rint(table.x_px[y, c]).astype(int)
    wrong = hot[y, at] & (dirty > 2)
    assert wrong.sum() < 0.005 * len(y)


def test_learned_extinction_is_the_fogs():
    sweep = simulated("dense", 10, "turned", rows=64, columns=160)
    estimator = Likelihood()
    estimator.estimate(sweep.volume, sweep.geometry)
    model, truth = estimator.model, sweep.point.light.extinction_per_m
    assert abs(model.extinction_per_m - truth) < 3 * model.extinction_sd_per_m + 0.1 * truth
    assert model.extinction_sd_per_m < 0.3 * truth


@pytest.mark.parametrize(("light", "exposures"), [("report", 10), ("dense", 1), ("dense", 10), ("clear", 3)])
def test_confidence_is_the_share_of_right_answers_and_places_without_a_stripe_are_not_believed(light, exposures):
    """All answers count, a quarter of them where there is no stripe. Few columns stand far apart here, so that true
    surfaces agree less than usual: confidence may be too low, but not too high."""
    confidence, right = [], []
    for seed in (1, 2):  # each with a model of its own: what one of them learned by chance shows in all its answers
        sweep = simulated(light, exposures, seed=seed)
        table, lit = Likelihood().estimate(sweep.volume, sweep.geometry), np.isfinite(sweep.point.x_true)
        used = sweep.point.trusted | (~lit & np.isfinite(table.x_px))
        confidence.append(table.confidence[used].astype(float))
        right.append(np.abs(np.where(lit, table.x_px - sweep.point.x_true, np.inf))[used] <= 1.0)
        assert (table.confidence[~lit] > 0.5).mean() < 0.12
    confidence, right = np.concatenate(confidence), np.concatenate(right)
    assert np.all((confidence >= 0) & (confidence <= 1))
    assert calibration_error(confidence, right) < 0.1
    assert right[confidence > 0.9].mean() > confidence[confidence > 0.9].mean() - 0.03


def test_stated_sd_matches_the_errors_of_sure_answers():
    for exposures in (10, 100):
        sweep = simulated(exposures=exposures)
        table = estimated(exposures=exposures)[0]
        sure = table.confidence[sweep.point.trusted] > 0.95
        errors = sweep.errors(table.x_px)[sure]
        sd = table.x_sd_px[sweep.point.trusted][sure]
        usual = errors < 1.5
        assert usual.mean() > 0.95
        assert 0.6 < np.sqrt(np.mean(errors[usual] ** 2)) / np.sqrt(np.mean(sd[usual] ** 2)) < 1.5


def test_signal_and_haze_are_those_of_the_light():
    sweep, table = simulated("dense", 30), estimated("dense", 30)[0]
    point, trusted = sweep.point, sweep.point.trusted
    right = sweep.errors(table.x_px) < 0.7
    assert right.mean() > 0.5
    signal = table.signal[trusted][right] / point.stripe[trusted][right]
    assert 0.75 < np.median(signal) < 1.33
    # Haze 8 px before the stripe, where its own light no longer reaches.
    step = 1 if sweep.geometry.near_is_left else -1
    rows, columns = np.nonzero(trusted)
    rows, columns = rows[right], columns[right]
    haze = []
    for column in range(0, 96, 8):
        flux = point.flux_of_column(column)
        here = columns == column
        x = np.clip(np.rint(point.x_true[rows[here], column]).astype(int) - 8 * step, 0, 511)
        haze += list(table.haze[rows[here], column] / (flux[rows[here], x] - point.light.ambient))
    assert 0.7 < np.median(haze) < 1.2
