"""Windows, counts, stripes and depth maps at the ends of their ranges: K = 10^6, ties, dead and empty rows."""

from dataclasses import replace

import mpmath
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibration.errors import CalibrationError
from calibration.model.camera import Camera
from calibration.model.rig_model import RigModel
from calibration.model.scanner import PlaneTable
from rig.count.volume import BIN_DARK, CountVolume, FrameTally, SweepCounter, SweepLayout, SweepTally, with_room
from rig.depth.depth import DepthMap, depth_map
from rig.depth.kernels import depth_rows, fill_rows
from rig.errors import UsageError
from rig.estimate.median import median_filter
from rig.estimate.registry import ESTIMATORS, create_estimator
from rig.estimate.row.ambient import ambient_map, hot_pixels
from rig.geometry.kernels import row_windows
from rig.geometry.stripe_table import MISSING_PX, StripeTable, charged_errors, depth_errors, stripe_errors
from rig.geometry.windows import SweepGeometry, sweep_geometry, uncalibrated_geometry
from rig.threads import RowWorkers
from tests.stability.inventory import EXAMPLES, covers
from tests.unit.small_maps import assert_same, simulated, volume_of

NAN = st.just(np.nan)


@covers(sweep_geometry, SweepGeometry, row_windows)
@EXAMPLES
@given(
    focal=st.sampled_from([1.0, 60.0, 6e4]), k1=st.sampled_from([-2.0, -0.3, 0.0, 0.5]), width=st.integers(1, 130),
    planes=st.lists(st.tuples(st.floats(-1.2, 1.2), *[st.floats(-0.5, 0.5)] * 2), min_size=1, max_size=6),
    offset=st.sampled_from([-1e3, -0.3, 2e-6, 0.3]), near=st.floats(1e-3, 1e3), ratio=st.floats(1.001, 1e6),
)  # fmt: skip
def test_windows_hold_what_lies_in_the_depth_range_and_nothing_else(
    focal, k1, width, planes, offset, near, ratio
) -> None:
    camera = Camera(width, 5, np.array([[focal, 0, width / 2], [0, focal, 2], [0, 0, 1]]), np.array([k1, 0, 0, 0]))
    normal = np.array([[np.cos(a) * np.cos(b), np.sin(b), -np.sin(a) * np.cos(b)] for a, b, _ in planes])
    rows = np.column_stack([normal, offset * (1 + np.array([c for *_, c in planes]))])
    commands = np.arange(len(rows), dtype=float)
    try:
        model = RigModel(camera, PlaneTable(commands, rows))
        geometry = sweep_geometry(model, commands, (near, near * ratio))
    except (CalibrationError, UsageError):
        return
    assert (geometry.rows, geometry.width, geometry.columns) == (5, width, len(rows))
    assert np.isfinite(geometry.reference_px()).all()
    assert 0 <= geometry.px_per_inverse_depth() < np.inf
    assert geometry.window % 64 == 0
    assert np.all((geometry.x0 % 64 == 0) & (geometry.x0 >= 0))
    u, v = geometry.u.astype(float), geometry.v.astype(float)
    w = np.einsum("cd,dyx->cyx", geometry.plane, np.stack([u, v, np.ones_like(u)]))
    x = np.arange(width)
    inside = (x >= geometry.x_lo.T[..., None]) & (x <= geometry.x_hi.T[..., None])
    assert np.isfinite(w[inside]).all()
    # Pixels within the rounding of float32 rays of a limit may go either way.
    slack = 1e-5 * np.abs(geometry.plane).sum(axis=1)[:, None, None] * (1 + np.abs(u) + np.abs(v))
    assert np.all(w[inside] <= (1 / near + slack)[inside])
    assert np.all(w[inside] >= (1 / (near * ratio) - slack)[inside])


@covers(depth_map, DepthMap, depth_rows, fill_rows, StripeTable, median_filter)
@EXAMPLES
@given(
    seed=st.integers(0, 10**6),
    spread=st.sampled_from([0.0, 1e-6, 1.0, 100.0]),
    missing=st.floats(0, 1),
    sd=st.floats(0, 1e3),
)
def test_depth_lies_in_the_depth_range_or_there_is_none(seed, spread, missing, sd) -> None:
    sweep = simulated(rows=4, columns=24)
    geometry, rng = sweep.geometry, np.random.default_rng(seed)
    x = (geometry.reference_px() + rng.normal(0, 1, sweep.point.x_true.shape) * spread).clip(-3, geometry.width + 3)
    x[rng.random(x.shape) < missing] = np.nan
    empty = StripeTable.empty(*x.shape)
    table = replace(
        empty, x_px=x.astype(np.float32), confidence=rng.choice([0, 0.5, 1], x.shape).astype(np.float32),
        x_sd_px=np.full(x.shape, sd, np.float32),
    )  # fmt: skip
    for answer in (table, median_filter(table, geometry.reference_px())):
        np.testing.assert_array_equal(np.isnan(answer.x_px), np.isnan(table.x_px))
        assert np.all((answer.confidence >= 0) & (answer.confidence <= 1 + 1e-6))
        depth, confidence, sd_m = depth_map(answer, geometry, 0.5)
        near, far = geometry.depth_range_m
        seen = np.isfinite(depth)
        assert not np.isinf(depth).any()
        assert np.all((depth[seen] > 0.9 * near) & (depth[seen] < far / 0.89))
        assert np.all(confidence[seen] >= 0.5)
        assert np.all(confidence[~seen] == 0)
        np.testing.assert_array_equal(np.isfinite(sd_m), seen)
        assert np.all(sd_m[seen] >= 0)
        left = DepthMap(depth, confidence, sd_m).without(seen)
        for values, nothing in zip(left, DepthMap.empty(*depth.shape), strict=True):
            np.testing.assert_array_equal(values, nothing)
    assert np.isnan(depth_map(empty, geometry, 0.5).depth_m).all()


