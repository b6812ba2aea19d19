"""How often a right map is doubted, and a wrong one: scenes, lights, rigs and exposures drawn by chance.

    python -m tests.campaigns.map_checks --maps 120
    python -m tests.campaigns.map_checks --maps 12 --estimator joint --seed 1
    python -m tests.campaigns.map_checks --maps 12 --estimator likelihood --stream

Each map is 64 rows of a scene (prepared, made or random) under a working point, 250 columns. It is judged as it is and
with each fault of FAULTS. With `argmax` the checks of counts are asked alone; an estimator that knows its confidence is
asked for its answers too, and what is `right` says how many of the sure ones are. With --stream the checks get what
is kept of a sweep that is judged as its frames come: the lines of 512 points.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from rig.batch.case import Case
from rig.count.map_checks import SURE, MapChecks, check_points
from rig.estimate.registry import LEARNING
from tests.campaigns.studies import add_options, results_of
from tests.reference.adapter import reconstructor_of, volume_of, windowed
from tests.reference.geometry import Geometry
from tests.reference.made_scenes import pane_scene, random_scene, thin_scene
from tests.reference.scene import Scene, load_scene, scene_names
from tests.reference.tables.printed import Table
from tests.reference.working_point import POINTS, WorkingPoint
from tests.unit.rig.count import test_map_checks as faults

ROWS, COLUMNS = 64, 250
RIGS: dict[str, dict[str, Any]] = {
    "left": {},
    "right": {"side": "right"},
    "turned": {"side": "right", "roll_deg": 3.0, "k1": -0.35, "axis_tilt_z_deg": 2.0, "axis_tilt_x_deg": 3.0},
    "narrow": {},  # a third of the others' sweep, as finely
}
EXPOSURES = (1, 3, 10, 20)
FAULTS: dict[str, faults.Change] = {
    "bits of bytes reversed": faults.least_significant_first,
    "exposures before columns": faults.exposures_first,
    "columns reversed": faults.reversed_,
    "columns shuffled": faults.shuffled,
    "planes of half the angle": faults.half_the_angle,
    "picture mirrored": lambda counts, exposures, rng: counts[:, :, ::-1],
    "noise alone": faults.noise,
    "all zero": faults.dark,
    "all one": faults.full,
}


def _scene(rng: np.random.Generator) -> Scene:
    """Some rows of a scene."""
    prepared = [scene for name in scene_names() if (scene := load_scene(name)) is not None]
    fixed = [*prepared, thin_scene()[0], pane_scene()]
    pick = int(rng.integers(2 * len(fixed)))
    whole = fixed[pick] if pick < len(fixed) else random_scene(int(rng.integers(400, 500)))
    first = int(rng.integers(0, whole.shape[0] - ROWS))
    return whole.part(slice(first, first + ROWS))


def one_map(seed: int, estimator: str, exposures: int, stream: bool) -> dict[str, Any]:
    """A map as a case: what it is, what speaks against it and its faulty kin, how much of what is sure is right."""
    rng = np.random.default_rng([seed, 79])
    light, rig, scene = str(rng.choice(list(POINTS))), str(rng.choice(list(RIGS))), _scene(rng)
    geometry = Geometry.build(width=512, height=ROWS, columns=COLUMNS, **RIGS[rig])
    if rig == "narrow":
        planes = Geometry.build(width=512, height=ROWS, columns=3 * COLUMNS).planes
        geometry = replace(geometry, planes=planes[COLUMNS : 2 * COLUMNS])
    point = WorkingPoint(scene, POINTS[light], geometry)
    counts = point.counts(exposures, seed)
    doubts: dict[str, tuple[str, ...]] = {}
    right = np.nan
    for fault, change in {"none": None, **FAULTS}.items():
        if fault == "exposures before columns" and exposures == 1:
            continue  # the same frames
        if change is None or estimator in LEARNING:
            maker = reconstructor_of(point, estimator)
        seen = counts if change is None else change(counts, exposures, rng)
        part = windowed(seen, maker.geometry.x0, maker.geometry.window)
        volume = volume_of(maker, part, exposures)
        result = maker.map(volume)
        doubts[fault] = result.doubts
        if stream:
            points = check_points(maker.geometry)
            kept = SimpleNamespace(n_frames=volume.n_frames, checked=volume.counts[points.column, points.row])
            checks = MapChecks(maker.geometry, calibrated=True, knows=estimator in LEARNING)
            doubts[fault], _ = checks.check(kept, volume.intensity(), result.stripe)
        if change is None:
            sure = result.stripe.confidence >= SURE
            error = np.abs(result.stripe.x_px - point.truth())
            right = float(np.mean(error[sure] <= 1)) if sure.any() else np.nan
    return {"what": f"{scene.name}, {light}, K = {exposures}, {rig}, seed {seed}", "doubts": doubts, "right": right}


def main(arguments: Sequence[str] | None = None) -> int:
    """Draw the maps and print the table; 1 where a right map was doubted, or a case failed."""
    parser = argparse.ArgumentParser(description="right and wrong maps against the checks of map_checks")
    parser.add_argument("--maps", type=int, default=120)
    parser.add_argument("--estimator", default="argmax")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--stream", action="store_true", help="judge by the lines that a stream keeps")
    add_options(parser)
    asked = parser.parse_args(arguments)
    maps: defaultdict[str, Counter[int]] = defaultdict(Counter)
    found: defaultdict[str, Counter[int]] = defaultdict(Counter)
    maps_asked = [
        {"seed": asked.seed * 100_000 + index, "estimator": asked.estimator, "stream": asked.stream,
         "exposures": EXPOSURES[index % len(EXPOSURES)]}
        for index in range(asked.maps)
    ]  # fmt: skip
    cases = [Case("tests.campaigns.map_checks:one_map", each, {"seed": each["seed"]}) for each in maps_asked]
    results = results_of(cases, asked.workers, asked.out)
    for each, result in zip(maps_asked, results, strict=True):
        if result is None:
            continue
        for fault in [fault for fault in ("none", *FAULTS) if fault in result["doubts"]]:
            reasons = result["doubts"][fault]
            maps[fault][each["exposures"]] += 1
            found[fault][each["exposures"]] += bool(reasons)
        if result["doubts"]["none"]:
            reason = result["doubts"]["none"][0]
            print(f"doubted: {result['what']}, {result['right']} of the sure answers right: {reason}", flush=True)
    table = Table(("fault", *(f"K = {k}" for k in EXPOSURES)))
    for fault, of in maps.items():
        table.add((fault, *(f"{found[fault][k]} of {of[k]}" for k in EXPOSURES)))
    return int(sum(found["none"].values()) > 0 or None in results)


if __name__ == "__main__":
    sys.exit(main())
