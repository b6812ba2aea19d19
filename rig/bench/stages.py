"""The stages that are measured. Each works on frames for a short time and returns their number and the time it took.

docs/results/speed.md explains each stage. Work that is done once a sweep is not timed, except with `whole_sweeps`. On a
machine with other work, quotients of times measured one after the other are meaningless, so `joint` and StereoSGBM make
maps alternately. Nothing is learned meanwhile. Stages that make maps begin with one that is not timed.
"""

import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.frames import FrameBlock
from drivers.spb1 import walk_blocks
from rig.bench.frames import (
    BLOCK_FRAMES,
    BLOCK_PLACES,
    PLACE_FRAMES,
    WINDOW,
    BenchFrames,
    BenchSurface,
    count_columns,
    count_surface,
    sweep_frames,
)  # fmt: skip
from rig.count.kernels import new_planes, rows_of_chunk
from rig.count.sweeps import MOST_UNDER_WAY
from rig.count.volume import CountVolume
from rig.estimate.joint.joint import Joint
from rig.estimate.likelihood import Likelihood
from rig.estimate.row.model import RowModel
from rig.estimate.search.stream import ColumnJudge
from rig.geometry.stripe_table import StripeTable
from rig.threads import RowWorkers

Bits = NDArray[np.uint8]

COUNT_PIECE = 1000
"""Frames that are counted at a time: so many that handing work to threads takes a negligible part of the time."""
NUMPY_PIECE = 20
"""Frames that numpy unpacks at a time, or a column if it has more: a naive program keeps its memory small too."""


@dataclass(frozen=True, slots=True)
class StripeError:
    """Mean and median |estimate - truth| of the rows and columns with an estimate; missing: share of those without. The
    first two are NaN without any estimate."""

    mean_abs_px: float
    median_abs_px: float
    missing: float


@dataclass(frozen=True, slots=True)
class Measured:
    """Work of one measurement, with the error if it estimates and the number of maps if it makes complete ones.

    times_sgbm: time of a map divided by that of a StereoSGBM map, if the two were made alternately.
    """

    frames: int
    seconds: float
    error: StripeError | None = None
    maps: int | None = None
    times_sgbm: float | None = None


Stage = Callable[[float], Measured]
"""A function that measures a stage for about the given number of seconds."""
Blocks = Callable[[BenchFrames, "Walk"], Iterator[tuple[int, Bits]]]
"""A function that yields, without end, the index of a block's first place and the block."""


class Walk:
    """Gives each measurement the next places of the frames, so that it does not find its frames in a cache."""

    def __init__(self, frames: BenchFrames) -> None:
        self._places = len(frames.bits) // PLACE_FRAMES
        self._at = 0

    def next(self, places: int = 1) -> int:
        """Index of the first of the next `places` places, which follow one another, each of PLACE_FRAMES frames."""
        at = self._at if self._at + places <= self._places else 0
        self._at = (at + places) % self._places
        return at


