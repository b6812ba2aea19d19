"""What passes over undecided columns gain over one plain sweep: share of stripes within 1 px against sensor time.

    python -m tests.reference.adaptive --scenes cones,art --points dense --estimators likelihood,joint --markdown t.md

Counts come from the yardstick, passes from `rig.adaptive` as a live scan would choose them, sensor time from the plan's
mirror path on the simulated galvo (run-in, fly-back and dark frames too). Both kinds of scan are estimated with the
same estimator, learned from their own counts. `same share` is the sensor time at which the passes reach the share of
the plain sweep, over that sweep's, read off between passes; `oracle K`: exposures per column with which an
oracle has the share of K = 10, which knows how the errors of each 25 columns fall with K and pays for no travel.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.reference import kernels
from tests.reference.geometry import DEPTH_RANGE_M, Geometry
from tests.reference.scene import Scene, load_scene, procedural_scene, scene_names
from tests.reference.working_point import POINTS, WorkingPoint

FIXED = (2, 4, 6, 10, 20)
BLOCK_COLUMNS = 25


@dataclass(frozen=True, slots=True)
class Rescan:
    """One scene and estimator: shares within 1 px of plain sweeps by K, and (sensor time, share) behind each pass."""

    scene: str
    point: str
    estimator: str
    fixed: dict[int, float]
    track: list[tuple[float, float]]
    passes: list[Any]
    oracle_exposures: float

    def plain_share(self, time_s: float) -> float:
        """Share of a plain sweep that takes so long, between those that were made."""
        known = sorted(self.fixed)
        times = [np.log(sweep_s(500, k)) for k in known]
        return float(1 - np.exp(np.interp(np.log(time_s), times, [np.log(1 - self.fixed[k]) for k in known])))

    @property
    def same_share(self) -> float:
        """Sensor time at which the passes have the share of a plain sweep at K = 10, over that sweep's; else inf."""
        target, before = self.fixed[10], (0.0, 0.0)
        for now in self.track:
            if now[1] >= target:
                part = (target - before[1]) / (now[1] - before[1]) if before[0] else 1.0
                return (before[0] + part * (now[0] - before[0])) / sweep_s(500, 10)
            before = now
        return float("inf")


class Study:
    """Estimates of one scene at a working point by the project's estimators, columns with exposures of their own."""

    def __init__(self, scene: Scene, point: str, rows: slice) -> None:
        from calibration.files.rig_file import load_rig_model

        height, width = scene.shape
        self.point = WorkingPoint(scene, POINTS[point], Geometry.build(width=width, height=height))
        with tempfile.TemporaryDirectory() as folder:
            self.model = load_rig_model(self.point.write_calibration(Path(folder)))
        self.columns = self.point.geometry.columns
        self.truth, self.trusted = self.point.truth()[rows], self.point.trusted[rows]
        self.rows = rows

    def draw(self, geometry: Any, exposures: int, seed: int, first: int = 0, end: int | None = None) -> Any:
        """Counts (columns, rows, window) of columns first..end - 1, zero elsewhere."""
        point = self.point
        out = np.zeros((self.columns, geometry.rows, geometry.window), np.uint8)
        end = self.columns if end is None else end
        kernels.draw_counts(point.optics, point.ends, exposures, seed, geometry.x0, first, end, out)
        return out

    def volume(self, counts: Any, n_frames: NDArray[np.int32], geometry: Any) -> Any:
        from rig.counting import CountVolume

        return CountVolume(
            counts=counts, x0=geometry.x0, n_frames=n_frames,
            column=np.arange(self.columns, dtype=np.float64), dark_counts=None, n_dark=0, width=geometry.width,
        )  # fmt: skip

    def reconstructor(self, estimator: str) -> Any:
        from rig.reconstruction import Reconstructor

        return Reconstructor(self.model, np.arange(float(self.columns)), DEPTH_RANGE_M, estimator=estimator, threads=2)

    def within(self, x_px: NDArray[np.float32]) -> NDArray[np.int64]:
        """Stripes within 1 px of each column (columns,)."""
        with np.errstate(invalid="ignore"):
            return np.asarray(((np.abs(x_px[self.rows] - self.truth) <= 1) & self.trusted).sum(axis=0))


@cache
def sweep_s(columns: int, exposures: int) -> float:
    """Sensor time of one way over `columns` of 500 columns, as the plan's path has it on the simulated galvo."""
    from rig.path_search import PathDemand, find_path
    from sim_backend.devices.scanner import LIMITS, MASTER_HZ

    frame_s = Fraction(1, 100_000)
    edges = (-0.88, -0.88 + 1.76 * columns / 500)
    demand = PathDemand(edges, columns, exposures * frame_s, frame_s, 2e-4, 1e-5, 2e-4, 0.05, False)
    found = find_path(demand, LIMITS, lambda hz: Fraction(MASTER_HZ, max(240, round(MASTER_HZ / hz))))
    assert found.path is not None, "the simulated galvo is fast enough for one exposure"
    return float(found.path.points / found.rate_hz)


