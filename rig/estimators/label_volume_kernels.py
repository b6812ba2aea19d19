"""Compiled label costs: every label of a row at once, sixteen to a vector, from counts and `label_tables`.

A column's rows go through each part of the work (`label_volume_rows`) sixteen together.
"""

from typing import Any, Final

import numba
import numpy as np
from numpy.typing import NDArray

from rig.aligned import CACHE_LINE
from rig.estimators.label_places import (
    PLACES,
    START,
    VARIANT,
    VARIANTS,
)
from rig.estimators.label_tables import NONES, LabelTables
from rig.estimators.label_volume_buffers import BATCH, At, Buffers, Ways, buffers_at
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
    address_of,
    load_float32,
    load_int16,
    prefetch,
    read_float32,
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
def fill_costs(
    counts: NDArray[np.unsignedinteger[Any]],
    n_frames: NDArray[np.int32],
    x0: NDArray[np.int32],
    place: NDArray[np.int16],
    tables: LabelTables,
    hot_start: NDArray[np.int32],
    hot_x: NDArray[np.int16],
    ways: Ways,
    first_row: int,
    last_row: int,
    out: NDArray[np.uint8],
) -> None:
    """Costs of rows first_row..last_row-1, see `label_volume.Costs.fill`.

    hot_x: hot pixels, those of row y from hot_start[y] to hot_start[y + 1].
    """
    pixels, vectors, labels = tables.edge.shape[1], tables.tap.shape[1], out.shape[2]
    _, size = buffers_at(0, pixels, vectors, labels)
    memory = np.zeros(size + CACHE_LINE, np.uint8)
    begin = address_of(memory)
    b, _ = buffers_at(begin + -begin % CACHE_LINE, pixels, vectors, labels)
    rows, columns, band_rows = out.shape[0], out.shape[1], ways.band_rows
    at = At(
        address_of(tables.edge), address_of(tables.edge_sum), pixels, address_of(tables.tap), tables.tap[:1].size,
        address_of(tables.constant), tables.constant[:1].size, address_of(tables.none), address_of(tables.span),
        address_of(hot_start), address_of(hot_x),
    )  # fmt: skip
    place_at, out_at, counts_at = address_of(place), address_of(out), address_of(counts)
    window, in_bytes = counts.shape[2], counts.itemsize == 1
    write_int32(b.table, 0, np.int32(-1))
    write_int32(b.shown, 0, np.int32(-1))
    for band in range(first_row // band_rows, -(-last_row // band_rows)):
        top, end = max(first_row, band * band_rows), min(last_row, (band + 1) * band_rows)
        for c in range(columns):
            exposures, halved = np.int64(n_frames[c]), 0
            while exposures >> halved > ways.most:
                halved += 1
            stored = np.int64(x0[c]), window, counts.size, window * rows
            shift = COUNT_BITS - ways.bits - halved
            per_nat = np.float32(ways.units * exposures / (1 << halved))
            for variant in range(VARIANTS):
                i = np.int64(tables.at[band, c, variant]) if exposures > 0 else np.int64(-1)
                write_int32(b.table, 1 + variant, np.int32(i))
                if i >= 0:
                    _fit_table(at, i, variant, ways.units, per_nat, b)
                if c + 1 < columns and tables.at[band, c + 1, variant] >= 0:
                    _fetch_table(at, np.int64(tables.at[band, c + 1, variant]))
            for y in range(top, end, BATCH):
                batch = min(BATCH, end - y)
                places = place_at + 2 * PLACES * (c * rows + y)
                for r in range(batch):
                    variant = np.int64(read_int16(places, PLACES * r + VARIANT))
                    write_int32(b.here, r, np.int32(read_int32(b.table, 1 + variant)))
                if in_bytes:
                    read_bytes(counts_at, (c * rows + y) * window, places, stored, ways.side, pixels, shift, b, batch)
                else:
                    _read_any(counts, c, y, places, stored[0], ways.side, pixels, shift, b, batch)
                mend_rows(at, places, y, per_nat, ways.side, b, batch)
                sum_edges(at, places, b, batch)
                score_rows(at, places, 2 * ways.reach + 1, b, batch)
                cost_rows(places, ways, b, batch)
                write_rows(places, ways, b, batch, out_at + (np.int64(y) * columns + c) * labels, columns * labels)


@numba.njit(forceinline=True)
def _fetch(begin, size):  # type: ignore[no-untyped-def]
    for line in range(0, size, CACHE_LINE):
        prefetch(begin + line)


@numba.njit(cache=True, nogil=True)
def _fetch_table(at, i):  # type: ignore[no-untyped-def]
    _fetch(at.tap + 2 * i * at.taps, 2 * at.taps)
    _fetch(at.constant + 4 * i * at.constants, 4 * at.constants)
    _fetch(at.edge_sum + 4 * i * at.pixels, 4 * at.pixels)
    _fetch(at.edge + 2 * i * at.pixels, 2 * at.pixels)


@numba.njit(forceinline=True)
def _fit_table(at, i, variant, units, per_nat, b):  # type: ignore[no-untyped-def]
    """Constants of table i for a number of exposures; per_nat: units times exposures."""
    source, to = at.constant + 4 * i * at.constants, b.constant + 2 * variant * at.constants
    for j in range(0, at.constants, LANES):
        store_int16(to, j, _rounded(load_float32(source, j) * per_nat))
    for j in range(NONES):
        prior = min(max(np.float32(units) * read_float32(at.none, NONES * i + j), -_LIMIT), _LIMIT)
        write_int16(b.none, NONES * variant + j, np.int16(prior))
    source, to = at.edge_sum + 4 * i * at.pixels, b.edge + 2 * variant * at.pixels
    # Differences of rounded sums: rounding each pixel would drift along the row.
    write_int16(b.through, LANES - 1, np.int16(0))
    for j in range(0, at.pixels, LANES):
        store_int16(b.through, LANES + j, _rounded(load_float32(source, j) * per_nat))
    for j in range(0, at.pixels, LANES):
        store_int16(to, j, load_int16(b.through, LANES + j) - load_int16(b.through, LANES - 1 + j))


@numba.njit(forceinline=True)
def _rounded(a):  # type: ignore[no-untyped-def]
    a = larger_float(smaller_float(a, _LIMIT), -_LIMIT)
    return to_int16(a + _TO_UNSIGNED) + np.int16(-32768)


@numba.njit(cache=True, nogil=True)
def _read_any(
    counts: NDArray[np.unsignedinteger[Any]], c: int, y: int, places: int, x0: int, side: int, pixels: int, shift: int,
    b: Buffers, batch: int,
) -> None:  # fmt: skip
    """The same as `read_bytes` of counts of any size."""
    for r in range(batch):
        start = np.int64(read_int16(places, PLACES * r + START)) - x0
        for p in range(pixels):
            x = start - side * p
            count = np.int64(counts[c, y + r, x]) if 0 <= x < counts.shape[2] else np.int64(0)
            write_int16(b.n + 2 * r * b.n_row, p, np.int16(count << shift if shift >= 0 else count >> -shift))
