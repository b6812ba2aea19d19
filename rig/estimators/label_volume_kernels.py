"""Compiled label costs: every label of a row at once, sixteen to a vector, from counts and `label_tables`.

A column's rows go through each part of the work sixteen together, so that what one waits for, the others fill.
Running sums carry the evidence of all pixels behind a label, taps that of the pixels around it; scores are saturating
16-bit numbers. The two phases of a pixel make the low and the high byte of the same 16 bits, which is their order.
"""

from typing import Any, Final, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rig.aligned import CACHE_LINE
from rig.estimators.label_places import (
    FAR_PX,
    LABEL,
    LABEL_END,
    MEND,
    ODD,
    PHASES,
    PLACES,
    START,
    VALID,
    VALID_END,
    VARIANT,
    VARIANTS,
)
from rig.estimators.label_tables import BEFORE, BEHIND, CHANGE, LIGHTS, NONES, LabelTables
from rig.lane_memory import (
    address_of,
    load_bytes,
    load_float32,
    load_int16,
    load_widened,
    prefetch,
    read_float32,
    read_int16,
    read_int32,
    store_bytes,
    store_int16,
    write_byte,
    write_int16,
    write_int32,
)
from rig.lane_reductions import largest_of_rows
from rig.lane_shuffles import last_everywhere, reversed_lanes, running_sum
from rig.lanes import (
    LANES,
    add_saturated,
    as_bytes,
    larger,
    larger_float,
    scaled,
    smaller,
    smaller_float,
    sub_saturated,
    to_int16,
    zero_bytes,
    zero_int16,
)

COST_LIMIT: Final = 160
"""Largest cost of a label that is not excluded."""
EXCLUDED: Final = 255
"""Cost of a label that cannot be: outside the picture, more than a pixel outside the row's search window, or none."""
BATCH: Final = LANES
BASE: Final = np.int16(-8000)
"""Score of 'everything is before the stripe': most of the range lies above it."""
HIGHEST: Final = 30000
SCORE_LIMIT: Final = np.float32(HIGHEST)
COUNT_BITS: Final = 15
"""Counts are kept as fractions of 2^15 of what they can be."""
_TO_UNSIGNED: Final = np.float32(32768.5)
_POSITION: Final = PHASES * LIGHTS * LANES


class Ways(NamedTuple):
    """How scores and costs are counted.

    units: of scores per nat, a power of two; bits: of the largest count; most: exposures up to which counts are not
    halved; down: power of two that scores are divided by to be costs; reach: taps on either
    side; side, stripes, none: as in `LabelGrid`; band_rows: rows that share tables.
    """

    units: float
    bits: int
    most: int
    down: int
    reach: int
    side: int
    stripes: int
    none: int
    band_rows: int


class _At(NamedTuple):
    """Addresses of what tables and places hold, see there, and the elements from table to table."""

    edge: int
    edge_sum: int
    pixels: int
    tap: int
    taps: int
    constant: int
    constants: int
    none: int
    span: int
    hot_start: int
    hot_x: int


class _Buffers(NamedTuple):
    """Addresses; of BATCH rows, int16 unless said, with the elements from row to row.

    n: counts of pixels from far to near; sums: score of a change at each pixel, the first one BASE; score: of pixel
    and phase; top, top_sum: largest ones of some lanes each, later of all; total: score of all pixels lying behind.
    cost: bytes of labels, from that of the first pixel's phase 0 on. Of all rows: mask: bytes, EXCLUDED or 0 for each
    label; constant: of positions, edge: of pixels, none: of 'no stripe', for each variant; through: room for sums. As
    int32, table: of variants from -1 on, -1 where there is none; here: of each row of the batch.
    """

    n: int
    n_row: int
    sums: int
    score: int
    score_row: int
    top: int
    top_sum: int
    total: int
    cost: int
    cost_row: int
    mask: int
    constant: int
    edge: int
    none: int
    through: int
    table: int
    here: int


