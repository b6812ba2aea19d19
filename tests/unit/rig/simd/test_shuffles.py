"""Reductions of sixteen rows against numpy."""

import numba
import numpy as np
import pytest

from rig.simd.memory import address_of, load_float32, store_float32, store_int16
from rig.simd.shuffles import FOLDED, largest_of_rows, store_folded, totals_of_rows
from rig.simd.vectors import LANES


@numba.njit
def largest(rows, out):
    store_int16(address_of(out), 0, largest_of_rows(address_of(rows)))


@numba.njit
def totals(rows, folded, out):
    for r in range(LANES):
        store_folded(address_of(folded), r, load_float32(address_of(rows), r * LANES))
    store_float32(address_of(out), 0, totals_of_rows(address_of(folded)))


@pytest.mark.parametrize("seed", range(5))
def test_the_largest_of_each_row_comes_out_in_order(seed):
    rows = np.random.default_rng(seed).integers(-32768, 32768, (LANES, LANES)).astype(np.int16)
    rows[3], rows[5, 7] = -32768, 32767
    out = np.empty(LANES, np.int16)
    largest(rows, out)
    np.testing.assert_array_equal(out, rows.max(axis=1))


@pytest.mark.parametrize("seed", range(5))
def test_the_sum_of_each_row_comes_out_in_order(seed):
    rows = np.random.default_rng(seed).normal(0, 10.0 ** (seed - 2), (LANES, LANES)).astype(np.float32)
    folded, out = np.empty((LANES, FOLDED), np.float32), np.empty(LANES, np.float32)
    totals(rows, folded, out)
    np.testing.assert_allclose(out, rows.astype(float).sum(axis=1), rtol=1e-5, atol=1e-5 * np.abs(rows).max())


def test_each_lane_takes_part_once():
    for lane in range(LANES):
        rows = np.zeros((LANES, LANES), np.float32)
        rows[:, lane] = np.arange(1, LANES + 1)
        folded, out = np.empty((LANES, FOLDED), np.float32), np.empty(LANES, np.float32)
        totals(rows, folded, out)
        np.testing.assert_array_equal(out, np.arange(1, LANES + 1))
