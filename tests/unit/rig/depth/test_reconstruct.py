import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from rig.config.models import EstimateConfig
from rig.depth.reconstruct import MapResult, Reconstructor
from rig.depth.warm_up import warm_up
from rig.errors import UsageError
from tests.reference.geometry import DEPTH_RANGE_M, Geometry
from tests.reference.scene import Scene
from tests.reference.working_point import Light, WorkingPoint
from tests.stability.inventory import covers
from tests.unit.small_maps import Sweep, geometry_of, rig_model, simulated, volume_of

covers(Reconstructor, warm_up)


def reconstructor(sweep, **options) -> Reconstructor:
    g = sweep.point.geometry
    return Reconstructor(rig_model(g), np.arange(g.columns), DEPTH_RANGE_M, EstimateConfig(threads=2, **options))


@cache
def mapped(light="report", exposures=10, rig="left", **options) -> MapResult:
    sweep = simulated(light, exposures, rig)
    return reconstructor(sweep, **options).map(sweep.volume)


@cache
def bright_wall(between=0.0) -> Sweep:
    """A wall at 3 m in clear air with the light `between` columns later than the nominal planes."""
    rows, columns, pitch = 6, 400, 0.8 / 499
    g = Geometry.build(width=512, height=rows, columns=columns)
    tangents = -0.25 + pitch * (np.arange(columns) + between)
    normals = np.stack([np.ones(columns), np.zeros(columns), -tangents], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    g = replace(g, planes=np.column_stack([normals, normals @ g.scanner_m]))
    shape = (rows, 512)
    scene = Scene("wall", np.full(shape, 3.0, np.float32), np.ones(shape, np.float32), np.ones(shape, bool))
    point = WorkingPoint(scene, Light(stripe=2.0, haze=0.0, ambient=0.0, extinction_per_m=0.0), g)
    return Sweep(point, geometry_of(g), point.counts(100, 1), 100)


def test_without_a_model_the_sensor_size_is_asked_for():
    with pytest.raises(UsageError, match=re.escape("sensor size (rows, width) must be given")):
        Reconstructor(None, np.arange(5), DEPTH_RANGE_M, EstimateConfig())


@pytest.mark.parametrize("estimator", ["argmax", "edge", "likelihood", "joint"])
def test_a_map_has_the_shapes_that_its_files_promise(estimator):
    sweep, result = simulated(), mapped(estimator=estimator)
    rows, columns = 32, 96
    for name in ("x_px", "confidence", "x_sd_px", "signal", "haze"):
        array = getattr(result.stripe, name)
        assert array.dtype == np.float32
        assert array.shape == (rows, columns)
    assert result.depth_m.shape == result.intensity.shape == (rows, 512)
    assert result.depth_m.dtype == np.float32
    assert result.intensity.dtype == np.uint32
    np.testing.assert_array_equal(result.intensity, sweep.volume.intensity())
    assert result.compute_s > 0
    assert (result.fog.extinction_per_m is None) == (estimator in ("argmax", "edge"))


def test_depth_follows_where_the_frames_of_a_column_really_were():
    nominal, shifted = bright_wall(), bright_wall(0.4)
    rebuilt = reconstructor(nominal, estimator="argmax")
    volume = volume_of(shifted.counts, rebuilt.geometry, 100, column=np.arange(400) + 0.4)
    bound = rebuilt.map(volume).depth_m
    blind = rebuilt.map(replace(volume, column=np.arange(400.0))).depth_m
    # 0.4 columns are 0.38 px: 2 cm at 3 m.
    assert abs(np.nanmedian(bound) - 3.0) < 0.004
    assert np.nanmedian(blind) - 3.0 == pytest.approx(0.0195, abs=0.004)


def test_depth_of_a_foggy_street_is_close_to_the_truth():
    result, truth = mapped(), simulated().point.scene.depth_m
    known = np.isfinite(result.depth_m)
    assert known.sum() > 800
    assert np.median(np.abs(result.depth_m / truth - 1)[known]) < 0.01


def test_a_higher_confidence_limit_only_takes_pixels_away():
    loose, strict = mapped(estimator="edge", min_confidence=0.0), mapped(estimator="edge", min_confidence=0.95)
    np.testing.assert_array_equal(loose.stripe.x_px, strict.stripe.x_px)
    few, many = np.isfinite(strict.depth_m), np.isfinite(loose.depth_m)
    assert 0 < few.sum() < many.sum()
    assert not (few & ~many).any()


def test_without_a_model_there_are_stripes_but_neither_depth_nor_fog():
    sweep, config = simulated(rows=16, columns=64), EstimateConfig(estimator="likelihood")
    rebuilt = Reconstructor(None, np.arange(64), DEPTH_RANGE_M, config, sensor=(16, 512))
    result = rebuilt.map(volume_of(sweep.counts, rebuilt.geometry, 10))
    assert np.isnan(result.depth_m).all()
    assert result.fog.extinction_per_m is result.fog.extinction_sd_per_m is result.fog.visibility_m is None
    assert np.nanmedian(sweep.errors(result.stripe.x_px)) < 1.0


def test_the_median_filter_leaves_light_alone_and_brings_positions_nearer():
    plain, filtered = mapped(estimator="edge"), mapped(estimator="edge", filter="median")
    for name in ("signal", "haze"):
        np.testing.assert_array_equal(getattr(filtered.stripe, name), getattr(plain.stripe, name))
    errors = simulated().errors
    assert np.nanmean(errors(filtered.stripe.x_px)) < 0.8 * np.nanmean(errors(plain.stripe.x_px))
