"""Vectors of stripes against loops over neighbours, and the score's light against numpy."""

import numba
import numpy as np
import pytest

from rig.estimate.joint.place.light import LEAST_FLUX, _dark_over_lit
from rig.estimate.joint.place.place import new_places
from rig.estimate.joint.place.places import MOST_FLUX
from rig.estimate.joint.place.pool import MARGIN, SAME_PX, pool_places, pool_row, widen_row, with_margin
from rig.simd.memory import address_of, load_float32, store_float32
from rig.simd.vectors import LANES


def surfaces(rows, columns, seed=1):
    """Distances of two surfaces and nothing, and two quantities of each stripe."""
    rng = np.random.default_rng(seed)
    distance = np.where(rng.random((rows, columns)) < 0.3, 20.0, 12.0) + rng.normal(0, 0.4, (rows, columns))
    distance[rng.random((rows, columns)) < 0.1] = np.nan
    first, second = rng.normal(0, 1, (rows, columns)), rng.random((rows, columns))
    return [np.ascontiguousarray(a, np.float32) for a in (distance, first, second)]


def pooled(distance, values, y, c, reach):
    part = slice(max(y - reach, 0), y + reach + 1), slice(max(c - reach, 0), c + reach + 1)
    same = np.abs(distance[part] - distance[y, c]) <= SAME_PX
    return values[part][same].astype(float).sum()


@pytest.mark.parametrize(("rows", "columns", "reach"), [(1, 1, 2), (9, 24, 0), (12, 61, 4)])
def test_sums_are_those_of_neighbours_on_the_same_surface(rows, columns, reach):
    arrays = distance, first, second = surfaces(rows, columns)
    around = [with_margin(a, 0, rows) for a in arrays]
    width = around[0].shape[1]
    sums, wider = (np.full((2, width - 2 * LANES), 7, np.float32) for _ in range(2))
    for y in range(rows):
        pool_row(*around, y, reach, sums)
        wanted = [[pooled(distance, a, y, c, reach) for c in range(columns)] for a in (first, second)]
        np.testing.assert_allclose(sums[:, :columns], wanted, rtol=1e-5, atol=1e-5)
        pool_row(*around, y, reach, wider)
        most = min(reach + 2, MARGIN)
        widen_row(tuple(a.ctypes.data for a in around), width, y, reach, most, np.inf, wider.ctypes.data)
        pool_row(*around, y, most, sums)
        np.testing.assert_allclose(wider, sums, rtol=1e-5, atol=1e-5)


def test_each_place_is_pooled_over_as_few_neighbours_as_it_takes():
    places = new_places(11, 53)
    places.distance[:], g, places.known[:] = surfaces(11, 53, 2)
    places.known[np.isnan(places.distance)] = 0
    places.score[:] = np.where(places.known > 0, places.known * places.distance + 0.1 * g, 0)
    moved, sd = (np.empty((11, 53), np.float32) for _ in range(2))
    reaches, enough = (1, 2, 3), 5.0
    pool_places(places, reaches, enough, 0, 11, moved, sd)
    for y, c in np.ndindex(11, 53):
        known = [pooled(places.distance, places.known, y, c, reach) for reach in reaches]
        i = next((i for i in range(2) if known[i] >= enough), 2)
        step = 0.0
        if known[i] > 0:
            step = pooled(places.distance, places.score, y, c, reaches[i]) / known[i] - places.distance[y, c]
        assert moved[y, c] == pytest.approx(np.clip(step, -1, 1), abs=1e-4)
        assert sd[y, c] == pytest.approx(min(max(known[i], 1e-12) ** -0.5, 1.0), rel=1e-5)


@numba.njit
def dark_over_lit(flux, out):
    for i in range(0, len(flux), LANES):
        store_float32(address_of(out), i, _dark_over_lit(load_float32(address_of(flux), i)))


def test_shares_of_dark_exposures_are_exact():
    flux = np.geomspace(LEAST_FLUX, MOST_FLUX, 64 * LANES).astype(np.float32)
    out = np.empty_like(flux)
    dark_over_lit(flux, out)
    np.testing.assert_allclose(out, 1 / np.expm1(flux.astype(float)), rtol=3e-6)
