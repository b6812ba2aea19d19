"""Tables of the label costs: a fast form of `rig.estimate.row.likelihood`, tested against it.

There is a table per column, band of rows and variant; the working memory is here too. Tables hold the terms of the
likelihood, relative to 'everything is before the stripe'. With the probability p' that a pixel fires, p'_B before and
p'_E behind the stripe, and p'_S where the stripe lights it,

    edge = logit p'_E - logit p'_B                  int16: a count at a pixel behind the stripe
    tap  = logit p'_S - logit (p'_B or p'_E)        int16: a count at a pixel around a label, for LIGHTS amplitudes;
                                                    E for pixels farther than the label's, else B
    constant, edge_sum: the same of log(1 - p'), float32 per exposure: the number of frames differs between columns

Haze, the level behind the stripe and ambient light vary slowly along a line, so the rows of a band share a table for
each variant of `rig.estimate.joint.labels.grid` that occurs among them. Counts are multiplied with weights by `scaled`.

The stripe's brightness is unknown. Two quantiles of the learned amplitudes are tried, under a halo four, and the score
of the likeliest is used. The learned prior of positions is not used, since it makes errors larger.
"""

from typing import Final, NamedTuple

import numba
import numpy as np

from rig.estimate.joint.labels.grid import (
    BAND_ROWS,
    FAR_PX,
    FRACTIONS,
    LABEL,
    LABEL_END,
    MEND,
    ODD,
    PHASES,
    START,
    VALID,
    VALID_END,
    VARIANT,
    VARIANTS,
)
from rig.estimate.row.inputs import RowState, Sweep, row_buffers, row_fluxes
from rig.estimate.row.likelihood import FLUX_MAX, FLUX_MIN, cell_of
from rig.simd import Bools, Float32, Int16, Int32, Uint8
from rig.simd.memory import CACHE_LINE, aligned_zeros
from rig.simd.vectors import LANES

LIGHTS: Final = 2
"""Stripe brightnesses that are scored together, as a pair. Of all pairs the likeliest brightness is used."""
WEIGHT_LIMIT: Final = 32767
"""Largest weight; larger ones are cut to it."""
IMPOSSIBLE: Final = np.float32(-1e9)
"""Constant of a position where no row of the band has a label."""
_NEAR, _FAR = 0, 1


class LabelTables(NamedTuple):
    """Tables of all bands and columns, see the module.

    P: pixels of a row, V: vectors of pixels that hold labels, from pixel FAR_PX on. PHASES: the far and the near half
    of a pixel.

    at: int32 (bands, columns, VARIANTS), index of the table, -1 if there is none.
    edge: int16 (tables, P), weight of a count behind the stripe. edge_sum: float32 (tables, P), nats per exposure if
    a pixel and all farther ones lie behind.
    tap: int16 (tables, V, pairs, taps, PHASES, LIGHTS, LANES), weight of the counts of the pixels around each position.
    constant: float32 (tables, V, pairs, PHASES, LIGHTS, LANES), nats per exposure of each position.
    span: int16 (tables, 2), first pixel with weights and the one after the last; others have weight 0.
    used: int16 (tables,), vectors up to the last one that holds a label of any row.
    fitted_constant, fitted_edge: int16, units of constant and of each pixel's share of edge_sum, for the usual number
    of exposures.
    hot_x: int16, x of hot pixels; those of row y begin at hot_start[y], int32 (rows + 1,).
    pixels, taps, constants: number of edge, tap and constant entries of a table. pairs: of brightnesses.
    """

    at: Int32
    edge: Int16
    edge_sum: Float32
    tap: Int16
    constant: Float32
    span: Int16
    used: Int16
    fitted_constant: Int16
    fitted_edge: Int16
    hot_start: Int32
    hot_x: Int16
    pixels: int
    taps: int
    constants: int
    pairs: int


@numba.njit(cache=True, nogil=True)
def number_tables(place: Int16, at: Int32) -> int:
    """Fill `at` of LabelTables with the numbers of the tables that the rows need; returns the number of tables."""
    tables = 0
    at[:] = -1
    for b in range(at.shape[0]):
        for c in range(at.shape[1]):
            for y in range(b * BAND_ROWS, min((b + 1) * BAND_ROWS, place.shape[1])):
                variant = place[c, y, VARIANT]
                if variant >= 0 and at[b, c, variant] < 0:
                    at[b, c, variant] = tables
                    tables += 1
    return tables


