"""The simulated apparatus against the world's own light, closed forms and its account of time and energy."""

import numpy as np
import pytest

from rig.strategies.apparatus import MakesApparatus
from sim_backend.projector import draws, transport
from sim_backend.projector.apparatus import SimulatedApparatus
from tests.stability.inventory import covers
from tests.unit.sim_backend.rigs import made_world

covers(SimulatedApparatus, draws, transport)

ASKED = {
    "rows": np.array([3, 4, 20, 37]), "columns": 40, "command_range": (-0.88, 0.88), "power_w": 0.05, "seed": 3,
    "depth_range_m": (1.0, 15.0),
}  # fmt: skip
GEOMETRY = "config/small-rig.yaml"


def made(rule: str = "energy", scene: str = "street", **changed):
    world = made_world(scene=scene, geometry=GEOMETRY, effects="all")
    assert isinstance(world, MakesApparatus)
    return world, world.apparatus(**{**ASKED, "rule": rule, **changed})


def expected(world, column: int, seconds: float):
    first, last = ASKED["command_range"]
    command = first + (column + 0.5) * (last - first) / ASKED["columns"]
    rows = [sum(world.flux_row(int(row), command, 0.05, seconds).values()) for row in ASKED["rows"]]
    return np.array(rows)


@pytest.mark.parametrize("scene", ["street", "street-dense-fog", "street-rain"])
def test_a_column_gives_the_light_of_the_line_that_stands_there(scene: str) -> None:
    world, apparatus = made(scene=scene)
    patterns = np.eye(40, dtype=np.float32)[[7, 20, 33]]
    counts = apparatus.spad_counts(patterns, np.array([20_000, 20_000, 20_000]))
    for i, column in enumerate((7, 20, 33)):
        p = -np.expm1(-expected(world, column, apparatus.spad_frame_s))
        if scene == "street-rain":  # drops are elsewhere at other times
            continue
        z = (counts[i] - 20_000 * p) / np.sqrt(20_000 * p * (1 - p) + 1e-3)
        assert np.abs(z).max() < 5.5
        assert abs(z.mean()) < 4 / np.sqrt(z.size)
        assert 0.9 < z.std() < 1.1
