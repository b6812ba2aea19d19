"""Flash lidar against closed forms: first photons, pile-up, Cramer-Rao bounds, fog."""

import math
from dataclasses import replace

import numpy as np
import pytest

from rig.strategies import lidar
from rig.strategies.apparatus import Budget, PulseTimes
from rig.strategies.lidar import first_photons, within
from rig.strategies.photon_times import Nodes, fog_background, matched_filter, surfaces, without_pile_up
from rig.strategies.strategy import TooShort
from tests.reference.tables.time_and_block_checks import first_on_target, lidar_bound_m
from tests.stability.inventory import covers
from tests.unit.rig.strategies.plane_scene import C, PlaneScene

ALL = (lidar.FIRST_PHOTON, lidar.PEAK, lidar.COATES, lidar.GAMMA)
HISTOGRAMS = ALL[1:]
covers(first_photons, within, surfaces, fog_background, matched_filter, without_pile_up)


def range_error(scene: PlaneScene, strategy: lidar.FlashLidar, pulses: int, seed: int = 0) -> np.ndarray:
    """Errors of the range in metres, of all pixels with an answer."""
    answer = strategy.measure(scene, scene.geometry, Budget(pulses * scene.spad_frame_s), seed)
    error = (answer.depth_m - scene.depth_m) * scene.stretch
    return error[np.isfinite(error)]


@pytest.mark.parametrize(("fog", "surface", "stated"), [(1.0, 0.5, 0.186), (0.2, 0.5, 0.640), (2.0, 0.1, 0.0147)])
def test_the_first_photon_comes_from_the_surface_as_often_as_the_closed_form_says(fog, surface, stated) -> None:
    closed, share, sd = first_on_target(fog, surface)
    assert closed == pytest.approx(stated, rel=3e-3)
    assert share == pytest.approx(closed, abs=4 * sd)


@pytest.mark.parametrize(("photons", "flat"), [(30, 0), (100, 0), (1000, 0), (100, 1000), (300, 10_000)])
def test_the_error_of_a_histogram_is_at_its_bound(photons, flat) -> None:
    pulses = 100_000
    scene = PlaneScene(
        rows_number=20, inverse=0.3137, photons=photons / pulses, flat=flat / pulses, width=100, seed=photons
    )
    seen = scene.pulse_times(1, scene.pulse_sigma_s)
    per_s = flat / (seen.counts.shape[-1] * seen.bin_s)
    # Bins widen the pulse; fewer photons than the mean weigh more than more.
    sigma_s = math.hypot(scene.pulse_sigma_s, seen.bin_s / math.sqrt(12))
    least = lidar_bound_m(sigma_s, photons, per_s) * (1 + 0.5 / photons)
    error = range_error(scene, lidar.PEAK, pulses)
    assert abs(error.mean()) < 0.1 * least
    assert error.std() == pytest.approx(least, rel=0.05)
    if not flat:
        assert least == pytest.approx(sigma_s * C / 2 / math.sqrt(photons), rel=0.02)


def test_the_error_of_a_first_photon_is_that_of_the_pulse() -> None:
    error = range_error(PlaneScene(photons=0.01, seed=2, rows_number=20), lidar.FIRST_PHOTON, 3000)
    assert error.std() == pytest.approx(1e-10 * math.sqrt(1 + 1 / 12) * C / 2, rel=0.05)


def test_pile_up_draws_a_bright_surface_nearer_and_is_corrected() -> None:
    scene = PlaneScene(photons=1.5, seed=3, width=100, rows_number=20)
    assert range_error(replace(scene), lidar.PEAK, 2000).mean() < -0.3 * 1e-10 * C / 2
    assert abs(range_error(replace(scene), lidar.COATES, 2000).mean()) < 0.03 * 1e-10 * C / 2


def test_rates_come_back_from_counts_of_first_photons() -> None:
    rate, pulses = np.array([0.0, 0.3, 0.1, 2.0, 0.0, 0.5]), 10**9
    waiting = pulses * np.exp(-(np.cumsum(rate) - rate))
    counts = np.rint(waiting * -np.expm1(-rate)).astype(np.uint32)
    corrected, share = np.empty(6), np.empty(6)
    without_pile_up(counts, pulses, corrected, share)
    np.testing.assert_allclose(share, waiting / pulses, rtol=1e-6)
    np.testing.assert_allclose(corrected / share / pulses, rate, rtol=1e-5)


