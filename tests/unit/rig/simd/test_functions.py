"""Powers, logarithms and the error function of lanes against numbers, and what is fetched or chosen lane by lane."""

import math

import numba
import numpy as np
import pytest

from rig.simd.functions import error_function, exponential, logarithm
from rig.simd.memory import address_of, load_counts, load_float32, store_float32
from rig.simd.shuffles import EIGHT, fetch_eights, spread_eights
from rig.simd.vectors import LANES, largest_float, smallest_float, where_below


@numba.njit
def all_three(a, out):
    for i in range(0, a.shape[1], LANES):
        store_float32(address_of(out[0]), i, logarithm(load_float32(address_of(a[0]), i)))
        store_float32(address_of(out[1]), i, exponential(load_float32(address_of(a[1]), i)))
        store_float32(address_of(out[2]), i, error_function(load_float32(address_of(a[2]), i)))


def test_powers_of_lanes_are_those_of_numbers():
    n = 64 * LANES
    a = np.stack([np.geomspace(1.2e-38, 1e38, n), np.linspace(-87, 88, n), np.linspace(0, 9, n)]).astype(np.float32)
    a[0, ::2] = np.linspace(0.5, 2, n // 2)
    out = np.empty_like(a)
    all_three(a, out)
    wide = a.astype(float)
    np.testing.assert_allclose(out[0], np.log(wide[0]), rtol=2e-7, atol=2e-7)
    np.testing.assert_allclose(out[1], np.exp(wide[1]), rtol=1e-5)
    np.testing.assert_allclose(out[2], [math.erf(x) for x in wide[2]], atol=1e-6)
    all_three(np.array([[1], [0], [0]], np.float32).repeat(n, 1), out)
    np.testing.assert_array_equal(out[:, 0], [0, 1, 0])
    all_three(np.full_like(a, -1e30), out)
    assert np.all((out[1] > 0) & (out[1] < 1e-37))


@numba.njit
def eights(places, counts, fetched, behind, spread):
    fetch_eights(address_of(places), 0, address_of(fetched))
    fetch_eights(address_of(places), 4 * 3, address_of(behind))
    spread_eights(address_of(counts), address_of(spread))


def test_eight_numbers_of_each_place_are_turned_into_lanes():
    rng = np.random.default_rng(1)
    numbers, counts = rng.random(200).astype(np.float32), rng.integers(0, 256, (LANES, EIGHT), np.uint8)
    at = rng.integers(0, 189, LANES)
    fetched, behind, spread = np.empty((3, EIGHT, LANES), np.float32)
    eights(numbers.ctypes.data + 4 * at, counts, fetched, behind, spread)
    np.testing.assert_array_equal(fetched, [numbers[at + d] for d in range(EIGHT)])
    np.testing.assert_array_equal(behind, [numbers[at + 3 + d] for d in range(EIGHT)])
    np.testing.assert_array_equal(spread, counts.T)


@numba.njit
def choose(a, limits, counts, out):
    values, limit = load_float32(address_of(a), 0), load_float32(address_of(limits), 0)
    store_float32(address_of(out), 0, where_below(values, limit, values, limit))
    store_float32(address_of(out), LANES, load_counts(address_of(counts), 1))
    return smallest_float(values), largest_float(values)


@pytest.mark.parametrize("seed", [0, 1])
def test_lanes_are_chosen_and_their_ends_found(seed):
    rng = np.random.default_rng(seed)
    a, limits = rng.normal(size=(2, LANES)).astype(np.float32)
    counts, out = rng.integers(0, 256, LANES + 1, np.uint8), np.empty((2, LANES), np.float32)
    assert choose(a, limits, counts, out) == (a.min(), a.max())
    np.testing.assert_array_equal(out, [np.minimum(a, limits), counts[1:]])
