"""The rows of `rig bench`: every stage at every window, number of exposures and of threads, measured in turn.

A round measures each row for a short time, and reads the memory in between; results are medians over the rounds. Each
measurement begins after the frames of the previous one, so that frames come from memory and not from a cache.
"""

import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.errors import digits
from drivers.cores import cores
from rig.bench import stages
from rig.bench.frames import (
    COLUMNS,
    FRAMES_BYTES,
    PLACE_FRAMES,
    ROWS,
    BenchFrames,
    bench_surface,
    count_surface,
    full_frames,
    read_all,
    sweep_frames,
    window_frames,
)  # fmt: skip
from rig.bench.latency import SECONDS, Latency, measure_latency, recording_of
from rig.bench.machine import machine
from rig.bench.stages import Measured, Stage, Walk, search_stage
from rig.count.volume import SweepCounter
from rig.estimate.likelihood import Likelihood
from rig.progress import Progress, counted, tell_stage
from rig.threads import RowWorkers

REAL_TIME_HZ = 100_000
"""Frames a second of the sensor."""
READ_EVERY = 12
"""Rows measured from one reading of the memory to the next."""

WINDOWS = (64, 128, 256, 512)
EXPOSURES = (1, 5, 10, 20, 50)
COUNT_EXPOSURES = (1, 3, 5, 10, 15, 20, 50)
"""Exposures at which counting alone and `numpy` are measured, in addition to those of the `Extent`."""
WINDOW = 128
"""Window, in px, of the rows that are measured at one window only."""
FEW_EXPOSURES = (1, 10)
MAP_EXPOSURES = (1, 3, 10)
"""Exposures at which `joint` makes a map from counts."""
SWEEP_EXPOSURES = (3, 10)
"""Exposures at which `joint` counts and makes maps as in a stream: three are the working point to recommend."""
LEARN_EXPOSURES = 10
"""Exposures per column of the sweep from which each window's model is learned; it holds for any number of exposures."""
READ_BYTES = 256 * 2**20
"""Memory that is read to measure its bandwidth: far more than any cache holds."""

Workers = Mapping[int, RowWorkers]
"""Workers by their number of threads."""


@dataclass(frozen=True, slots=True)
class Extent:
    """Amount of work that is measured.

    windows: widths in px. exposures: numbers per column. moment_s: time of each row in each of the `rounds`;
    count_moment_s: the same for the rows `count`, which are fast. latency_s: length of the stream for the latency.
    frames_bytes, read_bytes: memory of the frames of each window, and for the plain read. map_rows, map_columns: size
    of the complete maps.
    """

    windows: tuple[int, ...] = WINDOWS
    exposures: tuple[int, ...] = EXPOSURES
    rounds: int = 3
    moment_s: float = 0.05
    count_moment_s: float = 0.015
    latency_s: float = SECONDS
    frames_bytes: int = FRAMES_BYTES
    read_bytes: int = READ_BYTES
    map_rows: int = ROWS
    map_columns: int = COLUMNS

    @property
    def usual_window(self) -> int:
        """Window of the rows that are measured at one window only: WINDOW, or the first if WINDOW is not measured."""
        return WINDOW if WINDOW in self.windows else self.windows[0]


@dataclass(frozen=True, slots=True)
class MeasuredCase:
    """A row of the table of `rig bench`, still to be measured. window: in px. exposures: per column; None for stages
    without columns. frame_bytes: bytes read from memory per frame; None if that has no meaning."""

    stage: str
    window: int
    exposures: int | None
    threads: int
    frame_bytes: int | None
    measure: Stage


@dataclass(frozen=True, slots=True)
class SpeedRow:
    """A row of the table. exposures: None for stages without columns. Numbers without a meaning for a stage are None.

    of_memory_bandwidth: bytes of frames read a second, divided by the memory's bandwidth. times_numpy: speed divided by
    that of the row `numpy`. ms_per_map: time of a map, of stages that make complete ones. times_sgbm: for `joint`, the
    time of a map divided by that of a StereoSGBM map on as many threads, measured alternately. The error fields are
    those of `StripeError`.
    """

    stage: str
    window: int
    exposures: int | None
    threads: int
    frames_per_s: float | None
    times_real_time: float | None
    of_memory_bandwidth: float | None
    times_numpy: float | None
    error_px: float | None
    median_error_px: float | None
    missing: float | None
    ms_per_map: float | None
    times_sgbm: float | None


@dataclass(frozen=True, slots=True)
class WorkingPoint:
    """Whether an estimator, with counting, keeps up with the sensor.

    maps_per_s: possible maps of COLUMNS columns a second; needed_per_s: maps a second of a sensor at REAL_TIME_HZ.
    """

    estimator: str
    exposures: int
    threads: int
    maps_per_s: float
    needed_per_s: float

    @property
    def keeps_up(self) -> bool:
        """Whether as many maps are possible as are needed."""
        return self.maps_per_s >= self.needed_per_s

    def __str__(self) -> str:
        """Say in words whether it keeps up."""
        at = f"at K = {self.exposures} with {self.estimator} on {self.threads} thread{'s' * (self.threads > 1)}"
        needed, possible = digits(self.needed_per_s), digits(self.maps_per_s)
        if self.keeps_up:
            return f"keeps up: {needed} maps a second {at}, {possible} would be possible"
        return f"does not keep up: {possible} of {needed} maps a second {at}"


