"""Passages of the line over pixels: no bias, honest standard deviations, and nothing where nothing is to be told."""

import mpmath
import numpy as np
import pytest

from calibration.passages import find as finding
from calibration.passages import fit, flux_picture
from calibration.passages.find import SweepCounts, evenly, find_passages
from calibration.passages.fit import LineShape, fit_passages, light
from tests.stability.inventory import covers
from tests.unit.calibration.passed_lines import Light, passed, sweep_of, true_at

covers(fit, finding, flux_picture)

CASES = {
    "clear": (Light(0.6, 4.0), 10, 0.9),
    "narrow": (Light(0.4, 3.0), 20, 0.9),
    "wide in daylight": (Light(2.0, 20.0, ambient=0.3), 10, 0.8),
    "flat top": (Light(0.7, 70.0, ambient=0.1), 10, 0.95),
    "travelling": (Light(1.0, 5.0, travels=True), 4, 0.6),
    "one exposure": (Light(2.0, 70.0, ambient=0.001, travels=True), 1, 0.6),
    "haze": (Light(0.6, 3.6, ambient=0.1, wedge=(0.014, 0.036, 0.038, 0.002)), 10, 0.9),
    "thick haze": (Light(1.2, 8.0, ambient=0.1, wedge=(0.018, 0.06, 0.064, 0.002)), 20, 0.9),
}


@pytest.mark.parametrize("case", CASES)
def test_passages_are_unbiased_and_their_sds_honest(case):
    light, exposures, least = CASES[case]
    counts, centre = passed(np.random.default_rng(3), light, exposures)
    found = find_passages(sweep_of(counts, exposures), 1, 1.0)
    error = found.command - true_at(centre, found)
    assert len(error) > least * centre.size
    of_mean = error.std() / np.sqrt(len(error))
    assert abs(error.mean()) < 0.01 + 3 * of_mean
    assert abs(np.mean(error / found.sd)) < 0.1 + 3 / np.sqrt(len(error))
    assert 0.8 < np.std(error / found.sd) < 1.15
    assert np.mean(np.abs(error) > 5 * found.sd) < 0.003


@pytest.mark.parametrize("line", [Light(0.4, 4.0, travels=True), Light(0.6, 20.0, travels=True)])
def test_passages_do_not_lean_where_a_narrow_bright_line_moves_on(line):
    """By 0.019 column did those of a fit for which all frames of a column have the same light."""
    counts, centre = passed(np.random.default_rng(4), line, 10, pixels=9000)
    found = find_passages(sweep_of(counts, 10), 1, 1.0, most=9000)
    true = true_at(centre, found)
    phase = ((true % 1) * 8).astype(int)
    bias = np.bincount(phase, found.command - true) / np.bincount(phase)
    assert np.abs(bias).max() < 0.012


@pytest.mark.parametrize("lost", [0.0, 1e6])
def test_one_pixel_whose_fit_went_astray_does_not_choose_the_shape_for_all(lost, monkeypatch):
    chosen: list[LineShape] = []

    def astray(*args, exact=True):
        fit, shape = fit_passages(*args, exact=exact), args[-1]
        if exact:
            chosen.append(shape)
        elif shape.travels:
            fit.likelihood[0] -= lost
        return fit

    monkeypatch.setattr(finding, "fit_passages", astray)
    counts, _ = passed(np.random.default_rng(4), Light(0.6, 20.0, travels=True), 10, pixels=900)
    find_passages(sweep_of(counts, 10), 1, 1.0)
    assert [shape.travels for shape in chosen] == [True]


def test_windows_that_move_with_the_line_give_what_they_hold():
    rng = np.random.default_rng(6)
    counts, centre = passed(rng, Light(0.6, 6.0), 10, pixels=3840)
    width, window = counts.shape[2], 64
    x0 = np.linspace(0, width - window, len(counts)).astype(np.int32)
    cut = np.stack([counts[k, :, x : x + window] for k, x in enumerate(x0)])
    frames = np.full(len(counts), 10)
    found = find_passages(SweepCounts(cut, frames, np.arange(60.0), x0, width), 1, 1.0)
    error = (found.command - true_at(centre, found)) / found.sd
    assert len(error) > 500
    assert 0.8 < error.std() < 1.2
    at = np.rint(found.command).astype(int)
    assert np.all((found.x_px >= x0[at]) & (found.x_px < x0[at] + window))