def count_stage(frames: BenchFrames, walk: Walk, exposures: int, workers: RowWorkers) -> Stage:
    """The stage that only counts."""
    _, rows, row_bytes = frames.bits.shape
    row_words = row_bytes // 8
    chunks = -(-rows // rows_of_chunk(row_words))
    planes = new_planes(chunks)
    n = min(COUNT_PIECE, len(frames.bits)) // exposures * exposures

    def measure(seconds: float) -> Measured:
        done, spent = 0, 0.0
        while spent < seconds or not done:
            first = walk.next(-(-n // PLACE_FRAMES)) * PLACE_FRAMES
            words = frames.bits[first : first + n].reshape(-1).view(np.uint64)
            begun = time.perf_counter()
            workers.over(chunks, lambda a, b, w=words: count_columns(w, rows, row_words, exposures, planes, a, b))  # type: ignore[misc]
            spent += time.perf_counter() - begun
            done += n
        return Measured(done, spent)

    return measure


def numpy_stage(frames: BenchFrames, walk: Walk, exposures: int) -> Stage:
    """The stage that counts naively with numpy on one thread, and takes the brightest pixel of each row."""
    columns = max(NUMPY_PIECE // exposures, 1)
    n = columns * exposures
    rows = frames.bits.shape[1]
    x0 = int(frames.geometry.x0[0])

    def measure(seconds: float) -> Measured:
        done, spent = 0, 0.0
        errors: list[NDArray[np.float32]] = []
        while spent < seconds or not done:
            place = walk.next()
            bits = frames.bits[place * PLACE_FRAMES : place * PLACE_FRAMES + n]
            begun = time.perf_counter()
            pixels = np.unpackbits(bits, axis=2).reshape(columns, exposures, rows, frames.window)
            brightest = pixels.sum(axis=1).argmax(axis=2)
            spent += time.perf_counter() - begun
            done += len(bits)
            errors.append((brightest + x0 - frames.truth_px[place]).astype(np.float32))
        return Measured(done, spent, stripe_error(np.concatenate(errors)))

    return measure


def from_memory(frames: BenchFrames, walk: Walk) -> Iterator[tuple[int, Bits]]:
    """Yield blocks from memory, each after the index of its first place."""
    while True:
        place = walk.next(BLOCK_PLACES)
        yield place, frames.bits[place * PLACE_FRAMES : place * PLACE_FRAMES + BLOCK_FRAMES]


def from_file(path: Path, stride: int) -> Blocks:
    """A source that reads the same blocks from a recording and checks their headers. stride: bytes of each block."""

    def blocks(frames: BenchFrames, walk: Walk) -> Iterator[tuple[int, Bits]]:
        # Copy-on-write: kernels are compiled for memory that may be written.
        mapped = np.memmap(path, np.uint8, "c")
        seq = walk.next(BLOCK_PLACES) // BLOCK_PLACES
        while True:
            for block in walk_blocks(mapped[seq * stride :], stride, check_payload=False):
                if not isinstance(block, FrameBlock):
                    raise RuntimeError(f"the bench's own recording is damaged: {block}")
                yield block.header.block_seq * BLOCK_PLACES, block.bits
            seq = 0

    return blocks


def search_stage(
    frames: BenchFrames,
    walk: Walk,
    exposures: int,
    workers: RowWorkers,
    likelihood: Likelihood,
    source: Blocks = from_memory,
    *,
    whole_sweeps: bool = False,
) -> Stage:
    """The stage that counts and runs `likelihood`.

    whole_sweeps: whether it does whole sweeps and also times the work that is done once a sweep.
    """
    bins, column, x0 = sweep_frames(frames.geometry, exposures)
    layout = frames.layout(exposures)

    def measure(seconds: float) -> Measured:
        judge = likelihood.judge(frames.geometry, exposures, dark=True)
        # One for all sweeps, as in a scan, but a new one for each call: those of all stages would need too much memory.
        counter = ColumnJudge(layout, frames.geometry, judge, workers)
        blocks = source(frames, walk)
        done, spent = 0, 0.0
        error: StripeError | None = None
        while spent < seconds or not done:
            places: list[int] = []
            for at in range(0, len(bins), BLOCK_FRAMES):
                begun = time.perf_counter()
                place, bits = next(blocks)
                counter.add(bits, bins[at : at + BLOCK_FRAMES], column[at : at + BLOCK_FRAMES], x0[: len(bits)])
                counter.settle(MOST_UNDER_WAY - 1)
                spent += time.perf_counter() - begun
                done += len(bits)
                places += range(place, place + BLOCK_PLACES)
                if spent >= seconds and not whole_sweeps:
                    break
            spent += _seconds_of(counter.settle)
            ended = time.perf_counter()
            sweep = counter.finish() if error is None or whole_sweeps else None
            counter.begin(judge)
            spent += time.perf_counter() - ended if whole_sweeps else 0.0
            if error is None and sweep is not None:
                columns = len(places) * PLACE_FRAMES // exposures
                truth_px = frames.truth_px[np.repeat(places, PLACE_FRAMES // exposures)].T
                error = stripe_error(sweep.stripe.x_px[:, :columns] - truth_px)
        return Measured(done, spent, error)

    return measure


def stripe_error(difference: NDArray[np.float32]) -> StripeError:
    """The error of stripes, from their differences to the truth in px, NaN where there is no estimate."""
    found = np.abs(difference[np.isfinite(difference)])
    if not len(found):
        return StripeError(float("nan"), float("nan"), 1.0)
    return StripeError(float(found.mean()), float(np.median(found)), 1.0 - found.size / difference.size)


SGBM_BLOCK_PX = 3
"""Side of the blocks that StereoSGBM matches, OpenCV's default. Its documentation derives the penalties from it."""
PAIRS = 5
"""Least number of times that `joint` and StereoSGBM make a map alternately, for the median of the quotients."""
SGBM_STEPS = 16
"""Steps of OpenCV's disparities per pixel."""


def learn_joint(surface: BenchSurface, exposures: int, threads: int) -> RowModel:
    """The state that `joint` has learned after a first sweep of the surface, as in a scan."""
    joint = Joint(threads)
    with RowWorkers(threads) as workers:
        volume = count_surface(surface, surface.frames(exposures, workers), exposures, workers)
    joint.estimate(volume, surface.geometry)
    assert joint.used is not None, "a map has been estimated"
    return joint.used


def joint_stage(surface: BenchSurface, volume: CountVolume, threads: int, model: RowModel) -> Stage:
    """The stage that runs `joint` on counts, alternately with StereoSGBM."""
    pictures = surface.pictures()

    def measure(seconds: float) -> Measured:
        # Made anew for each call: all stages together would need too much memory.
        joint = Joint(threads, model, learns=False)

        def make() -> NDArray[np.float32]:
            return joint.estimate(volume, surface.geometry).x_px

        frames, error = int(volume.n_frames.sum()), stripe_error(make() - surface.truth_px())
        with matching(pictures, threads) as match:
            match()
            return _timed(make, seconds, frames, error, match)

    return measure


ROUNDS = 4
"""Maps that each thread makes between two looks at the clock, where several are made at the same time."""


def joint_sweep_stage(surface: BenchSurface, bits: Bits, exposures: int, threads: int, model: RowModel) -> Stage:
    """The stage that counts and runs `joint` as a scan does: a map on each thread, while the next sweep is counted."""
    bins, column, x0 = sweep_frames(surface.geometry, exposures)

    def measure(seconds: float) -> Measured:
        joint = Joint(threads, model, learns=False)
        counter = joint.counter(surface.layout(exposures), surface.geometry)
        solvers = [joint.solver() for _ in range(threads)]

        def count() -> CountVolume:
            counter.reset()
            for first in range(0, len(bits), BLOCK_FRAMES):
                block = slice(first, first + BLOCK_FRAMES)
                counter.add(bits[block], bins[block], column[block], x0[block])
            volume = counter.finish()
            assert isinstance(volume, CountVolume), "joint needs the counts of whole sweeps"
            return volume

        with ThreadPoolExecutor(threads) as pool:

            def make() -> NDArray[np.float32]:
                under_way: deque[Future[StripeTable]] = deque()
                for index in range(ROUNDS * threads):
                    if len(under_way) == threads:
                        under_way.popleft().result()
                    work = joint.begin(count(), surface.geometry, solvers[index % threads])
                    under_way.append(pool.submit(work.run))
                return [each.result() for each in under_way][-1].x_px

            error = stripe_error(make() - surface.truth_px())
            return _timed(make, seconds, len(bits), error, maps=ROUNDS * threads)

    return measure


def sgbm_stage(surface: BenchSurface, threads: int) -> Stage:
    """The stage that runs OpenCV's StereoSGBM."""
    pictures = surface.pictures()

    def measure(seconds: float) -> Measured:
        with matching(pictures, threads) as match:
            found = match()
            disparity = np.where(found < 0, np.float32(np.nan), found / np.float32(SGBM_STEPS))
            return _timed(match, seconds, 0, stripe_error(disparity - surface.place_px.T))

    return measure


@contextmanager
def matching(pictures: tuple[Bits, Bits], threads: int) -> Iterator[Callable[[], NDArray[np.int16]]]:
    """Give a function that makes a map of both pictures with StereoSGBM: disparities in 1 / SGBM_STEPS px. Meanwhile
    OpenCV uses `threads` threads."""
    import cv2

    area = SGBM_BLOCK_PX**2
    mode = cv2.STEREO_SGBM_MODE_HH4
    matcher = cv2.StereoSGBM.create(0, WINDOW, SGBM_BLOCK_PX, P1=8 * area, P2=32 * area, mode=mode)
    before = cv2.getNumThreads()
    cv2.setNumThreads(threads)
    try:
        yield lambda: np.asarray(matcher.compute(*pictures), np.int16)
    finally:
        cv2.setNumThreads(before)


def _timed(
    make: Callable[[], object],
    seconds: float,
    frames: int,
    error: StripeError,
    beside: Callable[[], object] | None = None,
    maps: int = 1,
) -> Measured:
    """Make maps of `frames` frames each for `seconds`. beside: called after each call of `make`, at least PAIRS times.
    maps: number of maps made by each call of `make`."""
    spent: list[float] = []
    quotients: list[float] = []
    while sum(spent) < seconds or len(spent) < (1 if beside is None else PAIRS):
        spent.append(_seconds_of(make))
        if beside is not None:
            quotients.append(spent[-1] / _seconds_of(beside))
    times = float(np.median(quotients)) if quotients else None
    return Measured(maps * len(spent) * frames, sum(spent), error, maps * len(spent), times)


def _seconds_of(work: Callable[[], object]) -> float:
    begun = time.perf_counter()
    work()
    return time.perf_counter() - begun
