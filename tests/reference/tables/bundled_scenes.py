"""Bundled scenes as a user scans them: errors, what the sure answers are worth, and the verdict.

    python -m tests.reference.tables.bundled_scenes --scenes street-dense-fog --estimators joint --seeds 3

Each line is one `rig scan --scene SCENE --estimator E --exposures K --seed S` with one map. Errors are of the stripe's
place, in px, over all stripes that the camera sees; `given`: share of these that a depth map takes (confidence of 0.5
and more); `sure` answers have a confidence of 0.9 and more, and one where there is no stripe is wrong; `empty
believed`: share of the places without a stripe that have a confidence above 0.5; `stated`: extinction that the fog
meter states, with its standard deviation, - if it states none. The second table has the means over the seeds, and of
`of them right` the worst.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import numpy as np

from rig.api.scans import scan
from rig.batch.case import Case
from tests.campaigns.studies import add_options, results_of
from tests.reference.tables.printed import Table, parser_of

SCENES = "street-clear,street,street-light-fog,street-dense-fog,street-smoke,street-rain,street-snow,street-everything"
FIRST_SEED = 11
SURE, BELIEVED = 0.9, 0.5
TITLES = (
    "scene", "estimator", "K", "seed", "verdict", "mean px", "within 1 px", "given", "sure", "of them right", "claimed",
    "empty believed", "depth error, m", "extinction, 1/m", "stated, 1/m",
)  # fmt: skip
MEANS = "mean px", "within 1 px", "given", "sure", "empty believed", "depth error, m"


def one_scan(scene: str, estimator: str, exposures: int, seed: int) -> dict[str, list[object]]:
    """One scan as a case: the cells of its line."""
    result = scan("simulated", scene=scene, estimator=estimator, exposures=exposures, seed=seed)
    assert result.last is not None, "one map was asked for"
    assert result.truth is not None, "a simulated world knows it"
    stripe, truth, learned = result.last.stripe, result.truth.x_px, result.last.learned
    error, lit = np.abs(stripe.x_px - truth), np.isfinite(truth)
    sure, given = stripe.confidence >= SURE, np.isfinite(error)
    depth = np.abs(result.last.depth_m - result.truth.depth_m)
    extinction, fog = getattr(learned, "extinction_per_m", np.nan), result.summary.fog
    stated = "-" if fog.extinction_per_m is None else f"{fog.extinction_per_m:.4f} +- {fog.extinction_sd_per_m:.4f}"
    cells = [
        scene, estimator, exposures, seed, result.summary.verdict.value, f"{error[given].mean():.3f}",
        f"{(error[lit] <= 1.0).mean():.3f}", f"{(stripe.confidence[lit] >= BELIEVED).mean():.3f}",
        f"{sure.mean():.3f}", f"{(error[sure] <= 1.0).mean():.4f}", f"{stripe.confidence[sure].mean():.4f}",
        f"{(stripe.confidence[~lit] > BELIEVED).mean():.3f}", f"{depth[np.isfinite(depth)].mean():.3f}",
        f"{extinction:.3f}", stated,
    ]  # fmt: skip
    return {"cells": cells}


def means_of(lines: Sequence[Sequence[object]]) -> list[object]:
    """The second table's cells for the lines of one scene, estimator and number of exposures."""
    of = {title: [str(line[TITLES.index(title)]) for line in lines] for title in (*MEANS, "of them right", "verdict")}
    means = [f"{np.mean([float(cell) for cell in of[title]]):.3f}" for title in MEANS]
    complete = sum(verdict == "complete" for verdict in of["verdict"])
    return [*lines[0][:3], len(lines), complete, *means, min(of["of them right"])]


def main(arguments: Sequence[str] | None = None) -> int:
    """Print a line for every scan; write the table where wanted. 1 where a scan failed."""
    parser = parser_of("tests.reference.tables.bundled_scenes", __doc__)
    parser.set_defaults(scenes=SCENES)
    parser.add_argument("--estimators", default="joint,likelihood")
    parser.add_argument("--exposures", default="1,3,10,20,50")
    parser.add_argument("--seeds", type=int, default=10, help="scans of each kind")
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    add_options(parser, workers=1)
    options = parser.parse_args(arguments)
    scans = [
        {"scene": scene, "exposures": exposures, "seed": seed, "estimator": estimator}
        for scene in options.scenes.split(",")
        for exposures in map(int, options.exposures.split(","))
        for seed in range(options.first_seed, options.first_seed + options.seeds)
        for estimator in options.estimators.split(",")
    ]
    cases = [Case("tests.reference.tables.bundled_scenes:one_scan", each, each) for each in scans]
    results = results_of(cases, options.workers, options.out)
    table = Table(TITLES)
    lines: dict[tuple[object, ...], list[list[object]]] = {}
    for each, result in zip(scans, results, strict=True):
        if result is not None:
            table.add(result["cells"])
            lines.setdefault((each["scene"], each["exposures"], each["estimator"]), []).append(result["cells"])
    means = Table(("scene", "estimator", "K", "maps", "complete", *MEANS, "of them right, worst"))
    for of_kind in lines.values():
        means.add(means_of(of_kind))
    table.text += "\n" + means.text
    table.write(options.markdown)
    return int(sum(map(len, lines.values())) < len(scans))


if __name__ == "__main__":
    sys.exit(main())
