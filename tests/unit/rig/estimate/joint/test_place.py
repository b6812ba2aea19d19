"""Places of stripes pooled over a wall whose counts are drawn from the very model they are placed with."""

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numba
import numpy as np
import pytest

from rig.estimate.joint.labels.grid import label_grid
from rig.estimate.joint.place import light, pool
from rig.estimate.joint.place import place as place_module
from rig.estimate.joint.place.light import LEAST_FLUX, _dark_over_lit
from rig.estimate.joint.place.place import BEYOND, PAIRS, amplitudes_of, line_width, new_places, place, profile_table
from rig.estimate.joint.place.places import BESIDE_PX, MOST_FLUX, REACH_PX
from rig.estimate.joint.place.pool import (
    SIGMAS,
    join_pairs,
    pool_places,
    pool_row,
    widen_row,
)
from rig.estimate.row.inputs import row_buffers, row_fluxes, state_of, sweep_of
from rig.estimate.row.model import pixel_shares
from rig.estimate.row.neighbours import MARGIN, SAME_PX, with_margin
from rig.geometry.stripe_table import StripeTable
from rig.simd.memory import address_of, load_float32, store_float32
from rig.simd.vectors import LANES
from rig.threads import RowWorkers
from tests.reference.geometry import Geometry
from tests.stability.inventory import covers
from tests.unit.rig.estimate.joint.test_label_volume import known_model
from tests.unit.small_maps import RIGS, geometry_of, volume_of

covers(light, pool, place_module, with_margin)

WORKERS = RowWorkers(1)
ROWS, COLUMNS = 24, 48
NEARER_PX = 20.2
"""The wall's distance from the far end."""
LIGHT = 3.0
"""Amplitude of its stripe: a third of a photon per exposure."""


@cache
def wall(rig="left", exposures=10, sigma_px=0.6, light=LIGHT, haze=0.14, slope=0.0):
    """Counts of a wall, its geometry, and x_px (rows, columns) of its stripe, NaN where it is not searched; tests must
    not write into them.

    slope: px by which it comes nearer from row to row and from column to column.
    """
    geometry = geometry_of(Geometry.build(width=384, height=ROWS, columns=COLUMNS, **RIGS[rig]))
    model, grid = known_model(geometry, haze=haze, sigma_px=sigma_px), label_grid(geometry)
    sweep, state, row = sweep_of(geometry), state_of(model), row_buffers(geometry.window, 1)
    y, c = np.mgrid[:ROWS, :COLUMNS]
    x_px = grid.x_far - grid.side * (NEARER_PX + slope * (y - ROWS / 2 + c - COLUMNS / 2))
    rng = np.random.default_rng(1)
    counts = np.zeros((COLUMNS, ROWS, geometry.width), np.uint16)
    for y, c in np.ndindex(ROWS, COLUMNS):
        length, first, last, start = row_fluxes(sweep, state, row, y, c)
        at, t = grid.side * (x_px[y, c] - start), np.arange(length)
        if length == 0 or not first + REACH_PX <= at <= last - REACH_PX:
            x_px[y, c] = np.nan
            continue
        before, behind, scale = (a[:length].astype(float) for a in (row.before, row.behind, row.scale))
        lit = np.clip(at - t + 0.5, 0.0, 1.0)
        flux = lit * before + (1 - lit) * behind + light * scale[round(at)] * pixel_shares(sigma_px, t - at)
        counts[c, y, start + grid.side * t] = rng.binomial(exposures, -np.expm1(-flux))
    assert np.isfinite(x_px).mean() > 0.3
    return volume_of(counts, geometry, exposures), geometry, x_px


def placed(volume, geometry, x_px, model, off_px=0.1, *, lesson=False):
    """x_px and its standard deviation after placing, from places so far off."""
    grid, places = label_grid(geometry), new_places(ROWS, COLUMNS)
    places.distance[:] = x_px - grid.x_far + np.random.default_rng(2).normal(0, off_px, x_px.shape)
    x = (grid.x_far + places.distance).astype(np.float32)
    shares = profile_table(model.line_sigma_px)
    sd = place(volume, sweep_of(geometry), state_of(model), shares, x, places, WORKERS, lesson=lesson)
    return x, sd, places


@pytest.mark.parametrize(
    ("rig", "exposures", "off_px"), [("left", 3, 0.15), ("right", 10, 0.15), ("turned", 10, 0.15), ("left", 300, 0.05)]
)
def test_places_of_a_wall_are_unbiased_and_as_good_as_they_say(rig, exposures, off_px):
    volume, geometry, x_px = wall(rig, exposures)
    found, sd, places = placed(volume, geometry, x_px, known_model(geometry), off_px)
    there = np.isfinite(x_px)
    np.testing.assert_array_equal(np.isfinite(found), there)
    error, sd = (found - x_px)[there], sd[there]
    # Neighbours share their photons: of 7 x 7 stripes one is independent.
    assert abs(error.mean()) < 4 * sd.mean() * np.sqrt(49 / len(error)) + 0.01
    assert 0.6 < np.sqrt(np.mean((error / sd) ** 2)) < 1.6
    # With many exposures few neighbours know enough.
    assert sd.mean() < (0.4 if exposures < 100 else 0.6) / np.sqrt(exposures)
    assert np.median(places.amplitude[there]) == pytest.approx(LIGHT, rel=0.15)


