"""Pulses against the lidar equation in closed form, and first photons against their distribution."""

import math
from dataclasses import replace

import numpy as np
import pytest

from sim_backend.effects.beam_spread import PLACES, STEP, shapes, totals
from sim_backend.effects.particles import make_particles
from sim_backend.frames.flux import FluxModel
from sim_backend.light.optics import LIGHT_M_PER_S, Sensor
from sim_backend.projector import pulse
from sim_backend.projector.draws import SensorBits
from sim_backend.projector.hardware import PulsedSource
from sim_backend.projector.pulse import (
    Echoes,
    Gate,
    echoes,
    first_photons,
    gate,
    mean_detections,
    solid_angle_sr,
    time_first,
)
from sim_backend.scenes.medium import Rain, Snow
from tests.stability.inventory import covers
from tests.unit.sim_backend.projector import traced_pulses
from tests.unit.sim_backend.rigs import pixel_solid_angle, rig, setting, wall

covers(pulse)

WALL_M, FOG = 4.0, {"medium": {"fog": {"visibility": "12 m"}}}


def mean_of(back: Echoes, opened: Gate, at: tuple[int, int]) -> np.ndarray:
    mean = np.zeros(opened.bins)
    light = (back.surface_per_j, back.late_per_j, back.range_m, back.detour_m, back.steady_per_s)
    times = opened.start_s, opened.bin_s, opened.sigma_s
    mean_detections(times, np.array([part[at] for part in light]), back.fog.of_bins(opened), mean)
    return mean


def made(scene: dict[str, object], bin_s: float = 2e-10, tilt: float = 0.3):
    model = rig(focal_px=110.0)
    normal = (math.sin(tilt), 0.0, math.cos(tilt))
    setup = setting(model, wall(model, normal, WALL_M, 0.4), **scene)
    rows = np.array([5, 32])
    back = echoes(setup, rows, np.zeros((2, 96)), False)
    return model, setup, back, gate(PulsedSource(), (1.0, 8.0), back.stretch, bin_s)


def test_a_wall_sends_back_what_the_lidar_equation_says() -> None:
    model, setup, back, opened = made(FOG)
    u, v = model.camera.tangents()
    sigma = 3.912 / 12
    sr = float(np.sum(pixel_solid_angle(model, u, v)))
    assert solid_angle_sr(setup) == pytest.approx(sr, rel=1e-3)
    for y, row in enumerate((5, 32)):
        for x in (3, 50, 90):
            ray = np.array([u[row, x], v[row, x], 1.0])
            normal = np.array([math.sin(0.3), 0, math.cos(0.3)])
            range_m = WALL_M / (normal @ ray) * np.linalg.norm(ray)
            cosine = normal @ ray / np.linalg.norm(ray)
            light = setup.gain * 0.4 / math.pi * cosine / (sr * range_m**2) * math.exp(-2 * sigma * range_m)
            assert back.range_m[y, x] == pytest.approx(range_m, rel=1e-6)
            assert back.surface_per_j[y, x] == pytest.approx(light, rel=2e-3)
            mean = mean_of(back, opened, (y, x))
            places = opened.start_s + (np.arange(opened.bins) + 0.5) * opened.bin_s
            echo = mean_of(replace(back, fog=replace(back.fog, per_j=0.0)), opened, (y, x))
            assert echo.sum() == pytest.approx(light, rel=2e-3)
            assert echo @ places / echo.sum() == pytest.approx(2 * range_m / LIGHT_M_PER_S, abs=1e-14)
            sd_s = math.hypot(500e-12, 100e-12) / 2.3548
            spread = math.sqrt(echo @ (places - 2 * range_m / LIGHT_M_PER_S) ** 2 / echo.sum())
            assert spread == pytest.approx(math.hypot(sd_s, opened.bin_s / math.sqrt(12)), rel=1e-3)
            assert mean.sum() > echo.sum()


@pytest.mark.parametrize("bin_s", [5e-11, 1e-9, 5e-9])
def test_fog_sends_back_the_lidar_equations_integral_up_to_the_wall(bin_s: float) -> None:
    _, setup, back, opened = made(FOG, bin_s)
    at = (1, 50)
    fog = mean_of(replace(back, surface_per_j=0 * back.surface_per_j), opened, at)
    sigma, first_m = 3.912 / 12, LIGHT_M_PER_S * opened.start_s / 2
    r = np.linspace(first_m, back.range_m[at], 200_001)
    light = setup.gain * sigma * 0.05 / solid_angle_sr(setup) * np.exp(-2 * sigma * r) / r**2
    assert fog.sum() == pytest.approx(np.trapezoid(light, r), rel=5e-3)
    assert not fog[int((2 * back.range_m[at] / LIGHT_M_PER_S + 3e-9 - opened.start_s) / bin_s) + 1 :].any()


