"""The measurements of `rig bench`: every stage at every window, number of exposures and of threads."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rig.bench.frames import (
    COLUMNS,
    FRAMES_BYTES,
    PLACE_FRAMES,
    ROWS,
    BenchFrames,
    bench_surface,
    count_surface,
    full_frames,
)
from rig.bench.latency import SECONDS, recording_of
from rig.bench.stages import (
    Stage,
    Walk,
    count_stage,
    from_file,
    joint_stage,
    joint_sweep_stage,
    learn_joint,
    numpy_stage,
    parse_stage,
    search_stage,
    sgbm_stage,
)
from rig.count.volume import SweepCounter
from rig.estimate.likelihood import Likelihood
from rig.threads import RowWorkers

WINDOWS = (64, 128, 256, 512)
EXPOSURES = (1, 5, 10, 20, 50)
COUNT_EXPOSURES = (1, 3, 5, 10, 15, 20, 50)
"""Counting is claimed for 3 to 15 and beyond."""
WINDOW = 128
"""Window of the rows that are not measured at every one."""
FEW_EXPOSURES = (1, 10)
LEARN_EXPOSURES = 10
"""Exposures of the sweep that is learned from, once a window: the light does not depend on them."""
READ_BYTES = 256 * 2**20
"""Memory that is read for its bandwidth: far more than any cache holds."""


@dataclass(frozen=True, slots=True)
class Extent:
    """Amount of work that is measured.

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
class Case:
    """A row to be measured. frame_bytes: read from memory per frame; None where that means nothing."""

    stage: str
    window: int
    exposures: int | None
    threads: int
    frame_bytes: int | None
    measure: Stage


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


def stream_cases(
    frames: dict[int, BenchFrames],
    learned: dict[int, Likelihood],
    workers: dict[int, RowWorkers],
    extent: Extent,
    folder: Path,
) -> list[Case]:
    """All rows of streams, those that share much of their memory beside each other."""
    cases: list[Case] = []
    for window, these in frames.items():
        walk = Walk(len(these.bits) // PLACE_FRAMES)
        size = these.frame_bytes
        for k in sorted({*COUNT_EXPOSURES, *extent.exposures}):
            cases.append(Case("numpy", window, k, 1, size, numpy_stage(these, walk, k)))
            cases += [Case("count", window, k, n, size, count_stage(these, walk, k, w)) for n, w in workers.items()]
        for k in extent.exposures:
            cases += [
                Case("likelihood", window, k, n, size, search_stage(these, walk, k, w, learned[window]))
                for n, w in workers.items()
            ]
    window = usual_window(extent)
    few = [k for k in FEW_EXPOSURES if k in extent.exposures]
    cases += _sweep_cases(frames[window], learned[window], workers, few)
    cases += _full_cases(frames[window], learned[window], workers, extent, few)
    cases += _recorded_cases(frames[window], learned[window], workers, few, folder)
    return cases


def _sweep_cases(
    frames: BenchFrames, learned: Likelihood, workers: dict[int, RowWorkers], few: list[int]
) -> list[Case]:
    walk = Walk(len(frames.bits) // PLACE_FRAMES)
    return [
        Case(
            "likelihood-sweep", frames.window, k, n, frames.frame_bytes,
            search_stage(frames, walk, k, w, learned, whole_sweeps=True),
        )
        for k in few
        for n, w in workers.items()
    ]  # fmt: skip


def _full_cases(
    narrow: BenchFrames, learned: Likelihood, workers: dict[int, RowWorkers], extent: Extent, few: list[int]
) -> list[Case]:
    full = full_frames(narrow, extent.frames_bytes)
    walk = Walk(len(full.bits) // PLACE_FRAMES)
    cases = []
    for k in few:
        for n, w in workers.items():
            cases += [
                Case("count-full", full.window, k, n, full.frame_bytes, count_stage(full, walk, k, w)),
                Case("likelihood-full", full.window, k, n, full.frame_bytes, search_stage(full, walk, k, w, learned)),
            ]
    return cases


def _recorded_cases(
    frames: BenchFrames, learned: Likelihood, workers: dict[int, RowWorkers], few: list[int], folder: Path
) -> list[Case]:
    recording, stride = recording_of(frames)
    path = folder / "frames.spb"
    recording.tofile(path)
    walk = Walk(len(frames.bits) // PLACE_FRAMES)
    cases = []
    for stage, check in (("parse", False), ("parse-crc", True)):
        measure = parse_stage(recording, stride, check_payload=check)
        # Headers alone are no stream of frames from memory.
        cases.append(Case(stage, frames.window, None, 1, frames.frame_bytes if check else None, measure))
    for stage, check in (("disk", False), ("disk-crc", True)):
        source = from_file(path, stride, check_payload=check)
        for k in few if not check else few[-1:]:
            cases += [
                Case(stage, frames.window, k, n, frames.frame_bytes, search_stage(frames, walk, k, w, learned, source))
                for n, w in workers.items()
            ]
    return cases


def map_cases(workers: dict[int, RowWorkers], extent: Extent) -> list[Case]:
    """The rows of whole maps."""
    surface = bench_surface(extent.map_rows, extent.map_columns)
    most, window = max(workers), WINDOWS[0]
    model = learn_joint(surface, LEARN_EXPOSURES, most)
    cases = [Case("sgbm", window, None, n, None, sgbm_stage(surface, n)) for n in workers]
    for k in FEW_EXPOSURES:
        bits = surface.frames(k, workers[most])
        volume = count_surface(surface, bits, k, workers[most])
        cases += [Case("joint", window, k, n, None, joint_stage(surface, volume, n, model)) for n in workers]
    cases.append(Case("joint-sweep", window, k, most, None, joint_sweep_stage(surface, bits, k, most, model)))
    return cases


def usual_window(extent: Extent) -> int:
    """Window of the rows that are not measured at every one."""
    return WINDOW if WINDOW in extent.windows else extent.windows[0]