@dataclass(frozen=True, slots=True)
class SpeedReport:
    """Findings of `rig bench`. seconds: time that it took."""

    machine: dict[str, Any]
    memory_read_gb_per_s: float
    rows: tuple[SpeedRow, ...]
    latency_us: Latency
    seconds: float

    @property
    def working_points(self) -> tuple[WorkingPoint, ...]:
        """The working point of each row that does whole sweeps on all threads."""
        most = max(row.threads for row in self.rows)
        return tuple(
            WorkingPoint(
                row.stage.removesuffix("-sweep"), row.exposures, most, row.frames_per_s / frames, REAL_TIME_HZ / frames
            )
            for row in self.rows
            if row.stage in ("likelihood-sweep", "joint-sweep") and row.threads == most
            if row.exposures is not None and row.frames_per_s is not None
            for frames in [COLUMNS * row.exposures]
        )

    def as_json(self) -> dict[str, Any]:
        """The findings as plain values, for programs."""
        points = [{**asdict(point), "keeps_up": point.keeps_up} for point in self.working_points]
        return {"advice": [str(point) for point in self.working_points], "working_points": points, **asdict(self)}


def measure_speed(
    threads: int | None = None, extent: Extent | None = None, progress: Progress | None = None
) -> SpeedReport:
    """Measure all rows and the latency.

    threads: the largest number; None for one per core. progress: called with rows done and the total, over all rounds.
    """
    begun = time.perf_counter()
    extent = extent or Extent()
    most = threads or cores()
    found = machine()
    with ExitStack() as stack:
        # Two threads are measured on bigger machines too, since claims are for two cores.
        workers = {n: stack.enter_context(RowWorkers(n)) for n in sorted({1, min(2, most), most})}
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="spadrig-bench-")))
        frames = {window: window_frames(window, workers[most], extent.frames_bytes) for window in extent.windows}
        tell_stage("learning")
        learned = {window: learn(these, most) for window, these in frames.items()}
        cases = [case for w, these in frames.items() for case in _window_cases(these, learned[w], workers, extent)]
        usual, likelihood = frames[extent.usual_window], learned[extent.usual_window]
        cases += _usual_cases(usual, likelihood, workers, extent, folder)
        cases += _map_cases(workers, extent)
        memory, measured = _in_turn(cases, frames[extent.windows[-1]], extent, progress)
        tell_stage("measuring the latency")
        latency = measure_latency(usual, LEARN_EXPOSURES, workers[most], likelihood, extent.latency_s)
    read = float(np.median(memory))
    return SpeedReport(found, read / 1e9, _rows(cases, measured, read), latency, time.perf_counter() - begun)


def warm_bench() -> None:
    """Compile what only the bench needs."""
    with RowWorkers(1) as workers:
        frames = window_frames(WINDOWS[0], workers, 1)
        stages.count_stage(frames, Walk(frames), PLACE_FRAMES, workers)(0.0)
    read_all(frames.bits.reshape(-1).view(np.uint64))


def learn(frames: BenchFrames, threads: int) -> Likelihood:
    """An estimator that has learned from a first sweep of these frames, as it would in a scan."""
    likelihood = Likelihood(threads)
    # Each column has its own stripe, as in a scan: one that stayed would look like hot pixels.
    places, column = len(frames.bits) // PLACE_FRAMES, np.arange(COLUMNS)
    first = column % places * PLACE_FRAMES + column // places * LEARN_EXPOSURES % PLACE_FRAMES
    bits = frames.bits[(first[:, None] + np.arange(LEARN_EXPOSURES)).ravel()]
    with RowWorkers(threads) as workers:
        counter = SweepCounter(frames.layout(LEARN_EXPOSURES), workers)
        counter.add(bits, *sweep_frames(frames.geometry, LEARN_EXPOSURES))
    likelihood.estimate(counter.finish(), frames.geometry)
    return likelihood


def _cases(
    stage: str,
    frames: BenchFrames,
    exposures: Iterable[int],
    workers: Workers,
    make: Callable[[int, RowWorkers], Stage],
) -> list[MeasuredCase]:
    """A stage at these numbers of exposures and of threads."""
    return [
        MeasuredCase(stage, frames.window, k, n, frames.frame_bytes, make(k, own))
        for k in exposures
        for n, own in workers.items()
    ]


def _window_cases(frames: BenchFrames, learned: Likelihood, workers: Workers, extent: Extent) -> list[MeasuredCase]:
    """The rows of every window."""
    walk, one = Walk(frames), {1: workers[1]}
    every = sorted({*COUNT_EXPOSURES, *extent.exposures})
    return [
        *_cases("numpy", frames, every, one, lambda k, _: stages.numpy_stage(frames, walk, k)),
        *_cases("count", frames, every, workers, lambda k, own: stages.count_stage(frames, walk, k, own)),
        *_cases(
            "likelihood",
            frames,
            extent.exposures,
            workers,
            lambda k, own: search_stage(frames, walk, k, own, learned),
        ),
    ]


