"""Passages of the line over pixels: no bias, honest standard deviations, and nothing where nothing is to be told."""

import math
from dataclasses import dataclass

import mpmath
import numpy as np
import pytest
from numpy.typing import NDArray

from calibration.board.board import Board
from calibration.passages import find as finding
from calibration.passages import fit
from calibration.passages.find import (
    AWAY_PX,
    SweepCounts,
    board_pixels,
    even_pixels,
    evenly,
    find_passages,
    flux_picture,
)
from calibration.passages.fit import LineShape, fit_passages, light
from calibration.views import Corners
from tests.stability.inventory import covers

pytestmark = pytest.mark.slow

covers(fit, finding)

ROWS = 30
_INTEGRAL = np.vectorize(lambda z: 0.5 * (1 + math.erf(z / math.sqrt(2))))


@dataclass(frozen=True)
class Light:
    """sigma: of the line, columns. light: flux times columns. wedge: haze just before the line, its slope per column
    away from it, its most, and what is left behind the line."""

    sigma: float
    light: float
    ambient: float = 0.05
    wedge: tuple[float, float, float, float] | None = None
    pixel: float = 1.0
    travels: bool = False


def passed(rng, light: Light, exposures: int, pixels: int = 1500, columns: int = 60):
    """Counts (columns, ROWS, width) and the true passages (ROWS, width), in columns."""
    centre = rng.uniform(15, columns - 16, pixels)
    within = (np.arange(exposures) + 0.5) / exposures - 0.5 if light.travels else np.zeros(1)
    inside = (np.arange(9) + 0.5) / 9 - 0.5
    counts = np.zeros((columns, pixels), np.uint16)
    for part in within:
        away = np.arange(columns)[:, None] + part - centre
        z = (away[None] - light.pixel * inside[:, None, None]) / light.sigma
        flux = light.ambient + light.light * np.exp(-0.5 * z * z).mean(axis=0) / (math.sqrt(2 * math.pi) * light.sigma)
        if light.wedge is not None:
            near, slope, most, behind = light.wedge
            gone = _INTEGRAL(away / light.sigma)
            flux = flux + (1 - gone) * np.minimum(near * np.exp(slope * np.maximum(-away, 0)), most) + gone * behind
        frames = 1 if light.travels else exposures
        counts += rng.binomial(frames, -np.expm1(-flux)).astype(np.uint16)
    return counts.reshape(columns, ROWS, -1), centre.reshape(ROWS, -1)


def sweep_of(counts, exposures, step=1.0, first=0.0) -> SweepCounts:
    """Counts (columns, rows, width) as a sweep of columns at commands `first`, `first + step`, ..."""
    columns, _, width = counts.shape
    frames = np.full(columns, exposures)
    return SweepCounts(counts, frames, first + step * np.arange(columns), np.zeros(columns, np.int32), width)


def true_at(centre: NDArray[np.float64], passages) -> NDArray[np.float64]:
    """The true passage of each pixel that was given."""
    return centre[passages.y_px.astype(int), passages.x_px.astype(int)]


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


def test_one_window_for_all_columns_gives_the_passages_of_its_own_pixels():
    counts, _ = passed(np.random.default_rng(6), Light(0.6, 6.0), 10, pixels=3840)
    x0, frames = np.full(len(counts), 32, np.int32), np.full(len(counts), 10)
    found = find_passages(SweepCounts(counts[:, :, 32:96], frames, np.arange(60.0), x0, counts.shape[2]), 1, 1.0)
    whole = np.zeros_like(counts)
    whole[:, :, 32:96] = counts[:, :, 32:96]
    wanted = find_passages(sweep_of(whole, 10), 1, 1.0)
    np.testing.assert_array_equal(found.command, wanted.command)
    assert len(found.command) > 500


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


HIGH, WIDTH, COLUMNS = 24, 64, 80


def _sweep(rng, ambient, line, exposures=10):
    """A line of flux `line` times the albedo that crosses a pixel per column, over a picture `ambient`."""
    at = np.arange(COLUMNS)[:, None] - 8 - np.arange(WIDTH)
    passing = line * np.exp(-0.5 * (at / 0.7) ** 2)[:, None, :] * ambient / ambient.max()
    counts = rng.binomial(exposures, -np.expm1(-(ambient + passing))).astype(np.uint8)
    frames = np.full(COLUMNS, exposures)
    return SweepCounts(counts, frames, np.arange(float(COLUMNS)), np.zeros(COLUMNS, int), WIDTH)


def _print(white, black):
    picture = np.full((HIGH, WIDTH), white)
    picture[:, 20:40] = black
    return picture


def test_room_light_alone_makes_the_picture_however_bright_the_line():
    rng = np.random.default_rng(1)
    ambient = _print(0.4, 0.05)
    picture = flux_picture((_sweep(rng, ambient, 50.0), _sweep(rng, ambient, 50.0)))
    assert picture.dtype == np.float32
    assert picture[:, 25:35].mean() == pytest.approx(0.05, rel=0.06)
    assert picture[:, 45:].mean() == pytest.approx(0.4, rel=0.03)


def test_in_the_dark_the_line_makes_the_picture():
    rng = np.random.default_rng(2)
    picture = flux_picture((_sweep(rng, _print(1e-4, 2e-5), 3.0),))
    assert picture[:, 45:].mean() > 3 * picture[:, 25:35].mean()


def test_pixels_that_no_window_held_are_nan():
    counts = np.full((COLUMNS, HIGH, 32), 5, np.uint8)
    frames, x0 = np.full(COLUMNS, 10), np.where(np.arange(COLUMNS) < 40, 0, 16)
    picture = flux_picture((SweepCounts(counts, frames, np.arange(float(COLUMNS)), x0, WIDTH),))
    assert np.isnan(picture[:, 48:]).all()
    assert np.allclose(picture[:, 20:30], np.log(2), rtol=0.02)


def test_a_picture_has_the_sensors_width_also_where_no_window_reaches_its_end():
    counts = np.full((COLUMNS, HIGH, 32), 5, np.uint8)
    frames, x0 = np.full(COLUMNS, 10), np.zeros(COLUMNS, np.int32)
    picture = flux_picture((SweepCounts(counts, frames, np.arange(float(COLUMNS)), x0, WIDTH),))
    assert picture.shape == (HIGH, WIDTH)
    assert np.isnan(picture[:, 32:]).all()


def test_edges_that_the_line_crosses_are_kept_clear_of_and_noise_is_none():
    rng = np.random.default_rng(4)
    picture = _print(0.4, 0.05)
    picture[12:, :20] = 0.05  # an edge along the row
    picture = (rng.poisson(500 * picture) / 500).astype(np.float32)
    even = even_pixels(picture)
    for edge in (20, 40):
        assert not even[:10, edge - AWAY_PX : edge + AWAY_PX].any()
    assert even[:, 4:14].mean() > 0.95
    assert even[:, 46:].mean() > 0.95


def test_a_board_is_its_squares_and_the_paper_around_them():
    board = Board("chessboard", (8, 5), 0.03)
    at = board.corners_m
    corners = Corners(np.arange(len(at), dtype=np.int32), at[:, :2] / 0.03 * 20 + [60, 50])  # 20 px a square
    mask = board_pixels(corners, board, (240, 320))
    y, x = np.nonzero(mask)
    assert (x.min(), x.max(), y.min(), y.max()) == (52, 228, 42, 158)
