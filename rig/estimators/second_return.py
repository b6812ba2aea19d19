"""Second returns: where the counts themselves show another line beside the stripe, and how probably so.

In haze a row cannot answer with both: the light behind the nearer one excludes that it ends there, so that the best
rival of an answer is hardly ever the second surface. `second_return_kernels` looks for its light instead.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

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
from rig.estimators.second_return_sums import BLOCK, LEFT_OUT, Blocks, sum_blocks
from rig.lanes import LANES
from rig.row_threads import RowWorkers

APART_PX = 2.0
"""Light so far from a stripe, and further by LINE_SIGMAS widths of the line, is not its own."""
LINE_SIGMAS = 2.5
LIGHT_SIGMAS = 1.5
"""Widths of the line to either side that its light is looked for in."""


class SecondLight(NamedTuple):
    """What the search for second returns takes of a model; made once per model by `second_light`.

    state: without ambient light. still: float32, (rows x width) between LANES numbers at either end, probability of no
    one by ambient light alone; LEFT_OUT of pixels that nearly always fire or are not to be used, which show nothing of
    haze or stripes. apart: px from a stripe within which light is its own. reach: px to either side of a line.
    """

    state: State
    still: NDArray[np.float32]
    apart: float
    reach: int


def second_light(state: State, line_sigma_px: float) -> SecondLight:
    """The light that haze and ambient bring under `state`."""
    still = np.where(hot_in_bands(state.ambient), LEFT_OUT, np.exp(-state.ambient))
    return SecondLight(
        state._replace(ambient=np.zeros_like(state.ambient)),
        np.pad(still.ravel(), LANES),
        APART_PX + LINE_SIGMAS * line_sigma_px,
        max(int(np.rint(LIGHT_SIGMAS * line_sigma_px)), 1),
    )


def second_returns(
    volume: CountVolume,
    grid: LabelGrid,
    sweep: Sweep,
    light: SecondLight,
    x_px: NDArray[np.float32],
    workers: RowWorkers,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """x2_px and confidence2 (rows, columns) beside stripes at x_px: NaN and 0 where nothing stands out."""
    rows, columns = x_px.shape
    shape, pixels = (-(-rows // BLOCK), -(-columns // BLOCK)), -(-grid.stripes // (PER_PX * LANES)) * LANES
    blocks = Blocks(*(np.empty((*shape, pixels), np.float32) for _ in Blocks._fields))
    candidates = Candidates(*(np.empty(shape, np.float32) for _ in Candidates._fields))
    seen = volume.counts, volume.n_frames, sweep, light.state, light.still, grid.x_far, grid.side, light.apart
    reach = light.reach

    workers.over(shape[0], lambda first, last: sum_blocks(*seen, x_px, first, last, blocks))
    workers.over(shape[0], lambda first, last: find_candidates(blocks, reach, grid.side, first, last, candidates))
    # One row at least: nothing may be left to compile for the first second return of a scan.
    asked = rows if np.isfinite(candidates.distance).any() else 1
    seconds = Seconds(*(np.empty((rows, columns), np.float32) for _ in Seconds._fields))

    def measure(first: int, last: int) -> None:
        measure_seconds(*seen, reach, x_px, candidates.haze, first, last, seconds)

    seconds.distance[asked:] = np.nan  # neighbours of those that are asked
    moved = np.empty((rows, columns), np.float32)
    workers.over(asked, lambda first, last: begin_seconds(candidates, first, last, seconds))
    workers.over(asked, measure)
    workers.over(asked, lambda first, last: move_seconds(reach, first, last, seconds, moved))
    seconds.distance[:asked] = moved[:asked]
    workers.over(asked, measure)
    x2_px, confidence2 = np.full((rows, columns), np.nan, np.float32), np.zeros((rows, columns), np.float32)
    workers.over(
        asked,
        lambda first, last: judge_seconds(grid.x_far, x_px, candidates.sure, first, last, seconds, x2_px, confidence2),
    )
    return x2_px, confidence2
