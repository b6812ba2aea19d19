from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from rig.estimate.likelihood import Likelihood
from rig.estimate.search import online_learning as lessons
from rig.geometry.stripe_table import StripeTable
from tests.unit.small_maps import simulated, volume_of

FIELDS = ("x_px", "confidence", "x_sd_px", "signal", "haze")


@cache
def estimated(light="report", exposures=10, rig="left"):
    """Stripe table of a fresh estimator, and the estimator afterwards."""
    sweep = simulated(light, exposures, rig)
    estimator = Likelihood(2)
    return estimator.estimate(sweep.volume, sweep.geometry), estimator


def assert_same(one: StripeTable, other: StripeTable) -> None:
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)


def assert_same_model(one, other) -> None:
    for name in one.__slots__:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)


@pytest.mark.parametrize(
    ("light", "share", "rig"),
    [("report", 0.85, "left"), ("report", 0.85, "right"), ("report", 0.85, "turned"), ("dense", 0.6, "right"),
     ("clear", 0.8, "turned")],
)  # fmt: skip
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
        assert_same_model(again.model, twice.model)
    assert again.used is not saved


def test_the_very_first_map_is_estimated_again_from_the_state_it_used():
    table, estimator = estimated()
    sweep = simulated()
    assert_same(table, Likelihood(3, model=estimator.used).estimate(sweep.volume, sweep.geometry))


def test_estimating_leaves_counts_and_learned_state_as_they_were():
    _, estimator = estimated()
    saved, later = estimator.model, simulated(seed=2)
    before = {name: np.copy(getattr(saved, name)) for name in saved.__slots__}
    counts = later.volume.counts.copy()
    volume = later.volume
    Likelihood(model=saved).estimate(volume, later.geometry)
    np.testing.assert_array_equal(volume.counts, counts)
    for name, value in before.items():
        np.testing.assert_array_equal(getattr(saved, name), value)


@pytest.mark.parametrize("rig", ["left", "right", "turned"])
def test_with_a_given_model_every_row_is_judged_alone(rig):
    sweep, model = simulated(rig=rig, seed=2), estimated(rig=rig)[1].model
    rng = np.random.default_rng(1)
    other = sweep.counts.copy()
    kept = np.arange(len(other[0])) % 3 == 1
    other[:, ~kept] = rng.integers(0, 11, other[:, ~kept].shape)
    plain = Likelihood(model=model).estimate(sweep.volume, sweep.geometry)
    mixed = Likelihood(model=model).estimate(volume_of(other, sweep.geometry, 10), sweep.geometry)
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(mixed, name)[kept], getattr(plain, name)[kept])
    assert not np.array_equal(mixed.x_px[~kept], plain.x_px[~kept])


def test_with_a_given_model_every_column_is_judged_alone():
    sweep, model = simulated(seed=2), estimated()[1].model
    frames = np.full(96, 10)
    frames[::2] = 0
    half = volume_of(np.where(frames[:, None, None], sweep.counts, 0), sweep.geometry, frames)
    whole = Likelihood(model=model).estimate(sweep.volume, sweep.geometry)
    rest = Likelihood(model=model).estimate(half, sweep.geometry)
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(rest, name)[:, 1::2], getattr(whole, name)[:, 1::2])
    assert np.isnan(rest.x_px[:, ::2]).all()
    assert not rest.confidence[:, ::2].any()


def test_counts_outside_the_search_windows_and_margins_do_not_matter():
    sweep, model = simulated(seed=2), estimated()[1].model
    g = sweep.geometry
    noisy = sweep.counts.copy()
    x = np.arange(512)
    outside = (x < g.x_lo.T[:, :, None] - 12) | (x > g.x_hi.T[:, :, None] + 12)
    noisy[outside] = 10
    plain = Likelihood(model=model).estimate(sweep.volume, g)
    assert_same(plain, Likelihood(model=model).estimate(volume_of(noisy, g, 10), g))


