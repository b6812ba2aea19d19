"""Belief in a learned medium: how well haze, ambient light and halo explain counts, compiled.

The counts of a row are compared with the light that the model expects beside its stripe, in blocks of BLOCK_PX pixels.
With O the ones counted in a block, E those expected, and V the variance of O (a binomial count):

    misfit = mean of (O - E)^2 / V                     1 if only chance is left
    error^2 = sum of ((O - E)^2 - V) / sum of E^2      relative error of the expected light

In quasi-likelihood (Wedderburn 1974) a log-likelihood whose counts scatter `misfit` times as much as its model says is
divided by `misfit`. So the belief is 1 / misfit, at most 1. With more exposures a wrong medium is wrong by more
standard deviations, and is believed less. The lines compared are evenly spread over the map; few of them were used to
learn the halo.
"""

from typing import Final, NamedTuple

import numba
import numpy as np

from rig.estimate.joint.place.places import most_shown
from rig.estimate.row.inputs import Lines, RowState, Sweep, row_buffers, row_fluxes
from rig.simd import Float32, Float64
from rig.threads import RowWorkers

BLOCK_PX: Final = 16
LINE_PX: Final = 4.5
"""Pixels nearer than this to a stripe are not compared: they show the line itself."""
PIECES: Final = 4
"""Pieces in which lines are summed, the same for any number of threads."""


class Belief(NamedTuple):
    """Belief in a medium, 0 to 1, and the relative error of its light."""

    belief: float
    error: float


def belief_of(
    lines: Lines, light: Float32, sweep: Sweep, state: RowState, halo: Float32, hot_flux: float, workers: RowWorkers
) -> Belief:
    """Belief in the medium of `state`. It is 1, and the error 0, if no line can be compared.

    light: of each line's stripe at its x_px, photons per exposure; halo: of `halo_shares`, without pixels if there is
    none; hot_flux: pixels with more ambient light are left out.
    """
    edges = np.linspace(0, len(light), PIECES + 1).astype(int)
    sums = np.zeros((PIECES, 4))

    def work(first: int, last: int) -> None:
        for i in range(first, last):
            add_misfit(lines, light, sweep, state, halo, hot_flux, edges[i], edges[i + 1], sums[i])

    workers.over(PIECES, work)
    misfit, blocks, excess, square = sums.sum(axis=0)
    if blocks == 0:
        return Belief(1.0, 0.0)
    return Belief(float(min(1.0, blocks / max(misfit, 1e-9))), float(np.sqrt(max(excess, 0.0) / square)))


@numba.njit(cache=True, nogil=True)
def add_misfit(
    lines: Lines, light: Float32, sweep: Sweep, state: RowState, halo: Float32, hot_flux: float, first_line: int,
    last_line: int, sums: Float64,
) -> None:  # fmt: skip
    """Add to sums (4,), for the blocks of lines first_line..last_line-1: (O - E)^2 / V, 1, (O - E)^2 - V, E^2 (see the
    module).

    Lines whose stripe saturates its pixels are left out: their light, and so their halo, is not known.
    """
    row, side = row_buffers(sweep.window, 1), 1 if sweep.near_is_left else -1
    for i in range(first_line, last_line):
        y, c, frames = lines.row[i], lines.column[i], lines.exposures[i]
        length, _, _, start = row_fluxes(sweep, state, row, y, c)
        unknown = np.isnan(lines.x_px[i]) or np.isnan(light[i])
        if length == 0 or frames == 0 or unknown or light[i] * state.psi[0] > most_shown(frames):
            continue
        place = side * (np.float64(lines.x_px[i]) - start)
        own = row.cell[min(max(int(np.rint(place)), 0), length - 1)]
        off = expected = variance = 0.0
        seen = 0
        for t in range(length):
            away = abs(t - place)
            if away < LINE_PX or state.ambient[y, start + side * t] > hot_flux:
                continue
            flux = np.float64(row.before[t] if t < place else row.behind[t])
            if halo.shape[1] > 0:
                flux += light[i] * halo[own, min(int(away), halo.shape[1] - 1)]
            dark = np.exp(-flux)
            off += lines.counts[i, start + side * t - sweep.x0[c]] - frames * (1.0 - dark)
            expected += frames * (1.0 - dark)
            variance += frames * (1.0 - dark) * dark
            seen += 1
            if seen == BLOCK_PX:
                if variance > 0.0:
                    sums[0] += off * off / variance
                    sums[1] += 1.0
                    sums[2] += off * off - variance
                    sums[3] += expected * expected
                off = expected = variance = 0.0
                seen = 0
