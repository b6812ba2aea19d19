"""Powers, logarithms and the error function of lanes against numbers; likelihoods from scores."""

import math

import numba
import numpy as np
import pytest

from rig.simd.functions import (
    BIAS,
    MEAN_EXCESS,
    error_function,
    exponential,
    lift_to_powers,
    logarithm,
    powers,
    powers_in_order,
)
from rig.simd.memory import address_of, load_float32, load_int16, read_int16, store_float32, store_int16
from rig.simd.vectors import LANES, UNPACKED


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
def likelihoods(scores, best, shift, out, unpacked, lift):
    lifts = lift_to_powers(load_int16(address_of(best), 0), shift)
    store_int16(address_of(lift), 0, lifts)
    store_float32(address_of(out), 0, powers_in_order(load_int16(address_of(scores), 0), lifts, shift))
    one = read_int16(address_of(lift), 0)
    store_float32(address_of(unpacked), 0, powers(load_int16(address_of(scores), 0), one, shift))


def answers(scores, best, shift):
    out, unpacked = np.empty((2, LANES), np.float32)
    lift = np.empty(LANES, np.int16)
    likelihoods(np.asarray(scores, np.int16), np.full(LANES, best, np.int16), shift, out, unpacked, lift)
    np.testing.assert_array_equal(out[list(UNPACKED)], unpacked)
    return out


@pytest.mark.parametrize("shift", [0, 3, 6])
@pytest.mark.parametrize("best", [-32768, -31752, -17000, 0, 12345, 32767])
def test_the_best_score_counts_and_what_lies_far_below_does_not(best, shift):
    octave = 128 >> shift
    below = np.maximum(best - octave * np.array([0, 1, 2, 10, 60, 200, *[300] * 10]), -32768)
    found = answers(below, best, shift)
    assert np.isfinite(found).all()
    assert found[0] > 0 or best < -32700
    reached = below == best - octave * np.array([0, 1, 2, 10, 60, 200, *[300] * 10])
    # Exact at whole octaves, where the range of 16 bits does not end first.
    if best - (int(BIAS) >> shift) >= -32767:
        assert found[0] > 0
        np.testing.assert_allclose(found[:5][reached[:5]] / found[0], 0.5 ** np.array([0, 1, 2, 10, 60])[reached[:5]])
        assert not found[5:][reached[5:]].any()


def test_between_octaves_terms_are_too_large_by_the_mean_that_is_said():
    units = np.arange(128)
    terms = np.concatenate([answers(1000 + units[i : i + LANES], 1128, 0) for i in range(0, 128, LANES)])
    excess = terms / terms[0] / 2 ** (units / 128)
    assert excess.max() < 1.0615
    assert excess.mean() == pytest.approx(MEAN_EXCESS, rel=1e-3)
