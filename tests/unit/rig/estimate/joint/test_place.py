"""Places of stripes pooled over a wall whose counts are drawn from the very model they are placed with."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from rig.estimate.joint.labels.grid import label_grid
from rig.estimate.joint.place import light, pool, score
from rig.estimate.joint.place import place as place_module
from rig.estimate.joint.place.place import (
    ENOUGH,
    LESSON_REACHES,
    amplitudes_of,
    line_width,
    new_places,
    place,
    profile_table,
)
from rig.estimate.joint.place.places import BESIDE_PX, REACH_PX, TAPS
from rig.estimate.joint.place.pool import pool_places
from rig.estimate.row.inputs import row_buffers, row_fluxes, state_of, sweep_of
from rig.estimate.row.model import pixel_shares
from rig.geometry.stripe_table import StripeTable
from rig.threads import RowWorkers
from tests.reference.geometry import Geometry
from tests.stability.inventory import covers
from tests.unit.rig.estimate.joint.test_label_volume import known_model
from tests.unit.small_maps import RIGS, geometry_of, volume_of

covers(light, score, pool, place_module)

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


@pytest.mark.parametrize("sigma_px", [0.4, 0.6, 0.8])
def test_shares_of_a_line_sum_to_one_and_lie_where_it_does(sigma_px):
    share, slope = profile_table(sigma_px)[:, :, :TAPS].astype(float).transpose(1, 0, 2)
    np.testing.assert_allclose(share.sum(axis=1), 1, atol=1e-3)
    np.testing.assert_allclose(slope.sum(axis=1), 0, atol=5e-3)
    centre = (share * np.arange(-REACH_PX, REACH_PX + 1)).sum(axis=1)
    np.testing.assert_allclose(centre, (np.arange(len(share)) + 0.5) / len(share) - 0.5, atol=0.02)
    half = len(share) // 2
    between = np.diff(share[half - 1 : half + 1], axis=0)[0] * len(share)
    np.testing.assert_allclose(slope[half - 1 : half + 1].mean(axis=0), between, atol=5e-3)


@pytest.mark.parametrize("rig", RIGS)
@pytest.mark.parametrize(("exposures", "off_px"), [(3, 0.15), (10, 0.15), (300, 0.05)])
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


@pytest.mark.parametrize("slope", [0.0, 0.15, -0.3])
def test_neighbours_far_off_place_a_wall_of_few_photons_whatever_its_slope(slope):
    volume, geometry, x_px = wall(exposures=1, slope=slope)
    found, sd, _ = placed(volume, geometry, x_px, known_model(geometry))
    there = np.isfinite(x_px)
    error = (found - x_px)[there]
    # 5 x 5 stripes alone: 0.33 px.
    assert np.sqrt(np.mean(error**2)) < 0.26
    assert 0.6 < np.sqrt(np.mean((error / sd[there]) ** 2)) < 1.6


def test_lessons_go_by_places_that_no_pairs_join():
    volume, geometry, x_px = wall(exposures=1)
    found, sd, places = placed(volume, geometry, x_px, known_model(geometry), lesson=True)
    moved, alone = np.empty_like(found), np.empty_like(sd)
    pool_places(places, LESSON_REACHES, ENOUGH, 0, ROWS, moved, alone)
    there = np.isfinite(x_px)
    np.testing.assert_array_equal(sd[there], alone[there])
    np.testing.assert_allclose(places.placed[there], (places.distance + moved)[there], rtol=1e-6)
    joined = placed(volume, geometry, x_px, known_model(geometry))[1]
    assert joined[there].mean() < 0.9 * sd[there].mean()


def test_a_map_without_stripes_or_frames_stays_one():
    volume, geometry, x_px = wall()
    nothing = replace(volume, n_frames=np.zeros_like(volume.n_frames))
    for seen, where in ((volume, np.full_like(x_px, np.nan)), (nothing, x_px)):
        found, sd, places = placed(seen, geometry, where, known_model(geometry))
        np.testing.assert_array_equal(np.isfinite(found), np.isfinite(where))
        assert not places.light.any()
        assert (sd == 1).all()


@pytest.mark.parametrize("sigma_px", [0.4, 0.6, 1.0])
@pytest.mark.parametrize("exposures", [3, 20])
def test_the_width_of_the_line_is_found_whatever_was_thought_before(sigma_px, exposures):
    volume, geometry, x_px = wall("left", exposures, sigma_px, 8.0, 0.01)
    nearly = known_model(geometry, haze=0.01, sigma_px=0.7)
    found = line_width(volume, sweep_of(geometry), state_of(nearly), stripes_at(x_px), WORKERS)
    assert found == pytest.approx(sigma_px, rel=0.12)


def test_stripes_that_fill_their_pixels_do_not_tell_the_width_in_a_halo():
    volume, geometry, x_px = wall("left", 5, 0.6, 8.0, 0.01)
    bright = np.arange(ROWS) % 2 == 0
    counts = volume.counts.copy()
    counts[:, bright] = wall("left", 5, 0.6, 100.0, 0.01)[0].counts[:, bright]
    volume = replace(volume, counts=counts)
    state = state_of(known_model(geometry, haze=0.01, sigma_px=0.6))
    seen = volume, sweep_of(geometry), state._replace(glow=np.full_like(state.glow, 0.01))
    stripes = stripes_at(x_px)
    taken_for_wide = line_width(*seen, stripes, WORKERS)
    stripes.signal[bright] = 10.0
    found = line_width(*seen, stripes, WORKERS)
    assert taken_for_wide > 0.7
    assert found == pytest.approx(0.6, rel=0.12)
    stripes.confidence[bright] = 0.0
    assert found == line_width(*seen, stripes, WORKERS)


def test_one_exposure_does_not_tell_the_width_in_a_halo():
    volume, geometry, x_px = wall("left", 1, 0.6, 8.0, 0.01)
    state = state_of(known_model(geometry, haze=0.01, sigma_px=0.6))
    seen, stripes = (volume, sweep_of(geometry)), stripes_at(x_px)
    assert line_width(*seen, state, stripes, WORKERS) is not None
    assert line_width(*seen, state._replace(glow=np.full_like(state.glow, 0.01)), stripes, WORKERS) is None


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
    assert line_width(wall()[0], *seen, StripeTable.empty(ROWS, COLUMNS), WORKERS) is None


def stripes_at(x_px) -> StripeTable:
    there = np.isfinite(x_px)
    table = StripeTable.empty(*x_px.shape)
    table.x_px[:], table.x_sd_px[:], table.confidence[:] = x_px, np.where(there, 0.01, np.nan), there
    return table


def test_amplitudes_stand_for_those_of_the_stripes():
    places = new_places(40, 50)
    assert len(amplitudes_of(places)[0]) == 4
    values = np.geomspace(0.1, 10, 1000).astype(np.float32)
    places.amplitude[:20], places.scale[:20] = values.reshape(20, 50), 1
    places.amplitude[20:] = 1e6  # nothing is seen there
    amplitude, weight = amplitudes_of(places)
    assert weight.sum() == pytest.approx(1)
    assert np.all(np.diff(amplitude) > 0)
    below = np.cumsum(weight) - 0.5 * weight
    np.testing.assert_allclose(np.log10(amplitude), -1 + 2 * below, atol=0.01)
