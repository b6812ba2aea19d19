"""How fast frames of simulated scenes are drawn, beside plain numpy: python -m tests.benchmarks.simulator.

Whole frames of the simulated rig's camera at its exposure and power. Per scene and number of threads:

- `ready`: the light of one column stands, frame after frame is drawn from it;
- `fresh`: as in a scan, K frames to each of the columns of a sweep, whose light is computed anew;

and once, for the scenes of light that it knows, `numpy-ready` and `numpy-fresh`: the same in whole-array numpy, one
random number for every pixel. Figures are medians over rounds in which all rows are measured in turn.
"""

import argparse
import os
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack, closing
from itertools import count

import numpy as np
from rich.console import Console
from rich.table import Table

from drivers.frames import packed_row_bytes
from rig.bench.machine import machine
from rig.cli.progress import progress
from rig.cli.tables import BENCH_WIDTH, print_machine
from rig.config.models import ScanConfig
from rig.config.overrides import configure
from rig.plan.scan_plan import column_command
from rig.progress import counted
from rig.tradeoff.effects import open_world
from sim_backend.effects.setting import FrameTimes
from sim_backend.world import SimulatedWorld
from tests.benchmarks.numpy_frames import NumpyFrames

SCENES = ("street-clear", "street", "street-everything")
NUMPY_SCENES = SCENES[:2]
"""Scenes of stripe and haze, all that the numpy way knows."""
BASELINE = "street"
"""Scene whose numpy rows all others are compared with."""
REAL_TIME_HZ = 100_000
"""Frames a second of the sensor."""
COLUMNS = 50
"""Columns of the sweep that are handed over at a time, a block of some milliseconds, spread over its range."""
ROUNDS, MOMENT_S = 5, 0.25
SEED = 1
Case = tuple[str, str, int]
"""Row, scene and number of threads."""
Frames = Callable[[], int]
"""Draws some frames, and says how many."""


def main() -> None:
    """Print the rows."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    with progress():
        speeds = measure()
    console = Console(highlight=False, width=BENCH_WIDTH)
    print_machine(console, machine())
    table = Table("row", "scene", "threads", "kframes/s", "us/frame", "real time", "x numpy", box=None, pad_edge=False)
    for (stage, scene, threads), speed in speeds.items():
        of_numpy = speed / speeds[f"numpy-{stage.removeprefix('numpy-')}", BASELINE, 1]
        figures = f"{speed / 1e3:.4g}", f"{1e6 / speed:.4g}", f"{speed / REAL_TIME_HZ:.2g}", f"{of_numpy:.3g}"
        table.add_row(stage, scene, str(threads), *figures)
    console.print(table)


def measure() -> dict[Case, float]:
    """Frames a second of each case, on 1 and 2 threads (claims are for two) and as many as there are cores."""
    cases: dict[Case, Frames] = {}
    with ExitStack() as stack:
        for scene in SCENES:
            config = configure("simulated", scene=scene)
            world, power_w = stack.enter_context(open_world(config))
            assert isinstance(world, SimulatedWorld)
            for number in sorted({1, 2, os.cpu_count() or 1}):
                for stage in ("ready", "fresh"):
                    fresh = stage == "fresh"
                    cases[stage, scene, number] = _compiled(stack, world, config.scan, power_w, number, fresh)
            if scene in NUMPY_SCENES:
                for stage in ("ready", "fresh"):
                    cases[f"numpy-{stage}", scene, 1] = _plain(world, config.scan, power_w, stage == "fresh")
        return _in_turn(cases)


def _compiled(
    stack: ExitStack, world: SimulatedWorld, scan: ScanConfig, power_w: float, threads: int, fresh: bool
) -> Frames:
    """Frames of the middle column, or of columns that are new each time, spread over the sweep."""
    source = stack.enter_context(closing(world.photons(FrameTimes(scan.exposure_s, scan.exposure_s), SEED, threads)))
    commands = column_command(np.arange(scan.columns), scan.command_range, scan.columns)
    n, (rows, width), blocks = COLUMNS * scan.exposures, world.size, count()
    bits = np.zeros((n, rows, packed_row_bytes(width)), np.uint8)
    rest = np.full(n, power_w), np.zeros(n, np.int32), bits, np.arange(n) * scan.exposure_s
    spread = np.arange(COLUMNS) * -(-scan.columns // COLUMNS)

    def frames() -> int:
        block = next(blocks)
        columns = (spread + block) % scan.columns if fresh else np.full(COLUMNS, scan.columns // 2)
        source.expose(block * n, np.repeat(commands[columns], scan.exposures), *rest)
        return n

    return frames


def _plain(world: SimulatedWorld, scan: ScanConfig, power_w: float, fresh: bool) -> Frames:
    """Frames of the middle column in the straightforward way."""
    frames = NumpyFrames(world.setting, world.flux_model.steady_per_s, scan.exposure_s, SEED)
    plane = world.model.planes(column_command(np.array([scan.columns // 2]), scan.command_range, scan.columns))[0]
    ready = frames.probability(plane, power_w)
    bits = np.zeros((scan.exposures, world.size[0], packed_row_bytes(world.size[1])), np.uint8)

    def some() -> int:
        frames.draw(frames.probability(plane, power_w) if fresh else ready, bits)
        return len(bits)

    return some


def _in_turn(cases: Mapping[Case, Frames]) -> dict[Case, float]:
    """Frames a second of each case, medians over rounds with a moment of each."""
    for frames in cases.values():  # compiled code is loaded before anything is timed
        frames()
    told, speeds = counted("measuring", "rows", None), np.zeros((ROUNDS, len(cases)))
    for done in range(ROUNDS):
        for i, frames in enumerate(cases.values()):
            begun, drawn = time.perf_counter(), 0
            while time.perf_counter() - begun < MOMENT_S or drawn == 0:
                drawn += frames()
            speeds[done, i] = drawn / (time.perf_counter() - begun)
            told(done * len(cases) + i + 1, speeds.size)
    return dict(zip(cases, np.median(speeds, axis=0).tolist(), strict=True))


if __name__ == "__main__":
    main()
