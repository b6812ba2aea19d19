"""Energy: what the sheet gives the fog and a wall is what the picture holds, to 1e-6, by quadrature over the sheet.

Light runs forward here, from the mirror through the sheet into the camera's pupil, over the sheet's own coordinates
X = (-b + u_p z, v z, z): nothing of the formulas that the simulator uses along a row. Radiance times solid angle,
summed over a row's pixels, must be the irradiance at the pupil. The camera has small pixels: what is left is the
pixels' sum against an integral.
"""

import math

import numpy as np
import pytest

from calibration.model.rig_model import RigModel
from sim_backend.effects.catalogue import CATALOGUE
from sim_backend.effects.setting import Setting
from sim_backend.frames.flux import FluxModel
from sim_backend.light.optics import ambient_irradiance
from sim_backend.scenes.surfaces import Surfaces
from tests.unit.sim_backend.rigs import Array, effect_rate, rig, setting

ROWS, WIDTH, FOCAL = 5, 12001, 13000.0
EXTINCTION, PHASE, SHARE, ALBEDO, DISTANCE_M, LUX = 0.15, 1 / (4 * math.pi), 0.9, 0.5, 2.5, 20.0
MEDIUM = {"extinction": f"{EXTINCTION} /m", "backscatter": f"{PHASE!r} /sr", "scattering_share": SHARE}
SCENE = {"medium": MEDIUM, "ambient": {"illuminance": f"{LUX} lux"}}
RELATIVE = 1e-6


def _setting(model: RigModel, slope: float, **scene: object) -> Setting:
    """A wall slope x + z = distance, in float64: pixels are so small that float32 depths are not plane."""
    u, _ = model.camera.tangents()
    wall = Surfaces(DISTANCE_M / (slope * u + 1), np.full(u.shape, ALBEDO), np.ones(u.shape, bool))
    return setting(model, wall, **scene)


def _pupil(setup: Setting, name: str, plane: Array) -> Array:
    """Irradiance at the pupil per unit of v and watt of laser, from an effect's radiances of each row."""
    view = setup.view
    solid_angle = np.abs(view.u_x) / (view.u**2 + view.v**2 + 1) ** 1.5
    result: Array = (effect_rate(setup, name, plane) * solid_angle).sum(axis=1) / setup.gain
    return result


@pytest.mark.parametrize("baseline_m", [0.3, -0.3], ids=["scanner left", "scanner right"])
@pytest.mark.parametrize("slope", [0.0, 0.4])
def test_stripe_and_haze(baseline_m: float, slope: float) -> None:
    model = rig(size=(ROWS, WIDTH), focal_px=FOCAL, baseline_m=baseline_m)
    clear, foggy = _setting(model, slope), _setting(model, slope, **SCENE)
    plane = model.planes(0.1 * np.sign(baseline_m))
    v, fan = clear.view.v[:, 0], clear.line.fan
    tangent = -float(plane[2] / plane[0])
    normal = np.array([slope, 0.0, 1.0])
    depth = (DISTANCE_M + slope * baseline_m) / (1 + slope * tangent)
    point = np.stack([np.full(ROWS, -baseline_m + tangent * depth), v * depth, np.full(ROWS, depth)], axis=1)
    camera_m = np.linalg.norm(point, axis=1)
    from_mirror_m = np.linalg.norm(point + np.array([baseline_m, 0, 0]), axis=1)
    cosine = point @ normal / camera_m / np.linalg.norm(normal)
    angle = math.sqrt(1 + tangent**2) / (1 + tangent**2 + v**2)  # of the fan, per unit of v
    expected = angle / fan * ALBEDO / math.pi * cosine / camera_m**2
    through_fog = np.exp(-EXTINCTION * (from_mirror_m + camera_m))
    for setup, light in ((clear, expected), (foggy, expected * through_fog)):
        np.testing.assert_allclose(_pupil(setup, "stripe", plane)[1:-1], light[1:-1], rtol=RELATIVE)
    # The sheet is in the picture from where it crosses the border of the outermost pixel on the light's way.
    near = baseline_m / (tangent + np.sign(baseline_m) * 0.5 * WIDTH / FOCAL)
    nodes, weights = np.polynomial.legendre.leggauss(200)
    # In 1/z: near the camera all changes fast.
    inverse = 0.5 * (1 / near + 1 / depth) + 0.5 * (1 / near - 1 / depth) * nodes
    z, dz = 1 / inverse, 0.5 * (1 / near - 1 / depth) * weights / inverse**2
    camera_m = z * np.sqrt((tangent - baseline_m / z) ** 2 + v[:, None] ** 2 + 1)
    from_mirror_m = z * np.sqrt(tangent**2 + v[:, None] ** 2 + 1)
    light = z * math.sqrt(1 + tangent**2) / (from_mirror_m * fan)  # W/m^2 times the area per dv dz
    scattered = SHARE * EXTINCTION * PHASE * np.exp(-EXTINCTION * (from_mirror_m + camera_m)) / camera_m**2
    haze = np.sum(dz * light * scattered, axis=1)
    np.testing.assert_allclose(_pupil(foggy, "fog", plane), haze, rtol=RELATIVE)


def test_ambient_light_and_airlight_of_a_wall() -> None:
    setup = _setting(rig(size=(ROWS, WIDTH), focal_px=FOCAL), 0.0, **SCENE)
    steady = FluxModel(setup, [entry for entry in CATALOGUE if entry.name in ("ambient", "airlight")]).steady
    through = np.exp(-EXTINCTION * DISTANCE_M * np.sqrt(setup.view.u**2 + setup.view.v**2 + 1))
    white = setup.gain * ambient_irradiance(LUX, setup.optics) / math.pi
    np.testing.assert_allclose(steady["ambient"], ALBEDO * white * through, rtol=RELATIVE)
    np.testing.assert_allclose(steady["airlight"], SHARE * white * (1 - through), rtol=RELATIVE)
