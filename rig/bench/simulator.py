"""The rows of `rig bench --simulator`: how fast frames of simulated scenes are drawn, beside plain numpy, in one run.

Whole frames of the config's camera at its exposure and power. Per scene and number of threads:

- `simulator-ready`: the light of one column stands, frame after frame is drawn from it;
- `simulator-fresh`: as in a scan, K frames to each of the columns of a sweep, whose light is computed anew;

and once, for the scenes of light that it knows, `simulator-numpy-ready` and `-fresh`: the same in whole-array numpy,
one random number for every pixel. Figures are medians over rounds in which all rows are measured in turn.

What made them what they are (one core, 512 x 512, us a frame drawn): bit planes against random words of SplitMix64 93;
16-bit levels against AES counters of five rounds 25; ties of the two found by a second comparison 20, by pixels drawn
anew 16; the highest level kept as a mask 14; the counter from a table and the comparison turned round, so that both
take their operands from memory, 12: 31 instructions for 64 pixels where there were 45. And of a new column's light: a
function that is handed arrays for every row costs 0.5 to 1 us a row in counted references, so rows are loops within;
numbers that LLVM knows are fetched anew for every vector, so they are arguments; one long loop is slower than two short
ones, since fewer of its rounds are under way at a time; float32 halves the haze's time and all memory. Bands of fewer
rows, for the sake of the caches, gained 10 % on a busy machine and lost as much on an idle one."""

import os
import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from drivers.frames import packed_row_bytes
from drivers.interfaces import World
from rig.bench.frames import read_all
from rig.bench.machine import machine
from rig.config.models import RigConfig
from rig.errors import UsageError
from rig.plan.scan_plan import column_command
from rig.progress import Progress, counted
from rig.tradeoff.effects import open_world

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


class FrameSource(Protocol):
    """Draws frames."""

    def expose(
        self,
        first_frame: int,
        held: Array,
        power_w: Array,
        x0: NDArray[np.int32],
        bits: NDArray[np.uint8],
        time_s: Array,
    ) -> None:
        """Fill bits (n, rows, row bytes) with frames at mirror commands `held` (n,)."""
        ...

    def close(self) -> None:
        """End its threads."""
        ...


class PlainFrames(Protocol):
    """Draws frames in the straightforward way."""

    def probability(self, plane: Array, power_w: float) -> Array:
        """Detection probability of every pixel."""
        ...

    def draw(self, p: Array, bits: NDArray[np.uint8]) -> None:
        """Fill bits (n, rows, row bytes)."""
        ...


@runtime_checkable
class MakesFrames(World, Protocol):
    """A world whose frames can be had without devices."""

    model: Any
    """Its rig model: `planes` of mirror commands."""

    def frame_source(self, exposure_s: float, seed: int, threads: int) -> FrameSource:
        """What draws its frames."""
        ...

    def numpy_frames(self, exposure_s: float, seed: int) -> PlainFrames:
        """The straightforward way to the same."""
        ...

    @property
    def size(self) -> tuple[int, int]:
        """Rows and width."""
        ...


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
    """What `rig bench --simulator` found."""

    machine: dict[str, Any]
    memory_read_gb_per_s: float
    size: tuple[int, int]
    rows: tuple[SimulatorRow, ...]
    seconds: float

    def as_json(self) -> dict[str, Any]:
        """For programs."""
        return asdict(self)


@dataclass(frozen=True, slots=True)
class _Case:
    """A row to be measured. frames: draws some, and says how many."""

    stage: str
    scene: str
    threads: int
    frames: Callable[[], int]


def measure_simulator(
    configure: Callable[[str], RigConfig], extent: SimulatorExtent | None = None, progress: Progress | None = None
) -> SimulatorReport:
    """Measure all scenes. configure: the config with a scene of that name. UsageError where its world draws none."""
    begun, extent = time.perf_counter(), extent or SimulatorExtent()
    numbers = extent.threads or sorted({1, 2, os.cpu_count() or 1})
    with ExitStack() as stack:
        cases: list[_Case] = []
        for scene in extent.scenes:
            config = configure(scene)
            world, power_w = stack.enter_context(open_world(config))
            if not isinstance(world, MakesFrames):
                raise UsageError(f"{config.name}: its world draws no frames; name a config with a simulated one")
            bench = _SceneBench(world, config, power_w)
            for threads in numbers:
                source = stack.enter_context(closing(world.frame_source(config.scan.exposure_s, SEED, threads)))
                cases += [
                    _Case("simulator-ready", scene, threads, bench.ready(source)),
                    _Case("simulator-fresh", scene, threads, bench.fresh(source)),
                ]
            if scene in NUMPY_SCENES:
                plain = world.numpy_frames(config.scan.exposure_s, SEED)
                cases += [
                    _Case("simulator-numpy-ready", scene, 1, bench.plain(plain, fresh=False)),
                    _Case("simulator-numpy-fresh", scene, 1, bench.plain(plain, fresh=True)),
                ]
        memory, speeds = _in_turn(cases, extent, progress)
    rows = _rows(cases, speeds, bench.exposures)
    return SimulatorReport(machine(), memory / 1e9, bench.size, rows, time.perf_counter() - begun)


class _SceneBench:
    """What is measured in one scene."""

    def __init__(self, world: MakesFrames, config: RigConfig, power_w: float) -> None:
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

    def ready(self, source: FrameSource) -> Callable[[], int]:
        """Frames of the middle column."""
        held = np.full(len(self._bits), self._commands[len(self._commands) // 2])
        return lambda: self._exposed(source, held)

    def fresh(self, source: FrameSource) -> Callable[[], int]:
        """Frames of columns that are new each time, spread over the sweep."""

        def frames() -> int:
            stride = -(-len(self._commands) // COLUMNS)
            self._block += 1
            columns = (np.arange(COLUMNS) * stride + self._block) % len(self._commands)
            return self._exposed(source, np.repeat(self._commands[columns], self.exposures))

        return frames

    def plain(self, frames: PlainFrames, *, fresh: bool) -> Callable[[], int]:
        """Frames of the middle column in the straightforward way."""
        plane = self._planes_of(self._commands[len(self._commands) // 2 :][:1])[0]
        bits, ready = self._bits[: self.exposures], frames.probability(plane, self._power_w)

        def some() -> int:
            frames.draw(frames.probability(plane, self._power_w) if fresh else ready, bits)
            return len(bits)

        return some

    def _exposed(self, source: FrameSource, held: Array) -> int:
        power_w, x0, bits, time_s = self._rest
        source.expose(self._block * len(bits), held, power_w, x0, bits, time_s)
        return len(bits)


def _in_turn(cases: list[_Case], extent: SimulatorExtent, progress: Progress | None) -> tuple[float, Array]:
    """Bytes a second of the memory and frames a second of each case, medians over the rounds."""
    words = np.random.default_rng(0).integers(0, 2**63, extent.read_bytes // 8, np.uint64)
    read_all(words)
    for case in cases:  # compiled code is loaded before anything is timed
        case.frames()
    told = counted("measuring", "rows", progress)
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
