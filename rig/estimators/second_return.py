"""Second returns: where the counts themselves show another line beside the stripe, and how probably so.

In haze a row cannot answer with both: the light behind the nearer one excludes that it ends there, so that the best
rival of an answer is hardly ever the second surface. `second_return_kernels` looks for its light instead.
"""

import numpy as np
from numpy.typing import NDArray

from rig.counting import CountVolume
from rig.estimators.label_grid import PER_PX, LabelGrid
from rig.estimators.label_volume import hot_in_bands
from rig.estimators.row_input import State, Sweep
from rig.estimators.second_return_kernels import (
    APART_PX,
    BLOCK,
    LINE_SIGMAS,
    Blocks,
    Candidates,
    Seconds,
    find_candidates,
    judge_seconds,
    measure_seconds,
    move_seconds,
    sum_blocks,
)
from rig.row_threads import RowWorkers

LIGHT_SIGMAS = 1.5
"""Widths of the line to either side that its light is looked for in."""
LOG_ODDS = -16.0, 0.4, 3.0
"""Log odds that a candidate is right: these times 1, and the standard deviations of its own light and its block's.

Between what maps with a pane over a third of them ask for and what those without any do: fitted to both, rounded."""


def second_returns(
    volume: CountVolume,
    grid: LabelGrid,
    sweep: Sweep,
    state: State,
    line_sigma_px: float,
    x_px: NDArray[np.float32],
    workers: RowWorkers,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """x2_px and confidence2 (rows, columns) beside stripes at x_px: NaN and 0 where nothing stands out."""
    rows, columns = x_px.shape
    shape = -(-rows // BLOCK), -(-columns // BLOCK)
    apart, reach = APART_PX + LINE_SIGMAS * line_sigma_px, max(int(np.rint(LIGHT_SIGMAS * line_sigma_px)), 1)
    blocks = Blocks(*(np.empty((*shape, -(-grid.stripes // PER_PX)), np.float32) for _ in Blocks._fields))
    candidates = Candidates(*(np.empty(shape, np.float32) for _ in Candidates._fields))
    # Pixels that nearly always fire, and those not to be used, show nothing of haze or stripes.
    dark = np.where(hot_in_bands(state.ambient), np.float32(np.nan), -np.expm1(-state.ambient))
    haze_only = state._replace(ambient=np.zeros_like(state.ambient))
    seen = volume.counts, volume.n_frames, sweep, haze_only, dark, grid.x_far, grid.side, apart

    workers.over(shape[0], lambda first, last: sum_blocks(*seen, x_px, first, last, blocks))
    workers.over(shape[0], lambda first, last: find_candidates(blocks, reach, grid.side, first, last, candidates))
    sure = np.zeros((rows, columns), np.float32)
    # One row at least: nothing may be left to compile for the first second return of a scan.
    asked = rows if np.isfinite(candidates.distance).any() else 1
    seconds = Seconds(
        _each(candidates.distance, rows, columns), *(np.zeros((rows, columns), np.float32) for _ in range(4))
    )

    def measure(first: int, last: int) -> None:
        measure_seconds(*seen, reach, x_px, candidates.haze, first, last, seconds)

    moved = np.full((rows, columns), np.nan, np.float32)
    workers.over(asked, measure)
    workers.over(asked, lambda first, last: move_seconds(reach, first, last, seconds, moved))
    seconds = seconds._replace(distance=moved)
    workers.over(asked, measure)
    workers.over(asked, lambda first, last: judge_seconds(first, last, seconds, sure))
    sure[np.isnan(x_px)] = 0.0
    x2_px = np.where(sure > 0, grid.x_far + moved, np.nan).astype(np.float32)
    return x2_px, _confidence(sure, _each(candidates.sure, rows, columns))


def _each(of_blocks: NDArray[np.float32], rows: int, columns: int) -> NDArray[np.float32]:
    """What each row and column has of its block."""
    wide = np.repeat(np.repeat(of_blocks, BLOCK, axis=0)[:rows], BLOCK, axis=1)
    return np.ascontiguousarray(wide[:, :columns])


def _confidence(own: NDArray[np.float32], of_block: NDArray[np.float32]) -> NDArray[np.float32]:
    odds = LOG_ODDS[0] + LOG_ODDS[1] * own + LOG_ODDS[2] * of_block
    return np.where(own > 0, 1 / (1 + np.exp(-odds)), 0.0).astype(np.float32)
