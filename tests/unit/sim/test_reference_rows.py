"""Rows of an independent path tracer: single scattering and stripe agree, within its noise."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from calibration.camera import Camera
from calibration.model import RigModel
from calibration.scanner import PlaneTable
from tests.unit.sim.rigs import effect_rate, setting, wall

FOLDER = Path(__file__).parents[4] / "shared" / "reference"
FOCAL, CENTRE, BASELINE, TANGENT = 277.128, 159.5, 0.4, (240 - 159.5) / 277.128

pytestmark = pytest.mark.skipif(not FOLDER.is_dir(), reason="no reference rows beside this checkout")


def _rows(name: str) -> NDArray[np.void]:
    return np.genfromtxt(FOLDER / name, delimiter=",", names=True)


def _model() -> RigModel:
    plane = np.array([[1.0, 0.0, -TANGENT, -BASELINE]])
    camera = Camera(320, 3, np.array([[FOCAL, 0, CENTRE], [0, FOCAL, 1.0], [0, 0, 1.0]]), np.zeros(5))
    return RigModel(camera, PlaneTable(np.array([0.0]), plane), source_m=np.array([-BASELINE, 0.0, 0.0]))


def _radiance(effect: str, **scene: object) -> NDArray[np.float64]:
    """Radiance of the middle row where the tracer's column (1 px wide, 1 W/m^2 on the plane z = 1) is lit."""
    model = _model()
    setup = setting(model, wall(model, (0.0, 0.0, 1.0), 5.0), **scene)
    per_radian = 1 / FOCAL * np.sqrt(1 + TANGENT**2)
    rate = effect_rate(setup, effect, model.planes(0.0))
    result: NDArray[np.float64] = rate[1] / setup.gain * per_radian * setup.line.fan
    return result


def test_the_stripe_in_clear_air() -> None:
    traced = _rows("clear_row.csv")["radiance"]
    ours = _radiance("stripe")
    assert ours.sum() == pytest.approx(traced.sum(), rel=0.005)
    x = np.arange(320)
    assert ours @ x / ours.sum() == pytest.approx(217.830, abs=2e-3)
    assert traced @ x / traced.sum() == pytest.approx(217.830, abs=0.05)


@pytest.mark.parametrize("tau", [0.5, 1.0])
def test_single_scattering_in_fog(tau: float) -> None:
    traced = _rows(f"fog_row_isotropic_tau{tau}.csv")
    medium = {"extinction": f"{tau / 5} /m", "scattering_share": 0.999, "backscatter": f"{1 / (4 * np.pi)} /sr"}
    haze, stripe = _radiance("fog", medium=medium), _radiance("stripe", medium=medium)
    for area in (slice(10, 70), slice(70, 130), slice(130, 190), slice(190, 214)):
        difference = np.sum(haze[area] - traced["single"][area])
        error = np.sqrt(np.sum(traced["single_se"][area] ** 2)) + 0.01 * haze[area].sum()
        assert abs(difference) < 3 * error
    peak = slice(214, 222)
    assert np.sum((haze + stripe)[peak]) == pytest.approx(np.sum(traced["single"][peak]), rel=0.02)
