"""What is asked of the accuracy of `joint`, and what it gives: one table, over the prepared scenes.

    python -m tests.reference.tables.joint_accuracy --markdown table.md
    python -m tests.reference.tables.joint_accuracy --scenes cones --points report,hot --rows 128 --row-step 2

Errors are in px against the continuous truth, over the stripes on trusted pixels of every `--row-step`-th row; a
missing answer counts as 10 px. `mean` and `worst` are over scenes; each map is estimated by an estimator that knows
nothing before it. Made scenes stand for what prepared ones cannot show: `smooth`, `thin`, `pane` (light of `report`).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tests.reference.adapter import reconstructor_of, volume_of
from tests.reference.made_scenes import pane_scene, smooth_scene, thin_scene
from tests.reference.random_scenes import random_scene
from tests.reference.scene import Scene, load_scene, procedural_scene, scene_names
from tests.reference.tables.answers import Answers, pooled
from tests.reference.tables.asked import Finding, Measured, findings
from tests.reference.tables.made_figures import figures_of
from tests.reference.working_point import POINTS, REPORT, WorkingPoint

ESTIMATORS = ("likelihood", "joint")
MADE = {"smooth": smooth_scene, "pane": pane_scene}
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
    """How much is measured. rows: middle rows of each prepared scene, None for all."""

    scenes: tuple[str, ...]
    estimators: tuple[str, ...]
    seeds: int = 1
    row_step: int = 1
    rows: int | None = None
    threads: int = 2

    def scenes_of(self, point: str) -> Iterator[Scene]:
        """Scenes that a point is measured on."""
        if point in MADE:
            yield MADE[point]()
        elif point == "thin":
            yield thin_scene()[0]
        else:
            for name in self.scenes:
                scene = _scene(name)
                if scene is None:
                    raise SystemExit(f"scene {name!r} is absent; present: {', '.join([*scene_names(), 'procedural'])}")
                yield scene if self.rows is None else scene.crop(self.rows, scene.shape[1])

    def measure(self, point: str, exposures: Sequence[int]) -> Iterator[Measured]:
        """Answers of every estimator at one point, scene after scene."""
        kept = slice(None, None, self.row_step)
        for scene in self.scenes_of(point):
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


def _scene(name: str) -> Scene | None:
    if name.startswith("random-"):
        return random_scene(int(name.removeprefix("random-")))
    return procedural_scene() if name == "procedural" else load_scene(name)


def as_row(cells: Sequence[object]) -> str:
    """One row of a markdown table."""
    return "| " + " | ".join(map(str, cells)) + " |\n"


def head(titles: Sequence[str]) -> str:
    """Title rows of a markdown table."""
    return as_row(titles) + "|---" * len(titles) + "|\n"


SEEN = ("point", "scene", "K", "estimator", "mean px", "median px", "within 1 px", "missing", "bias px", "s")
ASKED = ("what", "K", "estimator", "asked", "mean", "worst", "verdict")


def seen_row(one: Measured) -> str:
    """What one map gave."""
    a = one.answers
    figures = (
        f"{a.mean_px:.3f}",
        f"{np.median(a.errors):.3f}",
        f"{a.within:.4f}",
        f"{a.missing:.4f}",
        f"{a.bias_px:+.3f}",
    )
    return as_row([one.point, one.scene, one.exposures, one.estimator, *figures, f"{a.seconds:.2f}"])


def asked_row(one: Finding) -> str:
    """One figure beside what was asked."""
    return as_row([one.what, one.exposures, one.estimator, one.asked, one.mean, one.worst, one.verdict])


def main(arguments: Sequence[str] | None = None) -> int:
    """Print what every map gave as it comes, then everything asked; write the tables where wanted."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.reference.tables.joint_accuracy", description=__doc__.splitlines()[0]
    )
    parser.add_argument(
        "--scenes", help="comma-separated; 'procedural', 'random-NUMBER': built in; default: all prepared"
    )
    parser.add_argument("--points", default=",".join(EXPOSURES), help=f"of {', '.join(EXPOSURES)}")
    parser.add_argument("--exposures", help="comma-separated, instead of those asked for")
    parser.add_argument("--estimators", default=",".join(ESTIMATORS))
    parser.add_argument("--seeds", type=int, default=1, help="maps of each kind")
    parser.add_argument("--row-step", type=int, default=1, help="score every n-th row only")
    parser.add_argument("--rows", type=int, help="middle rows of the prepared scenes (faster, learned from less)")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--markdown", type=Path, help="file for the tables")
    options = parser.parse_args(arguments)
    names = tuple(options.scenes.split(",")) if options.scenes else scene_names() or ("procedural",)
    estimators = tuple(options.estimators.split(","))
    campaign = Campaign(names, estimators, options.seeds, options.row_step, options.rows, options.threads)
    seen: list[Measured] = []
    text = head(SEEN)
    print(text, end="")
    for point in options.points.split(","):
        if point not in EXPOSURES:
            parser.error(f"point {point!r} is unknown; choose of {', '.join(EXPOSURES)}")
        chosen = tuple(map(int, options.exposures.split(","))) if options.exposures else EXPOSURES[point]
        for one in campaign.measure(point, chosen):
            seen.append(one)
            text += seen_row(one)
            print(seen_row(one), end="", flush=True)
    summary = "\n" + head(ASKED) + "".join(map(asked_row, findings(seen)))
    print(summary, end="")
    if options.markdown:
        options.markdown.write_text(text + summary)
    return 0


if __name__ == "__main__":
    sys.exit(main())
