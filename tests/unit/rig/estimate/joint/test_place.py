"""Places of stripes pooled over a wall whose counts are drawn from the very model they are placed with."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from rig.estimate.joint.labels.grid import label_grid
from rig.estimate.joint.place import light, pool
from rig.estimate.joint.place import place as place_module
from rig.estimate.joint.place.place import amplitudes_of, line_width, new_places, place, profile_table
from rig.estimate.joint.place.places import BESIDE_PX, REACH_PX
from rig.estimate.row.inputs import row_buffers, row_fluxes, state_of, sweep_of
from rig.estimate.row.model import pixel_shares
from rig.geometry.stripe_table import StripeTable
from rig.threads import RowWorkers
from tests.reference.geometry import Geometry
from tests.stability.inventory import covers
from tests.unit.rig.estimate.joint.test_label_volume import known_model
from tests.unit.small_maps import RIGS, geometry_of, volume_of

covers(light, pool, place_module)

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
