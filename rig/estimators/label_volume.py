"""Cost of every label on every row of every column: how much less likely than the best answer its counts make it.

A label is a position of the stripe half a pixel nearer than the one before, counted from where the column's plane is
at the far end of the depth range; behind the positions stands 'none', a row without stripe. The likelihood is that of
`row_kernels`, with the line's profile at the label's own fraction of a pixel.
"""

from dataclasses import dataclass
from typing import Any, Final

import numba
import numpy as np
from numpy.typing import NDArray

from rig.counting import CountVolume
from rig.estimators.label_grid import LabelGrid
from rig.estimators.row_input import State, Sweep, row_buffers, row_fluxes, state_of, sweep_of
from rig.estimators.row_kernels import FLUX_MAX, cell_of, none_prior
from rig.estimators.row_model import RowModel, pixel_shares
from rig.geometry import SweepGeometry
from rig.row_threads import RowWorkers

UNITS: Final = 8
"""Units of cost per nat."""
COST_LIMIT: Final = 160
"""Largest cost of a label that is not excluded."""
EXCLUDED: Final = 255
"""Cost of a label that cannot be: outside the picture or more than a pixel outside the row's search window."""
FRACTIONS: Final = 8
"""Parts of a pixel that the centre of a line is told apart in."""
CHANGE_PX: Final = 8
"""Positions of a change without a stripe that count as one with the likeliest."""


@dataclass(frozen=True, slots=True, eq=False)
class Costs:
    """Gives the costs of a sweep's counts under one model; made once per model by `costs_of`."""

    sweep: Sweep
    state: State
    grid: LabelGrid
    shares: NDArray[np.float32]

    def fill(self, volume: CountVolume, first: int, last: int, out: NDArray[np.uint8]) -> None:
        """Write the costs of rows first..last-1 to out, uint8 (rows, columns, labels) of all rows; see UNITS.

        Cost: UNITS per nat below the likeliest label of that row and column, at most COST_LIMIT; EXCLUDED where a
        label cannot be. Rows of columns without frames cost 0 everywhere. Threads may fill different rows at once.
        """
        grid = self.grid
        _fill(
            self.sweep, self.state, volume.counts, volume.n_frames, grid.x_far, grid.side, grid.stripes, grid.none,
            self.shares, first, last, out,
        )  # fmt: skip


def costs_of(model: RowModel, geometry: SweepGeometry, grid: LabelGrid, exposures: int, workers: RowWorkers) -> Costs:
    """All that `Costs.fill` reads, for columns of about `exposures` frames under `model`."""
    reach = len(state_of(model).psi) - 1
    distance = np.arange(-reach, reach + 1) - (np.arange(FRACTIONS)[:, None] - FRACTIONS // 2) / FRACTIONS
    return Costs(sweep_of(geometry), state_of(model), grid, pixel_shares(model.line_sigma_px, distance))


@numba.njit(inline="always")
def _level(n, k, flux, table):  # type: ignore[no-untyped-def]
    """Log-likelihood of n ones in k exposures at a flux."""
    cell = cell_of(min(flux, FLUX_MAX))
    return n * table[0, cell] + k * table[1, cell]


@numba.njit(cache=True, nogil=True)
def _fill(
    sweep: Sweep, state: State, counts: NDArray[Any], n_frames: NDArray[np.int32], x_far: NDArray[np.float64],
    side: int, stripes: int, none: int, shares: NDArray[np.float32], first_row: int, last_row: int,
    out: NDArray[np.uint8],
) -> None:  # fmt: skip
    reach, amplitudes = shares.shape[1] // 2, state.amplitude.shape[0]
    row = row_buffers(sweep.window, 1)
    score = np.empty(stripes)
    near, far, edge = np.empty(sweep.window), np.empty(sweep.window), np.empty(sweep.window + 1)
    for y in range(first_row, last_row):
        for c in range(x_far.shape[1]):
            cost = out[y, c]
            cost[:] = EXCLUDED
            k = n_frames[c]
            length, first, last, start = row_fluxes(sweep, state, row, y, c)
            if length == 0 or k == 0:
                cost[:stripes] = 0
                cost[none] = 0
                continue
            edge[0] = 0.0
            top_edge = 0.0
            for t in range(length):
                row.n[t] = counts[c, y, start + side * t - sweep.x0[c]]
                near[t] = _level(row.n[t], k, row.before[t], state.table)
                far[t] = _level(row.n[t], k, row.behind[t], state.table)
                edge[t + 1] = edge[t] + near[t] - far[t]
                top_edge = max(top_edge, edge[t + 1])
            place = int(np.floor(FRACTIONS * side * x_far[y, c] + 0.5)) - FRACTIONS * side * start
            behind, before, change = none_prior(sweep.w_near, sweep.w_far, row.w[first], row.w[last], state.none_weight)
            share = np.log((1.0 - behind - before - change) / (last - first + 1))
            best = max(np.log(behind), np.log(before) + edge[length])
            best = max(best, np.log(change * CHANGE_PX / (length + 1)) + top_edge) - share
            no_stripe = best
            for label in range(stripes):
                at = place - FRACTIONS // 2 * label
                i = (at + FRACTIONS // 2) >> 3
                f = at - FRACTIONS * i
                score[label] = -np.inf
                if i < 0 or i >= length or not FRACTIONS * (first - 1) <= at <= FRACTIONS * (last + 1):
                    continue
                for a in range(amplitudes):
                    s = edge[max(0, i - reach)] + state.log_weight[a]
                    for j in range(max(0, i - reach), min(length, i + reach + 1)):
                        base = row.before[j] if j < i else row.behind[j]
                        if j == i:
                            base = row.behind[j] + (0.5 + f / FRACTIONS) * (row.before[j] - row.behind[j])
                        flux = base + state.amplitude[a] * row.scale[i] * shares[f + FRACTIONS // 2, j - i + reach]
                        s += _level(row.n[j], k, np.float32(flux), state.table) - far[j]
                    score[label] = max(score[label], s)
                best = max(best, score[label])
            for label in range(stripes):
                if score[label] > -np.inf:
                    cost[label] = min(round(UNITS * (best - score[label])), COST_LIMIT)
            cost[none] = min(round(UNITS * (best - no_stripe)), COST_LIMIT)
