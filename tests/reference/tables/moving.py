"""Gain from the temporal prior of `joint` on scenes that stand still, and its harm where something moves.

    python -m tests.reference.tables.moving --scenes cones,art --rows 128 --maps 4 --markdown table.md

A disc flies through a scene, five pixels of disparity nearer and a dozen pixels aside from map to map (the slow one:
one and three). A dark one's stripe has a small part of the others' photons: what it was taken for before outweighs it
first. The stripe of the median surface has what the point says. Mean errors in
px against the continuous truth, a missing answer as 10 px, over all maps but the first: `all` stripes on trusted
pixels, those on the `disc`, those `uncovered`, where the line stood on something else or nothing a map before, and on
`still` ground. Both estimators see the same counts.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.batch.case import Case
from tests.campaigns.studies import add_options, results_of
from tests.reference.adapter import reconstructor_of, volume_of
from tests.reference.geometry import FOCAL_PX
from tests.reference.scene import Scene, surroundings
from tests.reference.tables.answers import Answers, calibration_error, pooled
from tests.reference.tables.printed import Table, parser_of, scene_of, scenes_asked
from tests.reference.working_point import POINTS, WorkingPoint, at_stripe

PARTS = ("all", "disc", "uncovered", "still")
UNCOVERED_PX = 1.0
"""A true stripe that has gone farther than this lies on another surface than before."""


@dataclass(frozen=True, slots=True)
class Disc:
    """A round plate that faces the camera; aside_m, nearer_m: by how much it moves from map to map."""

    albedo: float = 0.5
    radius_m: float = 0.15
    at_m: tuple[float, float] = (-0.15, 2.0)
    aside_m: float = 0.04
    nearer_m: float = 0.1

    def into(self, scene: Scene, index: int) -> tuple[Scene, NDArray[np.bool_]]:
        """The scene of a map with the disc in it, and the pixels (H, W) that show the disc."""
        height, width = scene.shape
        y, x = np.mgrid[0:height, 0:width]
        z = self.at_m[1] - index * self.nearer_m
        middle = (self.at_m[0] + index * self.aside_m) / z * FOCAL_PX + (width - 1) / 2
        off_px = np.hypot(x - middle, y - (height - 1) / 2)
        on = (off_px < self.radius_m / z * FOCAL_PX) & (z < scene.depth_m)
        trusted = (scene.trusted | on) & ~_near_edges(on)
        depth = np.where(on, np.float32(z), scene.depth_m)
        albedo = np.where(on, np.float32(self.albedo), scene.albedo)
        return replace(scene, depth_m=depth, albedo=albedo, trusted=trusted), on


def _near_edges(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels that have both kinds within reach."""
    around = surroundings(mask)
    return np.asarray(around.any(axis=(2, 3)) & ~around.all(axis=(2, 3)))


@dataclass(frozen=True, slots=True)
class Moved:
    """Answers of one estimator over all maps but the first, and which of them each part of PARTS scores."""

    answers: Answers
    parts: dict[str, NDArray[np.bool_]]

    def mean_px(self, part: str) -> float:
        """Mean |error| of a part."""
        return self.answers.over(self.parts[part]).mean_px

    def within(self, part: str) -> float:
        """Share of a part within 1 px."""
        return self.answers.over(self.parts[part]).within


