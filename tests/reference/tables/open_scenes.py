"""Random scenes that are open to the sky in part: is `joint` as sure as it should be where there is nothing?

    python -m tests.reference.tables.open_scenes --scenes 306:312

Behind what is farther than 2 to 4 m, above a wavy horizon or in patches, there is nothing for 60 m: no stripe comes
back and haze goes on. Light is drawn by chance around that of a working point. Of every map: share of answers where
there is no stripe, calibration error over all answers and over those with a stripe, share of the former that a depth
map would take (confidence 0.5), share of right ones that it takes.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.batch.case import Case
from tests.campaigns.studies import add_options, results_of
from tests.reference.adapter import reconstruct
from tests.reference.geometry import Geometry
from tests.reference.made_scenes import noise, random_scene
from tests.reference.scene import Scene
from tests.reference.tables.answers import calibration_error
from tests.reference.working_point import POINTS, Light, WorkingPoint, at_stripe

SKY_M = 60.0
BEYOND_M = 20.0
ROWS = 256
TAKEN = 0.5
"""Confidence from which on a depth map has an answer."""


class OpenPoint(WorkingPoint):
    """A scene whose sky sends nothing back; the light's median stripe is over what does."""

    def __init__(self, scene: Scene, light: Light, geometry: Geometry | None = None) -> None:
        super().__init__(scene, light, geometry)
        sky = at_stripe(scene.depth_m > BEYOND_M, self.x_true)
        self.x_true[sky], self.stripe[sky] = np.nan, 0.0
        self.stripe *= light.stripe / float(np.median(self.stripe[self.stripe > 0]))


def opened(scene: Scene, number: int) -> Scene:
    """The scene with a sky of this number, always the same one."""
    rng = np.random.default_rng([number, 78])
    height, width = scene.shape
    y, x = np.mgrid[0:height, 0:width].astype(np.float64)
    if rng.random() < 0.6:
        horizon = height * rng.uniform(0.1, 0.6) + 20 * rng.normal() * noise(rng, scene.shape, 64)[0]
        sky = y < horizon + rng.uniform(-0.5, 0.5) * (x - width / 2)
    else:
        sky = noise(rng, scene.shape, int(rng.choice([32, 64, 128]))) > rng.uniform(-0.3, 1)
    sky &= scene.depth_m > rng.uniform(2, 4)
    return replace(scene, depth_m=np.where(sky, SKY_M, scene.depth_m).astype(np.float32))


def drawn_light(name: str, rng: np.random.Generator) -> Light:
    """A working point with other stripes (0.3 to 5 photons) and other ambient light."""
    stripe, ambient = (np.exp(rng.uniform(np.log(a), np.log(b))) for a, b in ((0.3, 5.0), (5e-4, 0.03)))
    return replace(POINTS[name], stripe=float(stripe), ambient=float(ambient))


def figures(confidence: NDArray[np.float32], x_px: NDArray[np.float32], point: WorkingPoint) -> tuple[float, ...]:
    """The five figures of the module, of answers (rows, columns)."""
    given = np.isfinite(x_px)
    sure, right = confidence[given].astype(np.float64), (np.abs(x_px - point.x_true) <= 1)[given]
    empty = np.isnan(point.x_true)[given]
    return (
        float(empty.mean()),
        calibration_error(sure, right),
        calibration_error(sure[~empty], right[~empty]),
        float((sure[empty] > TAKEN).mean()),
        float((sure[right] > TAKEN).mean()),
    )


def one_scene(number: int, points: Sequence[str], threads: int) -> dict[str, Any]:
    """The maps of a random scene as a case: [point, exposures, figures] of each."""
    rng = np.random.default_rng([number, 79])
    scene, maps = opened(random_scene(number, ROWS), number), []
    for name in points:
        point, exposures = OpenPoint(scene, drawn_light(name, rng)), int(rng.choice([1, 3, 10, 20]))
        counts = point.counts(exposures, number)
        (result,) = reconstruct(point, counts, exposures, estimator="joint", threads=threads)
        maps.append([name, exposures, figures(result.stripe.confidence, result.stripe.x_px, point)])
    return {"maps": maps}


def main(arguments: Sequence[str] | None = None) -> int:
    """A row per map, then their means. 1 where a scene failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", default="306:312", help="first and last but one of the random scenes")
    parser.add_argument("--points", default="clear,report,dense", help=f"of {', '.join(POINTS)}")
    parser.add_argument("--threads", type=int, default=2)
    add_options(parser, workers=1)
    options = parser.parse_args(arguments)
    numbers = range(*map(int, options.scenes.split(":")))
    fixed = {"points": options.points.split(","), "threads": options.threads}
    cases = [
        Case("tests.reference.tables.open_scenes:one_scene", {"number": number, **fixed}, {"scene": number})
        for number in numbers
    ]
    results = results_of(cases, options.workers, options.out)
    print("scene point K | empty | error over all, with stripe | empty taken, right taken")
    seen: dict[str, list[tuple[float, ...]]] = {}
    for number, result in zip(numbers, results, strict=True):
        for name, exposures, row in result["maps"] if result is not None else ():
            row = [np.nan if value is None else value for value in row]
            seen.setdefault(name, []).append(row)
            print(number, name, exposures, "|", *(f"{value:.3f}" for value in row), flush=True)
    for name, rows in seen.items():
        print("mean", name, "|", *(f"{value:.3f}" for value in np.mean(rows, axis=0)))
    return int(None in results)


if __name__ == "__main__":
    sys.exit(main())
