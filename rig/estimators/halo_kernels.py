"""Compiled sums of the fit of haze and halo, and its solution in numbers that are not negative."""

from typing import Final

import numba
import numpy as np
from numpy.typing import NDArray

from rig.estimators.row_input import Float32, Lines, State, Sweep, row_buffers, row_fluxes

LEAST_FLUX: Final = 2e-3
"""Flux that a pixel is taken to have at least where its counts are weighed."""
LINE_PX: Final = 4.5
"""Pixels so far from a stripe show nothing of the line itself."""
SETTLED: Final = 1e-6
MOST_SWEEPS: Final = 3000


@numba.njit(cache=True, nogil=True)
def add_equations(
    lines: Lines,
    light: Float32,
    sweep: Sweep,
    state: State,
    halo: Float32,
    reaches: NDArray[np.float64],
    nodes: int,
    hot_flux: float,
    first_line: int,
    last_line: int,
    matrix: NDArray[np.float64],
    right: NDArray[np.float64],
) -> None:
    """Add the normal equations of lines first_line..last_line-1, weighted as the present state expects counts.

    Unknown: haze in each profile bin; its share behind the stripe at each node; halo at each node and reach; ambient
    light that the state has too little of. halo: (BINS, pixels) of `halo_shares`; light: of each line's stripe at its
    x_px, photons. Only one half of the matrix is filled, rows from columns on.
    """
    bins, number = state.profile.shape[0], len(reaches)
    first_share, first_halo, last = bins, bins + nodes, matrix.shape[0] - 1
    terms = 3 + 2 * number
    index, value = np.empty(terms + 1, np.int64), np.empty(terms + 1)
    row, side = row_buffers(sweep.window, 1), 1 if sweep.near_is_left else -1
    per_bin = (nodes - 1) / (bins - 1)
    for i in range(first_line, last_line):
        y, c = lines.row[i], lines.column[i]
        length, _, _, start = row_fluxes(sweep, state, row, y, c)
        if length == 0 or lines.exposures[i] == 0:
            continue
        frames, s = np.float64(lines.exposures[i]), np.float64(light[i])
        place = side * (np.float64(lines.x_px[i]) - start)
        own = row.cell[min(max(int(np.rint(place)), 0), length - 1)]
        low = min(int(own * per_bin), nodes - 2)
        part = own * per_bin - low
        for t in range(length):
            away = abs(t - place)
            ambient = np.float64(state.ambient[y, start + side * t])
            if away < LINE_PX or ambient > hot_flux:
                continue
            before, cell, gain = t < place, row.cell[t], np.float64(row.gain[t])
            expected = (row.before[t] if before else row.behind[t]) + s * halo[own, min(int(away), halo.shape[1] - 1)]
            dark = np.exp(-max(expected, LEAST_FLUX))
            weight = frames * dark / (1.0 - dark)
            n = np.float64(lines.counts[i, start + side * t - sweep.x0[c]])
            # The flux that would make these counts the expected ones, near the present state.
            flux = (n / frames - 1.0 + dark) / dark - np.log(dark) - ambient - row.others[t]
            if before:
                index[0], value[0], used = cell, gain, 1
            else:
                node = min(int(cell * per_bin), nodes - 2)
                haze = gain * state.profile[cell, 0]
                index[0], index[1] = first_share + node, first_share + node + 1
                value[1] = haze * (cell * per_bin - node)
                value[0] = haze - value[1]
                used = 2
            for k in range(number):
                there = s * np.exp(-away / reaches[k]) / (2 * reaches[k])
                index[used], index[used + 1] = first_halo + low * number + k, first_halo + (low + 1) * number + k
                value[used], value[used + 1] = (1.0 - part) * there, part * there
                used += 2
            index[used], value[used] = last, 1.0
            for a in range(used + 1):
                for b in range(used + 1):
                    if index[a] >= index[b]:
                        matrix[index[a], index[b]] += weight * value[a] * value[b]
                right[index[a]] += weight * value[a] * flux


@numba.njit(cache=True, nogil=True)
def solve(matrix: NDArray[np.float64], right: NDArray[np.float64], free: int) -> NDArray[np.float64]:
    """What minimises x' matrix x - 2 right' x with no number below 0, one at a time; number `free` may be."""
    x, slope = np.zeros_like(right), -right
    for _ in range(MOST_SWEEPS):
        largest = 0.0
        for i in range(len(x)):
            if matrix[i, i] <= 0.0:
                continue
            to = x[i] - slope[i] / matrix[i, i]
            step = (to if i == free else max(to, 0.0)) - x[i]
            if step != 0.0:
                x[i] += step
                for j in range(len(x)):
                    slope[j] += step * matrix[j, i]
                largest = max(largest, step * step * matrix[i, i])
        if largest < SETTLED:
            break
    return x
