"""What the confidence of an estimator is worth, also where there is no stripe.

    python -m tests.reference.tables.confidence --scenes art,cones,random-200 --points report-10,dense-3,turned-10

A point is the name of a working point, or `turned` for `report` seen by the turned rig, and the number of exposures. A
line pools all scenes. Errors are over stripes on trusted pixels, a missing answer as 10 px. All else is over those and
the places without a stripe, where every answer is wrong: calibration error, the largest of the scenes' own, share of
the places without a stripe that have a confidence above 0.5, share of the answers with 0.9 and more, how many of these
are right, and share of the right answers that a depth map takes (0.5). `floating`: of 100 000 answers that a depth map
takes, those between two surfaces: true stripes up to 5 rows and columns away lie nearer and farther, and none within
1.5 px. `points`: the same of the points of the depth map, by the true depth on the camera's pixels, before the points
whose neighbours say that they float are left out; `left`: of those that stay; `right lost`: of 100 000 points that are
right, those left out.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.batch.case import Case
from tests.campaigns.studies import add_options, results_of
from tests.reference.adapter import depth_with_floating, filtered_maps, reconstructor_of, volume_of
from tests.reference.geometry import BASELINE_M, FOCAL_PX, Geometry
from tests.reference.scene import Scene
from tests.reference.tables.accuracy import RIGS
from tests.reference.tables.answers import WITHIN_PX, Answers, calibration_error, pooled, reliability
from tests.reference.tables.joint_accuracy import kept_answers
from tests.reference.tables.printed import Table, parser_of, scene_of, scenes_asked
from tests.reference.working_point import POINTS, REPORT, WorkingPoint

SURE, TAKEN = 0.9, 0.5
AROUND, SURFACE_PX = 5, 1.5
TITLES = (
    "point", "K", "estimator", "mean px", "missing", "calibration error", "largest", "empty believed", "sure",
    "of them right", "right taken", "floating", "points", "left", "right lost", "claimed less right, by tenths",
)  # fmt: skip


class _Seen(NamedTuple):
    """Answers of a map, the share of those taken that float, and numbers of points of its depth map."""

    answers: Answers
    floats: float
    points: NDArray[np.int64]
    """All, floating and right ones, before and after floating ones are left out (2, 3)."""


def answers_of(
    scene: Scene, point: str, exposures: int, estimators: Sequence[str], filters: Sequence[str], seed: int
) -> dict[str, _Seen]:
    """The answers of one map by each estimator and filter, of the same counts; and which of those taken float."""
    height, width = scene.shape
    geometry = Geometry.build(width=width, height=height, **RIGS.get(point, {}))  # type: ignore[arg-type]
    world = WorkingPoint(scene, POINTS.get(point, REPORT), geometry)
    makers = [reconstructor_of(world, name) for name in estimators]
    window = makers[0].geometry
    counts = world.counts_in(window.x0, window.window, exposures, seed)
    reference, seen = window.reference_px(), {}
    for estimator, maker in zip(estimators, makers, strict=True):
        results = filtered_maps(maker, volume_of(maker, counts, exposures), filters)
        for filter, result in zip(filters, results, strict=True):
            x_px = np.where(result.stripe.confidence > TAKEN, result.stripe.x_px, np.nan)
            floats = float(floating(x_px - reference, world.x_true - reference).sum() / np.isfinite(x_px).sum())
            maps = depth_with_floating(maker, result), result.depth_m
            points = np.array([_points(depth_m, scene.depth_m) for depth_m in maps])
            name = estimator if filter == "none" else f"{estimator}, {filter}"
            seen[name] = _Seen(Answers.of(world, result, slice(None)), floats, points)
    return seen


def _points(depth_m: NDArray[np.float32], true_m: NDArray[np.float32]) -> tuple[int, int, int]:
    """Number of points of a depth map, of those that float between true surfaces, and of those that are right."""
    disparity, true = (FOCAL_PX * BASELINE_M / depth.astype(np.float64) for depth in (depth_m, true_m))
    right = np.abs(disparity - true) <= WITHIN_PX
    return int(np.isfinite(disparity).sum()), int(floating(disparity, true).sum()), int(right.sum())


def floating(distance: NDArray[np.float64], true: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether each answer lies between surfaces; distances from where the line is at one depth, px, NaN for none."""
    around = np.pad(true, AROUND, constant_values=np.nan)
    near, before, behind = (np.zeros(distance.shape, np.bool_) for _ in range(3))
    rows, columns = distance.shape
    with np.errstate(invalid="ignore"):
        for y, c in np.ndindex(2 * AROUND + 1, 2 * AROUND + 1):
            off = around[y : y + rows, c : c + columns] - distance
            near |= np.abs(off) <= SURFACE_PX
            before |= off > SURFACE_PX
            behind |= off < -SURFACE_PX
    return before & behind & ~near


