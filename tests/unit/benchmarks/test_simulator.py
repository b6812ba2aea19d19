"""The simulator's bench: its rows and figures, measured for a moment; and the numpy way against the compiled one."""

import numpy as np
import pytest

from sim_backend.frames.flux import FluxModel
from tests.benchmarks.numpy_frames import NumpyFrames
from tests.benchmarks.simulator import SimulatorExtent, measure_simulator, simulator_table
from tests.unit.sim.rigs import rig, setting, wall


def test_every_row_has_its_figures_and_is_compared_with_numpy(capsys: pytest.CaptureFixture[str]) -> None:
    extent = SimulatorExtent(scenes=("street",), threads=(2,), rounds=1, moment_s=0.0, read_bytes=2**20)
    report = measure_simulator(extent)
    rows = {row.stage: row for row in report.rows}
    assert list(rows) == ["simulator-ready", "simulator-fresh", "simulator-numpy-ready", "simulator-numpy-fresh"]
    for name, row in rows.items():
        assert row.scene == "street"
        assert row.frames_per_s > 0
        assert row.us_per_frame == pytest.approx(1e6 / row.frames_per_s)
        assert row.times_real_time == pytest.approx(row.frames_per_s / 1e5)
        slow = rows[f"simulator-numpy-{name.rpartition('-')[2]}"].frames_per_s
        assert row.times_numpy == pytest.approx(row.frames_per_s / slow)
    simulator_table(report)
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 100
    assert sum("street" in line for line in lines) == 4


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
