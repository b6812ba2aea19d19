"""Energy: what the sheet gives the fog and a wall is what the picture holds, to 1e-6, by quadrature over the sheet.

Light runs forward here, from the mirror through the sheet into the camera's pupil, over the sheet's own coordinates
X = (-b + u_p z, v z, z): nothing of the formulas that the simulator uses along a row. Radiance times solid angle,
summed over a row's pixels, must be the irradiance at the pupil. The camera has small pixels: what is left is the
pixels' sum against an integral.
"""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from calibration.model.rig_model import RigModel
from sim_backend.effects.catalogue import CATALOGUE
from sim_backend.effects.setting import Setting
from sim_backend.frames.flux import FluxModel
from sim_backend.light.optics import ambient_irradiance
from sim_backend.scenes.surfaces import Surfaces
from tests.unit.sim.rigs import effect_rate, rig, setting

ROWS, WIDTH, FOCAL = 5, 12001, 13000.0
EXTINCTION, PHASE, SHARE, ALBEDO, DISTANCE_M = 0.15, 1 / (4 * math.pi), 0.9, 0.5, 2.5
FOG = {
    "medium": {
        "extinction": f"{EXTINCTION} /m",
        "backscatter": f"{PHASE!r} /sr",
        "scattering_share": SHARE,
    }
}
RELATIVE = 1e-6

Array = NDArray[np.float64]


def _setting(baseline_m: float, slope: float, **scene: object) -> tuple[RigModel, Setting]:
    """A wall slope x + z = distance, in float64: pixels are so small that float32 depths are not plane."""
    model = rig(size=(ROWS, WIDTH), focal_px=FOCAL, baseline_m=baseline_m)
    u, _ = model.camera.tangents()
    wall = Surfaces(DISTANCE_M / (slope * u + 1), np.full(u.shape, ALBEDO), np.ones(u.shape, bool))
    return model, setting(model, wall, **scene)


def _pupil(rate: Array, setup: Setting) -> Array:
    """Irradiance at the pupil per unit of v and watt of laser, from the radiances of each row."""
    view = setup.view
    solid_angle = np.abs(view.u_x) / (view.u**2 + view.v**2 + 1) ** 1.5
    result: Array = (rate * solid_angle).sum(axis=1) / setup.gain
    return result


def _sheet(model: RigModel, plane: Array, v: Array) -> tuple[float, Array]:
    """Tangent u_p of the sheet, and the fan's angle per unit of v on each row."""
    tangent = -float(plane[2] / plane[0])
    return tangent, math.sqrt(1 + tangent**2) / (1 + tangent**2 + v**2)


@pytest.mark.parametrize("baseline_m", [0.3, -0.3], ids=["scanner left", "scanner right"])
@pytest.mark.parametrize("slope", [0.0, 0.4])
def test_the_stripe_and_its_attenuation(baseline_m: float, slope: float) -> None:
    model, clear = _setting(baseline_m, slope)
    _, foggy = _setting(baseline_m, slope, **FOG)
    plane = model.planes(0.1 * np.sign(baseline_m))
    v = clear.view.v[:, 0]
    tangent, angle = _sheet(model, plane, v)
    normal = np.array([slope, 0.0, 1.0])
    depth = (DISTANCE_M + slope * baseline_m) / (1 + slope * tangent)
    point = np.stack([np.full(ROWS, -baseline_m + tangent * depth), v * depth, np.full(ROWS, depth)], axis=1)
    camera_m = np.linalg.norm(point, axis=1)
    from_mirror_m = np.linalg.norm(point + np.array([baseline_m, 0, 0]), axis=1)
    cosine = point @ normal / camera_m / np.linalg.norm(normal)
    expected = angle / clear.line.fan * ALBEDO / math.pi * cosine / camera_m**2
    through_fog = np.exp(-EXTINCTION * (from_mirror_m + camera_m))
    rows = slice(1, -1)
    np.testing.assert_allclose(_pupil(effect_rate(clear, "stripe", plane), clear)[rows], expected[rows], rtol=RELATIVE)
    np.testing.assert_allclose(
        _pupil(effect_rate(foggy, "stripe", plane), foggy)[rows], (expected * through_fog)[rows], rtol=RELATIVE
    )


@pytest.mark.parametrize("baseline_m", [0.3, -0.3], ids=["scanner left", "scanner right"])
@pytest.mark.parametrize("slope", [0.0, 0.4])
def test_the_haze_up_to_the_wall(baseline_m: float, slope: float) -> None:
    model, setup = _setting(baseline_m, slope, **FOG)
    plane = model.planes(0.1 * np.sign(baseline_m))
    v = setup.view.v[:, 0]
    tangent, _ = _sheet(model, plane, v)
    # The sheet is in the picture from where it crosses the border of the outermost pixel on the light's way.
    border = np.sign(baseline_m) * -0.5 * WIDTH / FOCAL
    near, far = baseline_m / (tangent - border), (DISTANCE_M + slope * baseline_m) / (1 + slope * tangent)
    nodes, weights = np.polynomial.legendre.leggauss(200)
    # In 1/z: near the camera all changes fast.
    inverse = 0.5 * (1 / near + 1 / far) + 0.5 * (1 / near - 1 / far) * nodes
    z, dz = 1 / inverse, 0.5 * (1 / near - 1 / far) * weights / inverse**2
    u = -baseline_m / z + tangent
    expected = np.empty(ROWS)
    for y in range(ROWS):
        camera_m = z * np.sqrt(u**2 + v[y] ** 2 + 1)
        from_mirror_m = z * math.sqrt(tangent**2 + v[y] ** 2 + 1)
        light = z * math.sqrt(1 + tangent**2) / (from_mirror_m * setup.line.fan)  # W/m^2 times the area per dv dz
        scattered = SHARE * EXTINCTION * PHASE * np.exp(-EXTINCTION * (from_mirror_m + camera_m)) / camera_m**2
        expected[y] = np.sum(dz * light * scattered)
    np.testing.assert_allclose(_pupil(effect_rate(setup, "fog", plane), setup), expected, rtol=RELATIVE)


def test_ambient_light_and_airlight_of_a_wall() -> None:
    lux = 20.0
    _, setup = _setting(0.3, 0.0, ambient={"illuminance": f"{lux} lux"}, **FOG)
    steady = FluxModel(setup, [entry for entry in CATALOGUE if entry.name in ("ambient", "airlight")]).steady
    path_m = DISTANCE_M * np.sqrt(setup.view.u**2 + setup.view.v**2 + 1)
    through = np.exp(-EXTINCTION * path_m)
    white = setup.gain * ambient_irradiance(lux, setup.optics) / math.pi
    np.testing.assert_allclose(steady["ambient"], ALBEDO * white * through, rtol=RELATIVE)
    np.testing.assert_allclose(steady["airlight"], SHARE * white * (1 - through), rtol=RELATIVE)
