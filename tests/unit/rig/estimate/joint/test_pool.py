"""Pairs of opposite neighbours against loops over them, and what they make of slopes, edges and thin things."""

from itertools import pairwise

import numpy as np
import pytest

from rig.estimate.joint.place.place import PAIRS
from rig.estimate.joint.place.pool import SAME_PX, SIGMAS, join_pairs

DIRECTIONS = ((0, 1), (1, -1), (1, 0), (1, 1))


def joined(distance, sd, step, share=1.0, enough=1e9, parts=None):
    """Distance and standard deviation after one round; parts: rows that are worked on one after the other."""
    inputs = [np.ascontiguousarray(a, np.float32) for a in (distance, sd)]
    out = [np.full(distance.shape, 7, np.float32) for _ in inputs]
    edges = parts or (0, len(distance))
    for first, last in pairwise(edges):
        join_pairs(*inputs, step, share, enough, first, last, *out)
    return out


def joined_one(distance, sd, y, c, step, share, enough):
    """The same of one stripe, the long way."""
    own, variance = distance[y, c], sd[y, c] ** 2
    if variance <= 1 / enough or np.isnan(own):
        return own, sd[y, c]
    pull = weight = 0.0
    for down, right in DIRECTIONS:
        places = [(y - step * down, c - step * right), (y + step * down, c + step * right)]
        if not all(0 <= i < distance.shape[0] and 0 <= j < distance.shape[1] for i, j in places):
            continue
        off = np.mean([distance[p] for p in places]) - own
        sds = [sd[p] for p in places]
        both = sum(s * s for s in sds) / 4
        if max(sds) < 1 and abs(off) <= SAME_PX and off * off < SIGMAS**2 * (both + variance):
            pull, weight = pull + off / both, weight + 1 / both
    return own + pull / (1 / variance + weight), (1 / variance + share * weight) ** -0.5


@pytest.mark.parametrize(("rows", "columns"), [(1, 1), (40, 61)])
@pytest.mark.parametrize(("step", "share"), PAIRS)
def test_stripes_are_joined_by_opposite_neighbours_that_agree(rows, columns, step, share):
    rng = np.random.default_rng(3)
    distance = np.where(rng.random((rows, columns)) < 0.3, 12.7, 12.0) + rng.normal(0, 0.3, (rows, columns))
    distance[rng.random((rows, columns)) < 0.1] = np.nan
    sd = np.minimum(np.exp(rng.normal(np.log(0.3), 0.7, (rows, columns))), 1).astype(np.float32)
    distance, enough = distance.astype(np.float32), 1 / 0.15**2
    found = joined(distance, sd, step, share, enough, (0, rows // 3, rows))
    wanted = [joined_one(distance, sd, y, c, step, share, enough) for y, c in np.ndindex(rows, columns)]
    there = np.isfinite(distance)
    for a, b in zip(found, np.reshape(wanted, (rows, columns, 2)).transpose(2, 0, 1), strict=True):
        np.testing.assert_allclose(a[there], b[there], rtol=2e-5)
    assert np.isnan(found[0][~there]).all()
    if rows > 9:
        moved = np.abs(found[0] - distance)[there]
        assert 0.3 < np.mean(moved > 0.01) < 0.9  # both kinds are there


def test_a_plane_is_found_whatever_its_slope_and_as_well_as_is_said():
    slope = 0.3, -0.5
    y, c = np.mgrid[0:200, 0:300].astype(float)
    plane = 60 + slope[0] * y + slope[1] * c
    noise = np.random.default_rng(4).normal(0, 1.0, (204, 304))
    pooled = np.mean([noise[i : 200 + i, j : 300 + j] for i in range(5) for j in range(5)], axis=0)
    distance, sd = plane + pooled, np.full(plane.shape, 0.2)
    for step, share in PAIRS:
        distance, sd = joined(distance, sd, step, share)
    inner = np.s_[10:-10, 10:-10]
    error, said = (distance - plane)[inner], sd[inner]
    assert np.sqrt(np.mean(error**2)) < 0.2 / 2.5
    assert error.mean() == pytest.approx(pooled[inner].mean(), abs=0.005)
    # Those that chance has put far from all others stay there; half of a normal error is within 0.674.
    assert np.median(np.abs(error / said)) == pytest.approx(0.674, abs=0.15)
