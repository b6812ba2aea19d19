"""Cost of every label on every row and column: a fast form of `rig.estimate.row.likelihood`, tested against it.

The cost says how much less likely a label makes the counts than the best label does. It uses the line's profile at the
label's own eighth of a pixel, two amplitudes (four under a halo), and tables that the rows of a band share
(`rig.estimate.joint.labels.tables`),

    cost(l) = units_per_nat (max log-likelihood - log-likelihood(l)),   uint8 (rows, columns, labels), <= COST_LIMIT
    units_per_nat = UNITS / (1 + K / SHARP) for K exposures

or less if 16 bits would not hold the scores. EXCLUDED marks impossible labels. 'No stripe' is not among the labels,
since a row with that answer would pass no information between its neighbours.
"""

from dataclasses import dataclass
from typing import Final

import numba
import numpy as np

from rig.count.volume import CountVolume
from rig.estimate.joint.labels.cost_rows import CostRoom, fill_costs, fit_tables, room_for
from rig.estimate.joint.labels.grid import (
    BAND_ROWS,
    FAR_PX,
    FRACTIONS,
    PHASES,
    VARIANTS,
    LabelGrid,
    label_pixels,
    places_of,
)
from rig.estimate.joint.labels.halo_rows import BLOCK_PX, HaloTables, fill_halo, halo_tables
from rig.estimate.joint.labels.tables import LIGHTS, LabelTables, Ways, fill_tables, mark_rows, number_tables
from rig.estimate.joint.winner import UNITS
from rig.estimate.row.inputs import (
    RowBuffers,
    RowState,
    Sweep,
    halo_shares,
    row_buffers,
    row_fluxes,
    state_of,
    sweep_of,
)
from rig.estimate.row.likelihood import FLUX_MAX, cell_of
from rig.estimate.row.model import RowModel, pixel_shares
from rig.estimate.search.prepare import HOT_FACTOR, HOT_FLUX
from rig.geometry.windows import MARGIN_PX, SweepGeometry
from rig.simd import Bools, Float32, Int16, Int32, Uint8
from rig.simd.memory import aligned_zeros, pointers
from rig.simd.vectors import LANES
from rig.threads import RowWorkers

SHARP: Final = 8.0
"""Exposures at which a nat is worth half as many units: the labels beside the best one must still count."""
FINEST: Final = 64.0
"""Largest number of units per nat in scores."""
WEIGHT_BITS: Final = 12
"""Weights of 2^WEIGHT_BITS units per nat reach to 8 nats per count."""
RISE_LIMIT: Final = 22000
"""Largest rise of the sum over a row's pixels, in units of score; scores have a range of 40000."""
TAPS_LIMIT: Final = 28000
"""Most that the pixels around a position may add to its score."""
FRAMES_OVER_HALF_MORE: Final = 4
"""The counts of a column weigh no more than those of one and a half times the nominal exposures plus this many."""
LOOKED_AT: Final = 32
"""Number of rows, and of columns, from which the units for all are chosen."""
QUANTILES: Final = (0.25, 0.75)
"""Quantiles of the learned amplitudes that the costs try."""
HALO_QUANTILES: Final = (0.1, 0.35, 0.65, 0.9)
"""Quantiles that are tried under a halo. A halo is many times brighter than its stripe, so a stripe between two
amplitudes would be drawn to a distance where the halo of one of them fits."""
HALO_TRUST: Final = 0.9
"""Factor on the halo's evidence: the many pixels over which it is summed share the errors of the learned halo."""


