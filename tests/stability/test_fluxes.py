"""From counts to photons and to what a count says of a hypothesis: K = 1 to 10^6, no counts to all ones."""

import mpmath
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.estimate.argmax_edge import _flux, peak_confidence, sub_pixel
from rig.estimate.row.em import flux
from rig.estimate.row.likelihood import (
    CELL_BITS,
    EXPONENT_HIGH,
    EXPONENT_LOW,
    FLOOR,
    FLUX_MAX,
    FLUX_MIN,
    LABEL_PX,
    LABELS,
    add_evidence,
    cell_of,
    logit_table,
    mode_of,
    none_prior,
    row_posterior,
    row_scores,
)
from rig.estimate.row.model import (
    EXTINCTION_MAX_PER_M,
    RowModel,
    fine_profiles,
    fit_haze,
    line_profile,
    line_reach,
    stripe_scale,
)
from rig.estimate.search.rows import EXPOSURE_PARTS, count_fluxes
from tests.stability.inventory import EXAMPLES, covers

EXPOSURES = (1, 2, 10, 255, 65_535, 10**6)
TABLE = logit_table()


def exact_flux(n, k):
    return mpmath.log((k + mpmath.mpf("0.5")) / (k - n + mpmath.mpf("0.5")))


@covers(flux, count_fluxes)
def test_fluxes_of_counts_are_exact_from_no_counts_to_all_ones(digits) -> None:
    for k in EXPOSURES:
        n = np.unique(np.round(np.concatenate([[0, 1, k - 1, k], np.geomspace(1, k, 25)])))
        for of in (flux, _flux):
            got = [of(float(a), float(k)) for a in n]
            digits("photons from counts, K = 1 to 10^6", 1e-14, got, exact_flux, n, k)
    assert flux(0.0, 0.0) == 0.0
    table = count_fluxes()
    assert np.isfinite(table).all()
    k, n = np.array([1, 10, 63]), np.array([1, 3, 63])
    digits("photons from counts, table in float32", 1e-7, table[EXPOSURE_PARTS * k, n], exact_flux, n, k)


@covers(logit_table, cell_of)
def test_what_a_count_says_is_exact_at_every_flux(worst, digits) -> None:
    """p' lies within floor / 2 of 0 and of 1 at the ends: neither logarithm may cancel."""
    cells = np.unique(np.linspace(0, TABLE.shape[1] - 1, 300).astype(int))
    middle = np.ldexp(1 + ((cells & 255) + 0.5) / 256, (cells >> CELL_BITS) + EXPONENT_LOW)
    floor = mpmath.mpf(FLOOR)

    def lit(x):
        return (floor - 1) * mpmath.expm1(-x) + floor / 2

    def dark(x):
        return (1 - floor) * mpmath.exp(-x) + floor / 2

    # Where the odds are even their logarithm is 0: there float32's own step counts, not the relative error.
    logit = np.array([float(mpmath.log(lit(x)) - mpmath.log(dark(x))) for x in middle])
    step = np.abs(TABLE[0, cells] - logit) / np.maximum(np.abs(logit), 1.0)
    worst("logit of p, flux 5e-7 to 256", "mpmath, 50 digits", step, 1e-7)
    digits("log(1 - p), flux 5e-7 to 256", 1e-7, TABLE[1, cells], lambda x: mpmath.log(dark(x)), middle)
    assert cell_of(FLUX_MIN) == 0
    assert cell_of(FLUX_MAX) == ((EXPONENT_HIGH - EXPONENT_LOW) << CELL_BITS) - 1


def scored(n, k, before, behind, amplitude):
    """Taps, edge scores and scores of a row of counts in K exposures, lit `before` and `behind` the stripe."""
    length = len(n)
    taps, edge, score = (np.empty(shape, np.float32) for shape in ((3, length), length + 1, (len(amplitude), length)))
    light = (np.full(length, flux, np.float32) for flux in (before, behind))
    row_scores(
        n, np.float32(k), *light, np.ones(length, np.float32), length, amplitude, line_profile(0.6), TABLE, taps, edge,
        score,
    )  # fmt: skip
    return taps, edge, score


