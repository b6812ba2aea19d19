"""Accuracy of `joint` beside what is asked of it: one table, over the prepared scenes.

    python -m tests.reference.tables.joint_accuracy --markdown table.md
    python -m tests.reference.tables.joint_accuracy --scenes cones --points report,hot --rows 128 --row-step 2

Errors are in px against the continuous truth, over the stripes on trusted pixels of every `--row-step`-th row; a
missing answer counts as 10 px. `mean` and `worst` are over scenes; each map is estimated by an estimator that knows
nothing before it. Made scenes stand for what prepared ones cannot show: `smooth`, `thin`, `pane` (light of `report`).
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import astuple, dataclass
from typing import Any

import numpy as np

from tests.reference.adapter import reconstructor_of, volume_of
from tests.reference.made_scenes import pane_scene, smooth_scene, thin_scene
from tests.reference.scene import Scene
from tests.reference.tables.answers import Answers, pooled
from tests.reference.tables.asked import Measured, findings
from tests.reference.tables.made_figures import figures_of
from tests.reference.tables.printed import Table, parser_of, scenes_asked
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


@dataclass(frozen=True, slots=True)
class Campaign:
    """Extent of what is measured."""

    scenes: Sequence[Scene]
    estimators: tuple[str, ...]
    seeds: int = 1
    row_step: int = 1
    threads: int = 2

    def measure(self, point: str, exposures: Sequence[int]) -> Iterator[Measured]:
        """Answers of every estimator at one point, scene after scene."""
        kept = slice(None, None, self.row_step)
        for scene in [MADE[point]()] if point in MADE else self.scenes:
            world = WorkingPoint(scene, POINTS.get(point, REPORT))
            for k in exposures:
                gathered: dict[str, list[Answers]] = {name: [] for name in self.estimators}
                tables: dict[str, list[Any]] = {name: [] for name in self.estimators}
                for seed in range(1, max(self.seeds, 2 if point == "smooth" else 1) + 1):
                    counts = None
                    for name in self.estimators:
                        reconstructor = reconstructor_of(world, name, threads=self.threads)
                        if counts is None:
                            geometry = reconstructor.geometry
                            counts = world.counts_in(geometry.x0, geometry.window, k, seed)
                        result = reconstructor.map(volume_of(reconstructor, counts, k))
                        gathered[name].append(Answers.of(world, result, kept))
                        tables[name].append(result.stripe)
                for name, answers in gathered.items():
                    extras = figures_of(point, world, tables[name], k)
                    yield Measured(point, scene.name, k, name, pooled(answers), extras)


SEEN = ("point", "scene", "K", "estimator", "mean px", "median px", "within 1 px", "missing", "bias px", "s")
ASKED = ("what", "K", "estimator", "asked", "mean", "worst", "verdict")


def seen_row(one: Measured) -> list[object]:
    """Cells of what one map gave."""
    a = one.answers
    figures = f"{a.mean_px:.3f}", f"{np.median(a.errors):.3f}", f"{a.within:.4f}", f"{a.missing:.4f}"
    return [one.point, one.scene, one.exposures, one.estimator, *figures, f"{a.bias_px:+.3f}", f"{a.seconds:.2f}"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Print what every map gave as it comes, then everything asked; write the tables where wanted."""
    parser = parser_of("tests.reference.tables.joint_accuracy", __doc__, points=",".join(EXPOSURES))
    parser.add_argument("--exposures", help="comma-separated, instead of those asked for")
    parser.add_argument("--estimators", default=",".join(ESTIMATORS))
    parser.add_argument("--seeds", type=int, default=1, help="maps of each kind")
    parser.add_argument("--row-step", type=int, default=1, help="score every n-th row only")
    parser.add_argument("--rows", type=int, help="middle rows of the prepared scenes (faster, learned from less)")
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args(arguments)
    if unknown := set(options.points.split(",")) - EXPOSURES.keys():
        parser.error(f"points {', '.join(sorted(unknown))} are unknown; choose of {', '.join(EXPOSURES)}")
    estimators = tuple(options.estimators.split(","))
    scenes = scenes_asked(parser, options.scenes, options.rows)
    campaign = Campaign(scenes, estimators, options.seeds, options.row_step, options.threads)
    seen: list[Measured] = []
    table = Table(SEEN)
    for point in options.points.split(","):
        chosen = tuple(map(int, options.exposures.split(","))) if options.exposures else EXPOSURES[point]
        for one in campaign.measure(point, chosen):
            seen.append(one)
            table.add(seen_row(one))
    print()
    asked = Table(ASKED)
    for finding in findings(seen):
        asked.add(astuple(finding))
    if options.markdown:
        options.markdown.write_text(f"{table.text}\n{asked.text}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
