"""Label costs of a batch of rows, compiled: a fast form of `rig.estimate.row.likelihood`, tested against it.

Counts are read, edges summed, positions scored and costs written in saturating int16, LANES pixels to a vector.
Relative to 'everything is before the stripe', with weights and constants of `rig.estimate.joint.labels.tables` in
units,

    sums(p)  = sum over pixels p' < p of (n edge + edge's constant)      all farther pixels lie behind the stripe
    score(x) = sums + max over brightnesses of (constant + sum over taps n tap)
    cost(x)  = (best score of the row - score(x)) / 2^down               uint8, at most COST_LIMIT

Counts n are int16 fractions of their maximum (COUNT_BITS). The costs of a pixel's two labels (phases 0 and 1) are the
low and the high byte of the same 16 bits. BATCH rows of a column go through each part together. Parts are separate
functions and not inlined, because in a single function the compiler keeps a register for every address. The loop over
taps (the pixels around a label) is unrolled for the usual width of the line.
"""

from typing import Final, NamedTuple

import numba
import numpy as np

from rig.count.volume import Counts
from rig.estimate.joint.labels.grid import (
    BAND_ROWS,
    FAR_PX,
    LABEL,
    LABEL_END,
    MEND,
    ODD,
    PLACES,
    START,
    VALID,
    VALID_END,
    VARIANT,
    VARIANTS,
)
from rig.estimate.joint.labels.halo_rows import (
    HIGHEST,
    HaloRoom,
    HaloTables,
    fit_halo,
    halo_rows,
    new_halo_room,
    rounded,
)
from rig.estimate.joint.labels.tables import BATCH, POSITION, SUMS_FROM, Buffers, Fitted, LabelTables, Ways, new_buffers
from rig.simd import Int16, Int32, Uint8
from rig.simd.memory import (
    CACHE_LINE,
    address_of,
    load_bytes,
    load_float32,
    load_int16,
    load_widened,
    prefetch,
    prefetch_to_write,
    read_byte,
    read_float32,
    read_int16,
    read_int32,
    store_bytes,
    store_int16,
    write_byte,
    write_int16,
    write_int32,
)
from rig.simd.shuffles import largest_of_rows, last_everywhere, reversed_lanes, running_sum
from rig.simd.vectors import (
    LANES,
    add_saturated,
    as_bytes,
    larger,
    scaled,
    smaller,
    sub_saturated,
    zero_bytes,
    zero_int16,
)

COST_LIMIT: Final = 160
"""Largest cost of a label that is not excluded."""
EXCLUDED: Final = 255
"""Cost of an impossible label: outside the stored pixels, or more than a pixel outside the row's search window."""
BASE: Final = -8000
"""Score of 'everything is before the stripe': low, since most scores lie above it."""
_USUAL_TAPS: Final = 5
"""Number of pixels around a position for a line of usual width."""
COUNT_BITS: Final = 15
"""Counts are stored as fractions of the largest possible count, in units of 2^-COUNT_BITS."""


@numba.njit(cache=True, nogil=True)
def read_bytes(
    counts: int, begin: int, places: int, stored: tuple[int, int, int, int], side: int, pixels: int, times: int,
    b: Buffers, batch: int,
) -> None:  # fmt: skip
    """Fill n of `batch` rows from counts that are bytes, from far to near. Pixels that were not stored get arbitrary
    values.

    counts: address of the first count; begin: index of the first row's first count. stored: x of a row's first stored
    pixel, stored pixels of a row, number of all counts, counts of a column. times: factor on counts.
    """
    x0, window, size, column = stored
    factor = np.int16(times)
    for r in range(batch):
        if read_int32(b.here, r) < 0:
            continue
        n, start = b.n + 2 * r * b.n_row, read_int16(places, PLACES * r + START) - x0
        first = begin + r * window + start
        low = first - pixels if side > 0 else first
        if low < 0 or low + pixels + LANES > size:
            for p in range(pixels):
                x = start - side * p
                count = np.int64(read_byte(counts + begin + r * window, x)) if 0 <= x < window else np.int64(0)
                write_int16(n, p, np.int16(count * times))
            continue
        # Prefetch this row's counts in the next column, no more than a window's: the next row prefetches the rest.
        for line in range(0, min(pixels + LANES, window), CACHE_LINE):
            prefetch(counts + low + column + line)
        if side > 0:
            for p in range(0, pixels, LANES):
                store_int16(n, p, reversed_lanes(load_widened(counts + first - p, 1 - LANES)) * factor)
        else:
            for p in range(0, pixels, LANES):
                store_int16(n, p, load_widened(counts + first, p) * factor)