@covers(stripe_errors, depth_errors, charged_errors)
@EXAMPLES
@given(
    x=st.lists(st.floats(-(2.0**99), 2.0**99, width=32) | NAN, min_size=4, max_size=4),
    true=st.lists(st.floats(-(2.0**99), 2.0**99, width=32) | NAN, min_size=4, max_size=4),
)
def test_scores_are_numbers_or_none(x, true) -> None:
    a, b = np.array([x], np.float32), np.array([true], np.float32)
    for scores in (stripe_errors(a, b), depth_errors(a, b)):
        assert all(value is None or np.isfinite(value) for value in scores.values())
    charged = charged_errors(a, b)
    np.testing.assert_array_equal(np.isnan(charged), np.isnan(b))
    assert np.all((charged[~np.isnan(b)] >= 0) & (charged[~np.isnan(b)] <= MISSING_PX))
    scores = stripe_errors(a, b)
    if scores["missing"] is not None:
        assert 0 <= scores["within_1px"] <= 1 - scores["missing"] + 1e-12


@covers(SweepCounter, SweepTally, SweepLayout, FrameTally, CountVolume, with_room)
def test_a_million_exposures_are_counted_to_the_last_one(worst) -> None:
    layout = SweepLayout(columns=2, rows=1, width=64, x0=np.zeros(2, np.int32), window=64, exposures=10**6)
    counter = SweepCounter(layout, RowWorkers(1))
    block = 50_000
    bits = np.zeros((block, 1, 8), np.uint8)
    bits[:, 0, 0] = 0x80
    bits[::2, 0, 7] = 0x01
    column = np.full(block, 0.1)
    for _ in range(10**6 // block):
        counter.add(bits, np.zeros(block, np.int32), column, np.zeros(block, np.int32))
    counter.add(bits[:3], np.array([1, BIN_DARK, -2], np.int32), column[:3], np.zeros(3, np.int32))
    volume = counter.finish()
    assert volume.counts[0, 0, 0] == 10**6
    assert volume.counts[0, 0, 63] == 10**6 // 2
    assert volume.counts[0, 0, 1:63].sum() == 0
    assert list(volume.n_frames) == [10**6, 1]
    assert volume.intensity()[0, 0] == 10**6 + 1
    with mpmath.workdps(50):
        exact = mpmath.mpf(0.1)
        worst("mean column of 10^6 frames", "mpmath, 50 digits", float((volume.column[0] - exact) / exact), 1e-10)
    assert volume.bound_column()[1] == pytest.approx(0.1)
    nothing = SweepTally(layout).finish()
    assert np.isnan(nothing.column).all()
    assert list(nothing.bound_column()) == [0, 1]


@covers(ambient_map, hot_pixels, uncalibrated_geometry)
@EXAMPLES
@given(
    k=st.sampled_from([1, 10, 10**6]), level=st.sampled_from([0.0, 1e-6, 0.3, 1.0]),
    n_dark=st.sampled_from([0, 1, 10**6]), dark=st.sampled_from([0.0, 1e-6, 1.0]),
    quiet=st.booleans(), halo=st.sampled_from([0.0, 0.01, 1.0]), seed=st.integers(0, 99),
)  # fmt: skip
def test_ambient_light_is_a_finite_flux_for_any_counts(k, level, n_dark, dark, quiet, halo, seed) -> None:
    rng = np.random.default_rng(seed)
    counts = rng.binomial(k, level, (3, 6, 64)).astype(np.uint32)
    geometry = uncalibrated_geometry(6, 64, 3)
    geometry.defects[2] = True
    volume = CountVolume(
        counts=counts, x0=geometry.x0, n_frames=np.full(3, k, np.int32), column=np.arange(3.0), width=64,
        exposures=k,
        dark_counts=rng.binomial(n_dark, dark, (6, 64)).astype(np.uint32) if n_dark else None, n_dark=n_dark,
    )  # fmt: skip
    # What is expected of a halo is taken off: more than there was, where it was misjudged.
    behind = np.stack([rng.binomial(k, level, (6, 64)) - halo * k, np.full((6, 64), k)]) if quiet else None
    ambient = ambient_map(volume, volume.intensity(), geometry, behind)
    assert np.isfinite(ambient).all()
    assert np.all(ambient >= 0)
    hot = hot_pixels(np.stack([counts.sum(axis=0), np.full((6, 64), 3 * k)]).astype(np.uint32))
    assert np.isfinite(hot).all()
    assert np.all(hot >= 0)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_ties_dead_and_saturated_rows_give_the_same_answer_on_any_number_of_threads(name) -> None:
    sweep = simulated(rows=16, columns=24)
    counts = sweep.counts.copy()
    counts[:, 2] = 0
    counts[:, 5] = sweep.exposures
    counts[:, 8] = 3
    counts[:, 9, ::2] = sweep.exposures
    tables = [
        create_estimator(name, threads=n).estimate(volume_of(counts, sweep.geometry, 10), sweep.geometry)
        for n in (1, 3)
    ]
    assert_same(*tables)
