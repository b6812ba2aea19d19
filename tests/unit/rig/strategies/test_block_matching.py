"""Block matching against closed forms: the Bayes factor, Bartlett's number, sub-pixel places, bands of rows."""

import math

import cv2
import numpy as np
import pytest

from rig.strategies.block_matching import (
    BLOCK_PX,
    bands,
    best_match,
    exposed,
    independent_values,
    log_bayes_factor,
    match,
)
from tests.stability.inventory import covers

covers(best_match, bands, exposed, independent_values, log_bayes_factor, match)
BLOCK = BLOCK_PX[0] * BLOCK_PX[1]


def shifted(picture: np.ndarray, shifts: list[float]) -> list[tuple[np.ndarray, np.ndarray]]:
    """The picture shifted along the row by parts of a pixel, by Fourier's shift theorem."""
    turns = np.fft.fftfreq(picture.shape[1])
    spectrum = np.fft.fft(picture, axis=1)
    moved = [np.fft.ifft(spectrum * np.exp(-2j * np.pi * turns * shift), axis=1).real for shift in shifts]
    return [(one.astype(np.float32), np.ones(picture.shape, bool)) for one in moved]


def smooth(seed: int, rows: int = 40, width: int = 128) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(size=(rows, width + 20))
    return cv2.GaussianBlur(noise, (0, 0), 1.2)[:, 10:-10]


def test_the_bayes_factor_is_the_mean_likelihood_ratio_of_a_regression() -> None:
    # y = gain x + noise of unknown size, gain ~ normal(0, g sd^2 / x.x), sd^2 ~ 1 / sd^2, by numerical integration.
    rng = np.random.default_rng(3)
    n, x = 8, rng.normal(size=8)
    x -= x.mean()
    y = 0.8 * x / np.linalg.norm(x) + rng.normal(size=n) * 0.3
    y -= y.mean()
    r2 = (x @ y) ** 2 / (x @ x) / (y @ y)
    variance = np.exp(np.linspace(-9, 6, 3000))[:, None]
    gain = np.linspace(-4, 6, 2001)[None]
    unit = x / np.linalg.norm(x)
    squares = np.sum(np.square(y[:, None] - unit[:, None] * gain), axis=0)[None]
    freedom = (n - 1) / 2  # the mean is fitted, too
    prior = np.exp(-(gain**2) / (2 * n * variance)) / np.sqrt(2 * np.pi * n * variance)
    step = gain[0, 1] - gain[0, 0]
    with_it = np.sum(np.sum(np.exp(-squares / (2 * variance)) * prior, axis=1) * step * variance[:, 0] ** -freedom)
    without = np.sum(np.exp(-(y @ y) / (2 * variance[:, 0])) * variance[:, 0] ** -freedom)
    assert log_bayes_factor(np.float32(1 - r2), n) == pytest.approx(math.log(with_it / without), abs=0.01)


def test_white_noise_has_as_many_independent_values_as_pixels_and_smooth_noise_fewer() -> None:
    rng = np.random.default_rng(1)
    white = [rng.normal(size=(200, 200)).astype(np.float32) for _ in range(2)]
    assert independent_values(*white) == pytest.approx(BLOCK, rel=0.02)
    blurred = [cv2.GaussianBlur(one, (0, 0), 1.0) for one in white]
    # A Gaussian of deviation s has the autocorrelation exp(-lag^2 / 4 s^2), and its square adds up to 2 pi s^2. There
    # are some more values, since the mean of the block is taken off.
    assert 1 < independent_values(*blurred) / (BLOCK / (2 * math.pi)) < 1.5


@pytest.mark.parametrize("place", [3.0, 3.2, 3.5, 3.9])
def test_a_place_between_hypotheses_is_found(place) -> None:
    scene = smooth(5)
    picture = (7 + 2 * shifted(scene, [place])[0][0]).astype(np.float32)
    known = shifted(scene, [float(k) for k in range(8)])
    independent = independent_values(picture, known[0][0])
    found = best_match(*match(picture, iter(known), independent), independent, 1.0)
    inner = found.place[:, 12:-12]
    assert np.mean(np.abs(inner - place) < 0.15) > 0.97
    assert abs(np.median(inner) - place) < 0.05
    assert np.all(found.confidence[:, 12:-12] > 0.99)


