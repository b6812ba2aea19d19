"""Several light planes at once on the yardstick: what they cost in accuracy and bring in time.

    python -m tests.reference.tables.multi_line --scenes cones --points clear,report --lines 1,2,4,8 --markdown table.md

A map of N columns by L lines takes N / L places of the mirror, each exposed K times; the frames of a place serve L
columns. Every line has its own stripe and haze, each with 1 / L of the light ('shared') or all of it ('each'); ambient
light is there once. Sensor time is that of the lit frames at 100 kHz.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.batch.case import Case
from tests.campaigns.studies import add_options, results_of
from tests.reference.adapter import reconstructor_of, volume_of
from tests.reference.geometry import Geometry
from tests.reference.scene import Scene
from tests.reference.tables.printed import Table, parser_of, scene_of, scenes_asked
from tests.reference.working_point import POINTS, THREADS, WorkingPoint, score

FRAME_MS = 0.01
COLUMNS = 496
SEED = 1
ROWS = 128
"""The middle ones of a scene: enough to learn from."""


@dataclass(frozen=True, slots=True)
class Lines:
    """So many planes at once, `power`: shared or each; columns places apart are lit together."""

    lines: int
    power: str

    @property
    def share(self) -> float:
        """Share of a single line's light that each one has."""
        return 1 / self.lines if self.power == "shared" else 1.0

    def counts(
        self, point: WorkingPoint, x0: NDArray[np.int32], window: int, exposures: int, seed: int
    ) -> NDArray[np.unsignedinteger]:
        """Counts (columns, H, window) of the pixels from x0 on; those lit together are of the same frames."""
        g = point.geometry
        out = np.zeros((g.columns, g.height, window), np.uint8 if exposures <= 255 else np.uint16)

        def draw(place: int) -> None:
            seen = self.counts_at(point, place, exposures, seed)
            for c in self.together(place):
                part = seen[:, x0[c] : x0[c] + window]
                out[c, :, : part.shape[1]] = part

        with ThreadPoolExecutor(THREADS) as pool:
            list(pool.map(draw, range(COLUMNS // self.lines)))
        return out

    def counts_at(self, point: WorkingPoint, place: int, exposures: int, seed: int) -> NDArray[np.integer]:
        """Counts (H, W) of the frames of a place of the mirror."""
        flux = point.ambient.copy()
        for c in self.together(place):
            flux += self.share * (point.flux_of_column(c) - point.ambient)
        return np.random.default_rng([seed, place]).binomial(exposures, -np.expm1(-flux))

    def together(self, place: int) -> range:
        """Columns that are lit there."""
        return range(place, COLUMNS, COLUMNS // self.lines)

    @property
    def grid(self) -> Any:
        """The project's account of what is lit together."""
        from rig.geometry.line_grid import LineGrid

        line, place = np.divmod(np.arange(COLUMNS, dtype=np.int32), np.int32(COLUMNS // self.lines))
        return LineGrid((0.0,) * self.lines, 1.0, line, place)


def dark_frames(point: WorkingPoint, lines: Lines, exposures: int) -> dict[str, Any]:
    """Dark frames as a scan has them, a twentieth of the lit ones."""
    n = max(1, COLUMNS // lines.lines * exposures // 20)
    counts = np.random.default_rng([SEED, COLUMNS]).binomial(n, -np.expm1(-point.ambient))
    return {"dark_counts": counts.astype(np.uint32), "n_dark": n}


def working_point(scene: Scene, point: str) -> WorkingPoint:
    """The middle rows of a scene in the light of a point, seen in `COLUMNS` columns."""
    cut = scene.crop(min(ROWS, scene.shape[0]), scene.shape[1])
    height, width = cut.shape
    return WorkingPoint(cut, POINTS[point], Geometry.build(width=width, height=height, columns=COLUMNS))


def measure(
    point: WorkingPoint, lines: Lines, exposures: int, estimators: Sequence[str], *, told: bool = True
) -> Iterator[tuple[str, dict[str, float]]]:
    """Figures of one map by estimator. told: whether it knows that there are other lines."""
    counts: NDArray[np.unsignedinteger] | None = None
    for estimator in estimators:
        reconstructor = reconstructor_of(point, estimator, lines=lines.grid if lines.lines > 1 and told else None)
        geometry = reconstructor.geometry
        if counts is None:
            counts = lines.counts(point, geometry.x0, geometry.window, exposures, SEED)
        volume = replace(volume_of(reconstructor, counts, exposures), **dark_frames(point, lines, exposures))
        stripe = reconstructor.map(volume).stripe
        scored = point.trusted & np.isfinite(point.truth())
        figures = score(stripe.x_px, point.truth(), point.trusted)
        yield estimator, {**figures, "confidence": float(stripe.confidence[scored].mean())}


TITLES = ("scene", "point", "power", "lines", "K", "lit ms", "overlap", "estimator", "mean abs px", "median px",
          "within 1 px", "confidence")  # fmt: skip


def one_kind(
    scene: str, point: str, power: str, lines: int, exposures: Sequence[int], estimators: Sequence[str]
) -> dict[str, Any]:
    """Maps of a scene with so many lines as a case: the lines of the table."""
    from rig.geometry.line_grid import window_overlap

    together, world = Lines(lines, power), working_point(scene_of(scene), point)
    overlap = window_overlap(together.grid, reconstructor_of(world, "argmax").geometry)
    cells = []
    for k in sorted({*exposures, *(lines * k for k in exposures)}):
        lit_ms = COLUMNS // lines * k * FRAME_MS
        for estimator, f in measure(world, together, k, estimators):
            told = scene, point, power, lines, k, f"{lit_ms:.1f}", f"{overlap:.2f}", estimator
            found = (f[figure] for figure in ("mean_abs_charged", "median_abs", "within_1px", "confidence"))
            cells.append([*told, *(f"{one:.3f}" for one in found)])
    return {"cells": cells}


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table, and write it where asked. 1 where a case failed."""
    parser = parser_of("tests.reference.tables.multi_line", __doc__, points="clear,report,dense")
    parser.set_defaults(scenes="procedural")
    parser.add_argument("--power", default="shared,each")
    parser.add_argument("--lines", default="1,2,4,8")
    parser.add_argument("--exposures", default="1,10", help="of one line; others take them and as many frames a map")
    parser.add_argument("--estimators", default="likelihood,joint")
    add_options(parser, workers=1)
    options = parser.parse_args(arguments)
    powers, scenes = options.power.split(","), scenes_asked(parser, options.scenes)
    fixed = {
        "exposures": [int(k) for k in options.exposures.split(",")], "estimators": options.estimators.split(","),
    }  # fmt: skip
    kinds = [
        {"scene": scene, "point": point, "power": power, "lines": int(lines)}
        for scene, point, power, lines in product(scenes, options.points.split(","), powers, options.lines.split(","))
        if int(lines) > 1 or power == powers[0]
    ]
    cases = [Case("tests.reference.tables.multi_line:one_kind", {**each, **fixed}, each) for each in kinds]
    results = results_of(cases, options.workers, options.out)
    table = Table(TITLES)
    for result in results:
        for cells in result["cells"] if result is not None else ():
            table.add(cells)
    table.write(options.markdown)
    return int(None in results)


if __name__ == "__main__":
    sys.exit(main())
