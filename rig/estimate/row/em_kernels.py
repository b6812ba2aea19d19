"""Expectation step of the row likelihood, compiled: sums of rows of counts, each weighted with its own posterior.

For each line `judge_line` gives the posterior P(j) over positions; pixel t lies before the stripe with the probability
that the stripe is farther, sum over j > t of P(j), and behind it with the rest. Ones and exposures are added with these
weights per bin of path inverse depth (`learn_rows` has the shapes); sums are float64.
"""

from typing import Final

import numba
import numpy as np
from numpy.typing import NDArray

from rig.estimate.row.inputs import Lines, RowBuffers, RowState, Sweep, judge_line, row_buffers
from rig.estimate.row.likelihood import mode_of

CUT: Final = 0.05
"""Share of the depth range outside the picture up to which a row tells how often the stripe is missing."""
CERTAIN: Final = 0.6
"""Probability within 1 px from which a row teaches the level behind the stripe."""
CLEAR: Final = 0.97
CLEAR_PX: Final = 6
"""Rows as certain as this, and pixels as far before their stripe, measure the haze itself."""
LEAST_OWN: Final = 1e-3
"""Least haze of a line, over that of the others at a pixel, that is told from none."""


@numba.njit(cache=True, nogil=True)
def learn_rows(
    sweep: Sweep,
    state: RowState,
    lines: Lines,
    hot_flux: float,
    levels: NDArray[np.float64],
    rows_seen: NDArray[np.float64],
    columns_seen: NDArray[np.float64],
    amplitude_mass: NDArray[np.float64],
) -> float:
    """Expectation step over some lines; returns the log evidence.

    Adds to levels (bins, 14): ones, exposures, and exposures weighted with geometry factor and with ambient flux, of
    pixels before the stripe, then of those behind it, each with the probability of being there, then of those well
    before a stripe beyond doubt; then stripes, and stripes if all positions were alike. To rows_seen (rows, 2) and
    columns_seen (columns, 2): ones before the stripe, and those expected. To amplitude_mass (M + 1,): rows per
    amplitude, the last entry 'no stripe'. Pixels with more ambient flux than hot_flux are left out.
    """
    amplitudes = state.amplitude.shape[0]
    row = row_buffers(sweep.window, amplitudes)
    total = 0.0
    for i in range(lines.row.shape[0]):
        length, first, last, start, none, cut, evidence = judge_line(sweep, state, row, lines, i)
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
            where = lines.row[i], lines.column[i], lines.exposures[i]
            _learn_levels(
                sweep, state, row, where, (length, first, last, start), none, hot_flux, levels, rows_seen, columns_seen
            )
    return total


@numba.njit(cache=True, nogil=True)
def _learn_levels(
    sweep: Sweep, state: RowState, row: RowBuffers, where: tuple[int, int, int], span: tuple[int, int, int, int],
    none: float, hot_flux: float, levels: NDArray[np.float64], rows_seen: NDArray[np.float64],
    columns_seen: NDArray[np.float64],
) -> None:  # fmt: skip
    """Add one row's pixels to the levels before and behind the stripe.

    where: row, column and exposures; span: what `row_fluxes` says of it.
    """
    (y, c, k), (length, first, last, start) = where, span
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
        gain, others = row.gain[t], row.others[t]
        if others > 0.0:
            # Other lines' haze is haze like this one's: what there is of both tells the strength of each.
            own = row.before[t] - ambient - others
            gain *= 1.0 + others / max(own, LEAST_OWN * others)
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
        levels[b, 2] += is_before * k * gain
        levels[b, 3] += is_before * k * ambient
        expected = is_before * k * -np.expm1(-row.before[t])
        rows_seen[y, 0] += is_before * row.n[t]
        rows_seen[y, 1] += expected
        columns_seen[c, 0] += is_before * row.n[t]
        columns_seen[c, 1] += expected
        if clear and t < mode - CLEAR_PX:
            levels[b, 8] += row.n[t]
            levels[b, 9] += k
            levels[b, 10] += k * gain
            levels[b, 11] += k * ambient
        if certain:
            is_behind = max(passed - near, 0.0)
            levels[b, 4] += is_behind * row.n[t]
            levels[b, 5] += is_behind * k
            levels[b, 6] += is_behind * k * row.gain[t]
            levels[b, 7] += is_behind * k * (ambient + others)
