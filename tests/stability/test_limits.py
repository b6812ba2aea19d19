"""The statistical limit over its domain: 1e-300 photons to a million, rows alike and rows that share nothing."""

import mpmath
import numpy as np
import pytest

from rig.tradeoff.limits import (
    bayes_errors,
    chernoff_exponent,
    least_exponent,
    limits,
    log_fired,
    position_information,
    position_sd_px,
)
from rig.tradeoff.row_light import FLUX_MIN, RowLight, pixel_share
from tests.stability.inventory import covers

FLUXES = (FLUX_MIN, 1e-30, 1e-9, 1e-4, 0.1, 1.0, 30.0, 800.0, 1e6)


def overlap(t, a, b):
    """p^t p'^(1-t) + q^t q'^(1-t) of a pixel with fluxes a and b, at 50 digits."""
    p, other = -mpmath.expm1(-a), -mpmath.expm1(-b)
    return p**t * other ** (1 - t) + mpmath.exp(-a * t - b * (1 - t))


def exact_exponent(a, b):
    """C of one pixel: ternary search, the function is concave in t."""
    low, high = mpmath.mpf(0), mpmath.mpf(1)
    for _ in range(90):
        x, y = low + (high - low) / 3, high - (high - low) / 3
        low, high = (x, high) if overlap(x, a, b) > overlap(y, a, b) else (low, y)
    return -mpmath.log(overlap((low + high) / 2, a, b))


def light(position=20.0, stripe=1.0, sigma_px=0.6, haze=0.0, dark=1e-4, pixels=40) -> RowLight:
    behind = np.full(pixels, dark)
    return RowLight(behind + haze, behind, np.ones(pixels), position, stripe, sigma_px, 0.0, pixels - 1.0)


@covers(chernoff_exponent)
def test_chernoff_exponents_of_any_two_pixels(digits) -> None:
    apart = [(a, b) for a in FLUXES for b in FLUXES if a != b]
    # Differences that cancel in p and in q: C falls with their square.
    alike = [(a, a * (1 + step)) for a in (1e-9, 1e-3, 0.3, 3.0, 30.0) for step in (1e-1, 1e-3, 1e-6, 1e-9)]
    one, two = np.array(apart + alike).T
    got = chernoff_exponent(one[:, None], two[:, None])
    digits("Chernoff exponent, flux 1e-300 to 1e6", 1e-12, got, exact_exponent, one, two)
    np.testing.assert_allclose(got, chernoff_exponent(two[:, None], one[:, None]), rtol=1e-12)
    assert np.all(chernoff_exponent(one[:, None], one[:, None]) == 0)


@covers(pixel_share, log_fired)
def test_shares_of_a_line_far_out_in_its_flanks(worst, digits) -> None:
    away, sigma = (a.ravel() for a in np.meshgrid([0.0, 0.3, 0.5, 1.0, 2.5, 4.0], [0.2, 0.6, 3.0, 100.0]))
    inside = away < 8 * sigma + 0.5
    away, sigma = away[inside], sigma[inside]
    got = [float(pixel_share(np.array([a]), s)[0]) for a, s in zip(away, sigma, strict=True)]

    def exact(a, s):
        return (mpmath.erfc((a - 0.5) / s / mpmath.sqrt(2)) - mpmath.erfc((a + 0.5) / s / mpmath.sqrt(2))) / 2

    digits("share of a Gaussian in a pixel", 1e-12, got, exact, away, sigma)
    flux = np.geomspace(1e-300, 1e3, 60)
    off = np.abs(log_fired(flux) - [float(mpmath.log(-mpmath.expm1(-mpmath.mpf(x)))) for x in flux])
    worst("log of the chance to fire", "mpmath, 50 digits", off / np.maximum(np.abs(log_fired(flux)), 1.0), 1e-15)


@covers(position_information, position_sd_px, RowLight.flux)
def test_information_of_any_stripe(digits) -> None:
    cases = [
        (position, stripe, sigma, haze, dark)
        for position in (20.0, 20.3, 20.5)
        for stripe in (1e-9, 0.5, 20.0, 3000.0)
        for sigma, haze, dark in ((0.3, 0.0, 1e-9), (0.6, 0.2, 1e-3), (2.5, 1.0, 5.0))
    ]

    def exact(position, stripe, sigma, haze, dark):
        def normal(x):
            return mpmath.exp(-(x**2) / 2) / mpmath.sqrt(2 * mpmath.pi)

        total = mpmath.mpf(0)
        for x in range(40):
            near, far = (x - position - 0.5) / sigma, (x - position + 0.5) / sigma
            share = (mpmath.erf(far / mpmath.sqrt(2)) - mpmath.erf(near / mpmath.sqrt(2))) / 2
            lit = min(max(mpmath.mpf(0.5) - (x - position), 0), 1)
            flux = dark + haze * lit + stripe * share
            slope = stripe * (normal(near) - normal(far)) / sigma + (haze if -0.5 <= x - position < 0.5 else 0)
            total += slope**2 / mpmath.expm1(flux)
        return total

    got = [position_information(light(p, s, g, h, d)) for p, s, g, h, d in cases]
    digits("Fisher information of the position", 1e-12, got, exact, *np.array(cases).T)


@covers(position_information, position_sd_px)
def test_a_saturated_pair_on_a_pixel_border_says_nothing() -> None:
    """Both always fire, wherever within them the line lies; its flanks, a hundred sigma off, are empty."""
    pair = light(position=20.5, stripe=1e6, sigma_px=0.01, dark=1e-9)
    assert position_information(pair) == 0.0
    assert position_sd_px(pair, 10**6) == np.inf
    assert position_sd_px(light(position=20.5, stripe=1.0, sigma_px=0.01, dark=1e-9), 100) < 0.01
    errors = bayes_errors(pair, [1, 1000], 10, np.random.default_rng(1))
    # Any place from which both pixels saturate: the answer is its middle, which the truth happens to be.
    assert np.all(errors < 0.1)


@covers(bayes_errors, limits, least_exponent, RowLight)
@pytest.mark.parametrize("stripe", [1e-12, 1.0, 1e4])
@pytest.mark.parametrize("sigma_px", [0.05, 0.6, 10.0])
@pytest.mark.parametrize(("haze", "dark"), [(0.0, FLUX_MIN), (0.0, 1e-3), (50.0, 1e-3), (0.1, 500.0)])
def test_limits_are_finite_for_any_light(stripe, sigma_px, haze, dark) -> None:
    rows = [light(position, stripe, sigma_px, haze, dark) for position in (0.0, 0.5, 17.2, 39.0)]
    for found in limits(rows, [1, 100, 10**6], draws=4):
        assert 0 <= found.mean_abs_px <= 39.0
        assert 0 <= found.mean_abs_se_px < 39.0
        assert 0 <= found.within_1px <= 1
        assert found.exponent >= 0
        assert found.position_sd_px >= 0
