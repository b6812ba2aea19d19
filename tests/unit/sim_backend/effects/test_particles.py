"""Drops and flakes: how many are in the sheet, what one sends back, and that a time says where they are."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_backend.effects import particles
from sim_backend.effects.particles import (
    MOST,
    ParticleLight,
    Particles,
    find_pixel,
    make_particles,
    rain_drops,
    share,
    snow_flakes,
)
from sim_backend.effects.setting import Setting
from sim_backend.light.optics import Line
from sim_backend.scenes.medium import Rain
from tests.stability.inventory import covers
from tests.unit.sim_backend.rigs import pixel_solid_angle, rig, setting, wall

covers(particles)

CONE = np.array([[-0.5, 1.0], [-0.4, 0.8]])
RAIN = Rain.model_validate({"rate": "20 mm/h", "wind": "1 m/s"})
WEATHER = {"rain": {"rate": "50 mm/h"}, "snow": {"rate": "2 mm/h", "wind": "-1 m/s"}}


def _wet(**scene: object) -> Setting:
    model = rig(k1=-0.1)
    return setting(model, wall(model, (0.0, 0.0, 1.0), 3.0), **(scene or WEATHER))


@pytest.mark.parametrize("time_s", [0.0, 4321.0])
def test_the_sheet_holds_density_times_thickness_times_area(time_s: float) -> None:
    drops = make_particles(RAIN, CONE, 4.0, np.random.default_rng(3))
    point = drops.points(time_s)
    thickness, faintest = 0.08, np.min(drops.diameter_mm / drops.z_m**1.5)
    z = np.linspace(0.61, 4.0, 2001)
    for x in (-0.2, 0.1, 0.3):
        above = np.array([RAIN.sizes.density_per_m3(float(d)) for d in faintest * z**1.5])
        expected = thickness * np.mean(above * CONE[1, 1] * z) * (z[-1] - z[0])
        found = np.sum((np.abs(point[:, 0] - x) < thickness / 2) & (point[:, 2] > z[0]))
        assert expected > 300
        assert found == pytest.approx(expected, abs=4 * np.sqrt(expected))


def test_the_number_of_particles_is_bounded() -> None:
    drops = make_particles(Rain.model_validate({"rate": "200 mm/h"}), CONE, 10.0, np.random.default_rng(1))
    assert 0.8 * MOST < len(drops.z_m) < 1.01 * MOST


def test_drops_fall_with_their_speed_and_drift_with_the_wind() -> None:
    drops = make_particles(RAIN, CONE, 4.0, np.random.default_rng(5))
    way = drops.points(1e-3) - drops.points(0.0)
    inside = np.linalg.norm(way, axis=1) < 0.1  # the others have come in again at the other side
    assert inside.mean() > 0.95
    np.testing.assert_allclose(way[inside, 0], 1e-3, rtol=1e-6)
    np.testing.assert_allclose(way[inside, 1], 1e-3 * RAIN.fall_m_per_s(drops.diameter_mm)[inside], rtol=1e-6)
    assert np.all(way[:, 2] == 0)


def _one(z: float, u: float, v: float, fall_per_s: float = 0.0) -> Particles:
    at = (np.array([[u, v]]) - CONE[:, 0]) / CONE[:, 1]
    per_s = np.array([[0.0, fall_per_s / z / CONE[1, 1]]])
    return Particles(CONE, np.array([z]), np.array([1.0]), np.array([1e-6]), at, per_s)


@pytest.mark.parametrize("fall", [0.0, 9.0])
def test_a_drop_sends_back_what_falls_on_it(fall: float) -> None:
    model = rig(k1=-0.1)
    line = Line(thickness="4 mm", spread="2 mrad")  # type: ignore[arg-type]
    rain = {"rain": {"rate": "20 mm/h"}, "medium": {"extinction": "0.2 /m"}}
    setup = setting(model, wall(model, (0.0, 0.0, 1.0), 3.0), line=line, **rain)
    effect, plane = rain_drops(setup), model.planes(0.4)
    z, v, aside_m = 1.0, 0.03, 5e-4
    u = (plane[3] + aside_m - plane[1] * v * z - plane[2] * z) / (plane[0] * z)
    effect.particles = _one(z, u, v, fall)
    rate = np.zeros((64, 96))
    effect.add(setup.view.sheet(plane), 0, 64, rate)
    point = np.array([u, v, 1.0]) * z
    assert model.source_m is not None
    r, camera_m = np.linalg.norm(point - model.source_m), np.linalg.norm(point)
    sigma_m = np.hypot(4e-3, 2e-3 * r) / 4
    across = np.exp(-0.5 * (aside_m / sigma_m) ** 2) / (sigma_m * np.sqrt(2 * np.pi))
    irradiance = across / r / line.fan * np.exp(-setup.scene.extinction_per_m * (r + camera_m))
    solid = pixel_solid_angle(model, np.array(u), np.array(v))
    assert rate.sum() == pytest.approx(setup.gain * irradiance * 1e-6 / camera_m**2 / solid, rel=0.01)
    x, y = model.camera.project(point)
    rows = np.arange(64) @ rate.sum(axis=1) / rate.sum()
    assert np.arange(96) @ rate.sum(axis=0) / rate.sum() == pytest.approx(float(x), abs=0.02)
    assert rows == pytest.approx(float(y) + 0.5 * fall * 2e-4 * 110, abs=0.02)


def test_a_streak_is_a_box_blurred() -> None:
    pixels = np.arange(-30, 60)
    for length in (0.01, 0.06, 12.0):
        shares = np.array([share(int(i), 0.3, length, 0.7) for i in pixels])
        assert shares.sum() == pytest.approx(1, abs=1e-6)
        mean = shares @ pixels
        assert mean == pytest.approx(0.3 + length / 2, abs=1e-3)
        assert shares @ (pixels - mean) ** 2 == pytest.approx(0.49 + 1 / 12 + length**2 / 12, rel=5e-3)


@pytest.mark.parametrize(("z", "wall_m", "seen"), [(1.2, 1.5, True), (2.0, 3.0, True), (2.0, 1.5, False)])
def test_drops_behind_a_surface_are_not_lit(z: float, wall_m: float, seen: bool) -> None:
    model = rig()
    setup, plane = setting(model, wall(model, (0.0, 0.0, 1.0), wall_m), rain={"rate": "20 mm/h"}), model.planes(0.2)
    effect, rate = rain_drops(setup), np.zeros((64, 96))
    effect.particles = _one(z, (plane[3] - plane[2] * z) / (plane[0] * z), 0.0)
    effect.add(setup.view.sheet(plane), 0, 64, rate)
    assert (rate.sum() > 0) == seen


@pytest.mark.parametrize("effect", [rain_drops, snow_flakes])
def test_a_time_says_where_they_are_whatever_the_rows(effect: Callable[[Setting], ParticleLight]) -> None:
    setup = _wet()
    plane = rig().planes(0.3)

    def light(time_s: float, cuts: tuple[int, ...] = (0, 64)) -> NDArray[np.float64]:
        made, rate = effect(setup), np.zeros((64, 96))
        for first, last in pairwise(cuts):
            made.add(setup.view.sheet(plane, time_s), first, last, rate)
        return rate

    whole = light(7.0)
    assert whole.sum() > 0
    assert np.array_equal(whole, light(7.0, (0, 1, 13, 40, 64)))
    assert np.array_equal(whole, light(7.00019))  # stands still for 0.2 ms
    assert not np.array_equal(whole, light(7.05))  # and has fallen on by the next sweep
    setup = _wet(seed=2, **WEATHER)
    assert not np.array_equal(whole, light(7.0))


def test_nothing_falls_in_front_of_a_camera_without_picture() -> None:
    model = rig()
    setup = setting(model, wall(model, (0.0, 0.0, 1.0), np.inf), rain={"rate": "20 mm/h"})
    rate = np.zeros((64, 96))
    effect = rain_drops(setup)
    effect.add(setup.view.sheet(model.planes(0.3)), 0, 64, rate)
    assert rate.sum() > 0  # lit in front of open sky
    effect.add(setup.view.sheet(np.array([1.0, 0.0, 0.0, 0.0])), 0, 64, np.zeros((64, 96)))  # edge-on: no error


def test_a_pixel_is_found_through_a_distorting_lens() -> None:
    model = rig(k1=-0.2)
    x, y = np.array([3.2, 47.0, 94.6]), np.array([60.4, 31.0, 0.2])
    for *at, pixel_x, pixel_y in zip(*model.camera.tangents_at(x, y), x, y, strict=True):
        assert find_pixel(*model.camera.tangents(), *at)[:2] == pytest.approx((pixel_x, pixel_y), abs=1e-2)
