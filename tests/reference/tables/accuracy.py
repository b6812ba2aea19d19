"""Accuracy of every estimator beside the genie, over scenes, working points and exposures.

    python -m tests.reference.tables.accuracy --scenes cones,art --exposures 3,10 --points report --markdown table.md

Stripe error in px over the trusted true stripes (continuous truth, `rounded`: against whole pixels). `ratio` is an
estimator's mean error over the genie's, both without filter. Several seeds are averaged.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.batch.case import Case
from tests.campaigns.studies import add_options, results_of
from tests.reference.adapter import reconstruct
from tests.reference.genie import Genie
from tests.reference.geometry import Geometry
from tests.reference.tables.printed import Table, parser_of, scene_of, scenes_asked
from tests.reference.working_point import POINTS, WorkingPoint, score

ESTIMATORS = ("argmax", "edge", "likelihood")
FILTERS = ("none", "median")
DEFAULT_EXPOSURES = {"report": (1, 3, 10, 20), "dense": (10, 30), "clear": (1, 3, 10)}
RIGS = {
    "rectified": {},
    "turned": {"side": "right", "roll_deg": 3.0, "k1": -0.35, "axis_tilt_z_deg": 2.0, "axis_tilt_x_deg": 3.0},
}
TITLES = (
    "point", "scene", "K", "estimator", "mean abs px", "ratio to genie", "median px", "within 1 px", "missing",
    "rounded px", "s",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Measurement:
    """Estimators and filters to measure on every `row_step`-th row. genies: by name; `genie` is among them."""

    estimators: Sequence[str] = ESTIMATORS
    filters: Sequence[str] = FILTERS
    genies: dict[str, Genie] | None = None
    row_step: int = 1

    def of(
        self, point: WorkingPoint, counts: NDArray[np.unsignedinteger], exposures: int
    ) -> Iterator[tuple[str, str, dict[str, float], float]]:
        """Estimator, filter, figures and seconds of one map of counts (columns, H, W), the genies' first."""
        rows = slice(None, None, self.row_step)
        truth, trusted = point.truth()[rows], point.trusted[rows]
        for name, genie in (self.genies or {}).items():
            begun = time.perf_counter()
            x = genie.estimate(point, counts, exposures, rows)[rows]
            yield name, "none", score(x, truth, trusted), time.perf_counter() - begun
        for estimator in self.estimators:
            results = reconstruct(point, counts, exposures, estimator=estimator, filters=self.filters)
            for filter, result in zip(self.filters, results, strict=True):
                yield estimator, filter, score(result.stripe.x_px[rows], truth, trusted), result.compute_s

    def means(self, point: WorkingPoint, exposures: int, seeds: int) -> Iterator[tuple[str, dict[str, float], float]]:
        """Name, mean figures and seconds of every estimator and filter over maps of so many seeds."""
        gathered: dict[str, list[dict[str, float]]] = {}
        seconds: dict[str, float] = {}
        for seed in range(1, seeds + 1):
            for estimator, filter, figures, took_s in self.of(point, point.counts(exposures, seed), exposures):
                name = named(estimator, filter)
                gathered.setdefault(name, []).append(figures)
                seconds[name] = took_s
        for name, found in gathered.items():
            yield name, {figure: float(np.mean([one[figure] for one in found])) for figure in found[0]}, seconds[name]


def named(estimator: str, filter: str) -> str:
    """An estimator with its filter, in words."""
    return estimator if filter == "none" else f"{estimator} + {filter}"


def one_cell(
    scene: str,
    point: str,
    rig: str,
    exposures: int,
    seeds: int,
    estimators: Sequence[str],
    filters: Sequence[str],
    row_step: int,
) -> dict[str, Any]:
    """A scene at a point with a number of exposures as a case: [name, figures] of every estimator and filter."""
    measurement = Measurement(estimators, filters, {"genie": Genie()}, row_step)
    found = scene_of(scene)
    height, width = found.shape
    geometry = Geometry.build(width=width, height=height, **RIGS[rig])  # type: ignore[arg-type]
    means = list(measurement.means(WorkingPoint(found, POINTS[point], geometry), exposures, seeds))
    figures = [[name, of] for name, of, _ in means]
    return {"figures": figures, "measured": {"estimate_s": [seconds for *_, seconds in means]}}


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table, and write it where asked. 1 where a case failed."""
    parser = parser_of("tests.reference.tables.accuracy", __doc__, points="report,dense,clear")
    parser.add_argument("--exposures", help="comma-separated; default depends on the point")
    parser.add_argument("--seeds", type=int, default=1, help="number of seeds averaged")
    parser.add_argument("--rig", choices=sorted(RIGS), default="rectified")
    parser.add_argument("--estimators", default=",".join(ESTIMATORS))
    parser.add_argument("--filters", default=",".join(FILTERS))
    parser.add_argument("--row-step", type=int, default=1, help="score every n-th row only")
    add_options(parser, workers=1)
    options = parser.parse_args(arguments)
    fixed = {
        "rig": options.rig, "seeds": options.seeds, "row_step": options.row_step,
        "estimators": options.estimators.split(","), "filters": options.filters.split(","),
    }  # fmt: skip
    scenes = scenes_asked(parser, options.scenes)
    cells = [
        {"point": point, "scene": scene, "exposures": int(exposures)}
        for point in options.points.split(",")
        for scene in scenes
        for exposures in (options.exposures.split(",") if options.exposures else DEFAULT_EXPOSURES[point])
    ]
    cases = [Case("tests.reference.tables.accuracy:one_cell", {**each, **fixed}, each) for each in cells]
    results = results_of(cases, options.workers, options.out)
    table = Table(TITLES)
    for each, result in zip(cells, results, strict=True):
        reference = np.nan
        for (name, f), seconds in zip(*_of(result), strict=True):
            if name == "genie":
                reference = f["mean_abs"]
            figures = [f"{f[key]:.3f}" for key in ("median_abs", "within_1px", "missing", "mean_abs_rounded")]
            found = f"{f['mean_abs']:.3f}", f"{f['mean_abs'] / reference:.2f}", *figures, f"{seconds:.2f}"
            table.add([*each.values(), name, *found])
    table.write(options.markdown)
    return int(None in results)


def _of(result: dict[str, Any] | None) -> tuple[list[Any], list[float]]:
    return ([], []) if result is None else (result["figures"], result["measured"]["estimate_s"])


if __name__ == "__main__":
    sys.exit(main())
