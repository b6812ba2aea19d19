"""Counts in lane order that are halved: rounded alike from either side, with the mean kept."""

import numpy as np
import pytest

from rig.count import lane_order
from rig.count.lane_order import (
    PAD,
    PAIRS,
    halve_counts,
    new_counts,
    read_counts,
)
from tests.stability.inventory import covers

covers(lane_order)


def address(array):
    return array.ctypes.data


def pixels_of(n, lanes):
    """A row of counts in pixel order (8 lanes,)."""
    pairs = n.reshape(PAIRS, lanes + 2 * PAD, 2)
    return pairs[:, PAD : PAD + lanes].transpose(1, 0, 2).ravel()


@pytest.mark.parametrize("times", [1, 2, 3])
def test_halving_rounds_the_same_from_planes_and_from_counts(times):
    most = min(60 << times, 256)
    counts = np.random.default_rng(times).integers(0, most, 128).astype(np.uint32)
    counts[:2] = 0, most - 1
    one, other = new_counts(2, 16)
    read_counts(counts, times, address(one), 16)
    # Rounded up or down by turns, so that few counts keep their mean.
    shares = ((np.arange(128) & 7) << times) >> 3
    np.testing.assert_array_equal(pixels_of(one, 16), (counts + shares) >> times)
    read_counts(counts, 0, address(other), 16)
    halve_counts(address(other), 16, times)
    np.testing.assert_array_equal(other, one)


@pytest.mark.parametrize("times", [4, 5, 10, 14])
def test_few_of_very_many_exposures_keep_their_mean_in_every_pixel(times):
    """Eight shares alone would turn 0.16 ones of a pixel, 327 of 2^11, into 0.125 or none."""
    counts, n, total = np.full(128, 0.16 * 2**times).round().astype(np.uint32), new_counts(1, 16)[0], np.zeros(128)
    for turn in range(2048):
        read_counts(counts, times, address(n), 16, turn)
        total += pixels_of(n, 16)
    np.testing.assert_allclose(total / 2048, counts / 2**times, atol=2.0 ** -min(times, 11))
