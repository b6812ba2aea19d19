"""The stages that make a whole map at a time, for so many threads each.

joint: the estimate alone, from counts that were made before, and by turns with it a map of sgbm on as many threads: of
figures that were measured one after the other a machine with other work makes any quotient. joint-sweep: counting in
blocks as in a scan, then the estimate. sgbm: OpenCV's StereoSGBM (MODE_HH4, which aggregates along four paths too) on a
pair of pictures of the same surface, as many disparities as the window has pixels; OpenCV leaves out as many columns at
the left edge. Nothing is learned meanwhile: `joint` goes by what it learned from the first sweep. Each begins with a
map that is not timed.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray

from rig.bench.frames import BLOCK_FRAMES
from rig.bench.stages import Measured, Stage, StripeError, stripe_error
from rig.bench.surface import WINDOW, BenchSurface, count_surface, sweep_frames
from rig.counting import CountVolume
from rig.estimators.joint import Joint
from rig.estimators.row_model import RowModel
from rig.row_threads import RowWorkers

Picture = NDArray[np.uint8]

SGBM_BLOCK_PX = 3
"""OpenCV's own default; its penalties follow from it as its documentation advises."""
PAIRS = 5
"""Maps of `joint` and of StereoSGBM, made by turns, that a quotient is the median of, each round."""
SGBM_STEPS = 16
"""Of OpenCV's disparities to the pixel."""


def learn_joint(surface: BenchSurface, exposures: int, threads: int) -> RowModel:
    """What `joint` learns from a first sweep of the surface, as in a scan."""
    joint = Joint(threads)
    with RowWorkers(threads) as workers:
        volume = count_surface(surface, surface.frames(exposures, workers), exposures, workers)
    joint.estimate(volume, surface.geometry)
    assert joint.used is not None, "a map has been estimated"
    return joint.used


def joint_stage(surface: BenchSurface, volume: CountVolume, threads: int, model: RowModel) -> Stage:
    """`joint` from counts."""
    pictures = surface.pictures()

    def measure(seconds: float) -> Measured:
        # Made anew: kept beyond this moment, the memory of all threads' and exposures' would be too much.
        joint = Joint(threads, model, learns=False)

        def make() -> NDArray[np.float32]:
            return joint.estimate(volume, surface.geometry).x_px

        frames, error = int(volume.n_frames.sum()), stripe_error(make() - surface.truth_px())
        with matching(pictures, threads) as match:
            match()
            return _timed(make, seconds, frames, error, match)

    return measure


def joint_sweep_stage(
    surface: BenchSurface, bits: NDArray[np.uint8], exposures: int, threads: int, model: RowModel
) -> Stage:
    """Counting and `joint`, one after the other."""
    bins, column, x0 = sweep_frames(surface, exposures)

    def measure(seconds: float) -> Measured:
        joint = Joint(threads, model, learns=False)
        counter = joint.counter(surface.layout(exposures), surface.geometry)

        def make() -> NDArray[np.float32]:
            counter.reset()
            for first in range(0, len(bits), BLOCK_FRAMES):
                block = slice(first, first + BLOCK_FRAMES)
                counter.add(bits[block], bins[block], column[block], x0[block])
            volume = counter.finish()
            assert isinstance(volume, CountVolume), "joint needs the counts of whole sweeps"
            return joint.estimate(volume, surface.geometry).x_px

        return _timed(make, seconds, len(bits), stripe_error(make() - surface.truth_px()))

    return measure


def sgbm_stage(surface: BenchSurface, threads: int) -> Stage:
    """OpenCV's StereoSGBM."""
    pictures = surface.pictures()

    def measure(seconds: float) -> Measured:
        with matching(pictures, threads) as match:
            found = match()
            disparity = np.where(found < 0, np.float32(np.nan), found / np.float32(SGBM_STEPS))
            return _timed(match, seconds, 0, stripe_error(disparity - surface.place_px.T))

    return measure


@contextmanager
def matching(pictures: tuple[Picture, Picture], threads: int) -> Iterator[Callable[[], NDArray[np.int16]]]:
    """StereoSGBM of left and right picture on so many threads, a map a call: disparities in SGBM_STEPS to the pixel."""
    import cv2

    area = SGBM_BLOCK_PX**2
    mode = cv2.STEREO_SGBM_MODE_HH4
    matcher = cv2.StereoSGBM.create(0, WINDOW, SGBM_BLOCK_PX, P1=8 * area, P2=32 * area, mode=mode)

    def match() -> NDArray[np.int16]:
        return np.asarray(matcher.compute(*pictures), np.int16)

    before = cv2.getNumThreads()
    cv2.setNumThreads(threads)
    try:
        yield match
    finally:
        cv2.setNumThreads(before)


def _timed(
    make: Callable[[], object],
    seconds: float,
    frames: int,
    error: StripeError,
    beside: Callable[[], object] | None = None,
) -> Measured:
    """Make maps of so many frames each for a moment; beside: what is done by turns with it, PAIRS times at least."""
    spent: list[float] = []
    quotients: list[float] = []
    while sum(spent) < seconds or len(spent) < (1 if beside is None else PAIRS):
        spent.append(_seconds_of(make))
        if beside is not None:
            quotients.append(spent[-1] / _seconds_of(beside))
    times = float(np.median(quotients)) if quotients else None
    return Measured(len(spent) * frames, sum(spent), error, len(spent), times)


def _seconds_of(work: Callable[[], object]) -> float:
    begun = time.perf_counter()
    work()
    return time.perf_counter() - begun