def test_the_first_photon_is_on_the_target_as_often_as_the_closed_form_says() -> None:
    # Of mean 1 from the fog before a target of mean 0.5: exp(-1) (1 - exp(-0.5)) / (1 - exp(-1.5)) = 0.186.
    counts, pulses = np.zeros(2, np.uint32), 4_000_000
    time_first(np.random.default_rng(8), pulses, np.array([1.0, 0.5]), counts)
    share, any_of = counts[1] / counts.sum(), counts.sum() / pulses
    assert share == pytest.approx(0.1863, abs=4 * math.sqrt(0.186 / pulses / 0.78))
    assert any_of == pytest.approx(-math.expm1(-1.5), abs=4 * math.sqrt(0.22 / pulses))


def test_first_photons_of_many_pixels_have_the_multinomial_distribution() -> None:
    mean = np.array([0.0, 0.02, 0.3, 1.2, 0.001, 0.4])
    pulses, repeats = 30, 20_000
    rng = np.random.default_rng(2)
    counts = np.zeros((repeats, 6), np.uint32)
    for row in counts:
        time_first(rng, pulses, mean, row)
    before = np.concatenate([[0.0], np.cumsum(mean)[:-1]])
    p = np.exp(-before) * -np.expm1(-mean)
    got = counts.astype(float)
    off = (got.mean(axis=0) - pulses * p)[1:] / np.sqrt(pulses * p * (1 - p) / repeats)[1:]
    assert np.abs(off).max() < 4.5
    assert not counts[:, 0].any()
    both = np.cov(got.T)
    exact = pulses * (np.diag(p) - np.outer(p, p))
    np.testing.assert_allclose(both, exact, atol=6 * pulses * 0.2 / math.sqrt(repeats))
    assert counts.sum(axis=1).max() <= pulses


def test_ambient_light_comes_evenly_and_open_sky_sends_nothing_back() -> None:
    _, setup, back, opened = made({})
    none = np.zeros((2, 96))
    sky = replace(back, range_m=np.full((2, 96), np.inf), surface_per_j=none, late_per_j=none, steady_per_s=none + 3e6)
    bits = SensorBits(FluxModel(setup), np.array([5, 32]), 1e-5)
    counts = first_photons(np.random.default_rng(1), sky, opened, 2000, 1e-6, bits)
    before = np.exp(-3e6 * opened.bin_s * np.arange(opened.bins))
    per_bin = counts.sum(axis=(0, 1)) / (2 * 96 * 2000) / before
    assert per_bin.mean() == pytest.approx(3e6 * opened.bin_s, rel=0.01)
    assert np.abs(per_bin / per_bin.mean() - 1).max() < 0.25


def test_dead_pixels_time_nothing_and_hot_ones_fire_at_once() -> None:
    model = rig()
    sensor = Sensor(dead_share="10 %", hot_share="10 %")
    setup = setting(model, wall(model, (0, 0, 1.0), WALL_M), sensor=sensor)
    rows = np.array([5, 32])
    bits = SensorBits(FluxModel(setup), rows, 1e-5)
    back = echoes(setup, rows, np.zeros((2, 96)), True)
    counts = first_photons(
        np.random.default_rng(1), back, gate(PulsedSource(), (1.0, 8.0), back.stretch, 1e-9), 50, 1e-6, bits
    )
    assert bits.dead is not None
    assert bits.hot is not None
    assert bits.hot.sum() > 5
    assert not counts[bits.dead].any()
    assert (counts[bits.hot, 0] == 50).all()
    assert counts[~(bits.dead | bits.hot)].any()


@pytest.mark.parametrize("what", [Rain(rate="20 mm/h"), Snow(rate="2 mm/h")])
def test_drops_send_back_on_average_what_all_of_them_do(what: Rain | Snow) -> None:
    cone = np.array([[-0.5, 1.0], [-0.5, 1.0]])
    found = make_particles(what, cone, 3.0, np.random.default_rng(4))
    # All but the smallest are kept near the camera.
    volume = (3.0**3 - 0.1**3) / 3
    assert pulse._back_per_m_sr(what) == pytest.approx(found.back_m2_per_sr.sum() / volume, rel=0.05)


