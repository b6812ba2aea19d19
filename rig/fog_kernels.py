"""Compiled sums of the fog meter: what lies clearly before and clearly behind the stripes of a sweep."""

from typing import Final

import numba
import numpy as np
from numpy.typing import NDArray

from rig.estimators.row_input import Lines, State, Sweep, row_buffers, row_fluxes

SUMS: Final = 4
"""Sums of a cell: ones, exposures, and exposures weighted with geometry factor and with flux that is no haze."""


@numba.njit(cache=True, nogil=True)
def add_clear_rows(
    sweep: Sweep,
    state: State,
    lines: Lines,
    x_px: NDArray[np.float32],
    clear: NDArray[np.bool_],
    block: NDArray[np.int32],
    clear_px: float,
    hot_flux: float,
    sums: NDArray[np.float64],
    at_stripe: NDArray[np.float64],
) -> None:
    """Add the pixels of clear lines that are clear_px and more before or behind their stripe at x_px.

    sums: (blocks, 2, bins, SUMS), before and behind. at_stripe (lines, 2): path in metres and geometry factor of the
    haze at the stripe, unchanged for other lines. Pixels of more ambient flux than hot_flux take no part.
    """
    row = row_buffers(sweep.window, state.amplitude.shape[0])
    step = 1 if sweep.near_is_left else -1
    for i in range(lines.row.shape[0]):
        y, c, k = lines.row[i], lines.column[i], lines.exposures[i]
        if not clear[i] or k == 0:
            continue
        length, _, _, start = row_fluxes(sweep, state, row, y, c)
        for t in range(length):
            x = start + step * t
            ahead_px = (x_px[i] - x) * step
            if abs(ahead_px) <= 0.5:
                at_stripe[i, 0] = 1.0 / (state.w_lo + row.cell[t] / state.per_w)
                at_stripe[i, 1] = row.gain[t]
            ambient = state.ambient[y, x]
            if ambient > hot_flux or abs(ahead_px) < clear_px:
                continue
            cell = sums[block[i], 0 if ahead_px > 0 else 1, row.cell[t]]
            cell[0] += lines.counts[i, x - sweep.x0[c]]
            cell[1] += k
            cell[2] += k * row.gain[t]
            cell[3] += k * (ambient + row.others[t])