@numba.njit(forceinline=True)
def _buffers_at(begin, pixels, vectors, labels):  # type: ignore[no-untyped-def]
    """The buffers from an address on, and where they end."""
    n_row = _whole(max(pixels, FAR_PX + vectors * LANES + LANES) + LANES)
    score_row = vectors * PHASES * LANES
    cost_row = _whole(max(labels, score_row) + 2 * 2 * LANES)
    sums = begin + 2 * BATCH * n_row
    score = sums + 2 * BATCH * n_row
    top = score + 2 * BATCH * score_row
    top_sum = top + 2 * BATCH * LANES
    total = top_sum + 2 * BATCH * LANES
    cost = total + 2 * LANES
    mask = cost + BATCH * cost_row
    constant = mask + _whole(labels)
    edge = constant + 2 * VARIANTS * vectors * _POSITION
    none = edge + 2 * VARIANTS * pixels
    through = none + 2 * VARIANTS * NONES
    table = through + 2 * (pixels + 2 * LANES)
    here = table + 4 * (VARIANTS + 1)
    buffers = _Buffers(begin, n_row, sums, score, score_row, top, top_sum, total, cost, cost_row, mask, constant, edge,
                       none, through, table, here)  # fmt: skip
    return buffers, here + 4 * BATCH


@numba.njit(inline="always")
def _whole(number):  # type: ignore[no-untyped-def]
    """The next multiple of a cache line's bytes."""
    return -(-number // CACHE_LINE) * CACHE_LINE


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
    _, size = _buffers_at(0, pixels, vectors, labels)
    memory = np.zeros(size + CACHE_LINE, np.uint8)
    begin = address_of(memory)
    b, _ = _buffers_at(begin + -begin % CACHE_LINE, pixels, vectors, labels)
    rows, columns, band_rows = out.shape[0], out.shape[1], ways.band_rows
    at = _At(
        address_of(tables.edge), address_of(tables.edge_sum), pixels, address_of(tables.tap), tables.tap[:1].size,
        address_of(tables.constant), tables.constant[:1].size, address_of(tables.none), address_of(tables.span),
        address_of(hot_start), address_of(hot_x),
    )  # fmt: skip
    place_at, out_at, counts_at = address_of(place), address_of(out), address_of(counts)
    window, in_bytes = counts.shape[2], counts.itemsize == 1
    shown = np.int64(-1)
    write_int32(b.table, 0, np.int32(-1))
    for band in range(first_row // band_rows, -(-last_row // band_rows)):
        top, end = max(first_row, band * band_rows), min(last_row, (band + 1) * band_rows)
        for c in range(columns):
            exposures, halved = np.int64(n_frames[c]), 0
            while exposures >> halved > ways.most:
                halved += 1
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
                    here, n = places + 2 * PLACES * r, b.n + 2 * r * b.n_row
                    i = np.int64(read_int32(b.table, 1 + np.int64(read_int16(here, VARIANT))))
                    write_int32(b.here, r, np.int32(i))
                    if i < 0:
                        continue
                    start = np.int64(read_int16(here, START)) - x0[c]
                    begin = (c * rows + y + r) * window + start
                    low = begin - pixels if ways.side > 0 else begin
                    if in_bytes and shift >= 0 and low >= 0 and low + pixels + LANES <= counts.size:
                        # The next column's counts will be wanted when this one's last row has been read.
                        _fetch(counts_at + low + window * rows, pixels + LANES)
                        _read_bytes(counts_at + begin, ways.side, pixels, np.int16(1 << shift), n)
                    else:
                        _read_any(counts, c, y + r, start, ways.side, pixels, shift, n)
                    if read_int16(here, MEND):
                        _mend_row(at, i, here, y + r, per_nat, ways.side, n)
                for r in range(batch):
                    if read_int32(b.here, r) >= 0:
                        _sum_edges(at, places, b, r)
                for r in range(batch):
                    if read_int32(b.here, r) >= 0:
                        _score_row(at, places, vectors, ways, b, r)
                store_int16(b.top, 0, largest_of_rows(b.top))
                store_int16(b.top_sum, 0, largest_of_rows(b.top_sum))
                for r in range(batch):
                    if read_int32(b.here, r) >= 0:
                        _cost_row(places, vectors, ways, b, r)
                for r in range(batch):
                    here = places + 2 * PLACES * r
                    odd = np.int64(read_int16(here, ODD))
                    low, high = np.int64(read_int16(here, LABEL)), np.int64(read_int16(here, LABEL_END))
                    if read_int32(b.here, r) < 0:
                        odd, low, high = 0, 0, ways.stripes
                        _blank(b.cost + r * b.cost_row, labels)
                    if shown != low << 16 | high:
                        shown = low << 16 | high
                        _mask(low, high, ways, labels, b.mask)
                    to = out_at + (np.int64(y + r) * columns + c) * labels
                    for label in range(0, labels, 2 * LANES):
                        cost = load_bytes(b.cost, r * b.cost_row + odd + label)
                        store_bytes(to, label, cost | load_bytes(b.mask, label))


@numba.njit(forceinline=True)
def _fetch(begin, size):  # type: ignore[no-untyped-def]
    for line in range(0, size, CACHE_LINE):
        prefetch(begin + line)


@numba.njit(forceinline=True)
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
        prior = min(max(np.float32(units) * read_float32(at.none, NONES * i + j), -SCORE_LIMIT), SCORE_LIMIT)
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
    a = larger_float(smaller_float(a, SCORE_LIMIT), -SCORE_LIMIT)
    return to_int16(a + _TO_UNSIGNED) + np.int16(-32768)


@numba.njit(forceinline=True)
def _read_bytes(begin, side, pixels, times, n):  # type: ignore[no-untyped-def]
    """Counts from far to near; begin: address of pixel 0. What lies outside the stored pixels is of any value."""
    for p in range(0, pixels, LANES):
        if side > 0:
            store_int16(n, p, reversed_lanes(load_widened(begin - p, 1 - LANES)) * times)
        else:
            store_int16(n, p, load_widened(begin, p) * times)


@numba.njit(cache=True, nogil=True)
def _read_any(
    counts: NDArray[np.unsignedinteger[Any]], c: int, y: int, start: int, side: int, pixels: int, shift: int, n: int
) -> None:
    """The same of counts of any size, at the ends of the volume too."""
    for p in range(pixels):
        x = start - side * p
        count = np.int64(counts[c, y, x]) if 0 <= x < counts.shape[2] else np.int64(0)
        write_int16(n, p, np.int16(count << shift if shift >= 0 else count >> -shift))


@numba.njit(forceinline=True)
def _mend_row(at, i, place, y, per_nat, side, n):  # type: ignore[no-untyped-def]
    """Give pixels that the table weighs, but that this row lacks, or that are hot, a count that says nothing."""
    begin, end = np.int64(read_int16(at.span, 2 * i)), np.int64(read_int16(at.span, 2 * i + 1))
    for p in range(begin, min(np.int64(read_int16(place, VALID)), end)):
        write_int16(n, p, _neutral(at, i, p, per_nat))
    for p in range(max(np.int64(read_int16(place, VALID_END)), begin), end):
        write_int16(n, p, _neutral(at, i, p, per_nat))
    start = np.int64(read_int16(place, START))
    for h in range(read_int32(at.hot_start, y), read_int32(at.hot_start, y + 1)):
        p = side * (start - np.int64(read_int16(at.hot_x, h)))
        if begin <= p < end:
            write_int16(n, p, _neutral(at, i, p, per_nat))


@numba.njit(forceinline=True)
def _neutral(at, i, p, per_nat):  # type: ignore[no-untyped-def]
    """The count at which a pixel is as likely before the stripe as behind it."""
    weight = np.float32(read_int16(at.edge, i * at.pixels + p))
    constant = read_float32(at.edge_sum, i * at.pixels + p)
    if p > 0:
        constant -= read_float32(at.edge_sum, i * at.pixels + p - 1)
    if weight == 0.0:
        return np.int16(0)
    count = -constant * per_nat / weight * np.float32(1 << COUNT_BITS)
    return np.int16(min(max(count, np.float32(0.0)), SCORE_LIMIT))


@numba.njit(forceinline=True)
def _sum_edges(at, places, b, r):  # type: ignore[no-untyped-def]
    """Fill sums, total and top_sum of row r."""
    n, sums, pixels = b.n + 2 * r * b.n_row, b.sums + 2 * r * b.n_row, at.pixels
    variant = np.int64(read_int16(places, PLACES * r + VARIANT))
    edge, constant = at.edge + 2 * pixels * np.int64(read_int32(b.here, r)), b.edge + 2 * pixels * variant
    carry = zero_int16() + BASE
    top = carry
    write_int16(sums, 0, BASE)
    for p in range(0, pixels, LANES):
        rise = running_sum(add_saturated(scaled(load_int16(n, p), load_int16(edge, p)), load_int16(constant, p)))
        through = add_saturated(rise, carry)
        store_int16(sums, p + 1, through)
        top = larger(top, through)
        carry = add_saturated(carry, last_everywhere(rise))
    store_int16(b.top_sum, r * LANES, top)
    write_int16(b.total, r, read_int16(sums, pixels))


@numba.njit(forceinline=True)
def _score_row(at, places, vectors, ways, b, r):  # type: ignore[no-untyped-def]
    """Fill score and top of row r."""
    taps = 2 * ways.reach + 1
    n, sums, score = b.n + 2 * r * b.n_row, b.sums + 2 * r * b.n_row, b.score + 2 * r * b.score_row
    variant = np.int64(read_int16(places, PLACES * r + VARIANT))
    tap, constant = at.tap + 2 * at.taps * np.int64(read_int32(b.here, r)), b.constant + 2 * variant * at.constants
    best = zero_int16() + np.int16(-32768)
    for v in range(vectors):
        to = v * _POSITION
        far_dim, far_bright = load_int16(constant, to), load_int16(constant, to + LANES)
        near_dim, near_bright = load_int16(constant, to + 2 * LANES), load_int16(constant, to + 3 * LANES)
        for d in range(taps):
            counts = load_int16(n, FAR_PX + v * LANES - ways.reach + d)
            to = (v * taps + d) * _POSITION
            far_dim = far_dim + scaled(counts, load_int16(tap, to))
            far_bright = far_bright + scaled(counts, load_int16(tap, to + LANES))
            near_dim = near_dim + scaled(counts, load_int16(tap, to + 2 * LANES))
            near_bright = near_bright + scaled(counts, load_int16(tap, to + 3 * LANES))
        level = load_int16(sums, FAR_PX + v * LANES)
        far = add_saturated(level, larger(far_dim, far_bright))
        near = add_saturated(level, larger(near_dim, near_bright))
        store_int16(score, 2 * v * LANES, far)
        store_int16(score, (2 * v + 1) * LANES, near)
        best = larger(best, larger(far, near))
    store_int16(b.top, r * LANES, best)


@numba.njit(forceinline=True)
def _cost_row(places, vectors, ways, b, r):  # type: ignore[no-untyped-def]
    """Fill cost of row r, that of 'none' included."""
    prior = b.none + 2 * NONES * np.int64(read_int16(places, PLACES * r + VARIANT))
    behind = np.int64(read_int16(b.total, r)) + np.int64(read_int16(prior, BEHIND))
    before = np.int64(BASE) + np.int64(read_int16(prior, BEFORE))
    change = np.int64(read_int16(b.top_sum, r)) + np.int64(read_int16(prior, CHANGE))
    none, half = min(max(behind, before, change), HIGHEST), (1 << ways.down) >> 1
    best = max(np.int64(read_int16(b.top, r)), none)
    level = add_saturated(zero_int16() + np.int16(best), np.int16(half))
    score, cost = b.score + 2 * r * b.score_row, b.cost + r * b.cost_row
    for v in range(vectors):
        far = smaller(sub_saturated(level, load_int16(score, 2 * v * LANES)) >> ways.down, np.int16(COST_LIMIT))
        near = smaller(sub_saturated(level, load_int16(score, (2 * v + 1) * LANES)) >> ways.down, np.int16(COST_LIMIT))
        store_bytes(cost, 2 * v * LANES, as_bytes(far | near << 8))
    lost = min(best - none + half >> ways.down, COST_LIMIT)
    write_byte(cost, np.int64(read_int16(places, PLACES * r + ODD)) + ways.none, np.uint8(lost))


@numba.njit(forceinline=True)
def _blank(cost, labels):  # type: ignore[no-untyped-def]
    for label in range(0, labels, 2 * LANES):
        store_bytes(cost, label, zero_bytes())


@numba.njit(forceinline=True)
def _mask(low, high, ways, labels, mask):  # type: ignore[no-untyped-def]
    """Bytes that exclude all labels but low..high-1 and 'none'."""
    for label in range(labels):
        inside = low <= label < high or label == ways.none
        write_byte(mask, label, np.uint8(0) if inside else np.uint8(EXCLUDED))