def test_only_the_gamma_fit_finds_a_surface_that_is_dimmer_than_the_fog() -> None:
    scene = PlaneScene(rows_number=20, inverse=0.2, photons=0.004, fog=0.4, extinction=0.3, seed=5, width=50)
    right = {each.name: np.mean(np.abs(range_error(replace(scene), each, 5000)) < 0.05) for each in HISTOGRAMS}
    assert right["lidar-gamma"] > 0.95
    assert right["lidar-peak"] < 0.05
    assert right["lidar-coates"] < 0.05


@pytest.mark.parametrize("strategy", ALL, ids=lambda each: each.name)
@pytest.mark.parametrize("light", [{}, {"fog": 0.3, "extinction": 0.2}, {"flat": 0.05}, {"fog": 0.02, "flat": 0.001}])
def test_without_a_surface_next_to_nothing_is_believed(strategy, light) -> None:
    scene = PlaneScene(rows_number=20, inverse=0.105, photons=0.0, seed=6, width=100, **light)
    answer = strategy.measure(scene, scene.geometry, Budget(0.02), 1)
    assert np.mean(answer.confidence >= 0.9) < 0.02


@pytest.mark.parametrize("strategy", ALL, ids=lambda each: each.name)
@pytest.mark.parametrize("light", [
    {"photons": 0.004}, {"photons": 0.002, "flat": 0.05}, {"photons": 0.01, "fog": 0.1, "extinction": 0.2},
])  # fmt: skip
def test_what_is_believed_is_right(strategy, light) -> None:
    scene = PlaneScene(rows_number=20, inverse=0.31, tilt=0.1, seed=8, width=150, **light)
    answer = strategy.measure(scene, scene.geometry, Budget(0.01), 1)
    right = np.abs(answer.depth_m / scene.depth_m - 1) < 0.02
    sure = answer.confidence >= 0.9
    assert np.sum(sure & ~right) <= 0.1 * sure.sum() + 10
    assert np.mean(right) > answer.confidence.mean() - 0.05


def test_counts_of_one_call_are_all_that_is_spent_and_nothing_is_cut_off() -> None:
    for strategy in ALL:
        scene = PlaneScene(rows_number=4, width=40)
        first = strategy.measure(scene, scene.geometry, Budget(0.01), 3)
        assert scene.spent.time_s == pytest.approx(0.01)
        again = replace(scene, spent=type(scene.spent)(0.0, 0.0))
        second = strategy.measure(again, again.geometry, Budget(0.01), 3)
        np.testing.assert_array_equal(first.depth_m, second.depth_m)
        with pytest.raises(TooShort, match="one pulse"):
            strategy.measure(scene, scene.geometry, Budget(0.9e-5), 3)


def test_a_pixel_without_photons_has_no_answer() -> None:
    seen = PulseTimes(np.zeros((1, 3, 200), np.uint32), 1e-9, 1e-10, 50)
    between_s = np.full(3, 2e-9), np.full(3, 15e-9)
    found = surfaces(seen, 1e-10, between_s, fog=True, coates=True)
    assert np.isnan(found.time_s).all()
    assert not np.any([found.sd_s, found.photons, found.confidence])


def test_the_lidar_equation_is_fitted_by_the_gamma_background() -> None:
    time_s = 7e-9 + 1e-10 * np.arange(900)
    light = 5e-15 / time_s**2 * np.exp(-time_s / 2e-8) * 1e-0 + 0.3
    nodes = Nodes.over(time_s)
    n, e = np.array([np.bincount(nodes.of_bin, values, nodes.number) for values in (light, np.ones(900))])
    fitted = fog_background(n[None], e[None], nodes)[0]
    at_bins = fitted[nodes.of_bin] + nodes.share * (fitted[nodes.of_bin + 1] - fitted[nodes.of_bin])
    np.testing.assert_allclose(at_bins, light, rtol=0.05)