@numba.njit(cache=True, nogil=True)
def fill_tables(
    sweep: Sweep, state: RowState, place: Int16, ambient: Float32, hot: Bools, light: Float32, shares: Float32,
    beside: Float32, per_nat: float, most: float, first_band: int, last_band: int, out: LabelTables,
) -> None:  # fmt: skip
    """Fill the tables of bands first_band..last_band-1.

    state: without ambient light. ambient: (rows, width), used for pixels that are not `hot`. light: (LIGHTS x pairs,)
    photons at unit scale. shares: (FRACTIONS, taps) of the line in the pixels around its centre, which is -4/8 to 3/8
    px off the middle of its pixel. beside: (BINS,), share of the halo in a pixel 4 px from the stripe. per_nat: units
    of weight per nat; most: largest sum of the sizes of a position's weights.
    """
    side = 1 if sweep.near_is_left else -1
    pixels = out.edge.shape[1]
    row, middle_light = row_buffers(sweep.window, 1), np.sqrt(light[0] * light[-1])
    mean, number = np.empty(pixels, np.float32), np.empty(pixels, np.int32)
    flux, level = np.empty((2, pixels), np.float32), np.empty((4, pixels), np.float32)
    glow, near_glow = np.empty(pixels, np.float32), np.empty(pixels, np.float32)
    for b in range(first_band, last_band):
        rows = b * BAND_ROWS, min((b + 1) * BAND_ROWS, place.shape[1])
        for c in range(place.shape[0]):
            if out.at[b, c].max() < 0:
                continue
            mean_ambient(place, ambient, hot, side, c, rows, mean, number)
            for variant in range(VARIANTS):
                i = out.at[b, c, variant]
                if i < 0:
                    continue
                y, label, label_end = middle_row(place, c, rows, variant)
                here = place[c, y]
                length, _, _, start = row_fluxes(sweep, state, row, y, c)
                to_t = side * (here[START] - start)
                span = max(to_t - length + 1, 0), min(to_t + 1, pixels)
                out.span[i, 0], out.span[i, 1] = span
                out.used[i] = -(-label_end // (PHASES * LANES))
                for p in range(span[0], span[1]):
                    # Near the stripe the halo is level; `fill_halo` tables how it differs elsewhere.
                    glow[p] = state.glow[row.cell[to_t - p]]
                    near_glow[p] = beside[row.cell[to_t - p]]
                    for near in (_NEAR, _FAR):
                        light_there = row.before[to_t - p] if near == _NEAR else row.behind[to_t - p]
                        light_there += middle_light * row.scale[to_t - p] * glow[p]
                        flux[near, p] = min(max(light_there + mean[p], FLUX_MIN), FLUX_MAX)
                        cell = cell_of(flux[near, p])
                        level[near, p], level[2 + near, p] = state.table[0, cell], state.table[1, cell]
                _fill_edges(level, span, per_nat, out.edge[i], out.edge_sum[i])
                _fill_taps(
                    state.table, row.scale, glow, near_glow, to_t, span, flux, light, shares, variant, per_nat, most,
                    (label, label_end), out.tap[i], out.constant[i],
                )  # fmt: skip


@numba.njit(cache=True, nogil=True)
def mark_rows(place: Int16, hot: Bools, side: int, tables: LabelTables) -> None:
    """Set MEND for rows in which pixels with a weight in the row's table are hot or missing."""
    for c in range(place.shape[0]):
        for y in range(place.shape[1]):
            here = place[c, y]
            if here[VARIANT] < 0:
                continue
            span = tables.span[tables.at[y // BAND_ROWS, c, here[VARIANT]]]
            here[MEND] = 1 if here[VALID] > span[0] or here[VALID_END] < span[1] else 0
            for p in range(max(here[VALID], span[0]), min(here[VALID_END], span[1])):
                if hot[y, here[START] - side * p]:
                    here[MEND] = 1


@numba.njit(cache=True, nogil=True)
def middle_row(place: Int16, c: int, rows: tuple[int, int], variant: int) -> tuple[int, int, int]:
    """Find the rows of a variant (-1: of any) among `rows`, (first, last + 1).

    Returns the row nearest to the middle, -1 if there is none; and of all these rows together, the first position and
    the last one plus 1. There are two positions per pixel, counted from the pixel with label 0.
    """
    middle = (rows[0] + rows[1]) // 2
    best, first, end = -1, 1 << 15, 0
    for y in range(rows[0], rows[1]):
        here = place[c, y]
        if here[VARIANT] == variant or variant < 0 <= here[VARIANT]:
            if best < 0 or abs(y - middle) < abs(best - middle):
                best = y
            first = min(first, int(here[LABEL] + here[ODD]))
            end = max(end, int(here[LABEL_END] + here[ODD]))
    return best, first, end


@numba.njit(cache=True, nogil=True)
def mean_ambient(
    place: Int16, ambient: Float32, hot: Bools, side: int, c: int,
    rows: tuple[int, int], mean: Float32, number: Int32,
) -> None:  # fmt: skip
    """Fill mean, the band's mean ambient light at each pixel p; pixels without a value take that of the one before."""
    mean[:] = 0.0
    number[:] = 0
    for y in range(rows[0], rows[1]):
        here = place[c, y]
        if here[VARIANT] < 0:
            continue
        for p in range(here[VALID], min(here[VALID_END], mean.shape[0])):
            x = here[START] - side * p
            if not hot[y, x]:
                mean[p] += ambient[y, x]
                number[p] += 1
    last = FLUX_MIN
    for p in range(mean.shape[0]):
        if number[p]:
            last = mean[p] / np.float32(number[p])
        mean[p] = last


@numba.njit(cache=True, nogil=True)
def _fill_edges(
    level: Float32, span: tuple[int, int], per_nat: float, edge: Int16,
    edge_sum: Float32,
) -> None:  # fmt: skip
    total = 0.0
    for p in range(edge.shape[0]):
        edge[p] = 0
        if span[0] <= p < span[1]:
            edge[p] = _weight((level[_FAR, p] - level[_NEAR, p]) * per_nat)
            total += level[2 + _FAR, p] - level[2 + _NEAR, p]
        edge_sum[p] = total


@numba.njit(cache=True, nogil=True)
def _fill_taps(
    table: Float32, scale: Float32, glow: Float32, near_glow: Float32,
    to_t: int, span: tuple[int, int], flux: Float32, light: Float32,
    shares: Float32, variant: int, per_nat: float, most: float, labels: tuple[int, int],
    tap: Int16, constant: Float32,
) -> None:  # fmt: skip
    reach = shares.shape[1] // 2
    half, middle_light = np.float32(0.5), np.sqrt(light[0] * light[-1])
    for q in range(LANES * tap.shape[0]):
        p, vector, lane = FAR_PX + q, q // LANES, q % LANES
        for phase in range(PHASES):
            inside = span[0] <= p < span[1] and labels[0] <= PHASES * q + phase < labels[1]
            off = variant - VARIANTS * (1 - phase)
            for m in range(light.shape[0]):
                total, largest, pair, own_light = np.float32(0.0), 0.0, m // LIGHTS, m % LIGHTS
                weights = tap[vector, pair, :, phase, own_light, lane]
                weights[:] = 0
                constant[vector, pair, phase, own_light, lane] = IMPOSSIBLE
                if not inside:
                    continue
                halo = (light[m] - middle_light) * scale[to_t - p] * glow[p]
                for d in range(max(-reach, span[0] - p), min(reach + 1, span[1] - p)):
                    at = p + d
                    # Relative to the running sum, in which pixels up to here lie behind, and from here on before.
                    own = _FAR if d < 0 else _NEAR
                    base = flux[own, at]
                    if d == 0:
                        nearer = half - np.float32(off) / np.float32(FRACTIONS)
                        base = flux[_FAR, at] + nearer * (flux[_NEAR, at] - flux[_FAR, at])
                    extra = light[m] * scale[to_t - p] * shares[off + VARIANTS, d + reach] + halo
                    cell = cell_of(min(max(base + extra, FLUX_MIN), FLUX_MAX))
                    # The light that the tables of the halo already assume for this pixel, without the line.
                    around = light[m] * scale[to_t - p] * near_glow[p] - middle_light * scale[to_t - at] * glow[at]
                    told = cell_of(min(max(flux[own, at] + around, FLUX_MIN), FLUX_MAX))
                    weight = _weight((table[0, cell] - table[0, told]) * per_nat)
                    weights[d + reach] = weight
                    largest += abs(weight)
                    total += table[1, cell] - table[1, told]
                constant[vector, pair, phase, own_light, lane] = total
                if largest > most:
                    for d in range(2 * reach + 1):
                        weights[d] = np.int16(weights[d] * most / largest)


@numba.njit(inline="always")
def _weight(value):  # type: ignore[no-untyped-def]
    return np.int16(round(min(max(value, np.float64(-WEIGHT_LIMIT)), np.float64(WEIGHT_LIMIT))))


BATCH: Final = LANES
"""Rows that go through each step of the work together: while one waits for a result, others go on."""
SUMS_FROM: Final = LANES - 1
"""Index of pixel 0's sum, which is over no pixels. Pixel 1's sum comes next and begins a whole vector."""
POSITION: Final = PHASES * LIGHTS * LANES
"""Numbers per vector of pixels in a table, for a pair of brightnesses."""


class Ways(NamedTuple):
    """Units and limits of scores and costs.

    units: of scores per nat, for columns with the usual number of `exposures`; bits: of the largest count; most:
    exposures up to which counts have full weight; sharp: number of exposures at which a nat is worth half as many
    units; down: scores are divided by 2^down for costs; reach: taps on either side; side, stripes: as in `LabelGrid`.
    """

    units: float
    bits: int
    exposures: int
    most: int
    sharp: float
    down: int
    reach: int
    side: int
    stripes: int


class Fitted(NamedTuple):
    """Addresses of constants and edges for a number of exposures, int16: of all tables, or of a column's variants."""

    constant: int
    edge: int


class Buffers(NamedTuple):
    """Working memory for BATCH rows, int16 (BATCH, ...) unless stated otherwise.

    n: counts of pixels from far to near; sums: for each pixel, from SUMS_FROM on, the score if all farther pixels lie
    behind the stripe; score: of pixel and phase; top: the largest score in each lane of each row; in the end the first
    LANES hold that of each row. cost: uint8, from the first pixel's phase 0 on. For all rows: mask: uint8 (labels,),
    EXCLUDED or 0; constant: of positions, edge: of pixels, for each variant; through: intermediate sums for edge.
    int32: table: number of each variant's table, from variant -1 on, -1 if there is none; here: number of the table of
    each row of the batch; fitted: index of that table in `Fitted`; shown: first label that the mask leaves, and the one
    after the last.
    """

    n: Int16
    sums: Int16
    score: Int16
    top: Int16
    cost: Uint8
    mask: Uint8
    constant: Int16
    edge: Int16
    through: Int16
    table: Int32
    here: Int32
    fitted: Int32
    shown: Int32
    n_row: int
    score_row: int
    cost_row: int
    labels: int


def new_buffers(tables: LabelTables, labels: int) -> Buffers:
    """Buffers for this number of labels, each beginning at a cache line."""
    pixels, vectors = tables.pixels, tables.tap.shape[1]
    n_row = _whole(max(pixels, FAR_PX + vectors * LANES + LANES) + LANES)
    score_row = vectors * PHASES * LANES
    cost_row = _whole(max(labels, score_row) + 2 * 2 * LANES)
    return Buffers(
        n=aligned_zeros((BATCH, n_row), np.int16), sums=aligned_zeros((BATCH, n_row), np.int16),
        score=aligned_zeros((BATCH, score_row), np.int16), top=aligned_zeros((BATCH, LANES), np.int16),
        cost=aligned_zeros((BATCH, cost_row), np.uint8), mask=aligned_zeros((labels,), np.uint8),
        constant=aligned_zeros((VARIANTS, tables.constants), np.int16),
        edge=aligned_zeros((VARIANTS, pixels), np.int16), through=aligned_zeros((pixels + 2 * LANES,), np.int16),
        table=aligned_zeros((VARIANTS + 1,), np.int32), here=aligned_zeros((BATCH,), np.int32),
        fitted=aligned_zeros((BATCH,), np.int32), shown=aligned_zeros((2,), np.int32), n_row=n_row, score_row=score_row,
        cost_row=cost_row, labels=labels,
    )  # fmt: skip


def _whole(number: int) -> int:
    """`number` rounded up to a multiple of a cache line's bytes."""
    return -(-number // CACHE_LINE) * CACHE_LINE
