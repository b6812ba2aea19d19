"""Compiled sweeps of the row likelihood: one pass that learns, one that estimates."""

from typing import Final

import numba
import numpy as np
from numpy.typing import NDArray

from rig.estimators.row_input import Row, State, Sweep, judge_row, row_buffers
from rig.estimators.row_kernels import mode_of, refine

CUT: Final = 0.05
"""Share of the depth range outside the picture up to which a row tells how often the stripe is missing."""
CERTAIN: Final = 0.6
"""Probability within 1 px from which a row teaches the level behind the stripe."""
CLEAR: Final = 0.97
CLEAR_PX: Final = 6
"""Rows as certain as this, and pixels as far before their stripe, measure the haze itself."""
QUIET: Final = 0.9
"""Probability within 1 px from which the pixels behind the stripe teach the ambient light."""


@numba.njit(cache=True, nogil=True)
def learn_rows(
    sweep: Sweep,
    state: State,
    row_of: NDArray[np.int32],
    column_of: NDArray[np.int32],
    hot_flux: float,
    levels: NDArray[np.float64],
    rows_seen: NDArray[np.float64],
    columns_seen: NDArray[np.float64],
    amplitude_mass: NDArray[np.float64],
) -> float:
    """Expectation step over the listed (row, column) pairs; returns the log evidence.

    Adds to levels (bins, 14): ones, exposures, and exposures weighted with geometry factor and with ambient flux, of
    pixels before the stripe, then of those behind it, each with the probability of being there, then of those well
    before a stripe beyond doubt; then stripes, and stripes if all positions were alike. To rows_seen (rows, 2) and
    columns_seen (columns, 2): ones before the stripe, and those expected. To amplitude_mass (M + 1,): rows per
    amplitude, the last entry 'no stripe'. Pixels with more ambient flux than hot_flux are left out.
    """
    amplitudes = state.amplitude.shape[0]
    row = row_buffers(sweep.counts.shape[2], amplitudes)
    total = 0.0
    for i in range(row_of.shape[0]):
        y, c = row_of[i], column_of[i]
        length, first, last, start, none, cut, evidence = judge_row(sweep, state, row, y, c)
        if length == 0:
            continue
        total += evidence
        if cut < CUT:
            for m in range(amplitudes):
                amplitude_mass[m] += row.by_amplitude[m]
            amplitude_mass[amplitudes] += none
            for j in range(first, last + 1):
                levels[row.cell[j], 12] += row.posterior[j]
                levels[row.cell[j], 13] += (1.0 - none) / (last - first + 1)
        if none < 0.5:
            _learn_levels(
                sweep, state, row, y, c, length, first, last, start, none, hot_flux, levels, rows_seen, columns_seen
            )
    return total


@numba.njit(cache=True, nogil=True)
def _learn_levels(
    sweep: Sweep,
    state: State,
    row: Row,
    y: int,
    c: int,
    length: int,
    first: int,
    last: int,
    start: int,
    none: float,
    hot_flux: float,
    levels: NDArray[np.float64],
    rows_seen: NDArray[np.float64],
    columns_seen: NDArray[np.float64],
) -> None:
    """Add one row's pixels to the levels before and behind the stripe."""
    k = sweep.n_frames[c]
    step = 1 if sweep.near_is_left else -1
    reach = state.psi.shape[0]
    # Doubtful rows would teach the level behind the stripe their own guess; haze before it is plentiful anyway.
    mode, near_mass = mode_of(row.posterior, first, last)
    certain, clear = near_mass > CERTAIN, near_mass > CLEAR
    passed = 0.0
    for t in range(length):
        passed += row.posterior[t]
        ambient = state.ambient[y, start + step * t]
        if ambient > hot_flux:
            continue
        # The stripe's own width counts for neither side.
        ahead = 0.0
        near = row.posterior[t]
        for d in range(1, reach + 1):
            if t + d < length:
                ahead += row.posterior[t + d]
            if t - d >= 0:
                near += row.posterior[t - d]
        is_before = max(1.0 - none - passed - ahead, 0.0)
        b = row.cell[t]
        levels[b, 0] += is_before * row.n[t]
        levels[b, 1] += is_before * k
        levels[b, 2] += is_before * k * row.gain[t]
        levels[b, 3] += is_before * k * ambient
        expected = is_before * k * -np.expm1(-row.before[t])
        rows_seen[y, 0] += is_before * row.n[t]
        rows_seen[y, 1] += expected
        columns_seen[c, 0] += is_before * row.n[t]
        columns_seen[c, 1] += expected
        if clear and t < mode - CLEAR_PX:
            levels[b, 8] += row.n[t]
            levels[b, 9] += k
            levels[b, 10] += k * row.gain[t]
            levels[b, 11] += k * ambient
        if certain:
            is_behind = max(passed - near, 0.0)
            levels[b, 4] += is_behind * row.n[t]
            levels[b, 5] += is_behind * k
            levels[b, 6] += is_behind * k * row.gain[t]
            levels[b, 7] += is_behind * k * ambient


@numba.njit(cache=True, nogil=True)
def estimate_rows(
    sweep: Sweep, state: State, first_row: int, last_row: int, out: NDArray[np.float32], quiet: NDArray[np.uint32]
) -> None:
    """Best position of every column on rows first_row..last_row-1.

    out: (5, rows, columns): x_px, confidence, x_sd_px, signal, haze (see StripeTable).
    quiet: (2, rows, width): ones and exposures of each pixel while it lay behind a stripe that was hardly in doubt.
    """
    amplitudes = state.amplitude.shape[0]
    row = row_buffers(sweep.counts.shape[2], amplitudes)
    reach = state.psi.shape[0]
    step = 1 if sweep.near_is_left else -1
    for c in range(sweep.counts.shape[0]):
        k = np.float32(sweep.n_frames[c])
        for y in range(first_row, last_row):
            length, first, last, start, _, _, _ = judge_row(sweep, state, row, y, c)
            if length == 0:
                continue
            mode, near = mode_of(row.posterior, first, last)
            offset, sd = refine(
                row.n, k, row.before, row.behind, row.scale, length, mode, row.score, row.edge, row.taps,
                state.amplitude, state.log_weight, state.fine, state.table, row.labels,
            )  # fmt: skip
            best = 0
            for m in range(1, amplitudes):
                if row.score[m, mode] + state.log_weight[m] > row.score[best, mode] + state.log_weight[best]:
                    best = m
            x = start + step * mode
            out[0, y, c] = x + step * offset
            out[1, y, c] = near
            out[2, y, c] = sd
            out[3, y, c] = state.amplitude[best] * row.scale[mode]
            out[4, y, c] = max(row.before[mode] - state.ambient[y, x], np.float32(0.0))
            if near > QUIET:
                for t in range(mode + reach + 1, length):
                    quiet[0, y, start + step * t] += np.uint32(row.n[t])
                    quiet[1, y, start + step * t] += np.uint32(k)
