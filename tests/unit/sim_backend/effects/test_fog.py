"""The haze traced forward through the volume, and where it must end; its closed form is in test_energy.py."""

import numpy as np
import pytest

from sim_backend.effects.fog import Haze
from sim_backend.scenes.surfaces import checked
from tests.unit.sim_backend.rigs import before_wall, effect_rate, pixel_solid_angle, rig, setting, wall

EXTINCTION, PHASE = 0.15, 0.05
FOG = {"medium": {"extinction": f"{EXTINCTION} /m", "backscatter": f"{PHASE} /sr", "scattering_share": 0.9}}


@pytest.mark.parametrize(("baseline_m", "roll", "k1"), [(0.3, 0.12, -0.2), (-0.3, -0.1, 0.1)])
def test_the_haze_is_what_the_volume_scatters_into_the_camera(baseline_m: float, roll: float, k1: float) -> None:
    model = rig(baseline_m=baseline_m, roll=roll, k1=k1)
    setup = setting(model, wall(model, (0.0, 0.0, 1.0), 3.0), **FOG)
    plane = model.planes(0.1 * np.sign(baseline_m))
    rate = effect_rate(setup, "fog", plane)
    along = np.cross(plane[:3], [0.0, 1.0, 0.0])
    along = along / np.linalg.norm(along) * np.sign(along[2])
    angle, r = np.linspace(-0.45, 0.45, 901), np.linspace(0.3, 4.0, 901)
    ray = np.cos(angle)[:, None] * along + np.sin(angle)[:, None] * np.cross(plane[:3], along)
    assert model.source_m is not None
    point = model.source_m + r[None, :, None] * ray[:, None, :]
    camera_m = np.linalg.norm(point, axis=-1)
    power = (angle[1] - angle[0]) * (r[1] - r[0]) / setup.line.fan
    irradiance = 0.9 * EXTINCTION * PHASE * power * np.exp(-EXTINCTION * (r + camera_m)) / camera_m**2
    x, y = model.camera.project(point)
    radiance = irradiance / pixel_solid_angle(model, point[..., 0] / point[..., 2], point[..., 1] / point[..., 2])
    seen = np.isfinite(x) & (point[..., 2] < 3.0)
    traced, _, _ = np.histogram2d(
        y[seen], x[seen], bins=(np.arange(65) - 0.5, np.arange(97) - 0.5), weights=radiance[seen]
    )
    # Blocks of 8 x 8 pixels well before the stripe, where the sheet is farther than the nearest traced point.
    stripe = setup.view.sheet(plane).x_stripe_px
    blocks = 0
    for top in range(8, 56, 8):
        for left in range(0, 96, 8):
            area = np.s_[top : top + 8, left : left + 8]
            ends = stripe[top : top + 8]
            before = np.nanmin((ends - left - 4) * np.sign(baseline_m))
            if 10 < before < 40:
                assert rate[area].sum() == pytest.approx(setup.gain * traced[area].sum(), rel=0.01)
                blocks += 1
    assert blocks >= 12


def test_haze_ends_in_the_shadow_of_a_body_and_does_not_come_back() -> None:
    model = rig()
    setup = setting(model, before_wall(model, 3.0, slice(40, 50), 1.2), **FOG)
    met = 0
    for command in np.linspace(-0.5, 0.9, 41):
        plane = model.planes(command)
        sheet, rate = setup.view.sheet(plane), effect_rate(setup, "fog", plane)
        depth_of_sheet = plane[3] / (plane[:3] @ np.array([(40 - 47.5) / 110, 0.0, 1.0]))
        if 1.3 < depth_of_sheet < 2.8:  # passes behind the body's near edge
            met += 1
            assert np.isnan(sheet.x_stripe_px[32])
            assert rate[32, 30] > 0
            assert np.all(rate[32, 40:] == 0)
    assert met >= 2


@pytest.mark.parametrize("phase", [{}, {"phase": {"terms": [[0.9, 0.9], [0.1, -0.5]]}}], ids=["constant", "terms"])
def test_haze_for_drawing_in_float32_is_that_in_float64_to_five_digits(phase: dict[str, object]) -> None:
    model = rig(roll=0.12, k1=-0.2)
    medium = {"medium": {"extinction": "2 /m", **phase}}
    setup = setting(model, wall(model, (0.1, 0.0, 1.0), 2.5), **medium)
    haze, sheet = Haze(setup), setup.view.sheet(model.planes(0.1))
    exact, drawn = (np.zeros((64, 96), kind) for kind in (np.float64, np.float32))
    haze.add(sheet, 0, 64, exact)
    haze.add(sheet, 0, 64, drawn)
    assert np.count_nonzero(exact) > 2000
    np.testing.assert_allclose(drawn, exact, rtol=2e-5, atol=1e-9 * exact.max())


@pytest.mark.parametrize("command", [0.8, 0.9, 1.0])
def test_pixels_without_a_ray_see_no_haze(command: float) -> None:
    """Where the lens has no inverse the end of the light may lie beside such pixels."""
    model = rig(size=(48, 96), focal_px=60.0, k1=-0.8)
    blind = np.isnan(model.camera.tangents()[0])
    depth, albedo = np.where(blind, np.inf, 2.5), np.full(blind.shape, 0.5)
    setup = setting(model, checked("wall", depth, albedo, ~blind, blind.shape), medium={"extinction": "0.1 /m"})
    assert blind.any()
    rate = effect_rate(setup, "fog", model.planes(command))
    assert np.all(rate[blind] == 0)
    assert np.isfinite(rate).all()
