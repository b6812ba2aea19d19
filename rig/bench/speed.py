"""The rows of `rig bench`: every stage at every window, number of exposures and of threads, measured in turn.

A round measures each row for a moment, and the memory beside them; figures are medians over the rounds. Each moment
begins behind the frames of the one before it, so that frames come from memory.
"""

import os
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.bench.bench_kernels import read_all
from rig.bench.frames import COLUMNS, FRAMES_BYTES, PLACE_FRAMES, ROWS, BenchFrames, full_frames, window_frames
from rig.bench.latency import SECONDS, Latency, measure_latency
from rig.bench.machine import machine
from rig.bench.map_stages import joint_stage, joint_sweep_stage, learn_joint, sgbm_stage
from rig.bench.recorded import recording_of
from rig.bench.stages import (
    Measured,
    Stage,
    StripeError,
    Walk,
    count_stage,
    from_file,
    numpy_stage,
    parse_stage,
    search_stage,
)
from rig.bench.surface import bench_surface, count_surface
from rig.counting import SweepCounter
from rig.estimators.likelihood import Likelihood
from rig.row_threads import RowWorkers

REAL_TIME_HZ = 100_000
"""Frames a second of the sensor."""
WINDOWS = (64, 128, 256, 512)
EXPOSURES = (1, 5, 10, 20, 50)
COUNT_EXPOSURES = (1, 3, 5, 10, 15, 20, 50)
"""Counting is claimed for 3 to 15 and beyond."""
WINDOW = 128
"""Window of the rows that are not measured at every one."""
FEW_EXPOSURES = (1, 10)
LEARN_EXPOSURES = 10
"""What is learned of the light does not depend on the exposures of a column, so that it is learned once a window."""
READ_BYTES = 256 * 2**20
"""Memory that is read for its bandwidth: far more than any cache holds."""
READ_EVERY = 12
"""Rows from one reading of the memory to the next."""


@dataclass(frozen=True, slots=True)
class Extent:
    """How much is measured.

    moment_s, count_moment_s: of each row in each of the `rounds`, those of `count` being fast. latency_s: of the stream
    for the latency. frames_bytes, read_bytes: memory of the frames of each window, and for the plain read. map_rows,
    map_columns: of the maps that are made as a whole.
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


@dataclass(frozen=True, slots=True)
class Row:
    """One figure. exposures: None where columns play no part; None as well where a speed or quotient means nothing.

    ms_per_map: of stages that make whole maps.
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


@dataclass(frozen=True, slots=True)
class SpeedReport:
    """What `rig bench` found."""

    machine: dict[str, Any]
    memory_read_gb_per_s: float
    rows: tuple[Row, ...]
    latency_us: Latency
    seconds: float

    def as_json(self) -> dict[str, Any]:
        """For programs."""
        return asdict(self)


@dataclass(frozen=True, slots=True)
class _Case:
    """A row to be measured. frame_bytes: read from memory per frame; None where that means nothing."""

    stage: str
    window: int
    exposures: int | None
    threads: int
    frame_bytes: int | None
    measure: Stage


def measure_speed(
    threads: int | None = None, extent: Extent | None = None, progress: Callable[[int, int], None] | None = None
) -> SpeedReport:
    """Measure everything. threads: the most; by default one for each core. progress: told rows done and all."""
    begun = time.perf_counter()
    extent = extent or Extent()
    most = threads or os.cpu_count() or 1
    found = machine()
    with ExitStack() as stack:
        # Two threads are measured on bigger machines too, since claims are for two cores.
        workers = {n: stack.enter_context(RowWorkers(n)) for n in sorted({1, min(2, most), most})}
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="spadrig-bench-")))
        frames = {window: window_frames(window, workers[most], extent.frames_bytes) for window in extent.windows}
        learned = {window: learn(these, most) for window, these in frames.items()}
        cases = _cases(frames, learned, workers, extent, folder) + _map_cases(workers, extent)
        memory, measured = _in_turn(cases, frames[extent.windows[-1]], extent, progress)
        window = _usual_window(extent)
        latency = measure_latency(frames[window], LEARN_EXPOSURES, workers[most], learned[window], extent.latency_s)
    read = float(np.median(memory))
    return SpeedReport(found, read / 1e9, _rows(cases, measured, read), latency, time.perf_counter() - begun)