def measure(
    scene: Scene, disc: Disc | None, exposures: int, maps: int = 4, point: str = "report"
) -> tuple[Moved, Moved]:
    """Without and with the prior, of the same maps of a scene; disc: None where nothing moves."""
    found: tuple[list[Answers], list[Answers]] = [], []
    parts: dict[str, list[NDArray[np.bool_]]] = {part: [] for part in PARTS}
    makers: list[Any] = []
    x_before: NDArray[np.float64] | None = None
    for index, (one, on) in enumerate(_worlds(scene, disc, maps)):
        world = WorkingPoint(one, POINTS[point])
        makers = makers or [reconstructor_of(world, "joint", threads=2, temporal_prior=on) for on in (False, True)]
        geometry = makers[0].geometry
        counts = world.counts_in(geometry.x0, geometry.window, exposures, seed=index + 1)
        results = []
        for maker in makers:
            if index == 0 and results:  # both learn the same from the first map: once is enough
                maker.estimator.model = makers[0].estimator.used
            results.append(maker.map(volume_of(maker, counts, exposures)))
        if x_before is not None:
            for answers, result in zip(found, results, strict=True):
                answers.append(Answers.of(world, result, slice(None)))
            scored, on_disc = world.trusted, at_stripe(on, world.x_true)
            elsewhere = ~(np.abs(world.x_true - x_before) <= UNCOVERED_PX)
            masks = (scored, scored & on_disc, scored & ~on_disc & elsewhere, scored & ~on_disc & ~elsewhere)
            for part, mask in zip(PARTS, masks, strict=True):
                parts[part].append(mask.ravel())
        x_before = world.x_true
    joined = {part: np.concatenate(masks) for part, masks in parts.items()}
    without, prior = (Moved(pooled(answers), joined) for answers in found)
    return without, prior


def _worlds(scene: Scene, disc: Disc | None, maps: int) -> Iterator[tuple[Scene, NDArray[np.bool_]]]:
    for index in range(maps):
        yield (scene, np.zeros(scene.shape, np.bool_)) if disc is None else disc.into(scene, index)


DISCS = {
    "nothing": None,
    "disc": Disc(),
    "dark disc": Disc(albedo=0.04),
    "slow disc": Disc(aside_m=0.01, nearer_m=0.02),
}
TITLES = ("scene", "moves", "K", *(f"{part}: without, with" for part in PARTS), "within 1 px", "calibration")


def row_of(name: str, moves: str, exposures: int, both: tuple[Moved, Moved]) -> list[object]:
    """Cells of a line of the table."""
    cells = [
        "-" if not both[0].parts[part].any() else ", ".join(f"{one.mean_px(part):.3f}" for one in both)
        for part in PARTS
    ]
    within = ", ".join(f"{one.within('all'):.4f}" for one in both)
    calibration = ", ".join(f"{calibration_error(*one.answers.over(one.parts['all']).claims()):.3f}" for one in both)
    return [name, moves, exposures, *cells, within, calibration]


def one_cell(scene: str, rows: int | None, moves: str, exposures: int, maps: int, point: str) -> dict[str, Any]:
    """A line of the table as a case."""
    both = measure(scene_of(scene, rows), DISCS[moves], exposures, maps, point)
    return {"cells": row_of(scene, moves, exposures, both)}


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table. 1 where a line failed."""
    parser = parser_of("tests.reference.tables.moving", __doc__)
    parser.add_argument("--moves", default=",".join(DISCS), help=f"of {', '.join(DISCS)}")
    parser.add_argument("--exposures", default="1,3")
    parser.add_argument("--point", default="report", choices=POINTS)
    parser.add_argument("--maps", type=int, default=4)
    parser.add_argument("--rows", type=int, help="middle rows of the scenes")
    add_options(parser, workers=1)
    options = parser.parse_args(arguments)
    fixed = {"rows": options.rows, "maps": options.maps, "point": options.point}
    asked = scenes_asked(parser, options.scenes), options.moves.split(","), map(int, options.exposures.split(","))
    lines = [{"scene": scene, "moves": moves, "exposures": k} for scene, moves, k in product(*asked)]
    cases = [Case("tests.reference.tables.moving:one_cell", {**each, **fixed}, each) for each in lines]
    results = results_of(cases, options.workers, options.out)
    table = Table(TITLES)
    for result in results:
        if result is not None:
            table.add(result["cells"])
    table.write(options.markdown)
    return int(None in results)


if __name__ == "__main__":
    sys.exit(main())