def test_noise_hot_pixels_and_saturation_give_no_passages():
    rng = np.random.default_rng(8)
    for flux in (0.02, 0.3, 2.0):
        counts = rng.binomial(10, -np.expm1(-flux), (200, 30, 60)).astype(np.uint8)
        assert len(find_passages(sweep_of(counts, 10), 1, 1.0).x_px) < 0.01 * 1800
    assert len(find_passages(sweep_of(np.full((60, 8, 8), 10, np.uint8), 10), 1, 1.0).x_px) == 0
    assert len(find_passages(sweep_of(np.zeros((60, 8, 8), np.uint8), 10), 1, 1.0).x_px) == 0


def test_an_empty_mask_and_a_sweep_without_frames_give_none():
    sweep = sweep_of(np.zeros((60, 8, 8), np.uint8), 10)
    assert len(find_passages(sweep, 1, 1.0, np.zeros((8, 8), bool)).command) == 0
    nothing = SweepCounts(sweep.counts, np.zeros(60, int), np.full(60, np.nan), sweep.x0, sweep.width)
    assert len(find_passages(nothing, 1, 1.0).command) == 0


def test_only_pixels_of_the_mask_and_no_more_than_asked_for():
    counts, _ = passed(np.random.default_rng(9), Light(0.6, 8.0), 10)
    mask = np.zeros(counts.shape[1:], bool)
    mask[5:20, 10:40] = True
    found = find_passages(sweep_of(counts, 10), 1, 1.0, mask, most=100)
    assert len(found.x_px) == 100
    assert mask[found.y_px.astype(int), found.x_px.astype(int)].all()
    assert np.ptp(found.x_px) > 25
    assert np.ptp(found.y_px) > 10


def test_every_beginning_of_the_order_is_spread_evenly():
    order = evenly(np.ones((64, 64), bool))
    assert len(np.unique(order, axis=0)) == 64 * 64
    for first in (16, 64, 256):
        cells = order[:first] // (64 // int(np.sqrt(first)))
        assert len(np.unique(cells, axis=0)) == first


@pytest.mark.parametrize(
    ("shape", "after"),
    [(LineShape(), 0.02), (LineShape(2.5), 0.1), (LineShape(0.0, True), 0.1), (LineShape(2.5, True), 0.1)],
)
def test_slopes_are_the_derivatives_of_the_light(shape, after):
    theta = np.array([[0.1, after, 2.0, 0.3, np.log(0.8)], [0.1, after, 5.0, -0.4, np.log(1.5)]])
    at = np.tile(np.arange(-6.0, 7.0), (2, 1))
    _, slopes = light(theta, at, shape)
    for which in range(5):
        step = np.zeros(5)
        step[which] = 1e-6
        numeric = (light(theta + step, at, shape)[0] - light(theta - step, at, shape)[0]) / 2e-6
        assert np.allclose(numeric, slopes[:, which], atol=2e-4)  # the normal integral is one to 2e-4


@pytest.mark.parametrize(
    ("sigma", "area", "within"), [(0.3, 4.0, 4e-3), (0.6, 20.0, 3e-4), (3.0, 100.0, 1e-6), (0.25, 3e3, 0.04)]
)
def test_a_line_that_moves_lights_the_mean_of_a_columns_frames(sigma, area, within):
    at = np.linspace(-3.0, 3.0, 13)[None]
    flux, slopes = light(np.array([[0.02, 0.02, area, 0.0, np.log(sigma)]]), at, LineShape(travels=True))

    def dark(away):
        return mpmath.quad(lambda u: mpmath.exp(-area * mpmath.npdf(away + u, 0, sigma)), mpmath.linspace(-0.5, 0.5, 9))

    lit = [float(1 - mpmath.exp(mpmath.mpf("-0.02")) * dark(away)) for away in at[0].tolist()]
    assert np.abs(-np.expm1(-flux[0]) - lit).max() < within
    assert np.isfinite(slopes).all()