def warm_bench() -> None:
    """Compile what the bench alone needs."""
    with RowWorkers(1) as workers:
        frames = window_frames(WINDOWS[0], workers, 1)
        count_stage(frames, Walk(1), PLACE_FRAMES, workers)(0.0)
    read_all(frames.bits.reshape(-1).view(np.uint64))


def learn(frames: BenchFrames, threads: int) -> Likelihood:
    """An estimator that has learned from a first sweep of these frames, as it would in a scan."""
    likelihood = Likelihood(threads)
    layout = frames.layout(LEARN_EXPOSURES)
    bins = np.repeat(np.arange(layout.columns, dtype=np.int32), LEARN_EXPOSURES)
    x0 = np.full(len(bins), frames.geometry.x0[0], np.int32)
    with RowWorkers(threads) as workers:
        counter = SweepCounter(layout, workers)
        counter.add(_ever_new(frames, layout.columns), bins, bins.astype(np.float64), x0)
    likelihood.estimate(counter.finish(), frames.geometry)
    return likelihood


def _ever_new(frames: BenchFrames, columns: int) -> NDArray[np.uint8]:
    """Frames of columns that each have their own stripe, as in a scan: one that stayed would look like hot pixels."""
    places = len(frames.bits) // PLACE_FRAMES
    column = np.arange(columns)
    first = column % places * PLACE_FRAMES + column // places * LEARN_EXPOSURES % PLACE_FRAMES
    bits: NDArray[np.uint8] = frames.bits[(first[:, None] + np.arange(LEARN_EXPOSURES)).ravel()]
    return bits


