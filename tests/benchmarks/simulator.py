"""How fast frames of simulated scenes are drawn, beside plain numpy: python -m tests.benchmarks.simulator.

Whole frames of the simulated rig's camera at its exposure and power. Per scene and number of threads:

- `simulator-ready`: the light of one column stands, frame after frame is drawn from it;
- `simulator-fresh`: as in a scan, K frames to each of the columns of a sweep, whose light is computed anew;

and once, for the scenes of light that it knows, `simulator-numpy-ready` and `-fresh`: the same in whole-array numpy,
one random number for every pixel. Figures are medians over rounds in which all rows are measured in turn.
"""

import argparse
import os
import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from drivers.frames import packed_row_bytes
from rig.bench.frames import read_all
from rig.bench.machine import machine
from rig.cli.progress import progress
from rig.cli.tables import BENCH_WIDTH, print_machine
from rig.config.models import RigConfig
from rig.config.overrides import configure
from rig.plan.scan_plan import column_command
from rig.progress import counted
from rig.tradeoff.effects import open_world
from sim_backend.effects.setting import FrameTimes
from sim_backend.frames.photons import PhotonSource
from sim_backend.world import SimulatedWorld
from tests.benchmarks.numpy_frames import NumpyFrames

Array = NDArray[np.float64]

SCENES = ("street-clear", "street", "street-everything")
NUMPY_SCENES = SCENES[:2]
"""Stripe and haze are all that the numpy way knows."""
BASELINE = "street"
"""Whose numpy rows all others are compared with."""
REAL_TIME_HZ = 100_000
"""Frames a second of the sensor."""
COLUMNS = 50
"""Columns of the sweep that are handed over at a time, a block of some milliseconds, spread over its range."""
READ_BYTES = 256 * 2**20
"""Memory that is read for its bandwidth: far more than any cache holds."""
SEED = 1


@dataclass(frozen=True, slots=True)
class SimulatorExtent:
    """How much is measured: moment_s of each row in each of the rounds. threads: None for 1, 2 (claims are for two) and
    as many as there are cores."""

    scenes: tuple[str, ...] = SCENES
    threads: tuple[int, ...] | None = None
    rounds: int = 5
    moment_s: float = 0.25
    read_bytes: int = READ_BYTES


@dataclass(frozen=True, slots=True)
class SimulatorRow:
    """One figure. exposures: frames a column. times_numpy: of the numpy way to the same, in the fog scene, one
    thread."""

    stage: str
    scene: str
    threads: int
    exposures: int
    frames_per_s: float
    us_per_frame: float
    times_real_time: float
    times_numpy: float | None


@dataclass(frozen=True, slots=True)
class SimulatorReport:
    """All rows. memory_read_gb_per_s: on one thread. size: rows and width of the frames."""

    machine: dict[str, Any]
    memory_read_gb_per_s: float
    size: tuple[int, int]
    rows: tuple[SimulatorRow, ...]
    seconds: float


@dataclass(frozen=True, slots=True)
class _Case:
    """A row to be measured. frames: draws some, and says how many."""

    stage: str
    scene: str
    threads: int
    frames: Callable[[], int]


