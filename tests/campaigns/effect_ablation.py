"""The planned effects against the full model: difference of the stripe error, and time that it saves.

    python -m tests.campaigns.effect_ablation --seeds 5

Five scenes, each scanned with every effect that it calls for and with the planner's choice, the same random numbers in
both. Air is never quite clear, and the sensor has a little of everything that its kind is known for, so that there is
something to leave out. Costs are those that the full model's effects were measured to have. Errors are charged: at
most 10 px, a missing answer 10 px. Wrong: a difference above the planner's bound, which is 10 px for every decision
that may change.
"""

import argparse
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, stdev
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import yaml

from rig import api
from rig.batch.case import Case
from rig.config.models import RigConfig
from rig.geometry.stripe_table import MISSING_PX, charged_errors
from tests.campaigns.studies import add_options, results_of
from tests.reference.tables.printed import Table

AIR = {"medium": {"fog": {"visibility": "300 km"}}}
"""Molecules alone."""
LAMPS = {"ambient": {"illuminance": "5 lux"}}
SCENES: dict[str, dict[str, Any]] = {
    "clear room": {"medium": {"fog": {"visibility": "50 km"}}, "ambient": {"illuminance": "100 lux"}},
    "light fog": {"medium": {"fog": {"visibility": "300 m"}}, **LAMPS},
    "dense fog": {"medium": {"fog": {"visibility": "15 m"}}, **LAMPS},
    "rain": {**AIR, "rain": {"rate": "20 mm/h"}, **LAMPS},
    "snow": {**AIR, "snow": {"rate": "2 mm/h"}, **LAMPS},
}
SENSOR = {
    "dark_rate": "20 cps",
    "hot_share": "0.1 %",
    "dead_share": "0.1 %",
    "crosstalk": "0.1 %",
    "afterpulsing": "0.1 %",
    "dead_time": "50 ns",
    "bit_error_rate": "1e-4 ppm",
}


@dataclass(frozen=True, slots=True)
class Ablation:
    """One scene. left_out: effects; bound_px: the planner's; difference_px: mean charged error of the full model less
    the plan's, of each seed; *_us: what all effects cost per frame.
    """

    scene: str
    left_out: tuple[str, ...]
    bound_px: float
    difference_px: tuple[float, ...]
    full_us: float
    planned_us: float

    @property
    def within(self) -> bool:
        """Whether the bound holds."""
        return abs(fmean(self.difference_px)) <= self.bound_px

    def cells(self) -> tuple[str, ...]:
        """A row of the table."""
        sd = stdev(self.difference_px) / len(self.difference_px) ** 0.5 if len(self.difference_px) > 1 else 0.0
        difference = f"{fmean(self.difference_px):+.5f} +- {sd:.5f}"
        left_out, saved = ", ".join(self.left_out) or "nothing", f"{1 - self.planned_us / self.full_us:.1%}"
        return self.scene, left_out, f"{self.bound_px:.2g}", difference, saved


TITLES = ("scene", "left out", "bound, px", "difference of the mean error, px", "time saved")


def ablations(
    config: RigConfig, folder: Path, seeds: Sequence[int], names: Iterable[str] = SCENES
) -> Iterator[Ablation]:
    """The scenes of these names one by one; folder: for their files."""
    for name in names:
        file = folder / f"{name.replace(' ', '-')}.yaml"
        file.write_text(yaml.safe_dump({"surfaces": "street", **SCENES[name]}))
        yield _ablation(name, api.configure(config, scene=str(file)), seeds)


def _ablation(name: str, config: RigConfig, seeds: Sequence[int]) -> Ablation:
    assert config.world is not None
    content, sensor = config.model_dump(mode="json"), {"sensor": SENSOR, "line": {"speckle": True}}
    planned, full = (
        api.configure(RigConfig.model_validate(content | {"world": content["world"] | sensor | {"effects": wanted}}))
        for wanted in ("planned", "all")
    )
    plan, whole = (api.effects(one, trials=False) for one in (planned, full))
    on = {effect.effect for effect in plan if effect.on}
    costs = {effect.effect: effect.cost_us_per_frame or 0.0 for effect in whole}
    return Ablation(
        scene=name,
        left_out=tuple(effect.effect for effect in whole if effect.on and effect.effect not in on),
        bound_px=MISSING_PX * plan.changed_decisions_bound,
        difference_px=tuple(_error_px(full, seed) - _error_px(planned, seed) for seed in seeds),
        full_us=sum(costs.values()),
        planned_us=sum(cost for effect, cost in costs.items() if effect in on),
    )


def _error_px(config: RigConfig, seed: int) -> float:
    result = api.scan(config, seed=seed)
    assert result.last is not None
    assert result.truth is not None
    return float(np.nanmean(charged_errors(result.last.stripe.x_px, result.truth.x_px)))


def one_scene(scene: str, columns: int, seeds: int) -> dict[str, Any]:
    """A scene as a case: the line of the table, and whether the bound holds."""
    config = api.configure()
    config = config.model_copy(update={"scan": config.scan.model_copy(update={"columns": columns})})
    with TemporaryDirectory() as folder:
        (ablation,) = ablations(config, Path(folder), range(seeds), [scene])
    return {"within": ablation.within, "measured": {"cells": ablation.cells()}}


def main() -> int:
    """The table; 1 where a bound does not hold."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--columns", type=int, default=500)
    add_options(parser)
    asked = parser.parse_args()
    cases = [
        Case("tests.campaigns.effect_ablation:one_scene", {"scene": scene, "columns": asked.columns,
             "seeds": asked.seeds}, {"scene": scene})
        for scene in SCENES
    ]  # fmt: skip
    results = results_of(cases, asked.workers, asked.out)
    table = Table(TITLES)
    for result in results:
        if result is not None:
            table.add(result["measured"]["cells"])
    return int(any(result is None or not result["within"] for result in results))


if __name__ == "__main__":
    sys.exit(main())
