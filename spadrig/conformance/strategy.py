"""The suite of every way to measure depth (strategy), before a small simulated scene.

It finds a clear surface as well as it says, claims nothing without light, keeps its time and the source's energy, and
answers the same for the same seed. The scene is a textured wall that recedes, in clear air, seen by a small rig with an
ideal lens and the mirror on its left.
"""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

from drivers.clock import VirtualClock
from drivers.registry import Surroundings, lookup
from rig.plan.scan_plan import column_command
from rig.strategies.apparatus import Apparatus, Budget
from rig.strategies.comparison.compare import require_form
from rig.strategies.comparison.score import scored_pixels
from rig.strategies.strategy import Answer, ColumnGeometry, Strategy, TooShort

ROWS, WIDTH, COLUMNS = 24, 160, 160
FOCAL_PX = 110.0
BASELINE_M = 0.3
COMMANDS = (-0.8, 0.8)
RANGE_M = (2.0, 15.0)
"""Narrow enough that the windows of eight lines do not overlap."""
NEAR_M, FAR_M = 2.1, 12.0
"""Ends of the wall, within the range: what lies nearer would be taken for another line's stripe."""
POWER_W = 0.05
LONG_S = 0.5
"""Plenty of time for all, even for a line before a conventional camera."""
SURE, MOST_WRONG = 0.9, 0.01
"""Confidence of a claim, and share of such claims that noise may cause in the dark: hot pixels and dark counts."""