def _usual_cases(
    frames: BenchFrames, learned: Likelihood, workers: Workers, extent: Extent, folder: Path
) -> list[MeasuredCase]:
    """The rows of the usual window only, all of `likelihood`: with whole sweeps, with whole frames, with frames from a
    recording."""
    few = [k for k in FEW_EXPOSURES if k in extent.exposures]
    full = full_frames(frames, extent.frames_bytes)
    walk, full_walk = Walk(frames), Walk(full)
    recording, stride = recording_of(frames)
    path = folder / "frames.spb"
    recording.tofile(path)
    source = stages.from_file(path, stride)

    def whole(k: int, own: RowWorkers) -> Stage:
        return search_stage(frames, walk, k, own, learned, whole_sweeps=True)

    return [
        *_cases("likelihood-sweep", frames, few, workers, whole),
        *_cases("likelihood-full", full, few, workers, lambda k, own: search_stage(full, full_walk, k, own, learned)),
        *_cases("disk", frames, few, workers, lambda k, own: search_stage(frames, walk, k, own, learned, source)),
    ]


def _map_cases(workers: Workers, extent: Extent) -> list[MeasuredCase]:
    """The rows of whole maps."""
    surface = bench_surface(extent.map_rows, extent.map_columns)
    most, window = max(workers), WINDOWS[0]
    model = stages.learn_joint(surface, LEARN_EXPOSURES, most)
    cases = [MeasuredCase("sgbm", window, None, n, None, stages.sgbm_stage(surface, n)) for n in workers]
    for k in MAP_EXPOSURES:
        bits = surface.frames(k, workers[most])
        volume = count_surface(surface, bits, k, workers[most])
        for n in workers:
            cases.append(MeasuredCase("joint", window, k, n, None, stages.joint_stage(surface, volume, n, model)))
            if k in SWEEP_EXPOSURES:
                sweep = stages.joint_sweep_stage(surface, bits, k, n, model)
                cases.append(MeasuredCase("joint-sweep", window, k, n, None, sweep))
    return cases


def _in_turn(
    cases: list[MeasuredCase], frames: BenchFrames, extent: Extent, progress: Progress | None
) -> tuple[list[float], list[list[Measured]]]:
    """Bytes a second of each reading of the memory, and the result of each case in each round."""
    # Memory of its own with the bits of frames: pages of zeros would be read from a cache.
    words = np.resize(frames.bits.reshape(-1).view(np.uint64), extent.read_bytes // 8)
    memory: list[float] = []
    measured: list[list[Measured]] = [[] for _ in cases]
    read_all(words)
    for case in {case.stage: case for case in cases}.values():  # compiled code is loaded before anything is timed
        case.measure(0.0)
    told = counted("measuring", "rows", progress)
    for done in range(extent.rounds):
        for i, case in enumerate(cases):
            if i % READ_EVERY == 0:
                memory.append(_read_bytes_per_s(words))
            moment_s = extent.count_moment_s if case.stage == "count" else extent.moment_s
            measured[i].append(case.measure(moment_s))
            told(done * len(cases) + i + 1, extent.rounds * len(cases))
    return memory, measured


def _read_bytes_per_s(words: NDArray[np.uint64]) -> float:
    begun = time.perf_counter()
    read_all(words)
    return words.nbytes / (time.perf_counter() - begun)


def _rows(cases: Sequence[MeasuredCase], measured: Sequence[Sequence[Measured]], read: float) -> tuple[SpeedRow, ...]:
    speeds = [_median(each.frames / each.seconds for each in these) or None for these in measured]
    naive = {
        (case.window, case.exposures): speed for case, speed in zip(cases, speeds, strict=True) if case.stage == "numpy"
    }
    rows = []
    for case, speed, these in zip(cases, speeds, measured, strict=True):
        error = these[0].error
        rows.append(
            SpeedRow(
                stage=case.stage,
                window=case.window,
                exposures=case.exposures,
                threads=case.threads,
                frames_per_s=speed,
                times_real_time=_over(speed, REAL_TIME_HZ),
                of_memory_bandwidth=_over(speed, read / case.frame_bytes if case.frame_bytes else None),
                times_numpy=_over(speed, naive.get((case.window, case.exposures))),
                error_px=error.mean_abs_px if error else None,
                median_error_px=error.median_abs_px if error else None,
                missing=error.missing if error else None,
                ms_per_map=_median(1e3 * each.seconds / each.maps for each in these if each.maps),
                times_sgbm=_median(each.times_sgbm for each in these if each.times_sgbm is not None),
            )
        )
    return tuple(rows)


def _over(value: float | None, unit: float | None) -> float | None:
    return None if value is None or unit is None else value / unit


def _median(values: Iterable[float]) -> float | None:
    found = list(values)
    return float(np.median(found)) if found else None