@pytest.mark.parametrize("light", ["report", "clear"])
def test_hot_pixels_do_not_capture_stripes(light):
    clean = simulated(light)
    rng = np.random.default_rng(7)
    hot = rng.random((32, 512)) < 0.005
    rate = np.where(hot, rng.uniform(0.1, 0.9, hot.shape), 0.0)
    # A hot pixel fires in some of the frames in which light did not.
    extra = rng.binomial(10 - clean.counts.astype(np.int64), rate)
    volume = volume_of((clean.counts + extra).astype(np.uint8), clean.geometry, 10)
    table = Likelihood().estimate(volume, clean.geometry)
    plain, dirty = clean.errors(estimated(light)[0].x_px), clean.errors(table.x_px)
    assert hot.sum() > 50
    assert np.mean(dirty <= 1) > np.mean(plain <= 1) - 0.03
    assert np.mean(dirty) < 1.3 * np.mean(plain) + 0.3
    # No pixel attracts answers: a stripe passes each hot pixel of a row once or twice.
    y, c = np.nonzero(clean.point.trusted)
    at = np.rint(table.x_px[y, c]).astype(int)
    wrong = hot[y, at] & (dirty > 2)
    assert wrong.sum() < 0.005 * len(y)


@pytest.mark.parametrize(("light", "rig"), [("report", "left"), ("dense", "turned")])
def test_learned_extinction_is_the_fogs(light, rig):
    sweep = simulated(light, 10, rig, rows=80, columns=200)
    estimator = Likelihood()
    estimator.estimate(sweep.volume, sweep.geometry)
    model, truth = estimator.model, sweep.point.light.extinction_per_m
    assert abs(model.extinction_per_m - truth) < 3 * model.extinction_sd_per_m + 0.1 * truth
    assert model.extinction_sd_per_m < 0.3 * truth


def test_clear_air_resolves_no_extinction():
    model = estimated("clear")[1].model
    resolved = model.extinction_per_m > 3 * model.extinction_sd_per_m
    assert not resolved


@pytest.mark.parametrize("light", ["report", "dense"])
@pytest.mark.parametrize("exposures", [1, 10])
def test_confidence_is_the_share_of_right_answers(light, exposures):
    # Three scans, each with a model of its own: what one of them learned by chance shows in all its answers.
    confidence, right = [], []
    for seed in (1, 2, 3):
        sweep = simulated(light, exposures, seed=seed)
        table = Likelihood().estimate(sweep.volume, sweep.geometry)
        confidence.append(table.confidence[sweep.point.trusted].astype(float))
        right.append(sweep.errors(table.x_px) <= 1.0)
    confidence, right = np.concatenate(confidence), np.concatenate(right)
    assert np.all((confidence >= 0) & (confidence <= 1))
    judged = 0
    for low in np.arange(0, 1, 0.2):
        here = (confidence >= low) & (confidence < low + 0.2 + 1e-9)
        if here.sum() >= 150:
            judged += 1
            assert abs(right[here].mean() - confidence[here].mean()) < 0.15
    assert judged >= 3
    assert abs(right.mean() - confidence.mean()) < 0.1


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


@pytest.mark.parametrize("light", ["report", "dense"])
def test_signal_and_haze_are_those_of_the_light(light):
    sweep = simulated(light, 30)
    table = estimated(light, 30)[0]
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


def test_a_sweep_without_dark_frames_and_one_with_them_agree():
    sweep = simulated("dense")
    dark = np.random.default_rng(3).binomial(100, -np.expm1(-0.05), (32, 512)).astype(np.uint32)
    with_dark = Likelihood().estimate(replace(sweep.volume, dark_counts=dark, n_dark=100), sweep.geometry)
    plain = estimated("dense")[0]
    right = [np.mean(sweep.errors(table.x_px) <= 1) for table in (plain, with_dark)]
    assert abs(right[0] - right[1]) < 0.03


def test_a_first_map_without_contrast_teaches_nothing():
    sweep = simulated()
    estimator = Likelihood()
    flat = volume_of(np.full_like(sweep.counts, 10), sweep.geometry, 10)
    estimator.estimate(flat, sweep.geometry)
    assert estimator.used is not None
    assert estimator.model is None
    assert_same(estimator.estimate(sweep.volume, sweep.geometry), estimated()[0])
