"""The halo's part of the label costs, compiled: a fast form of `rig.estimate.row.likelihood`, tested against it.

The halo (light of the stripe that fog scatters to both sides, `rig.estimate.row.inputs`) is part of every hypothesis.
The tables of `rig.estimate.joint.labels.tables` take it to be as bright everywhere as at the stripe, which is right for
the pixels around the stripe. The difference elsewhere varies slowly with the stripe's position and from pixel to pixel.
So it is tabled for stripes BLOCK_PX apart, with linear interpolation, and for the mean counts of blocks of BLOCK_PX
pixels. To the score of a stripe at place x it adds, in K exposures,

    K constant(x) + sum over blocks of (mean count of the block) weight(block, x)

with weights int16 and constants float32 in nats per exposure (`HaloTables`).
"""

from typing import Final, NamedTuple

import numba
import numpy as np

from rig.estimate.joint.labels.grid import BAND_ROWS, FAR_PX, PHASES, START, VARIANTS
from rig.estimate.joint.labels.tables import (
    BATCH,
    LIGHTS,
    POSITION,
    WEIGHT_LIMIT,
    Buffers,
    Fitted,
    LabelTables,
    mean_ambient,
    middle_row,
)
from rig.estimate.row.inputs import RowState, Sweep, row_buffers, row_fluxes
from rig.estimate.row.likelihood import FLUX_MAX, FLUX_MIN, cell_of
from rig.simd import Bools, Float32, Int16, Int32
from rig.simd.memory import aligned_zeros, load_float32, load_int16, read_int16, read_int32, store_int16, write_int16
from rig.simd.vectors import LANES, add_saturated, larger_float, scaled, smaller, smaller_float, to_int16, zero_int16

BLOCK_PX: Final = 8
FIRST_PX: Final = FAR_PX % BLOCK_PX - BLOCK_PX
"""First pixel of the first block, before the row, so that the first label's pixel begins a block."""
AHEAD: Final = (FAR_PX - FIRST_PX) // BLOCK_PX
"""Number of blocks on the far side of a stripe at place 0."""
_FULL: Final = 32768.0


class HaloTables(NamedTuple):
    """Tables of the halo. Blocks of pixels are counted from FIRST_PX on. Places of the stripe are BLOCK_PX apart and
    counted from the far end of label 0's pixel on.

    weight: int16 (bands, columns, blocks, lights, places), of the mean count of a block. constant: float32
    (bands, columns, lights, places), nats per exposure. ramp: int16 (phases, 3, LANES), interpolation weights of the
    three places around a vector of labels, in 2^-15. Without a halo all but `ramp` are empty.
    """

    weight: Int16
    constant: Float32
    ramp: Int16