def _cases(
    frames: dict[int, BenchFrames],
    learned: dict[int, Likelihood],
    workers: dict[int, RowWorkers],
    extent: Extent,
    folder: Path,
) -> list[_Case]:
    """All rows, those that share much of their memory beside each other."""
    cases: list[_Case] = []
    for window, these in frames.items():
        walk = Walk(len(these.bits) // PLACE_FRAMES)
        size = these.frame_bytes
        for k in sorted({*COUNT_EXPOSURES, *extent.exposures}):
            cases.append(_Case("numpy", window, k, 1, size, numpy_stage(these, walk, k)))
            cases += [_Case("count", window, k, n, size, count_stage(these, walk, k, w)) for n, w in workers.items()]
        for k in extent.exposures:
            cases += [
                _Case("likelihood", window, k, n, size, search_stage(these, walk, k, w, learned[window]))
                for n, w in workers.items()
            ]
    window = _usual_window(extent)
    few = [k for k in FEW_EXPOSURES if k in extent.exposures]
    cases += _sweep_cases(frames[window], learned[window], workers, few)
    cases += _full_cases(frames[window], learned[window], workers, extent, few)
    cases += _recorded_cases(frames[window], learned[window], workers, few, folder)
    return cases


def _sweep_cases(
    frames: BenchFrames, learned: Likelihood, workers: dict[int, RowWorkers], few: list[int]
) -> list[_Case]:
    walk = Walk(len(frames.bits) // PLACE_FRAMES)
    return [
        _Case(
            "likelihood-sweep", frames.window, k, n, frames.frame_bytes,
            search_stage(frames, walk, k, w, learned, whole_sweeps=True),
        )
        for k in few
        for n, w in workers.items()
    ]  # fmt: skip


def _full_cases(
    narrow: BenchFrames, learned: Likelihood, workers: dict[int, RowWorkers], extent: Extent, few: list[int]
) -> list[_Case]:
    full = full_frames(narrow, extent.frames_bytes)
    walk = Walk(len(full.bits) // PLACE_FRAMES)
    cases = []
    for k in few:
        for n, w in workers.items():
            cases += [
                _Case("count-full", full.window, k, n, full.frame_bytes, count_stage(full, walk, k, w)),
                _Case("likelihood-full", full.window, k, n, full.frame_bytes, search_stage(full, walk, k, w, learned)),
            ]
    return cases


def _recorded_cases(
    frames: BenchFrames, learned: Likelihood, workers: dict[int, RowWorkers], few: list[int], folder: Path
) -> list[_Case]:
    recording, stride = recording_of(frames)
    path = folder / "frames.spb"
    recording.tofile(path)
    walk = Walk(len(frames.bits) // PLACE_FRAMES)
    cases = []
    for stage, check in (("parse", False), ("parse-crc", True)):
        measure = parse_stage(recording, stride, check_payload=check)
        # Headers alone are no stream of frames from memory.
        cases.append(_Case(stage, frames.window, None, 1, frames.frame_bytes if check else None, measure))
    for stage, check in (("disk", False), ("disk-crc", True)):
        source = from_file(path, stride, check_payload=check)
        for k in few if not check else few[-1:]:
            cases += [
                _Case(stage, frames.window, k, n, frames.frame_bytes, search_stage(frames, walk, k, w, learned, source))
                for n, w in workers.items()
            ]
    return cases


def _map_cases(workers: dict[int, RowWorkers], extent: Extent) -> list[_Case]:
    surface = bench_surface(extent.map_rows, extent.map_columns)
    most, window = max(workers), WINDOWS[0]
    model = learn_joint(surface, LEARN_EXPOSURES, most)
    cases = [_Case("sgbm", window, None, n, None, sgbm_stage(surface, n)) for n in workers]
    for k in FEW_EXPOSURES:
        bits = surface.frames(k, workers[most])
        volume = count_surface(surface, bits, k, workers[most])
        cases += [_Case("joint", window, k, n, None, joint_stage(surface, volume, n, model)) for n in workers]
    cases.append(_Case("joint-sweep", window, k, most, None, joint_sweep_stage(surface, bits, k, most, model)))
    return cases


def _in_turn(
    cases: list[_Case], frames: BenchFrames, extent: Extent, progress: Callable[[int, int], None] | None
) -> tuple[list[float], list[list[Measured]]]:
    """Bytes a second of each reading of the memory, and what each case measured in each round."""
    words = _random_words(frames, extent.read_bytes)
    memory: list[float] = []
    measured: list[list[Measured]] = [[] for _ in cases]
    read_all(words)
    for stage in {case.stage: case for case in cases}.values():  # compiled code is loaded before anything is timed
        stage.measure(0.0)
    for done in range(extent.rounds):
        for i, case in enumerate(cases):
            if i % READ_EVERY == 0:
                memory.append(_read_bytes_per_s(words))
            moment_s = extent.count_moment_s if case.stage.startswith("count") else extent.moment_s
            measured[i].append(case.measure(moment_s))
            if progress is not None:
                progress(done * len(cases) + i + 1, extent.rounds * len(cases))
    return memory, measured


def _random_words(frames: BenchFrames, n_bytes: int) -> NDArray[np.uint64]:
    """Memory of its own with the bits of frames: pages of zeros would be read from a cache."""
    return np.resize(frames.bits.reshape(-1).view(np.uint64), n_bytes // 8)


def _read_bytes_per_s(words: NDArray[np.uint64]) -> float:
    begun = time.perf_counter()
    read_all(words)
    return words.nbytes / (time.perf_counter() - begun)


def _rows(cases: list[_Case], measured: list[list[Measured]], read: float) -> tuple[Row, ...]:
    speeds = [float(np.median([each.frames / each.seconds for each in these])) or None for these in measured]
    naive = {
        (case.window, case.exposures): speed for case, speed in zip(cases, speeds, strict=True) if case.stage == "numpy"
    }
    rows = []
    for case, speed, these in zip(cases, speeds, measured, strict=True):
        slow = naive.get((case.window, case.exposures))
        error = these[0].error or StripeError(*(float("nan"),) * 3)
        row = Row(
            stage=case.stage,
            window=case.window,
            exposures=case.exposures,
            threads=case.threads,
            frames_per_s=speed,
            times_real_time=None if speed is None else speed / REAL_TIME_HZ,
            of_memory_bandwidth=None if speed is None or case.frame_bytes is None else speed * case.frame_bytes / read,
            times_numpy=None if speed is None or slow is None else speed / slow,
            error_px=error.mean_abs_px,
            median_error_px=error.median_abs_px,
            missing=error.missing,
            ms_per_map=_ms_per_map(these),
        )
        rows.append(row if these[0].error else replace(row, error_px=None, median_error_px=None, missing=None))
    return tuple(rows)


def _ms_per_map(measured: list[Measured]) -> float | None:
    times = [1e3 * each.seconds / each.maps for each in measured if each.maps]
    return float(np.median(times)) if times else None


def _usual_window(extent: Extent) -> int:
    return WINDOW if WINDOW in extent.windows else extent.windows[0]