def test_the_gate_covers_the_depth_range_in_all_pixels() -> None:
    opened = gate(PulsedSource(), (1.0, 10.0), (1.0, 1.2), 1e-10)
    assert opened.start_s == pytest.approx(2 / LIGHT_M_PER_S - 4 * opened.sigma_s)
    end_s = opened.start_s + opened.bins * opened.bin_s
    assert 24 / LIGHT_M_PER_S + 4 * opened.sigma_s <= end_s < 24 / LIGHT_M_PER_S + 4 * opened.sigma_s + 1e-10
    assert gate(PulsedSource(), (1e-3, 10.0), (1.0, 1.2), 1e-10).start_s == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("depth", "phase", "of_fog"),
    [
        (0.25, None, 0.1), (0.5, None, 0.1), (1.0, None, 0.15), (2.0, None, 0.25), (0.5, {"g": 0.85}, 0.25),
        (1.0, {"g": 0.6}, 0.2), (0.5, "isotropic", 0.1), (1.0, "isotropic", 0.1),
    ],
)  # fmt: skip
def test_light_scattered_more_than_once_is_about_that_of_traced_pulses(
    depth: float, phase: object, of_fog: float
) -> None:
    wall_m, reach, albedo, step_m = 5.0, 0.43, 0.5, 0.05
    model = rig(size=(95, 95), focal_px=47.0 / reach)
    medium = {"extinction": f"{depth / wall_m} /m"} | ({} if phase is None else {"phase": phase})
    setup = setting(model, wall(model, (0.0, 0.0, 1.0), wall_m, albedo), medium=medium)
    back = echoes(setup, np.array([47]), np.zeros((1, 95)), True)
    assert setup.scene.medium is not None
    light, lobes = np.zeros((4, 300)), np.array(setup.scene.medium.lobes)
    rng = np.random.default_rng(3)
    traced_pulses.trace(rng, 600_000, (wall_m, depth / wall_m, albedo, reach), lobes, light, step_m)
    once_fog, once_wall, more_wall, more_fog = light
    factor = 1 + back.late_per_j[0, 47] / back.surface_per_j[0, 47]
    assert factor == pytest.approx(1 + more_wall.sum() / once_wall.sum(), rel=0.12)
    opened = Gate(2 * 2.5 / LIGHT_M_PER_S, 2 / LIGHT_M_PER_S, 1, 1e-12)
    fog = back.fog.of_bins(opened).sum() / replace(back.fog, more=0 * back.fog.more).of_bins(opened).sum()
    there = slice(int(2.5 / step_m), int(3.5 / step_m))
    assert fog == pytest.approx(1 + more_fog[there].sum() / once_fog[there].sum(), rel=of_fog)
    ends_m, within_m = step_m * np.arange(1, 301), np.array([0.1, 0.3])
    late = np.interp(wall_m + within_m, ends_m, np.cumsum(more_wall) / more_wall.sum())
    np.testing.assert_allclose(-np.expm1(-within_m / back.detour_m[0, 47]), late, atol=0.12)


@pytest.mark.parametrize("lobes", [((1.0, 0.0),), ((0.97, 0.9), (0.03, -0.7))])
def test_the_light_of_all_lines_is_the_sum_of_a_lines_band(lobes: tuple[tuple[float, float], ...]) -> None:
    of_surface, _ = totals(lobes, 0.9, STEP * PLACES)
    band, _, _ = shapes(lobes, 0.9, 0.05)
    np.testing.assert_allclose(of_surface, 2 * STEP * band.sum(axis=1), rtol=0.01)
    narrow, narrow_fog = totals(lobes, 0.9, 0.2)
    assert (narrow < of_surface).all()
    assert (np.diff(narrow) > 0).all()
    assert (narrow_fog > 0).all()


def test_a_detour_delays_light_by_its_mean_and_loses_none() -> None:
    opened, times = Gate(2e-8, 1e-10, 2000, 3e-10), (2e-8, 1e-10, 3e-10)
    places_m = 0.5 * LIGHT_M_PER_S * (2e-8 + 1e-10 * (np.arange(2000) + 0.5))
    for detour_m in (0.0, 1e-3, 0.006, 0.05, 0.6):
        mean = np.zeros(opened.bins)
        mean_detections(times, np.array([1e-9, 1.0, 5.0, detour_m, 0.0]), np.zeros((2000, 1)), mean)
        assert mean.sum() == pytest.approx(1, abs=1e-6)
        assert mean @ places_m == pytest.approx(5 + detour_m, abs=1e-4 + 2e-3 * detour_m)
