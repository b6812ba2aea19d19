"""Accuracy of every estimator beside the genie, over scenes, working points and exposures.

    python -m tests.reference.tables.accuracy --scenes cones,art --exposures 3,10 --points report --markdown table.md

Stripe error in px over the trusted true stripes (continuous truth, `rounded`: against whole pixels). `ratio` is an
estimator's mean error over the genie's, both without filter. Several seeds are averaged.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tests.reference.adapter import reconstruct
from tests.reference.genie import Genie
from tests.reference.geometry import Geometry
from tests.reference.scene import Scene, load_scene, procedural_scene, scene_names
from tests.reference.working_point import POINTS, WorkingPoint, score

ESTIMATORS = ("argmax", "edge", "likelihood")
FILTERS = ("none", "median")
FINE_GENIE = Genie(labels=4, mean_reach=8, profile_reach=3)
DEFAULT_EXPOSURES = {"report": (1, 3, 10, 20), "dense": (10, 30), "clear": (1, 3, 10)}
RIGS = {
    "rectified": {},
    "turned": {"side": "right", "roll_deg": 3.0, "k1": -0.35, "axis_tilt_z_deg": 2.0, "axis_tilt_x_deg": 3.0},
}
FIGURES = ("mean_abs", "median_abs", "within_1px", "missing", "mean_abs_rounded", "mean_abs_charged")


@dataclass(frozen=True, slots=True)
class Line:
    """One row of the table: figures of one estimator on one scene, point and number of exposures."""

    point: str
    scene: str
    exposures: int
    estimator: str
    figures: dict[str, float]
    ratio: float
    seconds: float


def measure(
    scene: Scene,
    point_name: str,
    exposures: int,
    *,
    seeds: Sequence[int] = (1,),
    rig: str = "rectified",
    row_step: int = 1,
    estimators: Sequence[str] = ESTIMATORS,
    filters: Sequence[str] = FILTERS,
    cosine: bool = False,
    fine: bool = False,
    columns: int = 500,
) -> Iterator[Line]:
    """Lines of the genie, then of every estimator; `row_step` thins the rows that are scored (and the genie's work)."""
    height, width = scene.shape
    geometry = Geometry.build(width=width, height=height, columns=columns, **RIGS[rig])  # type: ignore[arg-type]
    point = WorkingPoint(scene, replace(POINTS[point_name], cosine=cosine), geometry)
    rows = slice(None, None, row_step)
    truth, trusted = point.truth()[rows], point.trusted[rows]
    gathered: dict[str, list[dict[str, float]]] = {}
    seconds: dict[str, float] = {}
    for seed in seeds:
        counts = point.counts(exposures, seed)
        genies = {"genie": Genie(), **({"genie (quarter px)": FINE_GENIE} if fine else {})}
        for name, genie in genies.items():
            begun = time.perf_counter()
            x = genie.estimate(point, counts, exposures, rows)[rows]
            seconds[name] = time.perf_counter() - begun
            gathered.setdefault(name, []).append(score(x, truth, trusted))
        for estimator in estimators:
            for filtered in filters:
                name = estimator if filtered == "none" else f"{estimator} + {filtered}"
                result = reconstruct(point, counts, exposures, estimator=estimator, filter=filtered)
                seconds[name] = result.compute_s
                gathered.setdefault(name, []).append(score(result.stripe.x_px[rows], truth, trusted))
    reference = float(np.mean([one["mean_abs"] for one in gathered["genie"]]))
    for name, scores in gathered.items():
        figures = {figure: float(np.mean([one[figure] for one in scores])) for figure in FIGURES}
        yield Line(point_name, scene.name, exposures, name, figures, figures["mean_abs"] / reference, seconds[name])


TITLES = (
    "point", "scene", "K", "estimator", "mean abs px", "ratio to genie", "median px", "within 1 px", "missing",
    "rounded px", "s",
)  # fmt: skip
HEADER = "| " + " | ".join(TITLES) + " |\n" + "|---" * len(TITLES) + "|\n"


def as_markdown(line: Line) -> str:
    """One table row."""
    f = line.figures
    return (
        f"| {line.point} | {line.scene} | {line.exposures} | {line.estimator} | {f['mean_abs']:.3f} | {line.ratio:.2f} "
        f"| {f['median_abs']:.3f} | {f['within_1px']:.3f} | {f['missing']:.3f} | {f['mean_abs_rounded']:.3f} "
        f"| {line.seconds:.2f} |\n"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table, and write it where asked."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.reference.tables.accuracy", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--scenes", help="comma-separated; 'procedural' is the built-in one; default: all prepared")
    parser.add_argument("--exposures", help="comma-separated; default depends on the point")
    parser.add_argument("--points", default="report,dense,clear", help=f"of {', '.join(POINTS)}")
    parser.add_argument("--seeds", type=int, default=1, help="number of seeds averaged")
    parser.add_argument("--rig", choices=sorted(RIGS), default="rectified")
    parser.add_argument("--estimators", default=",".join(ESTIMATORS))
    parser.add_argument("--filters", default=",".join(FILTERS))
    parser.add_argument("--row-step", type=int, default=1, help="score every n-th row only")
    parser.add_argument("--cosine", action="store_true", help="stripe with the cosine of the camera's side")
    parser.add_argument("--fine", action="store_true", help="also a genie with quarter-pixel labels")
    parser.add_argument("--markdown", type=Path, help="file for the table")
    options = parser.parse_args(arguments)
    names = options.scenes.split(",") if options.scenes else list(scene_names()) or ["procedural"]
    table = [HEADER]
    print(HEADER, end="")
    for point in options.points.split(","):
        chosen = options.exposures.split(",") if options.exposures else DEFAULT_EXPOSURES[point]
        for name in names:
            scene = procedural_scene() if name == "procedural" else load_scene(name)
            if scene is None:
                parser.error(f"scene {name!r} is absent; present: {', '.join([*scene_names(), 'procedural'])}")
            for exposures in map(int, chosen):
                for line in measure(
                    scene, point, exposures, seeds=range(1, options.seeds + 1), rig=options.rig,
                    row_step=options.row_step, estimators=[e for e in options.estimators.split(",") if e],
                    filters=options.filters.split(","), cosine=options.cosine, fine=options.fine,
                ):  # fmt: skip
                    table.append(as_markdown(line))
                    print(table[-1], end="", flush=True)
                if options.markdown:
                    options.markdown.write_text("".join(table))
    return 0


if __name__ == "__main__":
    sys.exit(main())
