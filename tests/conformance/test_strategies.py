"""The suite of every way to measure depth, on all that are installed, before a small simulated scene.

What each one promises: it finds a clear surface as well as it says, claims nothing without light, keeps its time and
the source's energy, and answers the same for the same seed.
"""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from drivers.clock import VirtualClock
from drivers.registry import Surroundings, lookup
from rig.plan.scan_plan import column_command
from rig.strategies.apparatus import Apparatus, Budget
from rig.strategies.comparison.score import scored_pixels
from rig.strategies.strategy import Answer, ColumnGeometry, Strategy, TooShort, find_strategy, strategy_names
from tests.system.small_rig import calibration

ROWS, WIDTH, COLUMNS = 24, 160, 160
COMMANDS = (-0.8, 0.8)
RANGE_M = (2.0, 15.0)
"""Narrow enough that the windows of eight lines do not overlap: docs/explanation/multi-line.md."""
NEAR_M, FAR_M = 2.1, 12.0
"""Ends of the wall, within the range: what lies nearer would be taken for another line's stripe."""
POWER_W = 0.05
LONG_S = 0.5
"""Plenty of time for all, even for the line before the conventional camera."""
SURE, MOST_WRONG = 0.9, 0.01
"""Confidence of a claim, and share of such claims that noise may cause in the dark: hot pixels and dark counts."""
MORE_WRONG = {"likelihood": 0.12}
"""The same for an estimator that looks at one row at a time and has learned from darkness alone, by end of name."""


@cache
def world(folder: str, lux: float) -> Any:
    """A textured wall that recedes, in clear air, seen by a small rig with an ideal lens."""
    rig = calibration(WIDTH, ROWS)
    rig["camera"]["distortion"] = [0.0] * 5
    geometry = Path(folder) / "rig.yaml"
    geometry.write_text(yaml.safe_dump(rig), encoding="utf-8")
    surfaces = Path(folder) / "wall"
    if not surfaces.exists():
        surfaces.mkdir()
        depth_m = np.broadcast_to(1 / np.linspace(1 / NEAR_M, 1 / FAR_M, WIDTH), (ROWS, WIDTH))
        patches = (
            np.random.default_rng(1).uniform(0.2, 0.8, (ROWS // 4, WIDTH // 4)).repeat(4, axis=0).repeat(4, axis=1)
        )
        np.savez(surfaces / "world.npz", depth_m=depth_m.astype(np.float32), albedo=patches.astype(np.float32))
    scene = Path(folder) / f"scene-{lux:g}.yaml"
    scene.write_text(yaml.safe_dump({"surfaces": str(surfaces), "ambient": {"illuminance": f"{lux:g} lux"}}))
    kind = lookup("world", "simulated")
    config = kind.config.model_validate({"kind": "simulated", "geometry": str(geometry), "scene": str(scene)})
    return kind.create(config, Surroundings(VirtualClock(), None, seed=1))


class Bench:
    """Makes apparatus and truth. lux: ambient light; power_w: of the source."""

    def __init__(self, folder: str) -> None:
        self._folder = folder
        commands = np.array([column_command(column, COMMANDS, COLUMNS) for column in range(COLUMNS)])
        model = world(folder, 1.0).true_model()
        self.geometry = ColumnGeometry(model, commands, RANGE_M, np.arange(ROWS))
        truth = world(folder, 1.0).truth(commands)
        self.scored = scored_pixels(truth, self.geometry)
        self.true_m = truth.depth_m

    def apparatus(self, strategy: Strategy, *, lit: bool = True, seed: int = 0) -> Apparatus:
        """An apparatus with light, or in full darkness. Without a source of its own, light is that of a lit room."""
        lux = 0.0 if not lit else 50.0 if strategy.light == "ambient" else 1.0
        made: Apparatus = world(self._folder, lux).apparatus(
            rows=np.arange(ROWS), columns=COLUMNS, command_range=COMMANDS, power_w=POWER_W if lit else 0.0,
            rule="energy", seed=seed, depth_range_m=RANGE_M,
        )  # fmt: skip
        return made

    def errors_px(self, answer: Answer) -> Any:
        """Errors of the scored pixels that have an answer, in pixels of disparity."""
        depth_m, true_m = answer.depth_m[self.scored], self.true_m[self.scored]
        given = np.isfinite(depth_m)
        return self.geometry.px_per_inverse_depth * np.abs(1 / depth_m[given] - 1 / true_m[given])


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    return Bench(str(tmp_path_factory.mktemp("bench")))


@pytest.fixture(params=strategy_names())
def strategy(request: pytest.FixtureRequest) -> Strategy:
    return find_strategy(request.param)


def require_form(answer: Answer) -> None:
    assert answer.depth_m.shape == answer.confidence.shape == (ROWS, WIDTH)
    assert answer.depth_m.dtype == answer.confidence.dtype == np.float32
    assert np.all((answer.confidence >= 0) & (answer.confidence <= 1))  # not if one is NaN
    none = np.isnan(answer.depth_m)
    assert np.all(answer.confidence[none] == 0)
    assert np.all(np.isfinite(answer.depth_m[~none]) & (answer.depth_m[~none] > 0))


def test_says_what_it_is(strategy: Strategy) -> None:
    assert strategy.name == strategy.name.lower().replace(" ", "-")
    assert len(strategy.sentence) > 20
    assert strategy.sentence[-1] == "."
    assert len(strategy.source) > 10
    assert strategy.light in ("spot", "line", "pattern", "flash", "ambient")
    assert 0 < strategy.clear_px < 10


def test_finds_a_clear_surface_as_well_as_it_says_and_the_same_again(strategy: Strategy, bench: Bench) -> None:
    found = []
    for _ in range(2):
        apparatus = bench.apparatus(strategy)
        answer = strategy.measure(apparatus, bench.geometry, Budget(LONG_S), 7)
        require_form(answer)
        found.append((answer, apparatus.spent))
    errors = bench.errors_px(found[0][0])
    assert errors.size >= 0.5 * np.count_nonzero(bench.scored)
    assert np.median(errors) <= strategy.clear_px
    assert found[0][1].time_s <= LONG_S * (1 + 1e-9)
    assert found[0][1].energy_j <= POWER_W * LONG_S * (1 + 1e-6)
    np.testing.assert_array_equal(found[0][0].depth_m, found[1][0].depth_m)
    np.testing.assert_array_equal(found[0][0].confidence, found[1][0].confidence)


def test_claims_nothing_without_light(strategy: Strategy, bench: Bench) -> None:
    answer = strategy.measure(bench.apparatus(strategy, lit=False), bench.geometry, Budget(LONG_S), 3)
    require_form(answer)
    most = next((share for end, share in MORE_WRONG.items() if strategy.name.endswith(end)), MOST_WRONG)
    assert np.mean(answer.confidence >= SURE) <= most


@pytest.mark.parametrize("time_s", [1e-6, 1e-3, 7.77e-3])
def test_keeps_its_time_or_says_that_it_is_too_short(strategy: Strategy, bench: Bench, time_s: float) -> None:
    apparatus = bench.apparatus(strategy)
    try:
        require_form(strategy.measure(apparatus, bench.geometry, Budget(time_s), 1))
    except TooShort:
        assert apparatus.spent.time_s == 0  # before any light is sent
    else:
        assert 0 < apparatus.spent.time_s <= time_s * (1 + 1e-9)
