"""Light from counts and grey levels, the time that patterns get, and what an answer claims."""

import numpy as np
import pytest
from mpmath import mp

from rig.strategies.apparatus import Budget
from rig.strategies.patterns.levels import (
    Levels,
    answer_of,
    columns_at_infinity,
    flux_of,
    measured,
    normal_cdf,
    peak_offset,
    spad_frames,
    unwrapped,
    window_columns,
    with_noise,
)
from rig.strategies.patterns.posterior import Window
from rig.strategies.strategy import TooShort
from tests.stability.inventory import covers
from tests.unit.rig.strategies.patterns.bench import (
    COLUMNS,
    COMMANDS,
    DEPTH_RANGE_M,
    PER_COMMAND,
    Bench,
    geometry,
    true_column,
    walls,
)

covers(answer_of, columns_at_infinity, measured, peak_offset, spad_frames, unwrapped, window_columns, Window)
FLAT = np.ones((2, COLUMNS), np.float32)


@covers(flux_of)
@pytest.mark.parametrize("flux", [0.01, 0.3, 2.0])
def test_one_bit_counts_give_the_flux_with_the_variance_they_have(flux) -> None:
    rng = np.random.default_rng(1)
    counts = rng.binomial(1000, -np.expm1(-flux), (1, 1, 200000)).astype(np.uint32)
    light, variance = flux_of(counts, np.array([1000]))
    assert light.mean() == pytest.approx(flux, abs=4 * light.std() / 400)
    assert variance.mean() == pytest.approx(light.var(), rel=0.07)  # first order


def test_more_fired_frames_than_frames_are_refused() -> None:
    with pytest.raises(ValueError, match="fired in 8 frames, more than the 7"):
        flux_of(np.full((1, 1, 1), 8, np.uint32), np.array([7]))


def test_frames_are_shared_by_weight_and_each_pattern_has_one() -> None:
    bench = Bench(walls())
    assert list(spad_frames(bench, Budget(1e-3), [1, 1, 2])) == [25, 25, 49]
    assert list(spad_frames(bench, Budget(3e-5), [1, 1, 100])) == [1, 1, 1]
    with pytest.raises(TooShort, match=r"3 patterns take 3e-05 s, the budget is 2e-05 s"):
        spad_frames(bench, Budget(2e-5), [1, 1, 1])


def test_a_camera_that_would_saturate_takes_more_and_shorter_exposures() -> None:
    bench = Bench(walls(), signal=2e6)
    levels = measured(bench, "camera", FLAT, [1, 1], Budget(0.1))
    assert not levels.clipped.any()
    assert 0.5 < bench.time_s / 0.1 <= 1 + 1e-9
    assert measured(Bench(walls(), signal=1e8), "camera", FLAT, [1, 1], Budget(2e-3)).clipped.all()
    with pytest.raises(TooShort, match=r"2 patterns take 0\.002 s"):
        measured(bench, "camera", FLAT, [1, 1], Budget(1.9e-3))


@covers(with_noise)
def test_a_cameras_noise_is_found_from_what_the_pattern_does_not_explain() -> None:
    rng = np.random.default_rng(2)
    true = rng.uniform(0, 400, (1, 40, 200)) * np.ones((6, 1, 1))
    light = true + rng.normal(0, np.sqrt(30 + 0.25 * true))
    plain = Levels(light, np.ones_like(light), np.zeros(light.shape[1:], bool))
    levels, excess = with_noise(plain, "camera", np.broadcast_to(light.mean(axis=0), light.shape), 1)
    np.testing.assert_allclose(levels.variance.mean(), 30 + 0.25 * 200, rtol=0.1)
    slope = np.polyfit(true.ravel(), levels.variance.ravel(), 1)[0]
    assert slope == pytest.approx(0.25, rel=0.2)
    assert 1.0 <= np.median(excess) < 1.2
    # A SPAD's variance is known; light that the pattern does not explain shows.
    odd = light + 40 * (np.arange(6) % 2)[:, None, None]
    known = Levels(odd, 30 + 0.25 * true, plain.clipped)
    same, excess = with_noise(known, "spad", np.broadcast_to(odd.mean(axis=0), odd.shape), 1)
    assert same is known
    assert np.median(excess) > 4


