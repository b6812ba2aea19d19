"""Share of the fog meter's error bars that hold the truth: runs over scenes, extinctions, hazes, ambient light and K.

    python -m tests.reference.tables.fog_coverage --runs 40

Each run is a small sensor of its own, estimated from its counts alone. Prints a line a run and the shares at the end.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from rig.batch.case import Case
from rig.depth.fog_meter import VISIBILITY_CONTRAST
from tests.campaigns.studies import add_options, results_of
from tests.reference import kernels
from tests.reference.adapter import reconstruct
from tests.reference.geometry import Geometry
from tests.reference.scene import Scene
from tests.reference.tables.printed import scene_of, scenes_asked
from tests.reference.working_point import Light, WorkingPoint

SENSORS = ((64, 128), (128, 250), (96, 160), (48, 96))
"""Rows and columns."""
EXPOSURES = (2, 3, 5, 10, 20)
FIGURES = ("extinction_per_m", "visibility_m", "ambient_per_exposure", "veil_per_exposure")
SD_OF_95 = 1.96
"""Standard deviations to either side that hold 95 % of a normal distribution."""


@dataclass(frozen=True, slots=True)
class Reading:
    """One figure of a run: truth, and what was read; None where it was not resolved."""

    truth: float
    value: float | None
    sd: float | None

    @property
    def pull(self) -> float | None:
        """Error in standard deviations."""
        return None if self.value is None or self.sd is None else (self.value - self.truth) / self.sd


def lights(seed: int) -> Iterator[tuple[Light, int]]:
    """Working points without end, and exposures for them."""
    rng = np.random.default_rng(seed)

    def between(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    while True:
        light = Light(haze=between(0.05, 0.4), ambient=between(0.003, 0.05), extinction_per_m=between(0.02, 0.4))
        yield light, int(rng.choice(EXPOSURES))


def veil(point: WorkingPoint, seen: np.ndarray) -> float:
    """Mean haze just before the stripes that are `seen` (H, columns)."""
    g, total = point.geometry, []
    for y, c in np.argwhere(seen & np.isfinite(point.x_true)):
        x = round(float(point.x_true[y, c]))
        inverse = (g.planes[c, :3] @ [g.u[y, x], g.v[y, x], 1.0]) / g.planes[c, 3]
        extinction = point.light.extinction_per_m
        total.append(point.haze_scale * kernels.haze_at(g.u[y, x], g.v[y, x], inverse, g.scanner_m, extinction))
    return float(np.mean(total)) if total else float("nan")


def sd_of(name: str) -> str:
    """Name of a figure's standard deviation in a reading: extinction_sd_per_m, visibility_sd_m."""
    quantity, unit = name.split("_", 1)
    return f"{quantity}_sd_{unit}"


def run(scene: Scene, light: Light, exposures: int, sensor: tuple[int, int], seed: int) -> dict[str, Reading]:
    """The readings of one map."""
    rows, columns = sensor
    part = scene.crop(rows, scene.shape[1])
    point = WorkingPoint(part, light, Geometry.build(width=scene.shape[1], height=rows, columns=columns))
    (result,) = reconstruct(point, point.counts(exposures, seed), exposures)
    thin = VISIBILITY_CONTRAST / light.extinction_per_m
    truths = (light.extinction_per_m, thin, light.ambient, veil(point, result.stripe.confidence > 0.85))
    return {
        name: Reading(truth, getattr(result.fog, name), getattr(result.fog, sd_of(name)))
        for name, truth in zip(FIGURES, truths, strict=True)
    }


def one_run(
    scene: str, light: dict[str, Any], exposures: int, sensor: Sequence[int], seed: int
) -> dict[str, dict[str, float | None]]:
    """The readings of one map as a case."""
    found = run(scene_of(scene), Light(**light), exposures, (sensor[0], sensor[1]), seed)
    return {name: asdict(reading) for name, reading in found.items()}


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.reference.tables.fog_coverage", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--runs", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    add_options(parser)
    options = parser.parse_args(arguments)
    scenes = scenes_asked(parser, None)
    runs = [
        {"scene": scenes[i % len(scenes)], "light": asdict(light), "exposures": exposures,
         "sensor": SENSORS[i % len(SENSORS)], "seed": 1000 * options.seed + i}
        for i, (light, exposures) in zip(range(options.runs), lights(options.seed), strict=False)
    ]  # fmt: skip
    cases = [Case("tests.reference.tables.fog_coverage:one_run", each, {"seed": each["seed"]}) for each in runs]
    results = results_of(cases, options.workers, options.out)
    pulls: dict[str, list[float]] = {name: [] for name in FIGURES}
    for i, (each, result) in enumerate(zip(runs, results, strict=True)):
        if result is None:
            continue
        found = {name: Reading(**result[name]) for name in FIGURES}
        shown = [f"{i} {each['scene']} {each['sensor'][0]} x {each['sensor'][1]} K = {each['exposures']}"]
        for name, reading in found.items():
            if reading.pull is None:
                shown.append(f"{name} {reading.truth:.4f}: not resolved")
            else:
                pulls[name].append(reading.pull)
                shown.append(f"{name} {reading.truth:.4f}: {reading.value:.4f} +- {reading.sd:.4f}")
        print("; ".join(shown), flush=True)
    for name, of_figure in pulls.items():
        size = np.abs(of_figure)
        print(
            f"{name}: {len(of_figure)} of {options.runs} resolved, {np.mean(size <= 1):.0%} within 1 sd, "
            f"{np.mean(size <= SD_OF_95):.0%} in 95 %, mean pull {np.mean(of_figure):+.2f}"
        )
    return int(None in results)


if __name__ == "__main__":
    raise SystemExit(main())
