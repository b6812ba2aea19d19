import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rig.estimate.registry import create_estimator
from tests.unit.small_maps import rows_of, simulated

SIDES = pytest.mark.parametrize("near_is_left", [True, False])
NAMES = pytest.mark.parametrize("name", ["argmax", "edge"])


def estimate(name, counts, exposures, threads=2, **rows):
    return create_estimator(name, threads).estimate(*rows_of(np.asarray(counts), exposures, **rows))


def row(width=100, **peaks):
    """One row of zeros with peaks x12=5."""
    counts = np.zeros((1, 1, width), np.uint8)
    for name, n in peaks.items():
        counts[0, 0, int(name[1:])] = n
    return counts


@SIDES
def test_argmax_of_a_row_without_counts_is_the_smallest_x_at_low_confidence(near_is_left):
    stripes = estimate("argmax", row(), 10, near_is_left=near_is_left, x_lo=7)
    assert stripes.x_px.item() == 7.0
    assert stripes.confidence.item() < 0.1


@SIDES
@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32), st.integers(1, 5), st.integers(3, 130), st.data())
def test_argmax_is_the_first_largest_count_of_the_window(near_is_left, seed, k, width, data):
    x_lo = data.draw(st.integers(0, width - 1))
    x_hi = data.draw(st.integers(x_lo, width - 1))
    counts = np.random.default_rng(seed).integers(0, k + 1, (3, 4, width)).astype(np.uint8)
    x = estimate("argmax", counts, k, near_is_left=near_is_left, x_lo=x_lo, x_hi=x_hi).x_px
    first = x_lo + counts[:, :, x_lo : x_hi + 1].argmax(axis=2).T
    assert np.all(np.abs(x - first) <= 0.5)


@NAMES
@SIDES
def test_brighter_pixels_outside_the_search_interval_are_not_seen(name, near_is_left):
    counts = row(x10=9, x40=5, x95=9)
    stripes = estimate(name, counts, 10, near_is_left=near_is_left, x_lo=11, x_hi=94)
    assert stripes.x_px.item() == 40.0


@NAMES
def test_windows_that_start_off_zero_are_read_at_their_place(name):
    assert estimate(name, row(200, x150=8, x30=9), 10, x0=64, x_lo=70).x_px.item() == 150.0


@SIDES
def test_edge_finds_the_step_that_argmax_misses(near_is_left):
    x = np.arange(120)
    counts = np.round(60 * np.exp(-x / 40) * (x <= 70) + 25 * (x == 70)).astype(np.uint8)
    if not near_is_left:
        counts = counts[::-1]
    step = 70 if near_is_left else 49
    stripes = estimate("edge", counts[None, None], 100, near_is_left=near_is_left)
    assert abs(stripes.x_px.item() - step) <= 0.5
    assert abs(estimate("argmax", counts[None, None], 100, near_is_left=near_is_left).x_px.item() - step) > 60
    assert stripes.haze.item() == pytest.approx(60 * np.exp(-70 / 40) / 100, rel=0.3)


@NAMES
@SIDES
@pytest.mark.parametrize("offset", [-0.4, -0.2, 0.0, 0.2, 0.4])
def test_positions_are_sub_pixel(name, near_is_left, offset):
    # Pixel shares of a Gaussian of 0.6 px, by fine sums.
    fine = np.arange(-6, 6, 0.01) + 0.005
    light = np.exp(-0.5 * ((fine - offset) / 0.6) ** 2)
    shares = np.histogram(fine, np.arange(-5.5, 6), weights=light / light.sum())[0]
    counts = np.zeros((1, 1, 100), np.uint16)
    counts[0, 0, 45:56] = np.round(6000 * shares)
    stripes = estimate(name, counts, 10_000, near_is_left=near_is_left)
    assert stripes.x_px.item() == pytest.approx(50 + offset, abs=0.12)
    assert stripes.confidence.item() > 0.99


def test_confidence_of_argmax_says_how_far_the_peak_stands_out():
    clear = estimate("argmax", row(x30=9), 10)
    doubtful = estimate("argmax", row(x30=2, x60=2), 10)
    assert clear.confidence.item() > 0.99
    assert 0.2 < doubtful.confidence.item() < 0.6
    assert 0 < clear.x_sd_px.item() < 1


@NAMES
@pytest.mark.parametrize("light", ["report", "clear"])
def test_answers_with_high_confidence_are_mostly_right(name, light):
    sweep = simulated(light)
    stripes = create_estimator(name).estimate(sweep.volume, sweep.geometry)
    sure = stripes.confidence[sweep.point.trusted] > 0.9
    right = sweep.errors(stripes.x_px) <= 1
    assert sure.mean() > 0.3
    assert right[sure].mean() > 0.75
    assert right[sure].mean() > right[~sure].mean() + 0.3