@numba.njit(cache=True, nogil=True)
def mend_rows(at: LabelTables, places: int, y: int, per_nat: float, side: int, b: Buffers, batch: int) -> None:
    """Give a count without information to pixels with a weight in the table that are hot or missing in the row.

    y: index of the first row; per_nat: units that a nat per exposure is worth.
    """
    for r in range(batch):
        i, place = read_int32(b.here, r), places + 2 * PLACES * r
        if i < 0 or not read_int16(place, MEND):
            continue
        n, start = b.n + 2 * r * b.n_row, read_int16(place, START)
        begin, end = read_int16(at.span, 2 * i), read_int16(at.span, 2 * i + 1)
        for p in range(begin, min(read_int16(place, VALID), end)):
            write_int16(n, p, _neutral(at, i, p, per_nat))
        for p in range(max(read_int16(place, VALID_END), begin), end):
            write_int16(n, p, _neutral(at, i, p, per_nat))
        for h in range(read_int32(at.hot_start, y + r), read_int32(at.hot_start, y + r + 1)):
            p = side * (start - read_int16(at.hot_x, h))
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
    count = -constant * np.float32(per_nat) / weight * np.float32(1 << COUNT_BITS)
    return np.int16(min(max(count, np.float32(0.0)), np.float32(HIGHEST)))


@numba.njit(cache=True, nogil=True)
def sum_edges(at: LabelTables, fitted: Fitted, b: Buffers, batch: int) -> None:
    """Fill sums: at each pixel, the score if all farther pixels lie behind the stripe; as far as there are labels."""
    pixels = at.pixels
    for r in range(batch):
        i = read_int32(b.here, r)
        if i < 0:
            continue
        n, sums = b.n + 2 * r * b.n_row, b.sums + 2 * r * b.n_row
        edge, constant = at.edge + 2 * pixels * i, fitted.edge + 2 * pixels * read_int32(b.fitted, r)
        carry = zero_int16() + np.int16(BASE)
        write_int16(sums, SUMS_FROM, np.int16(BASE))
        for p in range(0, min(pixels, FAR_PX + LANES * read_int16(at.used, i)), LANES):
            rise = running_sum(add_saturated(scaled(load_int16(n, p), load_int16(edge, p)), load_int16(constant, p)))
            store_int16(sums, p + LANES, add_saturated(rise, carry))
            carry = add_saturated(carry, last_everywhere(rise))


@numba.njit(forceinline=True)
def _likelier_lights(n, tap, constant, taps):  # type: ignore[no-untyped-def]
    """Scores of a vector of pixels, of the far and the near phase, for the likelier one of a pair of brightnesses."""
    far_dim, far_bright = load_int16(constant, 0), load_int16(constant, LANES)
    near_dim, near_bright = load_int16(constant, 2 * LANES), load_int16(constant, 3 * LANES)
    for d in range(taps):
        counts, of_tap = load_int16(n, d), d * POSITION
        far_dim = far_dim + scaled(counts, load_int16(tap, of_tap))
        far_bright = far_bright + scaled(counts, load_int16(tap, of_tap + LANES))
        near_dim = near_dim + scaled(counts, load_int16(tap, of_tap + 2 * LANES))
        near_bright = near_bright + scaled(counts, load_int16(tap, of_tap + 3 * LANES))
    return larger(far_dim, far_bright), larger(near_dim, near_bright)


