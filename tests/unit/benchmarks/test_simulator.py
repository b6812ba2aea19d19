"""The numpy way of the simulator's benchmark against the compiled one."""

import numpy as np
import pytest

from sim_backend.frames.flux import FluxModel
from tests.benchmarks.numpy_frames import NumpyFrames
from tests.unit.sim_backend.rigs import rig, setting, wall


@pytest.mark.parametrize("baseline_m", [0.3, -0.3], ids=["scanner left", "scanner right"])
def test_the_numpy_way_sees_the_same_light(baseline_m: float) -> None:
    model = rig(baseline_m=baseline_m)
    fog = {"medium": {"extinction": "0.15 /m", "multiple_scattering": False}}
    setup = setting(model, wall(model, (0.2, 0.1, 1.0), 2.5), **fog)
    flux = FluxModel(setup)
    frames = NumpyFrames(setup, flux.steady_per_s, 1e-5, 1)
    plane = model.planes(0.15)
    p, expected = frames.probability(plane, 1e-4), -np.expm1(-flux.flux(plane, 1e-5, 1e-4))  # far from saturated
    assert np.median(np.abs(p / expected - 1)) < 1e-9
    np.testing.assert_allclose(p.sum(axis=1), expected.sum(axis=1), rtol=0.06)
    bits = np.zeros((400, 64, 12), np.uint8)
    frames.draw(p, bits)
    assert np.unpackbits(bits).sum() == pytest.approx(400 * p.sum(), abs=5 * np.sqrt(400 * p.sum()))
