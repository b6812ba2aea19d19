"""The picture of a sweep is the light without the line, and where a picture is even no print is crossed."""

import numpy as np
import pytest

from calibration.board.board import Board
from calibration.passages.find import SweepCounts
from calibration.passages.flux_picture import AWAY_PX, board_pixels, even_pixels, flux_picture
from calibration.views import Corners

ROWS, WIDTH, COLUMNS = 24, 64, 80


def _sweep(rng, ambient, line, exposures=10):
    """A line of flux `line` times the albedo that crosses a pixel per column, over a picture `ambient`."""
    at = np.arange(COLUMNS)[:, None] - 8 - np.arange(WIDTH)
    passing = line * np.exp(-0.5 * (at / 0.7) ** 2)[:, None, :] * ambient / ambient.max()
    counts = rng.binomial(exposures, -np.expm1(-(ambient + passing))).astype(np.uint8)
    frames = np.full(COLUMNS, exposures)
    return SweepCounts(counts, frames, np.arange(float(COLUMNS)), np.zeros(COLUMNS, int), WIDTH)


def _print(white, black):
    picture = np.full((ROWS, WIDTH), white)
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
    counts = np.full((COLUMNS, ROWS, 32), 5, np.uint8)
    frames, x0 = np.full(COLUMNS, 10), np.where(np.arange(COLUMNS) < 40, 0, 16)
    picture = flux_picture((SweepCounts(counts, frames, np.arange(float(COLUMNS)), x0, WIDTH),))
    assert np.isnan(picture[:, 48:]).all()
    assert np.allclose(picture[:, 20:30], np.log(2), rtol=0.02)


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
