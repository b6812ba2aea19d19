"""Accuracy of `joint` beside what is asked of it: one table, over the prepared scenes.

    python -m tests.reference.tables.joint_accuracy --markdown table.md
    python -m tests.reference.tables.joint_accuracy --scenes cones --points report,hot --rows 128 --row-step 2

Errors are in px against the continuous truth, over the stripes on trusted pixels of every `--row-step`-th row; a
missing answer counts as 10 px. `mean` and `worst` are over scenes; each map is estimated by an estimator that knows
nothing before it. Made scenes stand for what prepared ones cannot show: `smooth`, `thin`, `pane` (light of `report`).
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import astuple
from pathlib import Path
from typing import Any

import numpy as np

from rig.batch.case import Case
from tests.campaigns.studies import add_options, results_of
from tests.reference.adapter import reconstructor_of, volume_of
from tests.reference.made_scenes import pane_scene, smooth_scene, thin_scene
from tests.reference.tables.answers import Answers, pooled
from tests.reference.tables.asked import Measured, findings
from tests.reference.tables.made_figures import figures_of
from tests.reference.tables.printed import Table, parser_of, scene_of, scenes_asked
from tests.reference.working_point import POINTS, REPORT, WorkingPoint

ESTIMATORS = ("likelihood", "joint")
MADE = {"smooth": smooth_scene, "thin": lambda: thin_scene()[0], "pane": pane_scene}
EXPOSURES: dict[str, tuple[int, ...]] = {
    "report": (1, 3, 10, 20),
    "dense": (3,),
    "clear": (1,),
    "halo": (5,),
    "halo-less": (5,),
    "hot": (1, 3, 10),
    "smooth": (10, 20, 50),
    "thin": (3,),
    "pane": (10,),
}


def one_map(
    point: str,
    scene: str,
    exposures: int,
    rows: int | None,
    estimators: Sequence[str],
    seeds: int,
    row_step: int,
    threads: int,
    keep: str,
) -> dict[str, Any]:
    """The answers of every estimator in a scene at a point as a case: kept in files, further figures returned."""
    kept = slice(None, None, row_step)
    world = WorkingPoint(MADE[point]() if point in MADE else scene_of(scene, rows), POINTS.get(point, REPORT))
    gathered: dict[str, list[Answers]] = {name: [] for name in estimators}
    tables: dict[str, list[Any]] = {name: [] for name in estimators}
    for seed in range(1, max(seeds, 2 if point == "smooth" else 1) + 1):
        counts = None
        for name in estimators:
            reconstructor = reconstructor_of(world, name, threads=threads)
            if counts is None:
                geometry = reconstructor.geometry
                counts = world.counts_in(geometry.x0, geometry.window, exposures, seed)
            result = reconstructor.map(volume_of(reconstructor, counts, exposures))
            gathered[name].append(Answers.of(world, result, kept))
            tables[name].append(result.stripe)
    Path(keep).mkdir(parents=True)
    for name, answers in gathered.items():
        pooled(answers).save(Path(keep) / f"{name}.npz")
    return {"extras": {name: figures_of(point, world, found, exposures) for name, found in tables.items()}}


def kept_answers(folder: Path) -> dict[str, Answers]:
    """The answers that a case has kept, by estimator."""
    return {file.stem: Answers.load(file) for file in folder.glob("*.npz")}


SEEN = ("point", "scene", "K", "estimator", "mean px", "median px", "within 1 px", "missing", "bias px", "s")
ASKED = ("what", "K", "estimator", "asked", "mean", "worst", "verdict")


def seen_row(one: Measured) -> list[object]:
    """Cells of what one map gave."""
    a = one.answers
    figures = f"{a.mean_px:.3f}", f"{np.median(a.errors):.3f}", f"{a.within:.4f}", f"{a.missing:.4f}"
    return [one.point, one.scene, one.exposures, one.estimator, *figures, f"{a.bias_px:+.3f}", f"{a.seconds:.2f}"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Print what every map gave, then everything asked; write the tables where wanted. 1 where a map failed."""
    parser = parser_of("tests.reference.tables.joint_accuracy", __doc__, points=",".join(EXPOSURES))
    parser.add_argument("--exposures", help="comma-separated, instead of those asked for")
    parser.add_argument("--estimators", default=",".join(ESTIMATORS))
    parser.add_argument("--seeds", type=int, default=1, help="maps of each kind")
    parser.add_argument("--row-step", type=int, default=1, help="score every n-th row only")
    parser.add_argument("--rows", type=int, help="middle rows of the prepared scenes (faster, learned from less)")
    parser.add_argument("--threads", type=int, default=2)
    add_options(parser, workers=1)
    options = parser.parse_args(arguments)
    if unknown := set(options.points.split(",")) - EXPOSURES.keys():
        parser.error(f"points {', '.join(sorted(unknown))} are unknown; choose of {', '.join(EXPOSURES)}")
    estimators, scenes = options.estimators.split(","), scenes_asked(parser, options.scenes)
    fixed = {
        "rows": options.rows, "estimators": estimators, "seeds": options.seeds, "row_step": options.row_step,
        "threads": options.threads,
    }  # fmt: skip
    maps = [
        {"point": point, "scene": scene, "exposures": int(exposures)}
        for point in options.points.split(",")
        for scene in ([point] if point in MADE else scenes)
        for exposures in (options.exposures.split(",") if options.exposures else EXPOSURES[point])
    ]
    cases = [Case("tests.reference.tables.joint_accuracy:one_map", {**one, **fixed}, one, keeps=True) for one in maps]
    results = results_of(cases, options.workers, options.out, kept_answers)
    seen = [
        Measured(*one.values(), name, result["kept"][name], _numbers(result["extras"][name]))
        for one, result in zip(maps, results, strict=True)
        if result is not None
        for name in estimators
    ]
    table = Table(SEEN)
    for each in seen:
        table.add(seen_row(each))
    print()
    asked = Table(ASKED)
    for finding in findings(seen):
        asked.add(astuple(finding))
    if options.markdown:
        options.markdown.write_text(f"{table.text}\n{asked.text}")
    return int(None in results)


def _numbers(extras: dict[str, float | None]) -> dict[str, float]:
    """Figures as they were before they were written: None is NaN."""
    return {name: np.nan if value is None else value for name, value in extras.items()}


if __name__ == "__main__":
    sys.exit(main())