def main() -> None:
    """Print the rows."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    with progress():
        report = measure_simulator()
    simulator_table(report)


def simulator_table(report: SimulatorReport) -> None:
    """Print the rows to stdout."""
    console = Console(highlight=False, width=BENCH_WIDTH)
    print_machine(console, report.machine)
    console.print(f"memory read, one thread: {report.memory_read_gb_per_s:.1f} GB/s")
    rows, width = report.size
    console.print(f"frames of {rows} x {width}; ready: one column's light stands; fresh: computed for every column")
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for name in ("row", "scene", "threads", "K", "kframes/s", "us/frame", "real time", "x numpy"):
        table.add_column(name, justify="left" if name in ("row", "scene") else "right", no_wrap=True)
    for row in report.rows:
        table.add_row(
            row.stage.removeprefix("simulator-"),
            row.scene,
            str(row.threads),
            str(row.exposures),
            f"{row.frames_per_s / 1e3:.4g}",
            f"{row.us_per_frame:.4g}",
            f"{row.times_real_time:.2g}",
            "-" if row.times_numpy is None else f"{row.times_numpy:.3g}",
        )
    console.print(table)
    console.print(f"x numpy: of whole-array numpy in the foggy scene, one thread; measured in {report.seconds:.0f} s")


def measure_simulator(extent: SimulatorExtent | None = None) -> SimulatorReport:
    """Measure all scenes."""
    begun, extent = time.perf_counter(), extent or SimulatorExtent()
    numbers = extent.threads or sorted({1, 2, os.cpu_count() or 1})
    with ExitStack() as stack:
        cases: list[_Case] = []
        for scene in extent.scenes:
            config = configure("simulated", scene=scene)
            world, power_w = stack.enter_context(open_world(config))
            assert isinstance(world, SimulatedWorld)
            bench = _SceneBench(world, config, power_w)
            times = FrameTimes(config.scan.exposure_s, config.scan.exposure_s)
            for threads in numbers:
                source = stack.enter_context(closing(world.photons(times, SEED, threads)))
                cases += [
                    _Case("simulator-ready", scene, threads, bench.ready(source)),
                    _Case("simulator-fresh", scene, threads, bench.fresh(source)),
                ]
            if scene in NUMPY_SCENES:
                plain = NumpyFrames(world.setting, world.flux_model.steady_per_s, config.scan.exposure_s, SEED)
                cases += [
                    _Case("simulator-numpy-ready", scene, 1, bench.plain(plain, fresh=False)),
                    _Case("simulator-numpy-fresh", scene, 1, bench.plain(plain, fresh=True)),
                ]
        memory, speeds = _in_turn(cases, extent)
    rows = _rows(cases, speeds, bench.exposures)
    return SimulatorReport(machine(), memory / 1e9, bench.size, rows, time.perf_counter() - begun)


class _SceneBench:
    """What is measured in one scene."""

    def __init__(self, world: SimulatedWorld, config: RigConfig, power_w: float) -> None:
        scan = config.scan
        self.exposures, self.size = scan.exposures, world.size
        self._planes_of = world.model.planes
        self._power_w = power_w
        self._commands: Array = column_command(np.arange(scan.columns), scan.command_range, scan.columns)
        n = COLUMNS * self.exposures
        self._bits = np.zeros((n, self.size[0], packed_row_bytes(self.size[1])), np.uint8)
        self._rest = (
            np.full(n, power_w),
            np.zeros(n, np.int32),
            self._bits,
            np.arange(n, dtype=np.float64) * scan.exposure_s,
        )
        self._block = 0

    def ready(self, source: PhotonSource) -> Callable[[], int]:
        """Frames of the middle column."""
        held = np.full(len(self._bits), self._commands[len(self._commands) // 2])
        return lambda: self._exposed(source, held)

    def fresh(self, source: PhotonSource) -> Callable[[], int]:
        """Frames of columns that are new each time, spread over the sweep."""

        def frames() -> int:
            stride = -(-len(self._commands) // COLUMNS)
            self._block += 1
            columns = (np.arange(COLUMNS) * stride + self._block) % len(self._commands)
            return self._exposed(source, np.repeat(self._commands[columns], self.exposures))

        return frames

    def plain(self, frames: NumpyFrames, *, fresh: bool) -> Callable[[], int]:
        """Frames of the middle column in the straightforward way."""
        plane = self._planes_of(self._commands[len(self._commands) // 2 :][:1])[0]
        bits, ready = self._bits[: self.exposures], frames.probability(plane, self._power_w)

        def some() -> int:
            frames.draw(frames.probability(plane, self._power_w) if fresh else ready, bits)
            return len(bits)

        return some

    def _exposed(self, source: PhotonSource, held: Array) -> int:
        power_w, x0, bits, time_s = self._rest
        source.expose(self._block * len(bits), held, power_w, x0, bits, time_s)
        return len(bits)


def _in_turn(cases: list[_Case], extent: SimulatorExtent) -> tuple[float, Array]:
    """Bytes a second of the memory and frames a second of each case, medians over the rounds."""
    words = np.random.default_rng(0).integers(0, 2**63, extent.read_bytes // 8, np.uint64)
    read_all(words)
    for case in cases:  # compiled code is loaded before anything is timed
        case.frames()
    told = counted("measuring", "rows", None)
    memory, speeds = np.zeros(extent.rounds), np.zeros((extent.rounds, len(cases)))
    for done in range(extent.rounds):
        begun = time.perf_counter()
        read_all(words)
        memory[done] = words.nbytes / (time.perf_counter() - begun)
        for i, case in enumerate(cases):
            begun, frames = time.perf_counter(), 0
            while time.perf_counter() - begun < extent.moment_s or frames == 0:
                frames += case.frames()
            speeds[done, i] = frames / (time.perf_counter() - begun)
            told(done * len(cases) + i + 1, extent.rounds * len(cases))
    return float(np.median(memory)), np.median(speeds, axis=0)


def _rows(cases: list[_Case], speeds: Array, exposures: int) -> tuple[SimulatorRow, ...]:
    plain = {
        case.stage.removeprefix("simulator-numpy-"): float(speed)
        for case, speed in zip(cases, speeds, strict=True)
        if case.scene == BASELINE and case.stage.startswith("simulator-numpy-")
    }
    rows = []
    for case, speed in zip(cases, speeds, strict=True):
        slow = plain.get(case.stage.rpartition("-")[2])
        times = None if slow is None else float(speed) / slow
        place = case.stage, case.scene, case.threads, exposures
        rows.append(SimulatorRow(*place, float(speed), 1e6 / float(speed), float(speed) / REAL_TIME_HZ, times))
    return tuple(rows)


if __name__ == "__main__":
    main()