@covers(row_scores, add_evidence)
@pytest.mark.parametrize("length", [512, 100_000])
def test_sums_along_a_row_are_as_good_as_in_float64(length, worst) -> None:
    rng = np.random.default_rng(1)
    for k in (1, 10, 10**6):
        n = rng.binomial(k, -np.expm1(-0.05), length).astype(np.float32)
        taps, edge, score = scored(n, k, 0.08, 0.03, np.array([0.5, 3.0], np.float32))
        exact = np.concatenate([[0], np.cumsum(taps[0].astype(float) - taps[1].astype(float))])
        assert np.isfinite(score).all()
        worst(f"running sum of {length} terms, float32 out", "float64", (edge - exact) / np.abs(exact).max(), 1e-7)


@covers(row_posterior, none_prior, mode_of)
@EXAMPLES
@given(
    k=st.sampled_from(EXPOSURES), level=st.sampled_from([0.0, 1e-6, 0.5, 1.0]), length=st.integers(1, 200),
    light=st.floats(float(FLUX_MIN), float(FLUX_MAX)), dim=st.floats(float(FLUX_MIN), float(FLUX_MAX)),
    window=st.tuples(st.floats(0, 1), st.floats(0, 1)), none_weight=st.floats(1e-3, 0.5), seed=st.integers(0, 99),
)  # fmt: skip
def test_posteriors_are_probabilities_for_any_counts(k, level, length, light, dim, window, none_weight, seed) -> None:
    n = np.random.default_rng(seed).binomial(k, level, length).astype(np.float32)
    _, edge, score = scored(n, k, max(light, dim), min(light, dim), np.geomspace(0.03, 30, 4).astype(np.float32))
    first, last = sorted(int(w * (length - 1)) for w in window)
    none = none_prior(1.0, 0.1, 0.9, 0.2, none_weight)
    assert 0 < sum(none) < 1
    posterior, by_amplitude = np.empty(length, np.float32), np.empty(4)
    log_weight = np.full(4, np.log(0.25), np.float32)
    missing, evidence = row_posterior(
        score, edge, length, first, last, log_weight, np.zeros(length, np.float32), none, posterior, by_amplitude
    )
    assert np.isfinite(evidence)
    assert np.all((posterior >= 0) & (posterior <= 1))
    assert 0 <= missing <= 1
    assert posterior.sum(dtype=float) + missing == pytest.approx(1, abs=1e-5)
    mode, near = mode_of(posterior, first, last)
    assert first <= mode <= last
    assert 0 <= near <= 1


@covers(sub_pixel, peak_confidence)
@EXAMPLES
@given(
    row=st.lists(st.integers(0, 1000), min_size=1, max_size=40), at=st.integers(0, 39), more=st.integers(0, 10**6),
    scale=st.sampled_from([1.0, 2.0**-40, 2.0**40]),
)  # fmt: skip
def test_offsets_stay_in_the_pixel_and_turn_round_with_the_row_and_confidences_are_probabilities(
    row, at, more, scale
) -> None:
    n = np.array(row, float) * scale
    peak = min(at, len(row) - 1)
    offset = sub_pixel(n, peak, len(row))
    assert -0.5 <= offset <= 0.5
    assert sub_pixel(n[::-1].copy(), len(row) - 1 - peak, len(row)) == -offset
    if peak in (0, len(row) - 1):
        assert offset == 0
    near, rest = peak_confidence(n / scale, n / scale, float(max(row) + more or 1), peak, len(row))
    assert 0 <= near <= 1 + 1e-12
    assert rest >= 0


@covers(sub_pixel)
def test_flat_tops_have_the_offset_of_their_middle() -> None:
    for row, peak, offset in (((2, 5, 5, 2), 1, 0.5), ((5, 5, 5), 1, 0), ((0, 0, 0), 1, 0), ((1, 1e6, 1), 1, 0)):
        assert sub_pixel(np.array(row, float), peak, len(row)) == offset


