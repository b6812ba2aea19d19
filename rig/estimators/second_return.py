"""Second returns: where the counts themselves show another line beside the stripe, and how probably so.

In haze a row cannot answer with both: the light behind the nearer one excludes that it ends there, so that the best
rival of an answer is hardly ever the second surface. `second_return_kernels` looks for its light instead.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.aligned import aligned_zeros
from rig.counting import CountVolume
from rig.estimators.label_grid import PER_PX, LabelGrid
from rig.estimators.label_volume import hot_in_bands
from rig.estimators.row_input import State, Sweep
from rig.estimators.second_return_kernels import (
    Candidates,
    Seconds,
    begin_seconds,
    find_candidates,
    judge_seconds,
    measure_seconds,
    move_seconds,
)
from rig.estimators.second_return_lines import BLOCK, LEFT_OUT, line_places
from rig.estimators.second_return_sums import Blocks, sum_blocks
from rig.lanes import LANES
from rig.row_threads import RowWorkers, Work

APART_PX = 2.0
"""Light so far from a stripe, and further by LINE_SIGMAS widths of the line, is not its own."""
LINE_SIGMAS = 2.5
LIGHT_SIGMAS = 1.5
"""Widths of the line to either side that its light is looked for in."""


class SecondLight(NamedTuple):
    """What the search for second returns takes of a model; made once per model by `second_light`.

    state: without ambient light. still: float32, (rows x width) between LANES numbers at either end, probability of no
    one by ambient light alone; LEFT_OUT of pixels that always fire or are not to be used, which show nothing of
    haze or stripes. place: of `line_places`. apart: px from a stripe within which light is its own. reach: px to
    either side of a line.
    """

    state: State
    still: NDArray[np.float32]
    place: NDArray[np.int16]
    apart: float
    reach: int


def second_light(state: State, line_sigma_px: float, grid: LabelGrid, sweep: Sweep) -> SecondLight:
    """The light that haze and ambient bring under `state`."""
    still = np.where(hot_in_bands(state.ambient), LEFT_OUT, np.exp(-state.ambient))
    return SecondLight(
        state._replace(ambient=np.zeros_like(state.ambient)),
        np.pad(still.ravel(), LANES),
        line_places(sweep, grid.x_far, grid.side, distance_pixels(grid)),
        APART_PX + LINE_SIGMAS * line_sigma_px,
        max(int(np.rint(LIGHT_SIGMAS * line_sigma_px)), 1),
    )


def distance_pixels(grid: LabelGrid) -> int:
    """Pixels of distance that sums are made of, a multiple of LANES."""
    return grid.labels // PER_PX


class SecondRoom(NamedTuple):
    """Room for the search in one map after the other: memory that is new is slow."""

    blocks: Blocks
    candidates: Candidates
    seconds: Seconds
    moved: NDArray[np.float32]


def second_room(grid: LabelGrid) -> SecondRoom:
    """Room for maps of these labels."""
    rows, columns = grid.x_far.shape
    shape = -(-rows // BLOCK), -(-columns // BLOCK)
    return SecondRoom(
        Blocks(*(aligned_zeros((*shape, distance_pixels(grid)), np.float32) for _ in Blocks._fields)),
        Candidates(*(np.empty(shape, np.float32) for _ in Candidates._fields)),
        Seconds(*(np.empty((rows, columns), np.float32) for _ in Seconds._fields)),
        np.empty((rows, columns), np.float32),
    )


def second_returns(
    volume: CountVolume,
    grid: LabelGrid,
    sweep: Sweep,
    light: SecondLight,
    x_px: NDArray[np.float32],
    room: SecondRoom,
    workers: RowWorkers,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """x2_px and confidence2 (rows, columns) beside stripes at x_px: NaN and 0 where nothing stands out."""
    rows, columns = x_px.shape
    blocks, candidates, seconds, moved = room
    # Read by address: another kind of number would be read as nonsense.
    n_frames = np.ascontiguousarray(volume.n_frames, np.int32)
    seen = volume.counts, n_frames, sweep, light.state, light.still
    reach, side, apart, block_rows = light.reach, grid.side, light.apart, len(candidates.distance)

    x2_px, confidence2 = (np.empty((rows, columns), np.float32) for _ in range(2))

    def look(first: int, last: int) -> None:
        sum_blocks(*seen, light.place, side, apart, x_px, first, last, blocks)
        here = slice(first * BLOCK, last * BLOCK)
        seconds.distance[here] = x2_px[here] = np.nan  # of neighbours of those that are asked, too
        confidence2[here] = 0.0

    workers.over(block_rows, look)
    workers.over(block_rows, lambda first, last: find_candidates(blocks, reach, side, first, last, candidates))
    # One row of blocks at least: nothing may be left to compile for the first second return of a scan.
    asked = np.flatnonzero(np.isfinite(candidates.distance).any(axis=1))
    asked = asked if len(asked) else np.array([0])

    def of_asked(work: Work) -> None:
        def each(first: int, last: int) -> None:
            for run in np.split(asked[first:last], np.flatnonzero(np.diff(asked[first:last]) > 1) + 1):
                work(int(run[0]) * BLOCK, min((int(run[-1]) + 1) * BLOCK, rows))

        workers.over(len(asked), each)

    def measure(first: int, last: int) -> None:
        measure_seconds(*seen, grid.x_far, side, apart, reach, x_px, candidates.haze, first, last, seconds)

    def begin(first: int, last: int) -> None:
        begin_seconds(candidates, first, last, seconds)
        measure(first, last)

    def move(first: int, last: int) -> None:
        move_seconds(reach, first, last, seconds, moved)

    def measure_moved(first: int, last: int) -> None:
        seconds.distance[first:last] = moved[first:last]
        measure(first, last)

    def judge(first: int, last: int) -> None:
        judge_seconds(grid.x_far, x_px, candidates.sure, first, last, seconds, x2_px, confidence2)

    for work in (begin, move, measure_moved, judge):
        of_asked(work)
    return x2_px, confidence2
