"""Compiled parts of the label costs that a batch of rows goes through: sums, scores, costs.

Running sums carry the evidence of all pixels behind a label, taps that of the pixels around it; scores are saturating
16-bit numbers. The two phases of a pixel make the low and the high byte of the same 16 bits, which is their order.
Each part is a function of its own, not inlined: all in one, the compiler keeps a register for every address.
"""

from typing import Final

import numba
import numpy as np

from rig.aligned import CACHE_LINE
from rig.estimators.label_places import (
    FAR_PX,
    LABEL,
    LABEL_END,
    MEND,
    ODD,
    PLACES,
    START,
    VALID,
    VALID_END,
)
from rig.estimators.label_volume_buffers import POSITION, SUMS_FROM, At, Buffers, Fitted, Ways
from rig.lane_memory import (
    load_bytes,
    load_int16,
    load_widened,
    prefetch,
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
from rig.lane_reductions import largest_of_rows
from rig.lane_shuffles import last_everywhere, reversed_lanes, running_sum
from rig.lanes import LANES, add_saturated, as_bytes, larger, scaled, smaller, sub_saturated, zero_bytes, zero_int16

COST_LIMIT: Final = 160
"""Largest cost of a label that is not excluded."""
EXCLUDED: Final = 255
"""Cost of a label that cannot be: outside the picture, more than a pixel outside the row's search window."""
BASE: Final = -8000
"""Score of 'everything is before the stripe': most of the range lies above it."""
HIGHEST: Final = 30000
"""Scores and their parts are cut there."""
_USUAL_TAPS: Final = 5
"""Pixels around a position where the line is as narrow as it mostly is."""
COUNT_BITS: Final = 15
"""Counts are kept as fractions of 2^15 of what they can be."""


@numba.njit(cache=True, nogil=True)
def read_bytes(
    counts: int, begin: int, places: int, stored: tuple[int, int, int, int], side: int, pixels: int, times: int,
    b: Buffers, batch: int,
) -> None:  # fmt: skip
    """Fill n, from far to near; what lies outside the stored pixels is of any value.

    counts: address of the first of all, begin: place of the first row's. stored: first pixel, pixels of a row, all
    counts, counts of a column. times: what counts are multiplied with.
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
        # The next column's counts will be wanted when this one's last row has been read; the rest the next row asks
        # for.
        for line in range(0, min(pixels + LANES, window), CACHE_LINE):
            prefetch(counts + low + column + line)
        if side > 0:
            for p in range(0, pixels, LANES):
                store_int16(n, p, reversed_lanes(load_widened(counts + first - p, 1 - LANES)) * factor)
        else:
            for p in range(0, pixels, LANES):
                store_int16(n, p, load_widened(counts + first, p) * factor)


@numba.njit(cache=True, nogil=True)
def mend_rows(at: At, places: int, y: int, per_nat: float, side: int, b: Buffers, batch: int) -> None:
    """Give pixels that the table weighs, but that the row lacks, or that are hot, a count that says nothing.

    y: row of the first; per_nat: units times exposures.
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
def sum_edges(at: At, fitted: Fitted, b: Buffers, batch: int) -> None:
    """Fill sums, as far as there are labels."""
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
def _score_row(sums, n, tap, constant, score, vectors, taps):  # type: ignore[no-untyped-def]
    """The scores of a row, and the largest one of each lane."""
    best = zero_int16() + np.int16(-32768)
    for _ in range(vectors):
        far_dim, far_bright = load_int16(constant, 0), load_int16(constant, LANES)
        near_dim, near_bright = load_int16(constant, 2 * LANES), load_int16(constant, 3 * LANES)
        for d in range(taps):
            counts, of_tap = load_int16(n, d), d * POSITION
            far_dim = far_dim + scaled(counts, load_int16(tap, of_tap))
            far_bright = far_bright + scaled(counts, load_int16(tap, of_tap + LANES))
            near_dim = near_dim + scaled(counts, load_int16(tap, of_tap + 2 * LANES))
            near_bright = near_bright + scaled(counts, load_int16(tap, of_tap + 3 * LANES))
        level = load_int16(sums, 0)
        far = add_saturated(level, larger(far_dim, far_bright))
        near = add_saturated(level, larger(near_dim, near_bright))
        store_int16(score, 0, far)
        store_int16(score, LANES, near)
        best = larger(best, larger(far, near))
        n, sums, score, constant = n + 2 * LANES, sums + 2 * LANES, score + 4 * LANES, constant + 2 * POSITION
        tap += 2 * POSITION * taps
    return best


@numba.njit(cache=True, nogil=True)
def score_rows(at: At, constants: int, which: int, taps: int, b: Buffers, batch: int) -> None:
    """Fill score and top; constants: address of those of positions, which: of what each row's number there is.

    taps: pixels around a position.
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
        if taps == _USUAL_TAPS:
            best = _score_row(sums, n, tap, constant, score, vectors, _USUAL_TAPS)
        else:
            best = _score_row(sums, n, tap, constant, score, vectors, taps)
        store_int16(b.top, r * LANES, best)
    store_int16(b.top, 0, largest_of_rows(b.top))


@numba.njit(cache=True, nogil=True)
def cost_rows(at: At, ways: Ways, b: Buffers, batch: int) -> None:
    """Fill cost of all that may be a label."""
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
    """Write the costs of labels to address out, rows `row_bytes` apart."""
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