@pytest.mark.parametrize("slope", [0.0, -0.3])
def test_neighbours_far_off_place_a_wall_of_few_photons_whatever_its_slope(slope):
    volume, geometry, x_px = wall(exposures=1, slope=slope)
    found, sd, _ = placed(volume, geometry, x_px, known_model(geometry))
    there = np.isfinite(x_px)
    error = (found - x_px)[there]
    # 5 x 5 stripes alone: 0.33 px.
    assert np.sqrt(np.mean(error**2)) < 0.26
    assert 0.6 < np.sqrt(np.mean((error / sd[there]) ** 2)) < 1.6


def test_a_map_without_stripes_or_frames_stays_one():
    volume, geometry, x_px = wall()
    nothing = replace(volume, n_frames=np.zeros_like(volume.n_frames))
    for seen, where in ((volume, np.full_like(x_px, np.nan)), (nothing, x_px)):
        found, sd, places = placed(seen, geometry, where, known_model(geometry))
        np.testing.assert_array_equal(np.isfinite(found), np.isfinite(where))
        assert not places.light.any()
        assert (sd == 1).all()


@pytest.mark.parametrize(("sigma_px", "exposures"), [(0.4, 20), (1.0, 3)])
def test_the_width_of_the_line_is_found_whatever_was_thought_before(sigma_px, exposures):
    volume, geometry, x_px = wall("left", exposures, sigma_px, 8.0, 0.01)
    nearly = known_model(geometry, haze=0.01, sigma_px=0.7)
    found = line_width(volume, sweep_of(geometry), state_of(nearly), stripes_at(x_px), WORKERS)
    assert found == pytest.approx(sigma_px, rel=0.12)


def test_stripes_at_the_end_of_a_row_do_not_tell_the_width():
    volume, geometry, x_px = wall("left", 20, 0.6, 8.0, 0.01)
    state = state_of(known_model(geometry, haze=0.01, sigma_px=0.7))
    cut = int(np.nanquantile(x_px, 0.7))
    u = geometry.u.copy()
    u[:, cut:] = np.nan
    cut_off = replace(geometry, u=u, v=np.where(np.isnan(u), u, geometry.v))
    inside = np.where(np.rint(x_px) + BESIDE_PX[1] < cut, x_px, np.nan)
    found = line_width(volume, sweep_of(cut_off), state, stripes_at(x_px), WORKERS)
    assert found == line_width(volume, sweep_of(geometry), state, stripes_at(inside), WORKERS)
    outside = inside.copy()
    for at, x in zip(np.argwhere(np.isnan(inside)), (-3.0, 1.0, geometry.width + 2.0, 1e6), strict=False):
        outside[tuple(at)] = x
    assert found == line_width(volume, sweep_of(geometry), state, stripes_at(outside), WORKERS)


def test_too_little_light_tells_no_width():
    volume, geometry, x_px = wall(light=0.0)
    seen = sweep_of(geometry), state_of(known_model(geometry))
    assert line_width(volume, *seen, stripes_at(x_px), WORKERS) is None
    in_halo = seen[1]._replace(glow=np.full_like(seen[1].glow, 0.01))
    one, _, there = wall("left", 1, 0.6, 8.0, 0.01)
    assert line_width(one, seen[0], in_halo, stripes_at(there), WORKERS) is None, "one exposure tells none in a halo"
    assert line_width(wall()[0], *seen, StripeTable.empty(ROWS, COLUMNS), WORKERS) is None


def stripes_at(x_px) -> StripeTable:
    there = np.isfinite(x_px)
    table = StripeTable.empty(*x_px.shape)
    table.x_px[:], table.x_sd_px[:], table.confidence[:] = x_px, np.where(there, 0.01, np.nan), there
    return table


@pytest.mark.parametrize("others", [False, True])
def test_amplitudes_stand_for_those_of_the_stripes(others):
    places = new_places(40, 50)
    everywhere = np.ones((40, 50), bool)
    assert amplitudes_of(places, everywhere, others=others)[0].tolist() == [1, 1, 1, 1]  # no stripe at all
    values = np.geomspace(0.1, 10, 1000).astype(np.float32)
    places.amplitude[:20], places.scale[:20] = values.reshape(20, 50), 1
    places.amplitude[20:] = 1e6  # nothing is seen there
    amplitude, weight = amplitudes_of(places, everywhere, others=others)
    assert weight.sum() == pytest.approx(1)
    assert np.all(np.diff(amplitude) > 0)
    below = np.cumsum(weight) - 0.5 * weight
    np.testing.assert_allclose(np.log10(amplitude), -1 + 2 * below, atol=0.01)


def test_places_without_a_stripe_make_amplitudes_darker_within_limits_only():
    places = new_places(40, 50)
    places.amplitude[:10], places.scale[:10] = np.geomspace(0.1, 10, 500).astype(np.float32).reshape(10, 50), 1
    places.amplitude[10:], places.scale[10:] = 1e-4, 1
    trusted = np.zeros((40, 50), bool)
    trusted[:10] = True
    certain = amplitudes_of(places, trusted, others=False)[0]
    assert certain[0] > 0.1
    np.testing.assert_allclose(amplitudes_of(places, trusted, others=True)[0], certain / BEYOND, rtol=1e-5)
    # Where most answers are trusted, the others are dark stripes.
    places.scale[18:] = 0
    assert amplitudes_of(places, trusted, others=True)[0][0] < certain[0] / BEYOND
    # Where nobody trusts an answer, all of them say nothing.
    assert amplitudes_of(places, np.zeros((40, 50), bool), others=True)[0].tolist() == [1, 1, 1, 1]


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