def cells_of(seen: Sequence[_Seen]) -> list[str]:
    """The cells of a line, of what was seen in its scenes."""
    scenes = [one.answers for one in seen]
    together = pooled(scenes)
    confidence, right = together.claims(empty=True)
    sure, empty = confidence >= SURE, together.confidence[~together.lit]
    tenths = reliability(confidence, right)
    before, after = np.sum([one.points for one in seen], axis=0)
    points, float_before, right_before = before
    stay, float_after, right_after = after
    return [
        f"{together.mean_px:.3f}", f"{together.missing:.4f}", f"{calibration_error(confidence, right):.3f}",
        f"{max(calibration_error(*one.claims(empty=True)) for one in scenes):.3f}",
        f"{(empty > TAKEN).mean():.3f}", f"{sure.mean():.2f}", f"{right[sure].mean() if sure.any() else np.nan:.3f}",
        f"{(confidence[right] > TAKEN).mean():.3f}", f"{1e5 * np.mean([one.floats for one in seen]):.1f}",
        f"{1e5 * float_before / points:.1f}", f"{1e5 * float_after / stay:.1f}",
        f"{1e5 * (right_before - right_after) / right_before:.2f}",
        " ".join(f"{100 * (claimed - found):+.0f}" for _, claimed, found in tenths),
    ]  # fmt: skip


def one_map(
    scene: str, point: str, exposures: int, estimators: Sequence[str], filters: Sequence[str], seed: int, keep: str
) -> dict[str, Any]:
    """What is seen in one map by each estimator and filter as a case: the answers kept in files, the rest returned."""
    seen = answers_of(scene_of(scene), point, exposures, estimators, filters, seed)
    Path(keep).mkdir(parents=True)
    for name, one in seen.items():
        one.answers.save(Path(keep) / f"{name}.npz")
    return {name: [one.floats, one.points.tolist()] for name, one in seen.items()}


def main(arguments: Sequence[str] | None = None) -> int:
    """A line for each point and estimator. 1 where a map failed."""
    parser = parser_of(
        "tests.reference.tables.confidence", __doc__,
        points="report-1,report-3,report-10,dense-3,dense-10,clear-1,clear-3,uneven-10,turned-10",
    )  # fmt: skip
    parser.add_argument("--estimators", default="likelihood,joint")
    parser.add_argument("--filters", default="none")
    parser.add_argument("--seed", type=int, default=1)
    add_options(parser, workers=1)
    options = parser.parse_args(arguments)
    scenes, estimators = scenes_asked(parser, options.scenes), options.estimators.split(",")
    maps = [
        {"point": point, "exposures": int(exposures), "scene": scene}
        for point, exposures in (asked.rsplit("-", 1) for asked in options.points.split(","))
        for scene in scenes
    ]
    fixed = {"estimators": estimators, "filters": options.filters.split(","), "seed": options.seed}
    cases = [Case("tests.reference.tables.confidence:one_map", {**each, **fixed}, each, keeps=True) for each in maps]
    results = results_of(cases, options.workers, options.out, kept_answers)
    seen: dict[tuple[object, ...], list[_Seen]] = {}
    for each, result in zip(maps, results, strict=True):
        for name, answers in sorted((result or {"kept": {}})["kept"].items()):
            floats, points = result[name]
            one = _Seen(answers, np.nan if floats is None else floats, np.array(points))
            seen.setdefault((each["point"], each["exposures"], name), []).append(one)
    table = Table(TITLES)
    for line, of_scenes in seen.items():
        table.add([*line, *cells_of(of_scenes)])
    table.write(options.markdown)
    return int(None in results)


if __name__ == "__main__":
    sys.exit(main())
