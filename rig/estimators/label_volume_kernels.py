"""Compiled label costs: every label of a row at once, sixteen to a vector, from counts and `label_tables`.

A column's rows go through each part of the work (`label_volume_rows`) sixteen together. A row of 128 labels and five
taps takes 250 cycles on one thread of a busy core (Zen 3), a fifth of them to wait for memory, 765 instructions: the
loop over taps unrolled, which took 105 off. Asking for costs and places ahead: 20 cycles less; for tables and counts
earlier, or two rows of one table at once: nothing. All parts in one function took 1.6 times as long.
"""

from typing import Any, Final

import numba
import numpy as np
from numpy.typing import NDArray

from rig.aligned import CACHE_LINE
from rig.estimators.halo_rows import fit_halo, halo_at, halo_rows
from rig.estimators.halo_tables import HaloTables
from rig.estimators.label_places import (
    FAR_PX,
    MEND,
    PLACES,
    START,
    VARIANT,
    VARIANTS,
)
from rig.estimators.label_tables import LabelTables
from rig.estimators.label_volume_buffers import BATCH, At, Buffers, Fitted, Ways, buffers_at, signed_address
from rig.estimators.label_volume_rows import (
    COUNT_BITS,
    HIGHEST,
    cost_rows,
    mend_rows,
    read_bytes,
    score_rows,
    sum_edges,
    write_rows,
)
from rig.lane_memory import (
    load_float32,
    load_int16,
    prefetch,
    prefetch_to_write,
    read_int16,
    read_int32,
    store_int16,
    write_int16,
    write_int32,
)
from rig.lanes import (
    LANES,
    larger_float,
    smaller_float,
    to_int16,
)

_LIMIT: Final = np.float32(HIGHEST)
_TO_UNSIGNED: Final = np.float32(32768.5)


@numba.njit(cache=True, nogil=True)
def room_for(tables: LabelTables, halo: HaloTables, labels: int) -> NDArray[np.uint8]:
    """Memory that `fill_costs` and `fit_tables` work in."""
    _, size = buffers_at(0, tables.edge.shape[1], tables.tap.shape[1], labels)
    if halo.weight.size > 0:
        _, size = halo_at(halo, size, tables.constant[:1].size)
    return np.zeros(size + CACHE_LINE, np.uint8)