@numba.njit(forceinline=True)
def _score_row(sums, n, tap, constant, score, vectors, taps, pairs):  # type: ignore[no-untyped-def]
    """Write the scores of a row; returns the largest one of each lane."""
    best = zero_int16() + np.int16(-32768)
    for _ in range(vectors):
        far, near = _likelier_lights(n, tap, constant, taps)
        for pair in range(1, pairs):
            others = _likelier_lights(n, tap + 2 * POSITION * taps * pair, constant + 2 * POSITION * pair, taps)
            far, near = larger(far, others[0]), larger(near, others[1])
        level = load_int16(sums, 0)
        far, near = add_saturated(level, far), add_saturated(level, near)
        store_int16(score, 0, far)
        store_int16(score, LANES, near)
        best = larger(best, larger(far, near))
        n, sums, score, constant = n + 2 * LANES, sums + 2 * LANES, score + 4 * LANES, constant + 2 * POSITION * pairs
        tap += 2 * POSITION * taps * pairs
    return best


@numba.njit(cache=True, nogil=True)
def score_rows(at: LabelTables, constants: int, which: int, taps: int, b: Buffers, batch: int) -> None:
    """Fill `b.score`, a score per position, and `b.top`, the largest score, of the first `batch` rows in `b`.

    constants, which: addresses of the positions' constants, and of each row's index among them. taps: number of pixels
    around a position.
    """
    for r in range(batch):
        i = read_int32(b.here, r)
        if i < 0:
            continue
        sums, score = b.sums + 2 * (r * b.n_row + SUMS_FROM + FAR_PX), b.score + 2 * r * b.score_row
        n, tap = b.n + 2 * (r * b.n_row + FAR_PX - taps // 2), at.tap + 2 * at.taps * i
        constant = constants + 2 * at.constants * read_int32(which, r)
        vectors = read_int16(at.used, i)
        # With a usual width of the line the loop over its taps is unrolled.
        if taps == _USUAL_TAPS and at.pairs == 1:
            best = _score_row(sums, n, tap, constant, score, vectors, _USUAL_TAPS, 1)
        else:
            best = _score_row(sums, n, tap, constant, score, vectors, taps, at.pairs)
        store_int16(b.top, r * LANES, best)
    store_int16(b.top, 0, largest_of_rows(b.top))


@numba.njit(cache=True, nogil=True)
def cost_rows(at: LabelTables, ways: Ways, b: Buffers, batch: int) -> None:
    """Fill cost from scores, 0 for rows without a table."""
    half = (1 << ways.down) >> 1
    for r in range(batch):
        cost, score = b.cost + r * b.cost_row, b.score + 2 * r * b.score_row
        i = read_int32(b.here, r)
        if i < 0:
            for label in range(0, b.labels, 2 * LANES):
                store_bytes(cost, label, zero_bytes())
            continue
        level = add_saturated(zero_int16() + read_int16(b.top, r), np.int16(half))
        for v in range(read_int16(at.used, i)):
            far = smaller(sub_saturated(level, load_int16(score, 2 * v * LANES)) >> ways.down, np.int16(COST_LIMIT))
            near = sub_saturated(level, load_int16(score, (2 * v + 1) * LANES)) >> ways.down
            store_bytes(cost, 2 * v * LANES, as_bytes(far | smaller(near, np.int16(COST_LIMIT)) << 8))


@numba.njit(cache=True, nogil=True)
def write_rows(places: int, ways: Ways, b: Buffers, batch: int, out: int, row_bytes: int) -> None:
    """Write the costs of labels, EXCLUDED for impossible ones, to address `out`, `row_bytes` from row to row."""
    for r in range(batch):
        here, cost, to = places + 2 * PLACES * r, b.cost + r * b.cost_row, out + r * row_bytes
        low, high = read_int16(here, LABEL), read_int16(here, LABEL_END)
        if read_int32(b.here, r) < 0:
            low, high = 0, ways.stripes
        else:
            cost += read_int16(here, ODD)
        if read_int32(b.shown, 0) != low or read_int32(b.shown, 1) != high:
            write_int32(b.shown, 0, np.int32(low))
            write_int32(b.shown, 1, np.int32(high))
            for label in range(b.labels):
                write_byte(b.mask, label, np.uint8(0) if low <= label < high else np.uint8(EXCLUDED))
        for label in range(0, b.labels, 2 * LANES):
            store_bytes(to, label, load_bytes(cost, label) | load_bytes(b.mask, label))


class CostRoom(NamedTuple):
    """Tables and buffers of `fill_costs` and `fit_tables`, which take `pointers` to them.

    read: number of pixels of a row that are read. Without a halo, pixels beyond the last label of all tables and its
    taps do not matter.
    """

    at: LabelTables
    halo: HaloRoom
    buffers: Buffers
    read: int


def room_for(tables: LabelTables, halo: HaloTables, labels: int) -> CostRoom:
    """The tables with the working memory of one thread."""
    room, read = new_halo_room(halo, tables.constants), tables.pixels
    if room.blocks == 0 and tables.used.size > 0:
        reach = tables.tap.shape[3] // 2
        read = min(read, -(-(FAR_PX + LANES * int(tables.used.max()) + reach) // LANES) * LANES)
    return CostRoom(tables, room, new_buffers(tables, labels), read)


@numba.njit(cache=True, nogil=True)
def fill_costs(
    counts: Counts, n_frames: Int32, x0: Int32, place: Int16, numbers: Int32, room: CostRoom, ways: Ways,
    first_row: int, last_row: int, out: Uint8,
) -> None:  # fmt: skip
    """Fill the costs of rows first_row..last_row-1, see `Costs.fill` in `rig.estimate.joint.labels.costs`.

    numbers: `at` of the tables. room: pointers to the tables and a thread's buffers.
    """
    at, around, b, labels = room.at, room.halo, room.buffers, out.shape[2]
    rows, columns = out.shape[0], out.shape[1]
    usually, unusually = Fitted(at.fitted_constant, at.fitted_edge), Fitted(b.constant, b.edge)
    place_at, out_at, counts_at = address_of(place), address_of(out), address_of(counts)
    window, in_bytes = counts.shape[2], counts.itemsize == 1
    write_int32(b.table, 0, np.int32(-1))
    write_int32(b.shown, 0, np.int32(-1))
    for band in range(first_row // BAND_ROWS, -(-last_row // BAND_ROWS)):
        top, end = max(first_row, band * BAND_ROWS), min(last_row, (band + 1) * BAND_ROWS)
        for c in range(columns):
            exposures = int(n_frames[c])
            stored = int(x0[c]), window, counts.size, window * rows
            times = _times(exposures, ways)
            per_nat = ways.units * exposures * times / 2.0 ** (COUNT_BITS - ways.bits)
            usual = exposures == ways.exposures
            fitted = usually if usual else unusually
            for variant in range(VARIANTS):
                i = int(numbers[band, c, variant]) if exposures > 0 else -1
                write_int32(b.table, 1 + variant, np.int32(i))
                if i >= 0 and not usual:
                    _fit_table(at, i, variant, per_nat, fitted, b.through)
                if c + 1 < columns and numbers[band, c + 1, variant] >= 0:
                    _fetch_table(at, int(numbers[band, c + 1, variant]), usually)
            column = band * columns + c
            if around.blocks > 0:
                fit_halo(around, column, per_nat)
            for y in range(top, end, BATCH):
                batch = min(BATCH, end - y)
                to = out_at + (y * columns + c) * labels
                places = place_at + 2 * PLACES * (c * rows + y)
                # The processor prefetches neither the next row's costs nor the next column's places itself.
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
                    read_bytes(counts_at, at_row, places, stored, ways.side, room.read, int(times), b, batch)
                else:
                    _read_any(counts, c, y, places, stored[0], ways.side, room.read, times, b, batch)
                if mend:
                    mend_rows(at, places, y, per_nat, ways.side, b, batch)
                sum_edges(at, fitted, b, batch)
                if around.blocks > 0:
                    halo_rows(around, column, at, fitted, b, batch)
                    score_rows(at, around.constant, around.which, 2 * ways.reach + 1, b, batch)
                else:
                    score_rows(at, fitted.constant, b.fitted, 2 * ways.reach + 1, b, batch)
                cost_rows(at, ways, b, batch)
                write_rows(places, ways, b, batch, to, columns * labels)


@numba.njit(cache=True, nogil=True)
def _times(exposures: int, ways: Ways) -> float:
    """Factor on the counts of a column, a whole number if it is not below 1; products fit 16 bits.

    A nat is worth as many units as in a map whose columns all have this number of exposures: the more exposures, the
    fewer units. Otherwise, beside columns with many exposures, one with few would count for less, and the penalties
    between neighbours for more.
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
def _fetch_table(at: LabelTables, i: int, fitted: Fitted) -> None:
    _fetch(at.tap + 2 * i * at.taps, 2 * at.taps)
    _fetch(at.edge + 2 * i * at.pixels, 2 * at.pixels)
    _fetch(fitted.constant + 2 * i * at.constants, 2 * at.constants)
    _fetch(fitted.edge + 2 * i * at.pixels, 2 * at.pixels)


@numba.njit(cache=True, nogil=True)
def fit_tables(room: CostRoom, ways: Ways, first: int, last: int) -> None:
    """Fill the fitted parts of tables first..last-1 in `room`, for the usual number of exposures."""
    fitted = Fitted(room.at.fitted_constant, room.at.fitted_edge)
    for i in range(first, last):
        _fit_table(room.at, i, i, ways.units * ways.exposures, fitted, room.buffers.through)


@numba.njit(cache=True, nogil=True)
def _fit_table(at: LabelTables, i: int, j: int, per_nat: float, to: Fitted, through: int) -> None:
    """Write table i's constants and edges for a number of exposures to index j. per_nat: of `mend_rows`."""
    source, constant = at.constant + 4 * i * at.constants, to.constant + 2 * j * at.constants
    for k in range(0, at.constants, LANES):
        store_int16(constant, k, rounded(load_float32(source, k) * np.float32(per_nat)))
    source, edge = at.edge_sum + 4 * i * at.pixels, to.edge + 2 * j * at.pixels
    # Differences of rounded sums: rounding each pixel would drift along the row.
    write_int16(through, LANES - 1, np.int16(0))
    for k in range(0, at.pixels, LANES):
        store_int16(through, LANES + k, rounded(load_float32(source, k) * np.float32(per_nat)))
    for k in range(0, at.pixels, LANES):
        store_int16(edge, k, load_int16(through, LANES + k) - load_int16(through, LANES - 1 + k))


@numba.njit(cache=True, nogil=True)
def _read_any(
    counts: Counts, c: int, y: int, places: int, x0: int, side: int, pixels: int,
    times: float, b: Buffers, batch: int,
) -> None:  # fmt: skip
    """Fill n as `read_bytes` does, from counts of any type and with any factor; 0 where nothing was stored."""
    for r in range(batch):
        start = read_int16(places, PLACES * r + START) - x0
        for p in range(pixels):
            x = start - side * p
            count = np.int64(counts[c, y + r, x]) if 0 <= x < counts.shape[2] else np.int64(0)
            write_int16(b.n + 2 * r * b.n_row, p, np.int16(count * times))