@covers(normal_cdf)
def test_probabilities_of_the_normal_distribution() -> None:
    z = np.array([-60.0, -8.0, -2.0, -0.3, 0.0, 1e-9, 0.7, 3.0, 50.0])
    expected = [float(mp.ncdf(each)) for each in z]
    np.testing.assert_allclose(normal_cdf(z), expected, atol=2e-7)
    assert np.all(np.diff(normal_cdf(np.linspace(-5, 5, 101))) > 0)


def test_two_percent_of_the_columns_from_infinity_are_two_percent_of_the_depth() -> None:
    grid, depth = geometry(), walls()
    here, farther = true_column(depth), true_column(depth * 1.02)
    by_hand = np.abs(farther - here)
    np.testing.assert_allclose(0.02 * np.abs(here - columns_at_infinity(grid)), by_hand, rtol=0.06)


def test_pixels_know_the_columns_of_their_depth_range() -> None:
    grid = geometry()
    for depth_m, side in ((DEPTH_RANGE_M[0], grid.last), (DEPTH_RANGE_M[1], grid.first)):
        column = np.clip(np.rint(true_column(np.full(grid.shape, depth_m))), 0, COLUMNS - 1)
        np.testing.assert_allclose(side, column, atol=1)
    assert COMMANDS[1] - COMMANDS[0] == pytest.approx(1.76 / COLUMNS)
    assert PER_COMMAND > 0  # near surfaces lie in later columns


def test_a_number_that_repeats_becomes_the_feasible_column() -> None:
    grid, depth = geometry(), walls()
    column = true_column(depth)
    period = float(window_columns(grid))
    np.testing.assert_allclose(unwrapped(grid, np.mod(column, period), period), column, atol=1e-9)
    assert np.isnan(unwrapped(grid, grid.last + 3.0, 256.0)).all()


def test_an_answer_is_as_sure_as_its_column() -> None:
    grid, depth = geometry(), walls()
    column = true_column(depth)
    answer = answer_of(grid, column, np.full(grid.shape, 1e-3), np.full(grid.shape, 0.7))
    np.testing.assert_allclose(answer.depth_m, depth, rtol=1e-4)
    np.testing.assert_allclose(answer.confidence, 0.7, atol=1e-3)
    allowed = 0.02 * np.abs(column - columns_at_infinity(grid))
    one_sigma = answer_of(grid, column, allowed, np.ones(grid.shape))
    np.testing.assert_allclose(one_sigma.confidence, 0.682689, atol=1e-4)
    none = answer_of(grid, np.full(grid.shape, np.nan), np.zeros(grid.shape), np.ones(grid.shape))
    assert np.isnan(none.depth_m).all()
    assert (none.confidence == 0).all()


def test_the_offset_of_a_peak_with_straight_flanks_is_exact() -> None:
    for offset in (-0.5, -0.2, 0.0, 0.4):
        before, at, after = (np.array([5.0 - abs(step - offset)]) for step in (-1, 0, 1))
        assert peak_offset(before, at, after)[0] == pytest.approx(offset)
    assert peak_offset(np.zeros(1), np.zeros(1), np.zeros(1))[0] == 0


def test_the_posterior_is_over_feasible_columns_only() -> None:
    grid = geometry()
    window = Window(grid, 0, columns_at_infinity(grid)[0][None])
    flat = np.zeros(window.columns.shape)
    place = np.where(window.feasible, window.columns == grid.first[0][:, None] + 40, False).argmax(axis=1)
    share, spread = window.right(flat, place)
    assert np.all((share > 0) & (share < 0.3) & (spread > 0.7))
    peaked = np.where(np.arange(flat.shape[1]) == place[:, None], 100.0, flat)
    np.testing.assert_allclose(window.right(peaked, place), [np.ones(512), np.zeros(512)], atol=1e-9)
    wide = np.where(window.feasible, flat, 1e9)
    assert np.all(window.feasible[np.arange(len(place)), window.best(wide)])
    np.testing.assert_array_equal(window.of(np.tile(np.arange(50.0), (512, 1))), np.mod(window.columns, 50))