def study(
    scene: Scene, point: str, estimator: str, *, first: int, passes: int, budget: float, fixed: Sequence[int],
    seed: int, rows: slice,
) -> Rescan:  # fmt: skip
    """Plain sweeps and passes over one scene. budget: of the sensor time of a plain sweep at K = 10."""
    from rig.adaptive import Pass, Unsettled, moved_rows, next_pass
    from rig.adaptive_thinning import thinned

    it = Study(scene, point, rows)
    stripes = it.trusted.sum()
    shares, wrong = {}, []
    counts: Any = np.uint8(0)
    before = 0
    for k in sorted({*fixed, 10}):
        maker = it.reconstructor(estimator)
        counts, before = counts + it.draw(maker.geometry, k - before, 1000 + seed + k), k
        volume = it.volume(counts, np.full(it.columns, k, np.int32), maker.geometry)
        within = it.within(maker.map(volume).stripe.x_px)
        shares[k] = float(within.sum() / stripes)
        wrong.append(np.add.reduceat(it.trusted.sum(axis=0) - within, np.arange(0, it.columns, BLOCK_COLUMNS)))
        print(f"  K = {k}: {shares[k]:.4f}", file=sys.stderr, flush=True)
    scout = it.reconstructor(estimator)
    searched = scout.geometry.x_lo <= scout.geometry.x_hi
    one: Pass | None = Pass(0, it.columns, first)
    total = sweep_s(500, 10)
    counts, n_frames, taken, track, spent = np.uint8(0), np.zeros(it.columns, np.int32), [], [], 0.0
    while one is not None:
        drawn = 2000 + seed + len(taken)
        counts = counts + it.draw(scout.geometry, one.exposures, drawn, one.first_column, one.end_column)
        n_frames[one.part] += one.exposures
        spent += sweep_s(one.columns, one.exposures)
        taken.append(one)
        volume = it.volume(counts, n_frames.copy(), scout.geometry)
        track.append((spent, float(it.within(it.reconstructor(estimator).map(volume).stripe.x_px).sum() / stripes)))
        print(f"  {one}: {spent / total:.3f} {track[-1][1]:.4f}", file=sys.stderr, flush=True)
        if len(taken) == passes:
            break
        now, fewer = (scout.estimator.estimate(seen, scout.geometry) for seen in (volume, thinned(volume)))
        unsettled = Unsettled(moved_rows(fewer, now, searched), n_frames)
        one = next_pass(unsettled, sweep_s, budget * total - spent, passes - len(taken))
    oracle = best_possible(np.stack(wrong), sorted({*fixed, 10}))
    return Rescan(scene.name, point, estimator, shares, track, taken, oracle)


def best_possible(wrong: NDArray[np.float64], exposures: Sequence[int]) -> float:
    """Mean exposures, the least of `exposures` or more, at which blocks have as few errors as at K = 10 for all.

    wrong: (exposures, blocks), errors at each K; between them they fall as a power of K, and beyond as 1 / K.
    """
    grid = np.arange(exposures[0], 81)
    log_k = np.log(np.array(exposures, float))
    within = np.stack([np.interp(np.log(grid), log_k, np.log(block + 0.5)) for block in wrong.T], axis=1)
    errors = np.exp(within - np.maximum(np.log(grid)[:, None] - log_k[-1], 0))
    target = errors[list(grid).index(10)].sum()
    for price in np.geomspace(1e4, 1e-3, 2000):
        k = np.argmin(errors + price * grid[:, None], axis=0)
        if errors[k, np.arange(errors.shape[1])].sum() <= target:
            return float(grid[k].mean())
    return float("inf")


TITLES = (
    "point", "scene", "estimator", "K = 10", "passes: time", "share", "plain: share then", "same share at", "oracle K",
)  # fmt: skip


def as_markdown(r: Rescan) -> str:
    """One table row."""
    total = sweep_s(500, 10)
    time_s, share = r.track[-1]
    cells = [r.point, r.scene, r.estimator, f"{r.fixed[10]:.4f}", f"{time_s / total:.2f}", f"{share:.4f}"]
    cells += [f"{r.plain_share(time_s):.4f}", f"{r.same_share:.2f}", f"{r.oracle_exposures:.1f}"]
    return "| " + " | ".join(cells) + " |\n"


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table, and write it where asked."""
    parser = argparse.ArgumentParser(prog="python -m tests.reference.adaptive", description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", help="comma-separated; 'procedural' is the built-in one; default: all prepared")
    parser.add_argument("--points", default="dense", help=f"of {', '.join(POINTS)}")
    parser.add_argument("--estimators", default="likelihood,joint")
    parser.add_argument("--first", type=int, default=4, help="exposures of the first pass")
    parser.add_argument("--passes", type=int, default=4)
    parser.add_argument("--budget", type=float, default=0.6, help="sensor time, of that of a plain sweep at K = 10")
    parser.add_argument("--exposures", default=",".join(map(str, FIXED)), help="K of the plain sweeps")
    parser.add_argument("--row-step", type=int, default=1, help="score every n-th row only")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--markdown", type=Path, help="file for the table")
    options = parser.parse_args(arguments)
    table = ["| " + " | ".join(TITLES) + " |\n" + "|---" * len(TITLES) + "|\n"]
    print(table[0], end="")
    for name in options.scenes.split(",") if options.scenes else list(scene_names()) or ["procedural"]:
        scene = procedural_scene() if name == "procedural" else load_scene(name)
        if scene is None:
            parser.error(f"scene {name!r} is absent; present: {', '.join([*scene_names(), 'procedural'])}")
        for point in options.points.split(","):
            for estimator in options.estimators.split(","):
                found = study(
                    scene, point, estimator, first=options.first, passes=options.passes, budget=options.budget,
                    fixed=[int(k) for k in options.exposures.split(",")], seed=options.seed,
                    rows=slice(None, None, options.row_step),
                )  # fmt: skip
                table.append(as_markdown(found))
                print(table[-1], end="", flush=True)
                if options.markdown:
                    options.markdown.write_text("".join(table))
    return 0


if __name__ == "__main__":
    sys.exit(main())