def halo_tables(tables: LabelTables, there: bool) -> HaloTables:
    """Memory for the tables of a halo. there: whether there is one."""
    (bands, columns, _), lights = tables.at.shape, LIGHTS * tables.pairs
    blocks = -(-(tables.edge.shape[1] - FIRST_PX) // BLOCK_PX)
    places = -(-(LANES // BLOCK_PX * tables.tap.shape[1] + 1) // LANES) * LANES
    if not there:
        bands = blocks = places = 0
    weight = aligned_zeros((bands, columns, blocks, lights, places), np.int16)
    return HaloTables(weight, aligned_zeros((bands, columns, lights, places), np.float32), _ramps())


def _ramps() -> Int16:
    pixel = np.arange(LANES) + 0.5
    # A pixel's labels lie about a quarter of it to either side of its middle.
    at = (pixel + np.array([-0.25, 0.25])[:, None]) / BLOCK_PX
    parts = np.maximum(1.0 - np.abs(at[:, None] - np.arange(3)[:, None]), 0.0)
    return np.asarray(np.minimum(np.rint(_FULL * parts), _FULL - 1), np.int16)


@numba.njit(cache=True, nogil=True)
def fill_halo(
    sweep: Sweep, state: RowState, place: Int16, ambient: Float32, hot: Bools, light: Float32, halo: Float32,
    per_nat: float, first_band: int, last_band: int, tables: LabelTables, out: HaloTables,
) -> None:  # fmt: skip
    """Fill the tables of bands first_band..last_band-1; arguments as those of `fill_tables`.

    halo: (BINS, pixels) of `halo_shares`.
    """
    side = 1 if sweep.near_is_left else -1
    pixels = tables.edge.shape[1]
    row, middle_light = row_buffers(sweep.window, 1), np.sqrt(light[0] * light[-1])
    mean, number = np.empty(pixels, np.float32), np.empty(pixels, np.int32)
    # For each block: flux before and behind the stripe, and flux of the halo in the tables of labels.
    level, size = np.empty((3, out.weight.shape[2]), np.float32), np.empty(out.weight.shape[2], np.int64)
    for b in range(first_band, last_band):
        rows = b * BAND_ROWS, min((b + 1) * BAND_ROWS, place.shape[1])
        for c in range(place.shape[0]):
            y, _, _ = middle_row(place, c, rows, -1)
            if y < 0:
                continue
            mean_ambient(place, ambient, hot, side, c, rows, mean, number)
            length, _, _, start = row_fluxes(sweep, state, row, y, c)
            to_t = side * (place[c, y, START] - start)
            first_px, end_px = max(0, to_t - length + 1), min(pixels, to_t + 1)
            for variant in range(VARIANTS):
                i = tables.at[b, c, variant]
                if i >= 0:
                    first_px = max(first_px, int(tables.span[i, 0]))
                    end_px = min(end_px, int(tables.span[i, 1]))
            for k in range(level.shape[1]):
                level[:, k] = 0.0
                begin = max(FIRST_PX + BLOCK_PX * k, first_px)
                size[k] = max(min(FIRST_PX + BLOCK_PX * (k + 1), end_px) - begin, 0)
                for p in range(begin, begin + size[k]):
                    t = to_t - p
                    level[0, k] += (row.before[t] + mean[p]) / size[k]
                    level[1, k] += (row.behind[t] + mean[p]) / size[k]
                    level[2, k] += middle_light * row.scale[t] * state.glow[row.cell[t]] / size[k]
            out.weight[b, c] = 0
            out.constant[b, c] = 0.0
            # Further places only fill up a vector. They have no labels, and `halo` need not reach so far.
            for j in range(LANES // BLOCK_PX * tables.tap.shape[1] + 1):
                t = min(max(to_t - FAR_PX - BLOCK_PX * j, 0), length - 1)
                for m in range(light.shape[0]):
                    s = light[m] * row.scale[t]
                    for k in range(level.shape[1]):
                        if size[k] == 0:
                            continue
                        # The middle of a block is half a block from its ends.
                        away = abs(BLOCK_PX * (k - j - AHEAD) + BLOCK_PX // 2)
                        base = level[1 if k < j + AHEAD else 0, k]
                        told = min(max(base + level[2, k], FLUX_MIN), FLUX_MAX)
                        flux = min(max(base + s * halo[row.cell[t], away], FLUX_MIN), FLUX_MAX)
                        other, own = cell_of(told), cell_of(flux)
                        weight = BLOCK_PX * per_nat * (state.table[0, own] - state.table[0, other])
                        out.weight[b, c, k, m, j] = round(min(max(weight, -WEIGHT_LIMIT), WEIGHT_LIMIT))
                        out.constant[b, c, m, j] += size[k] * (state.table[1, own] - state.table[1, other])


HIGHEST: Final = 30000
"""Largest size of scores and their parts; larger ones are cut."""
_TO_UNSIGNED: Final = np.float32(32768.5)
_POSSIBLE: Final = np.int16(28000)
"""Constants of positions without a label lie below the negative of this, others above."""


@numba.njit(forceinline=True)
def rounded(a):  # type: ignore[no-untyped-def]
    """Parts of scores, float32 lanes, rounded to 16 bits and cut at HIGHEST."""
    a = larger_float(smaller_float(a, np.float32(HIGHEST)), np.float32(-HIGHEST))
    return to_int16(a + _TO_UNSIGNED) + np.int16(-32768)


class HaloRoom(NamedTuple):
    """The tables with their sizes, and working memory for a column and a batch of rows.

    All int16 unless stated. fitted: (lights, places), constants of all places for a column's exposures; mean:
    (blocks,), mean counts of blocks; level: (lights, places), evidence of the halo for a stripe at each place;
    constant: of the positions, for each row of a batch; which: int32 (BATCH,), each row's index in `constant`.
    """

    tables: HaloTables
    blocks: int
    lights: int
    places: int
    fitted: Int16
    mean: Int16
    level: Int16
    constant: Int16
    which: Int32


def new_halo_room(halo: HaloTables, constants: int) -> HaloRoom:
    """Working memory for rows with this number of constants."""
    _, _, blocks, lights, places = halo.weight.shape
    return HaloRoom(
        tables=halo, blocks=blocks, lights=lights, places=places, fitted=aligned_zeros((lights, places), np.int16),
        mean=aligned_zeros((blocks,), np.int16), level=aligned_zeros((lights, places), np.int16),
        constant=aligned_zeros((BATCH if blocks else 0, constants), np.int16), which=np.arange(BATCH, dtype=np.int32),
    )  # fmt: skip


@numba.njit(cache=True, nogil=True)
def fit_halo(halo: HaloRoom, column: int, per_nat: float) -> None:
    """Fill `halo.fitted` for a column's exposures. column: band * columns + column; per_nat: of `mend_rows`."""
    numbers = halo.lights * halo.places
    for j in range(0, numbers, LANES):
        nats = load_float32(halo.tables.constant + 4 * column * numbers, j) * np.float32(per_nat)
        store_int16(halo.fitted, j, rounded(nats))


@numba.njit(cache=True, nogil=True)
def halo_rows(halo: HaloRoom, column: int, at: LabelTables, fitted: Fitted, b: Buffers, batch: int) -> None:
    """Fill `halo.constant` for `batch` rows: constants of the rows' tables plus the evidence of the halo."""
    vectors, numbers = b.score_row // (PHASES * LANES), halo.lights * halo.places
    weights = halo.tables.weight + 2 * column * halo.blocks * numbers
    for r in range(batch):
        i = read_int32(b.here, r)
        if i < 0:
            continue
        n, first, end = b.n + 2 * r * b.n_row, read_int16(at.span, 2 * i), read_int16(at.span, 2 * i + 1)
        for k in range(halo.blocks):
            begin, total = FIRST_PX + BLOCK_PX * k, 0
            for p in range(max(begin, first), min(begin + BLOCK_PX, end)):
                total += read_int16(n, p)
            write_int16(halo.mean, k, np.int16(total // BLOCK_PX))
        for j in range(0, numbers, LANES):
            says = load_int16(halo.fitted, j)
            for k in range(halo.blocks):
                mean = zero_int16() + read_int16(halo.mean, k)
                says = add_saturated(says, scaled(mean, load_int16(weights, k * numbers + j)))
            store_int16(halo.level, j, says)
        source = fitted.constant + 2 * at.constants * read_int32(b.fitted, r)
        to = halo.constant + 2 * at.constants * r
        for v in range(vectors):
            for m in range(halo.lights):
                pair = v * at.pairs + m // LIGHTS
                place = m * halo.places + LANES // BLOCK_PX * v
                first = zero_int16() + read_int16(halo.level, place)
                second = zero_int16() + read_int16(halo.level, place + 1)
                third = zero_int16() + read_int16(halo.level, place + 2)
                for phase in range(PHASES):
                    ramp = halo.tables.ramp + 2 * 3 * LANES * phase
                    says = scaled(first, load_int16(ramp, 0)) + scaled(second, load_int16(ramp, LANES))
                    says = says + scaled(third, load_int16(ramp, 2 * LANES))
                    j = pair * POSITION + (phase * LIGHTS + m % LIGHTS) * LANES
                    constant = load_int16(source, j)
                    # Positions without a label stay impossible, whatever the halo adds.
                    never = smaller(constant + _POSSIBLE, np.int16(0)) << 4
                    store_int16(to, j, add_saturated(add_saturated(constant, says), never))
