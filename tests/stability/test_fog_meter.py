"""The fog meter's fit from no counts to all ones, over haze that is not there, even, or gone within a bin."""

import numpy as np
import pytest

from rig.depth.fog_meter import fit_fog, read_fog
from rig.depth.kernels import add_clear_rows, sum_dark
from tests.reference.working_point import Light
from tests.stability.inventory import covers
from tests.unit.rig.depth.test_fog_meter import PATH_M, state_of, stripes_of, sums, swept


@covers(fit_fog)
@pytest.mark.parametrize("exposures", [60.0, 1e4, 1e9])
@pytest.mark.parametrize("extinction", [0.0, 0.02, 1.0, 30.0])
@pytest.mark.parametrize("haze", [0.0, 1e-6, 0.3, 100.0])
@pytest.mark.parametrize("ambient", [0.0, 1e-4, 5.0])
def test_any_light_has_a_finite_fit(exposures, extinction, haze, ambient) -> None:
    fit = fit_fog(sums(extinction, haze, 0.1, ambient, exposures), PATH_M)
    assert np.isfinite(fit.value).all()
    assert np.isfinite(fit.covariance).all()
    assert np.all(np.diag(fit.covariance) >= 0)


@covers(fit_fog)
def test_exact_light_is_found_again_exactly(worst) -> None:
    for extinction, haze, rest in ((0.02, 0.1, 0.0), (0.2, 0.3, 0.3), (0.8, 1.0, 0.1)):
        fit = fit_fog(sums(extinction, haze, rest, 0.02, 1e7), PATH_M)
        haze_there, found_extinction, offset, found_rest = fit.value
        found = [haze_there * np.exp(2 * found_extinction * fit.at_m), found_extinction, 0.02 + offset, found_rest + 1]
        expected = np.array([haze, extinction, 0.02, rest + 1])
        worst("extinction, haze and rest of exact sums", "what they were made of", found / expected - 1, 1e-3)


@covers(fit_fog)
def test_sums_that_are_all_zeros_all_ones_or_nowhere() -> None:
    made = sums()
    for share in (0.0, 1.0):
        full = made.copy()
        full[..., 0] = share * full[..., 1]
        fit = fit_fog(full, PATH_M)
        assert np.isfinite(fit.value).all()
        assert np.isfinite(fit.covariance).all()
    assert fit_fog(np.zeros_like(made), PATH_M) is None
    few = np.zeros_like(made)
    few[3, :, 20:23] = made[3, :, 20:23]
    assert fit_fog(few, PATH_M) is None
    few[3, 0, 20:26] = made[3, 0, 20:26]
    assert np.isfinite(fit_fog(few, PATH_M).covariance).all()


@covers(add_clear_rows, read_fog)
@pytest.mark.parametrize("level", [0, 1, 5])
def test_pictures_without_any_contrast_have_no_fog(level) -> None:
    sweep = swept(Light(), 5)
    sweep.counts[:] = level
    fog = read_fog(sweep.volume, stripes_of(sweep), sweep.geometry, state_of(sweep))
    assert fog.extinction_per_m is None
    assert fog.veil_per_exposure is None
    assert fog.visibility_m is None


@covers(sum_dark)
@pytest.mark.parametrize("hot_flux", [0.0, 0.02, np.inf])
def test_dark_sums_are_those_of_exact_integers_up_to_the_largest_counts(hot_flux) -> None:
    rng = np.random.default_rng(1)
    ambient = rng.uniform(1e-7, 0.1, (40, 70)).astype(np.float32)
    ambient[3, 5] = np.inf  # a pixel that always fires
    for most in (0, 1, 2**31 - 1):
        dark = rng.integers(0, most, ambient.shape, np.uint32, endpoint=True)
        frames = rng.integers(0, most, 70, np.int32, endpoint=True)
        used = (ambient <= hot_flux) & np.isfinite(ambient)
        ambient_here = np.where(used, ambient.astype(np.float64), 0.0)
        expected = (
            dark[used].astype(np.float64).sum(), (used * frames.astype(float)).sum(), (ambient_here * frames).sum(),
        )  # fmt: skip
        limit = min(hot_flux, float(np.finfo(np.float32).max))
        assert sum_dark(dark, frames, ambient, limit) == pytest.approx(expected, rel=1e-12)