@covers(peak_confidence)
def test_confidence_of_a_peak_is_exact_up_to_a_million_exposures(digits) -> None:
    def exact(peak, rest, k, length):
        half = mpmath.mpf("0.5")
        p, q = (peak + half) / (k + 1), (k - peak + half) / (k + 1)
        pr = min((rest + half / length) / (k + mpmath.mpf(1) / length), p)
        gain = mpmath.log(p / q) - mpmath.log(pr / (1 - pr))
        evidence = gain * peak + k * (mpmath.log(q) - mpmath.log(1 - pr))
        share = mpmath.exp(min(max(gain * (rest - peak), -60), 60))
        none = length * mpmath.mpf("0.1") / mpmath.mpf("0.9") * mpmath.exp(-min(max(evidence, -60), 60))
        return (1 + 2 * share) / (1 + (length - 1) * share + none)

    for k in EXPOSURES:
        for rest in {0, k // 3, k - k // 500 - 1, k}:
            for peak in {max(rest, 1), min(rest + 1 + k // 1000, k), k}:
                n = np.full(9, float(rest))
                n[4] = peak
                got, mean = peak_confidence(n, n, float(k), 4, 9)
                assert mean == pytest.approx(rest)
                # exp() makes an absolute error of the exponent, of up to 60, a relative one of the answer
                digits("confidence of a peak, K = 1 to 10^6", 1e-8, got, exact, peak, rest, k, 9)


@covers(fit_haze)
@EXAMPLES
@given(
    near=st.floats(0.05, 2000), ratio=st.floats(1.01, 50), extinction=st.floats(0, 50), level=st.floats(1e-12, 1e3),
    noise=st.floats(1e-6, 1.0), seed=st.integers(0, 99),
)  # fmt: skip
def test_haze_of_any_density_and_distance_has_a_finite_fit_or_none(near, ratio, extinction, level, noise, seed) -> None:
    path = np.linspace(near, near * ratio, 64)
    haze = level * np.exp(-2 * extinction * (path - near)) * np.random.default_rng(seed).normal(1, noise, 64)
    fit = fit_haze(path, haze, np.full(64, (noise * level) ** 2))
    if fit is not None:
        assert np.isfinite(fit.amplitude)
        assert 0 <= fit.extinction_per_m <= EXTINCTION_MAX_PER_M
        assert fit.extinction_sd_per_m >= 0


@covers(fit_haze)
def test_noise_free_haze_gives_its_extinction_back(worst) -> None:
    path = np.linspace(0.8, 9, 64)
    for extinction in (0.0, 1e-3, 0.13, 4.0):
        fit = fit_haze(path, 0.4 * np.exp(-2 * extinction * path), np.full(64, 1e-12))
        assert fit is not None
        worst("extinction of noise-free haze, 0 to 4 /m", "exact", fit.extinction_per_m - extinction, 1e-6)


@covers(stripe_scale, RowModel.path_m)
@EXAMPLES
@given(near=st.floats(1e-3, 1e3), ratio=st.floats(1.0, 1e4), extinction=st.floats(0, 50))
def test_stripe_scales_are_finite_and_fall_with_distance(near, ratio, extinction) -> None:
    scale = stripe_scale(near * np.geomspace(1, ratio, 64), extinction)
    assert np.isfinite(scale).all()
    assert np.all(np.diff(scale) <= 0)


@covers(line_profile, line_reach, fine_profiles)
@pytest.mark.parametrize("sigma_px", [0.05, 0.25, 0.6, 2.4])
def test_line_profiles_are_exact_and_whole(sigma_px, worst) -> None:
    def share(distance, sigma):
        unit = 1 / (sigma * mpmath.sqrt(2))
        return (mpmath.erf((distance + 0.5) * unit) - mpmath.erf((distance - 0.5) * unit)) / 2

    profile = line_profile(sigma_px)
    assert len(profile) == line_reach(sigma_px) + 1 in range(3, 8)
    profiles = [(values, np.arange(len(values))) for values in (profile, line_profile(sigma_px, 4))]
    for i, fine in enumerate(fine_profiles(sigma_px)):
        profiles.append((fine, np.arange(len(fine)) - len(fine) // 2 - (i - LABELS // 2) * LABEL_PX))
    for values, away in profiles:
        off = values - np.array([float(share(t, mpmath.mpf(sigma_px))) for t in away])
        worst("share of a line in its pixels", "mpmath, 50 digits", off, 1e-7)
