"""The stripe traced forward from the mirror, its profile, and its blurred copy; closed forms are in test_energy.py."""

import numpy as np
import pytest

from sim_backend.effects import stripe
from sim_backend.scenes.medium import FORWARD_ANGLE
from tests.stability.inventory import covers
from tests.unit.sim_backend.rigs import effect_rate, pixel_solid_angle, rig, setting, wall

covers(stripe)

EXTINCTION = 0.1
FOG = {"medium": {"extinction": f"{EXTINCTION} /m"}}


@pytest.mark.parametrize(
    ("baseline_m", "roll", "k1"), [(0.3, 0.0, 0.0), (-0.3, 0.0, -0.2), (0.3, 0.12, -0.2), (-0.3, -0.2, 0.1)]
)
def test_rows_hold_the_light_that_rays_from_the_mirror_bring(baseline_m: float, roll: float, k1: float) -> None:
    model = rig(baseline_m=baseline_m, roll=roll, k1=k1)
    normal, distance = np.array([0.2, -0.3, 1.0]), 2.5
    setup = setting(model, wall(model, tuple(normal), distance), **FOG)
    plane = model.planes(0.1 if baseline_m > 0 else -0.1)
    rate = effect_rate(setup, "stripe", plane)

    # Forward: rays of equal power within the sheet, scattered by a Lambertian wall into the camera.
    along = np.cross(plane[:3], [0.0, 1.0, 0.0])
    along = along / np.linalg.norm(along) * np.sign(along[2])
    across = np.cross(plane[:3], along)
    angle = np.linspace(-0.5, 0.5, 400_001)
    step = angle[1] - angle[0]
    ray = np.cos(angle)[:, None] * along + np.sin(angle)[:, None] * across
    assert model.source_m is not None
    r = (distance - normal @ model.source_m) / (ray @ normal)
    point = model.source_m + r[:, None] * ray
    camera_m = np.linalg.norm(point, axis=1)
    cosine = np.abs(point @ normal) / camera_m / np.linalg.norm(normal)
    irradiance = 0.5 / np.pi * cosine * step / setup.line.fan / camera_m**2 * np.exp(-EXTINCTION * (r + camera_m))
    x, y = model.camera.project(point)
    radiance = irradiance / pixel_solid_angle(model, point[:, 0] / point[:, 2], point[:, 1] / point[:, 2])
    inside = np.isfinite(x) & (x > 5) & (x < 90) & (y > -0.5) & (y < 63.5)
    traced = np.bincount(np.rint(y[inside]).astype(int), weights=radiance[inside], minlength=64)
    counts = np.bincount(np.rint(y[inside]).astype(int), minlength=64)
    whole = slice(2, 62)
    assert counts[whole].min() > 500
    np.testing.assert_allclose(rate.sum(axis=1)[whole], setup.gain * traced[whole], rtol=4e-3)


def test_the_profile_is_a_gaussian_integrated_over_pixels() -> None:
    model = rig()
    setup = setting(model, wall(model, (0.0, 0.0, 1.0), 2.0))
    plane = model.planes(0.1)
    rate, centre = effect_rate(setup, "stripe", plane), setup.view.sheet(plane).x_stripe_px
    x = np.arange(96)
    for row in (0, 20, 63):
        weight = rate[row] / rate[row].sum()
        assert weight @ x == pytest.approx(centre[row], abs=1e-3)
        assert weight @ (x - centre[row]) ** 2 == pytest.approx(0.6**2 + 1 / 12, abs=2e-3)


def test_blurred_and_ballistic_light_are_what_is_not_turned_much() -> None:
    medium = {"extinction": "0.3 /m", "scattering_share": 0.9, "forward_share": 0.5}
    model = rig(size=(8, 300), focal_px=220.0)
    setup = setting(model, wall(model, (0.0, 0.0, 1.0), 2.5), medium=medium)
    clear = setting(model, wall(model, (0.0, 0.0, 1.0), 2.5))
    plane = model.planes(0.05)
    sharp, blurred = effect_rate(setup, "stripe", plane), effect_rate(setup, "forward blur", plane)
    whole = effect_rate(clear, "stripe", plane)
    centre = setup.view.sheet(plane).x_stripe_px[3]
    point = np.array([2.5 * (centre - 149.5) / 220, -2.5 * 0.5 / 220, 2.5])
    assert model.source_m is not None
    way_m = np.linalg.norm(point) + np.linalg.norm(point - model.source_m)
    lost = np.exp(-(0.3 - 0.3 * 0.9 * 0.5) * way_m)
    assert sharp[3].sum() + blurred[3].sum() == pytest.approx(lost * whole[3].sum(), rel=1e-4)
    x = np.arange(300)
    mean = blurred[3] @ x / blurred[3].sum()
    turns = 0.3 * 0.9 * 0.5 * way_m
    variance = 0.6**2 + 1 / 12 + turns / (1 - np.exp(-turns)) * (FORWARD_ANGLE * 220) ** 2 / 3
    assert mean == pytest.approx(centre, abs=0.01)
    assert blurred[3] @ (x - mean) ** 2 / blurred[3].sum() == pytest.approx(variance, rel=2e-3)
