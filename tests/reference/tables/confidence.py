"""What the confidence of an estimator is worth, also where there is no stripe.

    python -m tests.reference.tables.confidence --scenes art,cones,random-200 --points report-10,dense-3,turned-10

A point is the name of a working point, or `turned` for `report` seen by the turned rig, and the number of exposures. A
line pools all scenes. Errors are over stripes on trusted pixels, a missing answer as 10 px. All else is over those and
the places without a stripe, where every answer is wrong: calibration error, the largest of the scenes' own, share of
the places without a stripe that have a confidence above 0.5, share of the answers with 0.9 and more, how many of these
are right, and share of the right answers that a depth map takes (0.5).
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import numpy as np

from tests.reference.adapter import reconstructor_of, volume_of
from tests.reference.geometry import Geometry
from tests.reference.tables.accuracy import RIGS
from tests.reference.tables.answers import Answers, calibration_error, pooled, reliability
from tests.reference.tables.printed import Table, parser_of, scenes_asked
from tests.reference.working_point import POINTS, REPORT, WorkingPoint

SURE, TAKEN = 0.9, 0.5
TITLES = (
    "point", "K", "estimator", "mean px", "missing", "calibration error", "largest", "empty believed", "sure",
    "of them right", "right taken", "claimed less right, by tenths",
)  # fmt: skip


def answers_of(world: WorkingPoint, exposures: int, estimator: str, seed: int) -> Answers:
    """The answers of one map."""
    maker = reconstructor_of(world, estimator)
    counts = world.counts_in(maker.geometry.x0, maker.geometry.window, exposures, seed)
    return Answers.of(world, maker.map(volume_of(maker, counts, exposures)), slice(None))


def cells_of(scenes: Sequence[Answers]) -> list[str]:
    """The cells of a line, of the answers in its scenes."""
    together = pooled(scenes)
    confidence, right = together.claims(empty=True)
    sure, empty = confidence >= SURE, together.confidence[~together.lit]
    tenths = reliability(confidence, right)
    return [
        f"{together.mean_px:.3f}", f"{together.missing:.4f}", f"{calibration_error(confidence, right):.3f}",
        f"{max(calibration_error(*one.claims(empty=True)) for one in scenes):.3f}",
        f"{(empty > TAKEN).mean():.3f}", f"{sure.mean():.2f}", f"{right[sure].mean() if sure.any() else np.nan:.3f}",
        f"{(confidence[right] > TAKEN).mean():.3f}",
        " ".join(f"{100 * (claimed - found):+.0f}" for _, claimed, found in tenths),
    ]  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> int:
    """A line for each point and estimator."""
    parser = parser_of(
        "tests.reference.tables.confidence", __doc__,
        points="report-1,report-3,report-10,dense-3,dense-10,clear-1,clear-3,uneven-10,turned-10",
    )  # fmt: skip
    parser.add_argument("--estimators", default="likelihood,joint")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args(arguments)
    scenes = scenes_asked(parser, options.scenes)
    table = Table(TITLES)
    for asked in options.points.split(","):
        point, exposures = asked.rsplit("-", 1)
        for estimator in options.estimators.split(","):
            seen = []
            for scene in scenes:
                height, width = scene.shape
                geometry = Geometry.build(width=width, height=height, **RIGS.get(point, {}))  # type: ignore[arg-type]
                world = WorkingPoint(scene, POINTS.get(point, REPORT), geometry)
                seen.append(answers_of(world, int(exposures), estimator, options.seed))
            table.add([point, exposures, estimator, *cells_of(seen)])
    table.write(options.markdown)
    return 0


if __name__ == "__main__":
    sys.exit(main())