@dataclass(frozen=True, slots=True, eq=False)
class Costs:
    """Tables and settings for the costs of sweeps under one model; made once per model by `costs_of`.

    units_per_nat: of cost; UNITS / (1 + exposures / SHARP), or less if 16 bits would not hold the scores.
    """

    grid: LabelGrid
    tables: LabelTables
    halo: HaloTables
    place: Int16
    ways: Ways
    units_per_nat: float

    def room(self) -> CostRoom:
        """Working memory for one thread, used for one band of rows after another."""
        return room_for(self.tables, self.halo, self.grid.labels)

    def fill(self, volume: CountVolume, first: int, last: int, room: CostRoom, out: Uint8) -> None:
        """Write the costs of rows first..last-1 to out, uint8 (rows, columns, labels) of all rows.

        All labels cost 0 in columns without frames and where nothing is searched. A call is fastest with 16 rows or
        more at a time. Threads may fill different rows at once, each with its own working memory. room: `pointers` to
        this memory, which the caller keeps alive.
        """
        fill_costs(
            volume.counts, volume.n_frames, volume.x0, self.place, self.tables.at, room, self.ways, first, last, out
        )


def costs_of(model: RowModel, geometry: SweepGeometry, grid: LabelGrid, exposures: int, workers: RowWorkers) -> Costs:
    """The costs under `model` for columns of about `exposures` frames, with all their tables."""
    sweep, state = sweep_of(geometry), state_of(model)
    reach = len(state.psi) - 1
    light = _lights(model)
    ways, units_per_nat = _ways(sweep, state, grid, exposures, light, reach)
    place = places_of(sweep, grid)
    bands = -(-geometry.rows // BAND_ROWS)
    at = np.empty((bands, geometry.columns, VARIANTS), np.int32)
    ambient, hot = model.ambient, hot_in_bands(model.ambient)
    tables = _empty_tables(at, number_tables(place, at), grid, 2 * reach + 1, hot, len(light) // LIGHTS)
    distance = np.arange(-reach, reach + 1) - (np.arange(FRACTIONS)[:, None] - FRACTIONS // 2) / FRACTIONS
    shares = pixel_shares(model.line_sigma_px, distance)
    beside = np.ascontiguousarray(halo_shares(model, BLOCK_PX // 2 + 1)[:, -1])
    dark = state._replace(ambient=np.zeros_like(ambient), row_gain=_band_means(state.row_gain))
    scale, seen = 2.0**ways.bits, (sweep, dark, place, ambient, hot, light)

    def work(first: int, last: int) -> None:
        most = TAPS_LIMIT * scale / ways.most
        fill_tables(*seen, shares, beside, ways.units * scale, most, first, last, tables)

    workers.over(bands, work)
    halo = halo_tables(tables, bool(model.halo.any()))

    if halo.weight.size > 0:
        shares_of_halo = halo_shares(model, tables.edge.shape[1] + FAR_PX)
        around = *seen, shares_of_halo, ways.units * scale * HALO_TRUST
        workers.over(bands, lambda first, last: fill_halo(*around, first, last, tables, halo))
        np.multiply(halo.constant, np.float32(HALO_TRUST), out=halo.constant)

    def fit(first: int, last: int) -> None:
        room = room_for(tables, halo, grid.labels)
        fit_tables(pointers(room), ways, first, last)

    workers.over(len(tables.span), fit)
    mark_rows(place, hot, grid.side, tables)
    return Costs(grid, tables, halo, place, ways, units_per_nat)


def _ways(
    sweep: Sweep, state: RowState, grid: LabelGrid, exposures: int, light: Float32, reach: int
) -> tuple[Ways, float]:
    most = exposures + exposures // 2 + FRAMES_OVER_HALF_MORE
    bits = most.bit_length()
    rise, gain = _largest(sweep, state, row_buffers(sweep.window, 1), light[-1])
    # If pixels give no information at all, any unit will do.
    largest = max(rise / RISE_LIMIT, gain / TAPS_LIMIT, 1e-9)
    finest = min(FINEST, 2.0 ** (WEIGHT_BITS - bits), 1.0 / (most * largest))
    wanted = UNITS / (1.0 + exposures / SHARP)
    down = max(int(np.floor(np.log2(finest / wanted))), 0)
    units_per_nat = min(wanted, finest)
    ways = Ways(
        units=units_per_nat * 2.0**down, bits=bits, exposures=exposures, most=most, sharp=SHARP, down=down,
        reach=reach, side=grid.side, stripes=grid.stripes,
    )  # fmt: skip
    return ways, units_per_nat


@numba.njit(cache=True, nogil=True)
def _largest(sweep: Sweep, state: RowState, row: RowBuffers, light: float) -> tuple[float, float]:
    """Largest sums along some rows, in nats.

    The first is per exposure, from all pixels of a row being behind the stripe instead of before it. The second is per
    count, from the pixels that a stripe of this light falls on.
    """
    rise = gain = 0.0
    rows, columns = sweep.x_lo.shape
    for y in range(0, rows, max(rows // LOOKED_AT, 1)):
        for c in range(0, columns, max(columns // LOOKED_AT, 1)):
            length, _, _, _ = row_fluxes(sweep, state, row, y, c)
            total = 0.0
            for t in range(length):
                dark = cell_of(row.behind[t])
                total += abs(state.table[1, dark] - state.table[1, cell_of(row.before[t])])
                taps = 0.0
                for d in range(1 - state.psi.shape[0], state.psi.shape[0]):
                    flux = np.float32(row.behind[t] + light * row.scale[t] * state.psi[abs(d)])
                    taps += state.table[0, cell_of(min(flux, FLUX_MAX))] - state.table[0, dark]
                gain = max(gain, taps)
            rise = max(rise, total)
    return rise, gain


def _empty_tables(at: Int32, tables: int, grid: LabelGrid, taps: int, hot: Bools, pairs: int) -> LabelTables:
    y, x = np.nonzero(hot)
    vectors = -(-label_pixels(grid) // LANES)
    pixels = -(-(FAR_PX + label_pixels(grid) + MARGIN_PX) // LANES) * LANES
    return LabelTables(
        at=at, edge=aligned_zeros((tables, pixels), np.int16), edge_sum=aligned_zeros((tables, pixels), np.float32),
        tap=aligned_zeros((tables, vectors, pairs, taps, PHASES, LIGHTS, LANES), np.int16),
        constant=aligned_zeros((tables, vectors, pairs, PHASES, LIGHTS, LANES), np.float32),
        span=np.zeros((tables, 2), np.int16), used=np.zeros(tables, np.int16),
        fitted_constant=aligned_zeros((tables, vectors, pairs, PHASES, LIGHTS, LANES), np.int16),
        fitted_edge=aligned_zeros((tables, pixels), np.int16),
        hot_start=np.searchsorted(y, np.arange(len(hot) + 1)).astype(np.int32), hot_x=x.astype(np.int16), pixels=pixels,
        taps=vectors * pairs * taps * PHASES * LIGHTS * LANES, constants=vectors * pairs * PHASES * LIGHTS * LANES,
        pairs=pairs,
    )  # fmt: skip


def _lights(model: RowModel) -> Float32:
    """QUANTILES of the learned amplitudes, or HALO_QUANTILES under a halo; ascending."""
    weight = np.maximum(model.weight, 1e-6)
    middle = (np.cumsum(weight) - 0.5 * weight) / weight.sum()
    quantiles = HALO_QUANTILES if model.halo.any() else QUANTILES
    return np.exp(np.interp(quantiles, middle, np.log(model.amplitude.astype(np.float64)))).astype(np.float32)


def hot_in_bands(ambient: Float32) -> Bools:
    """Pixels (rows, width) with ambient light far above the median at their x over their band; for the last band, over
    the last BAND_ROWS rows."""
    rows, hot = len(ambient), np.empty(ambient.shape, np.bool_)
    for first in range(0, rows, BAND_ROWS):
        band = ambient[first : first + BAND_ROWS]
        around = ambient[max(min(first, rows - BAND_ROWS), 0) : first + BAND_ROWS]
        hot[first : first + BAND_ROWS] = band > HOT_FACTOR * np.median(around, axis=0) + HOT_FLUX
    return hot


def _band_means(gain: Float32) -> Float32:
    """For each row the mean gain of its band."""
    parts = np.split(gain, np.arange(BAND_ROWS, len(gain), BAND_ROWS))
    return np.concatenate([np.full_like(part, part.mean()) for part in parts])