@numba.njit(cache=True, nogil=True)
def fill_costs(
    counts: NDArray[np.unsignedinteger[Any]],
    n_frames: NDArray[np.int32],
    x0: NDArray[np.int32],
    place: NDArray[np.int16],
    tables: LabelTables,
    halo: HaloTables,
    hot_start: NDArray[np.int32],
    hot_x: NDArray[np.int16],
    ways: Ways,
    first_row: int,
    last_row: int,
    memory: NDArray[np.uint8],
    out: NDArray[np.uint8],
) -> None:
    """Costs of rows first_row..last_row-1, see `label_volume.Costs.fill`.

    hot_x: hot pixels, those of row y from hot_start[y] to hot_start[y + 1]. memory: of `room_for`, kept by the caller,
    since what is known by its address alone would be freed in here.
    """
    pixels, vectors, labels = tables.edge.shape[1], tables.tap.shape[1], out.shape[2]
    begin = signed_address(memory)
    b, end_of_buffers = buffers_at(begin + -begin % CACHE_LINE, pixels, vectors, labels)
    around, _ = halo_at(halo, end_of_buffers, tables.constant[:1].size)
    rows, columns, band_rows = out.shape[0], out.shape[1], ways.band_rows
    at = _at(tables, hot_start, hot_x)
    usually = _usually(tables)
    room = Fitted(b.constant, b.edge)
    place_at, out_at, counts_at = signed_address(place), signed_address(out), signed_address(counts)
    window, in_bytes = counts.shape[2], counts.itemsize == 1
    # Of no label are pixels beyond the last vector of any table, and the taps of that; halos weigh all.
    read = pixels
    if halo.weight.size == 0 and tables.used.size > 0:
        read = min(pixels, -(-(FAR_PX + LANES * int(tables.used.max()) + ways.reach) // LANES) * LANES)
    write_int32(b.table, 0, np.int32(-1))
    write_int32(b.shown, 0, np.int32(-1))
    for band in range(first_row // band_rows, -(-last_row // band_rows)):
        top, end = max(first_row, band * band_rows), min(last_row, (band + 1) * band_rows)
        for c in range(columns):
            exposures = int(n_frames[c])
            stored = int(x0[c]), window, counts.size, window * rows
            times = _times(exposures, ways)
            per_nat = ways.units * exposures * times / 2.0 ** (COUNT_BITS - ways.bits)
            usual = exposures == ways.exposures
            fitted = usually if usual else room
            for variant in range(VARIANTS):
                i = int(tables.at[band, c, variant]) if exposures > 0 else -1
                write_int32(b.table, 1 + variant, np.int32(i))
                if i >= 0 and not usual:
                    _fit_table(at, i, variant, per_nat, fitted, b.through)
                if c + 1 < columns and tables.at[band, c + 1, variant] >= 0:
                    _fetch_table(at, int(tables.at[band, c + 1, variant]), usually)
            column = band * columns + c
            if halo.weight.size > 0:
                fit_halo(around, column, per_nat)
            for y in range(top, end, BATCH):
                batch = min(BATCH, end - y)
                to = out_at + (y * columns + c) * labels
                places = place_at + 2 * PLACES * (c * rows + y)
                # Costs of one row after the other, and places of one column after the other, are not foreseen.
                for r in range(batch):
                    for line in range(0, labels, CACHE_LINE):
                        prefetch_to_write(to + r * columns * labels + line)
                _fetch(places + 2 * PLACES * rows, 2 * PLACES * batch)
                mend = 0
                for r in range(batch):
                    mend |= read_int16(places, PLACES * r + MEND)
                    variant = read_int16(places, PLACES * r + VARIANT)
                    i = read_int32(b.table, 1 + variant)
                    write_int32(b.here, r, i)
                    write_int32(b.fitted, r, i if usual else np.int32(variant))
                if in_bytes and times >= 1.0:
                    at_row = (c * rows + y) * window
                    read_bytes(counts_at, at_row, places, stored, ways.side, read, int(times), b, batch)
                else:
                    _read_any(counts, c, y, places, stored[0], ways.side, read, times, b, batch)
                if mend:
                    mend_rows(at, places, y, per_nat, ways.side, b, batch)
                sum_edges(at, fitted, b, batch)
                if halo.weight.size > 0:
                    halo_rows(around, column, at, fitted, b, batch)
                    score_rows(at, around.constant, around.which, 2 * ways.reach + 1, b, batch)
                else:
                    score_rows(at, fitted.constant, b.fitted, 2 * ways.reach + 1, b, batch)
                cost_rows(at, ways, b, batch)
                write_rows(places, ways, b, batch, to, columns * labels)


@numba.njit(cache=True, nogil=True)
def _times(exposures: int, ways: Ways) -> float:
    """What counts of a column are multiplied with, a whole number where it is not below 1; products fit 16 bits.

    A nat of more exposures is worth fewer units, as it would be in a map where all columns had so many: else columns
    with few would count for less beside others with many, and the penalties between neighbours for more.
    """
    full = 2.0 ** (COUNT_BITS - ways.bits)
    worth = (ways.sharp + ways.exposures) / (ways.sharp + exposures)
    times = full * min(worth, ways.most / max(exposures, 1))
    # Rounded down: a product must not exceed that of `most` exposures.
    return np.floor(times) if times >= 1.0 else times


@numba.njit(forceinline=True)
def _fetch(begin, size):  # type: ignore[no-untyped-def]
    for line in range(0, size, CACHE_LINE):
        prefetch(begin + line)


@numba.njit(cache=True, nogil=True)
def _fetch_table(at: At, i: int, fitted: Fitted) -> None:
    _fetch(at.tap + 2 * i * at.taps, 2 * at.taps)
    _fetch(at.edge + 2 * i * at.pixels, 2 * at.pixels)
    _fetch(fitted.constant + 2 * i * at.constants, 2 * at.constants)
    _fetch(fitted.edge + 2 * i * at.pixels, 2 * at.pixels)


@numba.njit(cache=True, nogil=True)
def fit_tables(tables: LabelTables, ways: Ways, first: int, last: int, memory: NDArray[np.uint8]) -> None:
    """Fill the fitted parts of tables first..last-1: what they say at the usual number of exposures."""
    at = _at(tables, tables.span, tables.span)
    fitted = _usually(tables)
    for i in range(first, last):
        _fit_table(at, i, i, ways.units * ways.exposures, fitted, signed_address(memory))


@numba.njit(forceinline=True)
def _usually(tables):  # type: ignore[no-untyped-def]
    """What the tables say at the usual number of exposures."""
    return Fitted(signed_address(tables.fitted_constant), signed_address(tables.fitted_edge))


@numba.njit(cache=True, nogil=True)
def _fit_table(at: At, i: int, j: int, per_nat: float, to: Fitted, through: int) -> None:
    """Constants of table i for a number of exposures, as number j; per_nat: units times exposures."""
    source, constant = at.constant + 4 * i * at.constants, to.constant + 2 * j * at.constants
    for k in range(0, at.constants, LANES):
        store_int16(constant, k, _rounded(load_float32(source, k) * np.float32(per_nat)))
    source, edge = at.edge_sum + 4 * i * at.pixels, to.edge + 2 * j * at.pixels
    # Differences of rounded sums: rounding each pixel would drift along the row.
    write_int16(through, LANES - 1, np.int16(0))
    for k in range(0, at.pixels, LANES):
        store_int16(through, LANES + k, _rounded(load_float32(source, k) * np.float32(per_nat)))
    for k in range(0, at.pixels, LANES):
        store_int16(edge, k, load_int16(through, LANES + k) - load_int16(through, LANES - 1 + k))


@numba.njit(forceinline=True)
def _at(tables, hot_start, hot_x):  # type: ignore[no-untyped-def]
    return At(
        signed_address(tables.edge), signed_address(tables.edge_sum), tables.edge.shape[1], signed_address(tables.tap),
        tables.tap[:1].size, signed_address(tables.constant), tables.constant[:1].size,
        signed_address(tables.span), signed_address(tables.used), signed_address(hot_start), signed_address(hot_x),
    )  # fmt: skip


@numba.njit(forceinline=True)
def _rounded(a):  # type: ignore[no-untyped-def]
    a = larger_float(smaller_float(a, _LIMIT), -_LIMIT)
    return to_int16(a + _TO_UNSIGNED) + np.int16(-32768)


@numba.njit(cache=True, nogil=True)
def _read_any(
    counts: NDArray[np.unsignedinteger[Any]], c: int, y: int, places: int, x0: int, side: int, pixels: int,
    times: float, b: Buffers, batch: int,
) -> None:  # fmt: skip
    """The same as `read_bytes` of counts of any size."""
    for r in range(batch):
        start = read_int16(places, PLACES * r + START) - x0
        for p in range(pixels):
            x = start - side * p
            count = np.int64(counts[c, y + r, x]) if 0 <= x < counts.shape[2] else np.int64(0)
            write_int16(b.n + 2 * r * b.n_row, p, np.int16(count * times))
