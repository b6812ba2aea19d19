"""Labels and pooled places at the ends of their ranges."""

from dataclasses import replace

import mpmath
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.errors import UsageError
from rig.estimate.joint.labels.grid import far_ends, label_grid
from rig.estimate.joint.place import places
from rig.estimate.joint.place.place import amplitudes_of, line_width, new_places, place, profile_table
from rig.estimate.row.inputs import state_of, sweep_of
from rig.estimate.row.model import pixel_shares
from rig.geometry.stripe_table import StripeTable
from rig.threads import RowWorkers
from tests.reference.geometry import Geometry
from tests.stability.inventory import EXAMPLES, covers
from tests.unit.rig.estimate.joint.test_label_volume import known_model
from tests.unit.small_maps import RIGS, geometry_of, volume_of

ROWS, COLUMNS, WIDTH = 6, 10, 256
GEOMETRIES = {rig: geometry_of(Geometry.build(width=WIDTH, height=ROWS, columns=COLUMNS, **RIGS[rig])) for rig in RIGS}
WORKERS = RowWorkers(1)


@covers(pixel_shares, profile_table)
def test_shares_of_a_line_are_those_of_a_gaussian_however_narrow_or_wide(worst) -> None:
    distance = np.array([-60.0, -3.0, -0.5, 0.0, 0.25, 0.5, 1.0, 7.0])
    with mpmath.workdps(50):
        for sigma_px in (1e-3, 0.25, 0.6, 2.4, 100.0):
            exact = [
                float(mpmath.ncdf((mpmath.mpf(d) + 0.5) / sigma_px) - mpmath.ncdf((mpmath.mpf(d) - 0.5) / sigma_px))
                for d in distance
            ]
            worst("share of a line in float32", "mpmath, 50 digits", pixel_shares(sigma_px, distance) - exact, 1e-7)
            table = profile_table(sigma_px)
            assert np.isfinite(table).all()
            assert np.all((table[:, 0] >= 0) & (table[:, 0].sum(axis=1, keepdims=True) <= 1 + 1e-6))


@covers(far_ends)
@EXAMPLES
@given(
    rig=st.sampled_from(list(RIGS)), near=st.floats(1e-3, 1e3), ratio=st.floats(1.001, 1e6),
    k1=st.sampled_from([-0.3, 0.0, 0.5]),
)  # fmt: skip
def test_far_ends_are_numbers_where_anything_is_searched_and_nowhere_else(rig, near, ratio, k1) -> None:
    g = Geometry.build(width=WIDTH, height=ROWS, columns=COLUMNS, **{**RIGS[rig], "k1": k1})
    try:
        geometry = geometry_of(g, (near, near * ratio))
    except UsageError:
        return
    asked = geometry.x_lo <= geometry.x_hi
    found = far_ends(geometry.u, geometry.v, geometry.plane, geometry.x_lo, geometry.x_hi, 1 / (near * ratio))
    np.testing.assert_array_equal(np.isfinite(found), asked)
    grid = label_grid(geometry)
    assert grid.labels % 32 == 0
    assert 0 < grid.stripes <= grid.labels
    nearest = geometry.x_lo if geometry.near_is_left else geometry.x_hi
    assert np.all((grid.side * (grid.x_far - nearest))[asked] * 2 < grid.stripes)


@covers(place, places)
@EXAMPLES
@given(
    rig=st.sampled_from(list(RIGS)), exposures=st.sampled_from([1, 10, 255, 65_535]),
    rate=st.sampled_from([0.0, 1e-4, 0.5, 1.0]), haze=st.sampled_from([1e-9, 0.14, 50.0]),
    ambient=st.sampled_from([1e-6, 0.005, 20.0]), light=st.sampled_from([1e-6, 1.0, 1e6]),
    sigma_px=st.sampled_from([0.25, 0.6, 2.4]), seed=st.integers(0, 99),
)  # fmt: skip
def test_places_of_any_counts_move_a_pixel_at_most(rig, exposures, rate, haze, ambient, light, sigma_px, seed) -> None:
    geometry, rng = GEOMETRIES[rig], np.random.default_rng(seed)
    model = known_model(geometry, haze=haze, ambient=ambient, sigma_px=sigma_px)
    model = replace(model, amplitude=np.float32(light) * model.amplitude)
    sweep, state, grid = sweep_of(geometry), state_of(model), label_grid(geometry)
    frames = np.where(rng.random(COLUMNS) < 0.2, 0, exposures).astype(np.int32)
    counts = rng.binomial(frames[:, None, None], rate, (COLUMNS, ROWS, WIDTH)).astype(np.uint16)
    volume = volume_of(counts, geometry, frames)
    x_px = rng.uniform(geometry.x_lo - 2, np.maximum(geometry.x_hi, geometry.x_lo) + 2).astype(np.float32)
    x_px[(geometry.x_lo > geometry.x_hi) | (frames == 0)] = np.nan
    before, places = x_px.copy(), new_places(ROWS, COLUMNS)
    places.distance[:] = x_px - grid.x_far
    sd = place(volume, sweep, state, profile_table(sigma_px), x_px, places, WORKERS)
    there = np.isfinite(before)
    np.testing.assert_array_equal(np.isfinite(x_px), there)
    assert np.all(np.abs(x_px - before)[there] <= 1 + 1e-4)
    assert np.all((sd[there] > 0) & (sd[there] <= 1))
    for values in (places.light, places.scale, places.amplitude, places.haze, places.known):
        assert np.isfinite(values[there]).all()
    assert np.all(places.haze[there] >= 0)
    amplitude, weight = amplitudes_of(places, there, others=True)
    assert np.all(amplitude > 0)
    assert weight.sum() == pytest.approx(1)
    table = StripeTable.empty(ROWS, COLUMNS)
    table.x_px[:], table.x_sd_px[:], table.confidence[:] = x_px, sd, there
    width = line_width(volume, sweep, state, table, WORKERS)
    assert width is None or 0.2 < width < 2.5
