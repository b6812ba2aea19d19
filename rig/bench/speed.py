"""The rows of `rig bench`: every stage at every window, number of exposures and of threads, measured in turn.

A round measures each row for a moment, and the memory beside them; figures are medians over the rounds. Each moment
begins behind the frames of the one before it, so that frames come from memory.
"""

import os
import tempfile
import time
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.errors import digits
from rig.bench.cases import LEARN_EXPOSURES, WINDOWS, Case, Extent, learn, map_cases, stream_cases, usual_window
from rig.bench.frames import COLUMNS, PLACE_FRAMES, BenchFrames, read_all, window_frames
from rig.bench.latency import Latency, measure_latency
from rig.bench.machine import machine
from rig.bench.stages import Measured, StripeError, Walk, count_stage
from rig.progress import Progress, counted, tell_stage
from rig.threads import RowWorkers

REAL_TIME_HZ = 100_000
"""Frames a second of the sensor."""
READ_EVERY = 12
"""Rows from one reading of the memory to the next."""


@dataclass(frozen=True, slots=True)
class SpeedRow:
    """One figure. exposures: None where columns play no part; None as well where a speed or quotient means nothing.

    ms_per_map: of stages that make whole maps. times_sgbm: of `joint`, the time of a map over that of one of
    StereoSGBM's on as many threads, made by turns.
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
    """Whether an estimator keeps up with the sensor, counting included. maps_per_s: of COLUMNS columns; needed_per_s:
    as many as frames at REAL_TIME_HZ make.
    """

    estimator: str
    exposures: int
    threads: int
    maps_per_s: float
    needed_per_s: float

    @property
    def keeps_up(self) -> bool:
        """Whether no frame has to wait for long."""
        return self.maps_per_s >= self.needed_per_s

    def __str__(self) -> str:
        """In words."""
        at = f"at K = {self.exposures} with {self.estimator} on {self.threads} thread{'s' * (self.threads > 1)}"
        needed, possible = digits(self.needed_per_s), digits(self.maps_per_s)
        if self.keeps_up:
            return f"keeps up: {needed} maps a second {at}, {possible} would be possible"
        return f"does not keep up: {possible} of {needed} maps a second {at}"


@dataclass(frozen=True, slots=True)
class SpeedReport:
    """Findings of `rig bench`."""

    machine: dict[str, Any]
    memory_read_gb_per_s: float
    rows: tuple[SpeedRow, ...]
    latency_us: Latency
    seconds: float

    @property
    def working_points(self) -> tuple[WorkingPoint, ...]:
        """The working point of each estimator at each number of exposures of whole sweeps, on all threads."""
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
        """For programs."""
        points = [{**asdict(point), "keeps_up": point.keeps_up} for point in self.working_points]
        return {"advice": [str(point) for point in self.working_points], "working_points": points, **asdict(self)}


def measure_speed(
    threads: int | None = None, extent: Extent | None = None, progress: Progress | None = None
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
        tell_stage("learning")
        learned = {window: learn(these, most) for window, these in frames.items()}
        cases = stream_cases(frames, learned, workers, extent, folder) + map_cases(workers, extent)
        memory, measured = _in_turn(cases, frames[extent.windows[-1]], extent, progress)
        window = usual_window(extent)
        tell_stage("measuring the latency")
        latency = measure_latency(frames[window], LEARN_EXPOSURES, workers[most], learned[window], extent.latency_s)
    read = float(np.median(memory))
    return SpeedReport(found, read / 1e9, _rows(cases, measured, read), latency, time.perf_counter() - begun)


def warm_bench() -> None:
    """Compile what the bench alone needs."""
    with RowWorkers(1) as workers:
        frames = window_frames(WINDOWS[0], workers, 1)
        count_stage(frames, Walk(1), PLACE_FRAMES, workers)(0.0)
    read_all(frames.bits.reshape(-1).view(np.uint64))


def _in_turn(
    cases: list[Case], frames: BenchFrames, extent: Extent, progress: Progress | None
) -> tuple[list[float], list[list[Measured]]]:
    """Bytes a second of each reading of the memory, and what each case measured in each round."""
    words = _random_words(frames, extent.read_bytes)
    memory: list[float] = []
    measured: list[list[Measured]] = [[] for _ in cases]
    read_all(words)
    for stage in {case.stage: case for case in cases}.values():  # compiled code is loaded before anything is timed
        stage.measure(0.0)
    told = counted("measuring", "rows", progress)
    for done in range(extent.rounds):
        for i, case in enumerate(cases):
            if i % READ_EVERY == 0:
                memory.append(_read_bytes_per_s(words))
            moment_s = extent.count_moment_s if case.stage.startswith("count") else extent.moment_s
            measured[i].append(case.measure(moment_s))
            told(done * len(cases) + i + 1, extent.rounds * len(cases))
    return memory, measured


def _random_words(frames: BenchFrames, n_bytes: int) -> NDArray[np.uint64]:
    """Memory of its own with the bits of frames: pages of zeros would be read from a cache."""
    return np.resize(frames.bits.reshape(-1).view(np.uint64), n_bytes // 8)


def _read_bytes_per_s(words: NDArray[np.uint64]) -> float:
    begun = time.perf_counter()
    read_all(words)
    return words.nbytes / (time.perf_counter() - begun)


def _rows(cases: list[Case], measured: list[list[Measured]], read: float) -> tuple[SpeedRow, ...]:
    speeds = [float(np.median([each.frames / each.seconds for each in these])) or None for these in measured]
    naive = {
        (case.window, case.exposures): speed for case, speed in zip(cases, speeds, strict=True) if case.stage == "numpy"
    }
    rows = []
    for case, speed, these in zip(cases, speeds, measured, strict=True):
        slow = naive.get((case.window, case.exposures))
        error = these[0].error or StripeError(*(float("nan"),) * 3)
        row = SpeedRow(
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
            times_sgbm=_times_sgbm(these),
        )
        rows.append(row if these[0].error else replace(row, error_px=None, median_error_px=None, missing=None))
    return tuple(rows)


def _ms_per_map(measured: list[Measured]) -> float | None:
    times = [1e3 * each.seconds / each.maps for each in measured if each.maps]
    return float(np.median(times)) if times else None


def _times_sgbm(measured: list[Measured]) -> float | None:
    quotients = [each.times_sgbm for each in measured if each.times_sgbm is not None]
    return float(np.median(quotients)) if quotients else None
