import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from rig.config.models import EstimateConfig
from rig.depth.reconstruct import MapResult, Reconstructor, map_geometry
from rig.depth.warm_up import warm_up
from rig.errors import UsageError
from rig.geometry.windows import uncalibrated_geometry
from tests.reference.geometry import DEPTH_RANGE_M
from tests.stability.inventory import covers
from tests.unit.small_maps import rig_model, simulated, volume_of

covers(Reconstructor, map_geometry, warm_up)


def reconstructor(sweep, **options) -> Reconstructor:
    g = sweep.point.geometry
    estimate = EstimateConfig(threads=2, **{"estimator": "likelihood", **options})
    model, commands = rig_model(g), np.arange(g.columns)
    return Reconstructor(model, commands, map_geometry(model, commands, DEPTH_RANGE_M), estimate)


@cache
def mapped(light="report", exposures=10, rig="left", **options) -> MapResult:
    sweep = simulated(light, exposures, rig)
    return reconstructor(sweep, **options).map(sweep.volume)


def test_without_a_model_the_sensor_size_is_asked_for():
    with pytest.raises(UsageError, match=re.escape("sensor size (rows, width) must be given")):
        map_geometry(None, np.arange(5), DEPTH_RANGE_M)


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


def test_a_strangers_estimator_that_errs_is_named(monkeypatch):
    sweep = simulated()
    maker = reconstructor(sweep)
    answer = maker.map(sweep.volume).stripe
    monkeypatch.setattr(maker, "_name", "their-own")

    def raising(*_):
        raise IndexError("their mistake")

    for wrong, told in (
        (replace(answer, haze=answer.haze[:5]), "haze as float32 (5, 96), which must be float32 (32, 96)"),
        (
            replace(answer, confidence=answer.confidence * np.float32(np.nan)),
            "a confidence of nan, which must be from 0",
        ),
        (
            replace(answer, x2_px=answer.x_px, confidence2=np.full_like(answer.confidence, 1.5)),
            "a confidence of 1.5, which must be from 0",
        ),
        (replace(answer, x_px=answer.x_px.astype(float)), "x_px as float64 (32, 96)"),
        (replace(answer, signal=None), "signal as NoneType ()"),
    ):
        monkeypatch.setattr(maker.estimator, "estimate", lambda *_, wrong=wrong: wrong)
        with pytest.raises(UsageError, match=re.escape(f"estimator their-own gives {told}")):
            maker.map(sweep.volume)
    monkeypatch.setattr(maker.estimator, "estimate", raising)
    with pytest.raises(IndexError) as raised:
        maker.map(sweep.volume)
    assert raised.value.__notes__ == ["raised by the estimator their-own of another package: tell its authors"]


@pytest.mark.parametrize(("estimator", "trusted"), [("likelihood", 1.0), ("joint", 0.5)])
def test_the_filter_takes_agreement_for_evidence_unless_answers_influence_each_other(estimator, trusted):
    sweep = simulated()
    maker = reconstructor(sweep, estimator=estimator)
    stripe = maker.estimator.estimate(sweep.volume, maker.geometry)
    even = replace(stripe, x_px=maker.geometry.reference_px().astype(np.float32))
    even.confidence[:] = 0.5
    found = maker.complete(even, sweep.volume, "median", 0.0).stripe
    assert np.nanmedian(found.confidence) == pytest.approx(trusted, abs=1e-3)


def test_answers_without_light_stay_doubted_whatever_their_neighbours_are(monkeypatch):
    sweep = simulated()
    maker = reconstructor(sweep)
    stripe = maker.estimator.estimate(sweep.volume, maker.geometry)
    even = replace(stripe, x_px=maker.geometry.reference_px().astype(np.float32))
    even.confidence[:] = 0.9
    lowered = np.where(np.arange(even.confidence.shape[1]) < 30, np.float32(0.4), even.confidence)
    monkeypatch.setattr(maker._checks, "check", lambda *given: (("dim",), replace(even, confidence=lowered)))
    found = maker.complete(even, sweep.volume, "median", 0.0)
    assert found.doubts == ("dim",)
    assert found.stripe.confidence[:, :30].max() <= np.float32(0.4)
    assert np.nanmedian(found.stripe.confidence[:, 40:]) > 0.99


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


def test_floating_points_are_left_out_and_counted_unless_they_are_kept():
    options = {"estimator": "argmax", "exposures": 3, "min_confidence": 0.0}
    plain, kept = mapped(**options), mapped(**options, keep_floating=True)
    out = np.isfinite(kept.depth_m) & np.isnan(plain.depth_m)
    assert plain.floating == out.sum() > 0
    assert kept.floating is None
    np.testing.assert_array_equal(plain.depth_m, np.where(out, np.nan, kept.depth_m))
    for name in ("x_px", "confidence"):
        np.testing.assert_array_equal(getattr(plain.stripe, name), getattr(kept.stripe, name))


def test_without_a_model_there_are_stripes_but_neither_depth_nor_fog():
    sweep, config = simulated(rows=16, columns=64), EstimateConfig(estimator="likelihood")
    geometry = map_geometry(None, np.arange(64), DEPTH_RANGE_M, sensor=(16, 512))
    rebuilt = Reconstructor(None, np.arange(64), geometry, config)
    result = rebuilt.map(volume_of(sweep.counts, rebuilt.geometry, 10))
    assert np.isnan(result.depth_m).all()
    assert result.fog.extinction_per_m is result.fog.extinction_sd_per_m is result.fog.visibility_m is None
    assert np.nanmedian(sweep.errors(result.stripe.x_px)) < 1.0


def test_no_learned_state_makes_another_estimator_of_one_that_learns_nothing():
    config, learned = EstimateConfig(estimator="edge"), [mapped().learned]
    with pytest.raises(KeyError, match="edge"):
        Reconstructor(None, np.arange(64), uncalibrated_geometry(16, 512, 64), config, learned=learned)


def test_the_median_filter_leaves_light_alone_and_brings_positions_nearer():
    plain, filtered = mapped(estimator="edge"), mapped(estimator="edge", filter="median")
    for name in ("signal", "haze"):
        np.testing.assert_array_equal(getattr(filtered.stripe, name), getattr(plain.stripe, name))
    errors = simulated().errors
    assert np.nanmean(errors(filtered.stripe.x_px)) < 0.8 * np.nanmean(errors(plain.stripe.x_px))
