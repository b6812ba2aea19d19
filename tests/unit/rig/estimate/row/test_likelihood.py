"""The row likelihood against direct sums of n log p' + (K - n) log(1 - p'), in 50 digits and in float64."""

from dataclasses import dataclass

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rig.estimate.row.likelihood import (
    FLOOR,
    FLUX_MAX,
    FLUX_MIN,
    add_evidence,
    logit_table,
    none_prior,
    row_posterior,
    row_scores,
)
from rig.estimate.row.model import line_profile

TABLE = logit_table()
HALF_CELL = 1 / 512
"""Largest relative error of a flux taken as the middle of its cell, 256 cells an octave."""


def log_q(flux):
    """log(1 - p') and log p' of a pixel in float64."""
    flux = np.asarray(flux, float)
    q = (1 - FLOOR) * np.exp(-flux) + FLOOR / 2
    p = -(1 - FLOOR) * np.expm1(-flux) + FLOOR / 2
    return np.log(q), np.log(p)


def log_likelihood(n, k, flux):
    q, p = log_q(flux)
    return n * p + (k - n) * q


def table_error(n, k, flux):
    """What half a cell of flux changes in the log-likelihood, with a little for float32."""
    flux = np.asarray(flux, float)
    up, down = (log_likelihood(n, k, flux * (1 + s * 1.1 * HALF_CELL)) for s in (1, -1))
    here = log_likelihood(n, k, flux)
    return np.maximum(np.abs(up - here), np.abs(down - here)) + 2e-6 * (n * 10 + k * 8)


def looked_up(n, k, flux):
    flux = np.atleast_1d(np.asarray(flux, np.float32))
    score, zero = np.zeros(len(flux), np.float32), np.zeros(len(flux), np.float32)
    n = np.broadcast_to(np.float32(n), flux.shape).copy()
    add_evidence(n, np.float32(k), flux, np.float32(0), zero, zero, TABLE, score)
    return score


@dataclass
class Lines:
    """One random row with everything that the kernels ask for."""

    n: np.ndarray
    k: int
    before: np.ndarray
    behind: np.ndarray
    scale: np.ndarray
    amplitude: np.ndarray
    sigma_px: float

    def __post_init__(self):
        length = len(self.n)
        self.taps = np.empty((3, length), np.float32)
        self.edge = np.empty(length + 1, np.float32)
        self.score = np.empty((len(self.amplitude), length), np.float32)
        self.psi = line_profile(self.sigma_px)
        row_scores(
            self.n, np.float32(self.k), self.before, self.behind, self.scale, length, self.amplitude, self.psi, TABLE,
            self.taps, self.edge, self.score,
        )  # fmt: skip

    def flux_of(self, j, q):
        """Flux of every pixel when the stripe of amplitude q stands at j, float64."""
        t = np.arange(len(self.n))
        base = np.where(t < j, self.before.astype(float), self.behind)
        base[j] = 0.5 * (float(self.before[j]) + float(self.behind[j]))
        away = np.abs(t - j)
        share = np.where(away < len(self.psi), self.psi[np.minimum(away, len(self.psi) - 1)], 0.0)
        return base + float(q) * share * self.scale

    def posterior(self, first, last, log_weight, log_prior, none):
        out, by_amplitude = np.empty(len(self.n), np.float32), np.empty(len(self.amplitude))
        p_none, evidence = row_posterior(
            self.score, self.edge, len(self.n), first, last, log_weight, log_prior, none, out, by_amplitude
        )
        return out, by_amplitude, p_none, evidence


def random_row(seed, *, length=60, k=10, stripe_at=None, signal=0.7, sigma_px=0.6, haze=0.15, amplitudes=6):
    rng = np.random.default_rng(seed)
    t = np.arange(length)
    before = (0.005 + haze * np.exp(-t / length) * rng.uniform(0.7, 1.3, length)).astype(np.float32)
    behind = (0.004 * rng.uniform(0.5, 2, length)).astype(np.float32)
    scale = np.exp(-0.5 * t / length).astype(np.float32)
    centre = rng.uniform(8, length - 8) if stripe_at is None else stripe_at
    flux = np.where(t < centre, before, behind) + signal * pixel_shares(t - centre, sigma_px)
    n = rng.binomial(k, -np.expm1(-flux)).astype(np.float32)
    amplitude = np.geomspace(0.05, 5.0, amplitudes).astype(np.float32)
    return Lines(n, k, before, behind, scale, amplitude, sigma_px)


def pixel_shares(distance, sigma_px):
    step = 0.02
    fine = np.arange(-0.5 + step / 2, 0.5, step)
    z = (np.asarray(distance, float)[:, None] + fine) / sigma_px
    return np.exp(-0.5 * z**2).sum(axis=1) * step / (sigma_px * np.sqrt(2 * np.pi))


def assert_near(value, wanted, slope):
    assert abs(value - float(wanted)) <= 1.02 * HALF_CELL * float(abs(slope)) + 2e-6 * (1 + float(abs(wanted)))


