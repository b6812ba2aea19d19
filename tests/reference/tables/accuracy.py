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

import numpy as np
from numpy.typing import NDArray

from tests.reference.adapter import reconstruct
from tests.reference.genie import Genie
from tests.reference.geometry import Geometry
from tests.reference.tables.printed import Table, parser_of, scenes_asked
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


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table, and write it where asked."""
    parser = parser_of("tests.reference.tables.accuracy", __doc__, points="report,dense,clear")
    parser.add_argument("--exposures", help="comma-separated; default depends on the point")
    parser.add_argument("--seeds", type=int, default=1, help="number of seeds averaged")
    parser.add_argument("--rig", choices=sorted(RIGS), default="rectified")
    parser.add_argument("--estimators", default=",".join(ESTIMATORS))
    parser.add_argument("--filters", default=",".join(FILTERS))
    parser.add_argument("--row-step", type=int, default=1, help="score every n-th row only")
    options = parser.parse_args(arguments)
    filters = options.filters.split(",")
    measurement = Measurement(options.estimators.split(","), filters, {"genie": Genie()}, options.row_step)
    scenes = scenes_asked(parser, options.scenes)
    table = Table(TITLES)
    for name in options.points.split(","):
        chosen = options.exposures.split(",") if options.exposures else DEFAULT_EXPOSURES[name]
        for scene in scenes:
            height, width = scene.shape
            geometry = Geometry.build(width=width, height=height, **RIGS[options.rig])  # type: ignore[arg-type]
            point = WorkingPoint(scene, POINTS[name], geometry)
            for exposures in map(int, chosen):
                reference = np.nan
                for estimator, f, seconds in measurement.means(point, exposures, options.seeds):
                    if estimator == "genie":
                        reference = f["mean_abs"]
                    figures = [f"{f[key]:.3f}" for key in ("median_abs", "within_1px", "missing", "mean_abs_rounded")]
                    found = f"{f['mean_abs']:.3f}", f"{f['mean_abs'] / reference:.2f}", *figures, f"{seconds:.2f}"
                    table.add([name, scene.name, exposures, estimator, *found])
                table.write(options.markdown)
    return 0


if __name__ == "__main__":
    sys.exit(main())
