"""Every estimator on hard input: no warning (pytest makes them errors), no NaN but where no answer is promised."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from rig.estimate import registry
from rig.estimate.argmax_edge import peak_rows
from rig.estimate.joint import second_return_blocks, second_returns
from rig.estimate.median import median_filter
from rig.estimate.registry import ESTIMATORS, create_estimator
from rig.geometry.windows import uncalibrated_geometry
from tests.reference.geometry import Geometry
from tests.stability.inventory import covers
from tests.unit.small_maps import RIGS, assert_same, geometry_of, simulated, volume_of

covers(peak_rows, registry, second_returns, second_return_blocks)

ROWS, COLUMNS = 12, 24


def small():
    return simulated(rows=24, columns=48)


@cache
def view(rig="left", rows=ROWS, width=256, columns=COLUMNS):
    return geometry_of(Geometry.build(width=width, height=rows, columns=columns, **RIGS[rig]))


def check(table, volume, geometry):
    """What a stripe table promises for any counts."""
    asked = (geometry.x_lo <= geometry.x_hi) & (volume.n_frames > 0)
    np.testing.assert_array_equal(np.isfinite(table.x_px), asked)
    assert np.all((table.confidence >= 0) & (table.confidence <= 1))
    assert not table.confidence[~asked].any()
    for values in (table.x_sd_px, table.signal, table.haze):
        np.testing.assert_array_equal(np.isfinite(values), asked)
    if table.x2_px is not None:
        found = np.isfinite(table.x2_px)
        assert not found[~asked].any()
        assert np.all((table.confidence2 >= 0) & (table.confidence2 <= found))
    assert np.all(table.x_sd_px[asked] > 0)
    assert np.all(table.signal[asked] >= 0)
    assert np.all(table.haze[asked] >= 0)
    assert np.all(table.x_px[asked] >= geometry.x_lo[asked] - 2)
    assert np.all(table.x_px[asked] <= geometry.x_hi[asked] + 2)
    filtered = median_filter(table, geometry.reference_px()).x_px
    np.testing.assert_array_equal(np.isfinite(filtered), asked)


def run(name, counts, exposures, geometry, maps=1, **volume):
    """Estimate the same counts `maps` times with what was learned before, checking each table."""
    estimator = create_estimator(name)
    made = volume_of(counts, geometry, exposures, **volume)
    for _ in range(maps):
        table = estimator.estimate(made, geometry)
        check(table, made, geometry)
    return table, estimator


def full(level, geometry, dtype=np.uint8):
    return np.full((geometry.columns, geometry.rows, geometry.width), level, dtype)


EVERY = pytest.mark.parametrize("name", ESTIMATORS)


@EVERY
@pytest.mark.parametrize(("k", "level"), [(1, 1), (10, 0), (10, 5), (65_535, 65_535)])
def test_pictures_without_any_contrast(name, k, level):
    geometry = view("turned")
    table, _ = run(name, full(level, geometry, np.uint8 if k < 256 else np.uint16), k, geometry, maps=2)
    assert np.isfinite(table.x_px).sum() > 50


@EVERY
@pytest.mark.parametrize(("k", "dtype", "rate"), [(1, np.uint8, 0.5), (300, np.uint16, 1e-4), (300, np.uint16, 0.9999)])
def test_noise_without_any_stripe(name, k, dtype, rate):
    geometry = view()
    counts = np.random.default_rng(1).binomial(k, rate, full(0, geometry).shape).astype(dtype)
    table, _ = run(name, counts, k, geometry)
    if name == "likelihood":
        assert np.median(table.confidence[np.isfinite(table.x_px)]) < 0.5


@EVERY
@pytest.mark.parametrize("exposures", [300, 65_535])
def test_many_exposures(name, exposures):
    sweep = simulated(rows=16, columns=24)
    rng = np.random.default_rng(1)
    flux = np.stack([sweep.point.flux_of_column(c) for c in range(24)])
    counts = rng.binomial(exposures, -np.expm1(-flux)).astype(np.uint16)
    table, _ = run(name, counts, exposures, sweep.geometry)
    if name in ("likelihood", "joint"):
        errors = sweep.errors(table.x_px)
        assert np.median(errors) < 0.15
        # Counts of 65535 exposures are divided by 1024, which leaves 64 levels.
        assert np.mean(errors <= 1) > 0.97


@EVERY
def test_counts_of_any_type_give_the_same_and_stay_as_they_were(name):
    sweep = small()
    tables = []
    for dtype in (np.uint8, np.uint16):  # most counts are of the first; no plan has exposures for more than the second
        volume = volume_of(sweep.counts.astype(dtype), sweep.geometry, 10)
        before = volume.counts.copy()
        tables.append(create_estimator(name).estimate(volume, sweep.geometry))
        np.testing.assert_array_equal(volume.counts, before)
    assert_same(*tables)


@EVERY
@pytest.mark.parametrize("lost", [slice(1, None, 2), slice(1, None), slice(None)], ids=["odd", "all but one", "all"])
def test_columns_without_frames(name, lost):
    sweep = small()
    frames = np.full(48, 10)
    frames[lost] = 0
    counts = np.where(frames[:, None, None] > 0, sweep.counts, 0).astype(np.uint8)
    run(name, counts, frames, sweep.geometry, maps=2)


@EVERY
def test_rows_without_a_window(name):
    sweep = small()
    geometry = replace(sweep.geometry, x_lo=sweep.geometry.x_lo.copy(), x_hi=sweep.geometry.x_hi.copy())
    geometry.x_lo[[0, 7, 20]], geometry.x_hi[[0, 7, 20]] = 0, -1
    geometry.x_lo[:, 25], geometry.x_hi[:, 25] = 0, -1
    run(name, sweep.counts, 10, geometry)


@EVERY
def test_rays_that_end_within_the_picture(name):
    sweep = small()
    u, v = sweep.geometry.u.copy(), sweep.geometry.v.copy()
    for y in range(len(u)):
        reach = int(6 * y**0.5) + 5
        u[y, :reach] = v[y, :reach] = np.nan
        u[y, -reach:] = v[y, -reach:] = np.nan
    u[3], v[3] = np.nan, np.nan
    g = sweep.geometry
    valid = np.isfinite(u)
    first, last = valid.argmax(axis=1), 511 - valid[:, ::-1].argmax(axis=1)
    x_lo, x_hi = np.maximum(g.x_lo, first[:, None]), np.minimum(g.x_hi, last[:, None])
    x_lo[3], x_hi[3] = 0, -1
    geometry = replace(g, u=u, v=v, x_lo=x_lo.astype(np.int32), x_hi=x_hi.astype(np.int32))
    run(name, sweep.counts, 10, geometry)


@EVERY
@pytest.mark.parametrize(("rig", "length"), [("left", 1), ("right", 2), ("left", 8)])
def test_search_windows_of_a_few_pixels(name, rig, length):
    geometry = view(rig)
    seen = geometry.x_lo <= geometry.x_hi
    x_hi = np.where(seen, np.minimum(geometry.x_lo + length - 1, geometry.x_hi), -1).astype(np.int32)
    counts = np.random.default_rng(2).binomial(10, 0.2, full(0, geometry).shape).astype(np.uint8)
    run(name, counts, 10, replace(geometry, x_hi=x_hi))


@EVERY
@pytest.mark.parametrize(
    ("rows", "width", "columns", "rig"), [(1, 256, 24, "left"), (1, 256, 1, "right"), (50, 70, 24, "right")]
)
def test_odd_sensors_and_sweeps(name, rows, width, columns, rig):
    g = Geometry.build(width=width, height=rows, columns=max(columns, 3), **RIGS[rig])
    g = replace(g, planes=g.planes[len(g.planes) // 2 :][:columns]) if columns == 1 else g
    geometry = geometry_of(g)
    counts = np.random.default_rng(3).binomial(10, 0.1, full(0, geometry).shape).astype(np.uint8)
    run(name, counts, 10, geometry, maps=2)


@EVERY
@pytest.mark.parametrize(("rows", "width"), [(1, 1), (2, 1), (3, 65)])
def test_tiny_sensors_without_a_model(name, rows, width):
    geometry = uncalibrated_geometry(rows, width, 3)
    counts = np.random.default_rng(3).binomial(10, 0.3, full(0, geometry).shape).astype(np.uint8)
    run(name, counts, 10, geometry, maps=2)


@EVERY
def test_dark_frames_that_are_all_ones_or_all_zeros(name):
    sweep = small()
    for level in (0, 50):
        dark = np.full((24, 512), level, np.uint32)
        run(name, sweep.counts, 10, sweep.geometry, dark_counts=dark, n_dark=50)


def test_learning_goes_on_for_many_maps_without_drifting():
    maps = [simulated(exposures=5, seed=seed) for seed in range(4)]
    estimator = create_estimator("likelihood")
    errors = []
    for index in range(24):
        sweep = maps[index % len(maps)]
        errors.append(np.nanmean(sweep.errors(estimator.estimate(sweep.volume, sweep.geometry).x_px)))
    assert np.mean(errors[-4:]) < 1.15 * np.mean(errors[:4])


@EVERY
def test_a_bad_map_does_not_spoil_the_next_ones(name):
    sweep = small()
    estimator = create_estimator(name)
    estimator.estimate(volume_of(np.full_like(sweep.counts, 10), sweep.geometry, 10), sweep.geometry)
    for _ in range(3):
        table = estimator.estimate(sweep.volume, sweep.geometry)
        check(table, sweep.volume, sweep.geometry)
    fresh = create_estimator(name).estimate(sweep.volume, sweep.geometry)
    after, alone = (np.mean(sweep.errors(t.x_px) <= 1) for t in (table, fresh))
    assert after > alone - 0.05