@settings(max_examples=200, deadline=None)
@given(st.floats(float(np.log(FLUX_MIN)) + 1e-6, float(np.log(FLUX_MAX)) - 1e-6))
def test_the_table_is_within_half_a_cell_of_fifty_digits(log_flux):
    flux = np.float32(np.exp(log_flux))
    with mpmath.workdps(50):
        lam, e = mpmath.mpf(float(flux)), mpmath.mpf(FLOOR)
        q = (1 - e) * mpmath.exp(-lam) + e / 2
        p = 1 - q
        gain, loss = mpmath.log(p / q), mpmath.log(q)
        # Slopes per relative change of flux.
        slope_q = -(1 - e) * lam * mpmath.exp(-lam) / q
        slope_gain = -slope_q * (1 + q / p)
    assert_near(looked_up(1, 0, flux).item(), gain, slope_gain)
    assert_near(looked_up(0, 1, flux).item(), loss, slope_q)


@pytest.mark.parametrize("flux", [FLUX_MIN, FLUX_MAX, np.float32(1e9)])
def test_the_ends_of_the_table_are_inside_it(flux):
    q, p = log_q(min(flux, FLUX_MAX))
    assert looked_up(1, 1, flux).item() == pytest.approx(float(p), abs=0.01)
    assert looked_up(0, 1, flux).item() == pytest.approx(float(q), abs=0.01)
    assert min(p, q) > np.log(FLOOR / 2) - 1e-6


@pytest.mark.parametrize("sigma_px", [0.3, 0.8, 2.4])
@pytest.mark.parametrize(("k", "signal"), [(1, 0.7), (10, 6.0), (300, 0.05)])
def test_scores_are_direct_sums_of_log_likelihoods(k, signal, sigma_px):
    row = random_row(k, k=k, signal=signal, sigma_px=sigma_px)
    own = log_likelihood(row.n, k, row.behind)
    own_error = table_error(row.n, k, row.behind)
    for m, q in enumerate(row.amplitude):
        for j in range(len(row.n)):
            flux = row.flux_of(j, q)
            wanted = np.sum(log_likelihood(row.n, k, flux) - own)
            # Errors of pixels add at random; their plain sum is the bound.
            unlike = flux != row.behind
            bound = np.sum((table_error(row.n, k, flux) + own_error)[unlike]) + 1e-4 * k
            assert abs(row.score[m, j] - wanted) <= bound
    for t in range(len(row.n) + 1):
        here = slice(0, t)
        wanted = np.sum((log_likelihood(row.n, k, row.before) - own)[here])
        bound = np.sum((table_error(row.n, k, row.before) + own_error)[here]) + 1e-4 * k
        assert abs(row.edge[t] - wanted) <= bound


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 2**32), st.sampled_from([1, 3, 10, 255, 3000]), st.floats(0.005, 0.5), st.floats(0, 0.45),
    st.floats(0, 0.45), st.data(),
)  # fmt: skip
def test_the_posterior_and_no_stripe_sum_to_one_and_are_a_softmax(seed, k, none, near, far, data):
    rng = np.random.default_rng(seed)
    row = random_row(seed, k=k, signal=rng.choice([0.0, 0.1, 1.0]))
    length, amplitudes = len(row.n), len(row.amplitude)
    first = data.draw(st.integers(0, length - 1))
    last = data.draw(st.integers(first, length - 1))
    log_weight = np.log(rng.dirichlet(np.ones(amplitudes))).astype(np.float32)
    log_prior = rng.normal(0, 0.5, length).astype(np.float32)
    third = none / 3
    prior = third + near * (1 - none), third + far * (1 - none), third
    posterior, by_amplitude, p_none, evidence = row.posterior(first, last, log_weight, log_prior, prior)

    inside = slice(first, last + 1)
    share = np.exp(log_prior[inside].astype(float))
    share *= (1 - sum(prior)) / share.sum()
    stripes = row.score[:, inside].astype(float) + log_weight[:, None] + np.log(share)
    nothing = np.concatenate([
        [np.log(prior[0]), row.edge[-1] + np.log(prior[1])], row.edge.astype(float) + np.log(prior[2] / (length + 1))
    ])  # fmt: skip
    top = max(stripes.max(), nothing.max())
    total = np.exp(stripes - top).sum() + np.exp(nothing - top).sum()
    assert posterior.sum(dtype=float) + p_none == pytest.approx(1.0, abs=1e-5)
    assert by_amplitude.sum() + p_none == pytest.approx(1.0, abs=1e-5)
    assert not posterior[:first].any()
    assert not posterior[last + 1 :].any()
    np.testing.assert_allclose(posterior[inside], np.exp(stripes - top).sum(axis=0) / total, atol=1e-3)
    np.testing.assert_allclose(by_amplitude, np.exp(stripes - top).sum(axis=1) / total, atol=1e-3)
    assert p_none == pytest.approx(np.exp(nothing - top).sum() / total, abs=1e-3)
    assert evidence == pytest.approx(top + np.log(total), abs=1e-3 * max(1.0, abs(top)) + 2e-3)


def test_the_prior_of_no_stripe_is_what_the_border_cuts_off():
    near, far, none = 1.0, 0.2, 0.03
    assert sum(none_prior(near, far, 1.2, 0.1, none)) == pytest.approx(none)
    # The picture begins half-way through the range: half of the stripes are nearer than it shows.
    behind, before, _ = none_prior(near, far, 0.6, 0.1, none)
    assert behind == pytest.approx(0.01 + 0.97 * 0.5)
    assert before == pytest.approx(0.01)
    behind, before, _ = none_prior(near, far, 1.2, 0.4, none)
    assert before == pytest.approx(0.01 + 0.97 * 0.25)
    assert behind == pytest.approx(0.01)