@cache
def world(folder: str, lux: float) -> Any:
    """The world with the suite's rig and wall, in ambient light of `lux`. folder: where its files are written."""
    geometry = Path(folder) / "rig.yaml"
    geometry.write_text(yaml.safe_dump(_calibration()), encoding="utf-8")
    surfaces = Path(folder) / "wall"
    if not surfaces.exists():
        surfaces.mkdir()
        depth_m = np.broadcast_to(1 / np.linspace(1 / NEAR_M, 1 / FAR_M, WIDTH), (ROWS, WIDTH))
        patches = np.random.default_rng(1).uniform(0.2, 0.8, (ROWS // 4, WIDTH // 4))
        albedo = patches.repeat(4, axis=0).repeat(4, axis=1)
        np.savez(surfaces / "world.npz", depth_m=depth_m.astype(np.float32), albedo=albedo.astype(np.float32))
    scene = Path(folder) / f"scene-{lux:g}.yaml"
    scene.write_text(yaml.safe_dump({"surfaces": str(surfaces), "ambient": {"illuminance": f"{lux:g} lux"}}))
    kind = lookup("world", "simulated")
    config = kind.config.model_validate({"kind": "simulated", "geometry": str(geometry), "scene": str(scene)})
    return kind.create(config, Surroundings(VirtualClock(), None, seed=1))


def _calibration() -> dict[str, Any]:
    centre = [(WIDTH - 1) / 2, (ROWS - 1) / 2]
    return {
        "format": "spadrig-calibration",
        "version": 1,
        "camera": {
            "width": WIDTH,
            "height": ROWS,
            "matrix": [[FOCAL_PX, 0, centre[0]], [0, FOCAL_PX, centre[1]], [0, 0, 1]],
            "distortion": [0.0] * 5,
        },
        "scanner": {
            "pivot": {
                "axis_point_m": [-BASELINE_M, 0, 0],
                "axis_direction": [0, 1, 0],
                "zero_normal": [1, 0, 0],
                "angle_rad": [0.08, 0.38],
            }
        },
        "source_m": [-BASELINE_M, 0, 0],
        "lag_s": {"forward": 2e-4, "backward": 2e-4},
    }


class StrategyBench:
    """Makes apparatus for the suite, and knows the truth. folder: where files are written.

    geometry: that of the rig. scored: (rows, width), pixels that the source lights and the camera sees.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = str(folder)
        commands = np.array([column_command(column, COMMANDS, COLUMNS) for column in range(COLUMNS)])
        self.geometry = ColumnGeometry(world(self._folder, 1.0).true_model(), commands, RANGE_M, np.arange(ROWS))
        truth = world(self._folder, 1.0).truth(commands)
        self.scored = scored_pixels(truth, self.geometry)
        self._true_m = truth.depth_m

    def apparatus(self, strategy: Strategy, *, lit: bool = True, seed: int = 0) -> Apparatus:
        """An apparatus with light, or in full darkness. A strategy without a light source of its own gets the light of
        a lit room."""
        lux = 0.0 if not lit else 50.0 if strategy.light == "ambient" else 1.0
        made: Apparatus = world(self._folder, lux).apparatus(
            rows=np.arange(ROWS), columns=COLUMNS, command_range=COMMANDS, power_w=POWER_W if lit else 0.0,
            rule="energy", seed=seed, depth_range_m=RANGE_M,
        )  # fmt: skip
        return made

    def measured(self, strategy: Strategy, apparatus: Apparatus, time_s: float, seed: int) -> Answer:
        """The answer of a strategy. Asserts that its form is that of `Answer` and that its depths are positive, or NaN
        where there is no answer."""
        answer = strategy.measure(apparatus, self.geometry, Budget(time_s), seed)
        require_form(answer, strategy.name, (ROWS, WIDTH))
        given = np.isfinite(answer.depth_m)
        assert np.all(answer.depth_m[given] > 0)
        assert not np.isinf(answer.depth_m).any()
        return answer

    def errors_px(self, answer: Answer) -> NDArray[np.floating]:
        """Errors of the scored pixels that have an answer, (pixels,), in pixels of disparity."""
        depth_m, true_m = answer.depth_m[self.scored], self._true_m[self.scored]
        given = np.isfinite(depth_m)
        return np.asarray(self.geometry.px_per_inverse_depth * np.abs(1 / depth_m[given] - 1 / true_m[given]))


class StrategySuite:
    """Tests of a strategy. The fixture `strategy` gives it.

    Override `most_wrong` for a strategy that learns from the darkness itself.
    """

    def most_wrong(self, strategy: Strategy) -> float:
        """Largest share of the pixels for which an answer in the dark may be sure."""
        return MOST_WRONG

    def test_says_what_it_is(self, strategy: Strategy) -> None:
        assert strategy.name == strategy.name.lower().replace(" ", "-")
        assert len(strategy.sentence) > 20
        assert strategy.sentence[-1] == "."
        assert len(strategy.source) > 10
        assert strategy.light in ("spot", "line", "pattern", "flash", "ambient")
        assert 0 < strategy.clear_px < 10

    def test_finds_a_clear_surface_as_well_as_it_says_and_the_same_again(
        self, strategy: Strategy, strategy_bench: StrategyBench
    ) -> None:
        found = []
        for _ in range(2):
            apparatus = strategy_bench.apparatus(strategy)
            found.append((strategy_bench.measured(strategy, apparatus, LONG_S, 7), apparatus.spent))
        (answer, spent), (again, _) = found
        errors = strategy_bench.errors_px(answer)
        assert errors.size >= 0.5 * np.count_nonzero(strategy_bench.scored)
        assert np.median(errors) <= strategy.clear_px
        assert spent.time_s <= LONG_S * (1 + 1e-9)
        assert spent.energy_j <= POWER_W * LONG_S * (1 + 1e-6)
        np.testing.assert_array_equal(answer.depth_m, again.depth_m)
        np.testing.assert_array_equal(answer.confidence, again.confidence)

    def test_claims_nothing_without_light(self, strategy: Strategy, strategy_bench: StrategyBench) -> None:
        answer = strategy_bench.measured(strategy, strategy_bench.apparatus(strategy, lit=False), LONG_S, 3)
        assert np.mean(answer.confidence >= SURE) <= self.most_wrong(strategy)

    @pytest.mark.parametrize("time_s", [1e-6, 1e-3, 7.77e-3])
    def test_keeps_its_time_or_says_that_it_is_too_short(
        self, strategy: Strategy, strategy_bench: StrategyBench, time_s: float
    ) -> None:
        apparatus = strategy_bench.apparatus(strategy)
        try:
            strategy_bench.measured(strategy, apparatus, time_s, 1)
        except TooShort:
            assert apparatus.spent.time_s == 0, "before any light is sent"
        else:
            assert 0 < apparatus.spent.time_s <= time_s * (1 + 1e-9)
