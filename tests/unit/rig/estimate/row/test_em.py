import math
from functools import cache

import numpy as np
import pytest

from rig.estimate.row import em
from rig.estimate.row.ambient import ambient_map
from rig.estimate.row.em import lattice, learn_first
from rig.estimate.row.model import BINS, RowModel, fit_haze, stripe_scale
from rig.threads import RowWorkers
from tests.reference.geometry import Geometry
from tests.stability.inventory import covers
from tests.unit.small_maps import RIGS, geometry_of, simulated, volume_of

pytestmark = pytest.mark.slow

covers(em, RowModel)

WORKERS = RowWorkers(1)
PATH_M = 1.0 / np.linspace(0.08, 1.1, BINS)


@cache
def learned(light="report", exposures=10, rig="left") -> RowModel:
    sweep = simulated(light, exposures, rig)
    return first_model(sweep.volume, sweep.geometry)


def first_model(volume, geometry) -> RowModel:
    return learn_first(volume, geometry, ambient_map(volume, volume.intensity(), geometry, None), WORKERS)


def noisy_haze(rng, extinction, amplitude=0.3, photons=2000.0):
    """Haze of an exponential with the scatter of counting, and its variance."""
    haze = amplitude * np.exp(-2 * extinction * PATH_M)
    variance = (haze + 0.005) / photons  # ambient light counts as well
    return haze + rng.normal(0, np.sqrt(variance)), variance


@pytest.mark.parametrize("extinction", [0.02, 0.3, 1.0])
def test_an_exponential_is_fitted_within_its_own_uncertainty(extinction):
    rng = np.random.default_rng(1)
    pulls = []
    for _ in range(200):
        fit = fit_haze(PATH_M, *noisy_haze(rng, extinction))
        assert fit.extinction_sd_per_m < 0.5 * extinction
        pulls.append((fit.extinction_per_m - extinction) / fit.extinction_sd_per_m)
    assert abs(np.mean(pulls)) < 0.4
    assert 0.7 < np.std(pulls) < 1.2


def test_where_there_is_no_haze_there_is_no_fit():
    nothing, variance = np.zeros(BINS), np.full(BINS, 1e-6)
    assert fit_haze(PATH_M, nothing, variance) is None
    assert fit_haze(PATH_M, nothing - 1e-3, variance) is None
    assert fit_haze(PATH_M, np.full(BINS, np.nan), variance) is None
    few = np.full(BINS, np.nan)
    few[:3] = 0.1
    assert fit_haze(PATH_M, few, variance) is None
    # Haze that is lost in its own noise.
    assert fit_haze(PATH_M, np.full(BINS, 1e-4), np.ones(BINS)) is None


@pytest.mark.parametrize("extinction", [0.0, 0.05, 5.0])
def test_stripe_scale_falls_as_distance_squared_and_both_paths(extinction):
    scale = stripe_scale(PATH_M, extinction)
    assert np.all(np.isfinite(scale) & (scale > 0))
    assert scale[BINS // 2] == pytest.approx(1.0)
    a, b = BINS // 2, BINS // 2 + 10
    wanted = (PATH_M[a] / PATH_M[b]) ** 2 * math.exp(-2 * extinction * (PATH_M[b] - PATH_M[a]))
    assert scale[b] / scale[a] == pytest.approx(wanted)


@pytest.mark.parametrize("rig", RIGS)
@pytest.mark.parametrize("lines", [1, 3000, 10**6])
def test_the_lattice_picks_distinct_rows_and_columns_that_have_a_window(rig, lines):
    geometry = geometry_of(Geometry.build(width=300, height=40, columns=100, **RIGS[rig]))
    y, c = lattice(geometry, lines)
    seen = geometry.x_lo <= geometry.x_hi
    assert seen[y, c].all()
    assert len(set(zip(y.tolist(), c.tolist(), strict=True))) == len(y)
    if lines >= seen.sum():
        assert len(y) == seen.sum()
    else:
        assert 0.6 * lines <= len(y) <= lines
    if lines == 3000:
        # Every row with windows takes part about evenly.
        share = np.bincount(y, minlength=40) / np.maximum(seen.sum(axis=1), 1)
        assert share[seen.any(axis=1)].max() < 3 * share[seen.any(axis=1)].mean()
        assert (share[seen.any(axis=1)] > 0).all()


@pytest.mark.parametrize("light", ["report", "dense", "clear"])
def test_the_learned_haze_is_that_of_the_light(light):
    sweep, model = simulated(light), learned(light)
    # Light before the stripe at the near end of the rows, by the truth.
    wanted = np.median(
        [sweep.point.flux_of_column(c)[16, max(int(sweep.geometry.x_lo[16, c]), 0) + 5] for c in range(30, 96, 6)]
    )
    path_m = model.path_m()
    near = np.median(model.profile[(path_m > 1.1) & (path_m < 2.0), 0])
    found = near + np.median(model.ambient)
    assert found == pytest.approx(wanted, rel=0.35, abs=0.01)
    assert (model.profile[:, :3] >= 0).all()
    assert np.all(np.diff(model.amplitude) > 0)
    assert model.weight.sum() == pytest.approx(1.0)
    assert 0 < model.none_weight <= 0.5


@pytest.mark.parametrize(("light", "exposures"), [("report", 10), ("dense", 3)])
def test_the_width_of_the_line_is_learned(light, exposures):
    assert learned(light, exposures).line_sigma_px == pytest.approx(0.6, rel=0.35)


def test_rows_with_a_weaker_line_get_a_smaller_gain():
    sweep = simulated("dense", rows=160, columns=16)
    # The lower rows see half of all light: haze, stripe and ambient.
    counts = sweep.counts.copy()
    counts[:, 80:] = np.random.default_rng(5).binomial(counts[:, 80:], 0.5)
    falls = []
    for picture in (sweep.counts, counts):
        volume = volume_of(picture, sweep.geometry, 10)
        model = first_model(volume, sweep.geometry)
        falls.append(model.row_gain[-30:].mean() / model.row_gain[:30].mean())
    assert falls[1] < 0.75 * falls[0]