def test_places_err_as_much_as_stated() -> None:
    scene, rng = smooth(6, 200, 256), np.random.default_rng(2)
    noise = 0.5 * scene.std()
    picture = (shifted(scene, [3.0])[0][0] + rng.normal(size=scene.shape) * noise).astype(np.float32)
    known = shifted(scene, list(np.arange(2.0, 4.01, 1 / 3)))
    found = best_match(*match(picture, iter(known), float(BLOCK)), float(BLOCK), 1 / 3)
    error = (found.place - 3.0)[:, 12:-12]
    assert error.std() == pytest.approx(float(np.sqrt(np.mean(found.sd[:, 12:-12] ** 2))), rel=0.15)


def test_noise_is_not_believed() -> None:
    rng = np.random.default_rng(9)
    picture, others = rng.normal(size=(60, 100)).astype(np.float32), rng.normal(size=(150, 60, 100)).astype(np.float32)
    possible = np.ones((60, 100), bool)
    found = best_match(*match(picture, ((one, possible) for one in others), 40.0), 40.0, 1.0)
    assert np.mean(found.confidence > 0.9) < 0.005


def test_an_edge_within_the_block_leaves_even_odds() -> None:
    near, far = shifted(smooth(7), [20.0])[0][0], shifted(smooth(7), [8.0])[0][0]
    picture = np.where(np.arange(128) < 64, near, far).astype(np.float32)
    known = shifted(smooth(7), [float(k) for k in range(30)])
    found = best_match(*match(picture, iter(known), 30.0), 30.0, 1.0)
    assert np.all(found.confidence[5:-5, 61:67] <= 0.5)
    assert np.all(found.confidence[5:-5, 30:50] > 0.9)


def test_what_is_not_possible_is_not_found() -> None:
    picture = smooth(8).astype(np.float32)
    nowhere = np.zeros(picture.shape, bool)
    found = best_match(*match(picture, iter([(picture, nowhere)] * 3), 30.0), 30.0, 1.0)
    assert np.isnan(found.place).all()
    assert not found.confidence.any()


@pytest.mark.parametrize("rows", [[5], [0, 2, 4], list(range(100)), [*range(10, 30), *range(200, 260), 300]])
def test_bands_cover_every_row_once_and_never_cross_a_gap(rows) -> None:
    numbers, kept = np.array(rows), []
    for part, wanted in bands(numbers):
        assert np.all(np.diff(numbers[part]) == 1)
        kept += numbers[part][wanted].tolist()
    assert kept == rows


@pytest.mark.parametrize("level", [1.0, 30.0, 2000.0, 1e5, 1e7])
@pytest.mark.parametrize("time_s", [1e-3, 1.9e-3, 2e-3, 0.01, 0.5])
def test_exposures_fill_the_time_and_do_not_saturate_if_they_need_not(level, time_s) -> None:
    taken = []

    def take(number: int, exposure_s: float) -> np.ndarray:
        assert exposure_s >= 1e-3
        taken.append((number, exposure_s))
        return np.full((number, 2, 2), min(level * exposure_s, 4095)).astype(np.uint16)

    picture = exposed(take, 1e-3, time_s, 4095)
    spent = sum(number * exposure_s for number, exposure_s in taken)
    assert spent <= time_s * (1 + 1e-6)
    assert max(number for number, _ in taken) <= 64
    if time_s >= 2e-3:
        assert all(level * exposure_s < 0.75 * 4095 or exposure_s <= 1.01e-3 for _, exposure_s in taken)
        if level < 1e5:
            assert spent > 0.9 * time_s
    assert picture.shape == (2, 2)
