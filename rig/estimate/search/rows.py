"""Estimate of image rows, compiled: a fast form of `rig.estimate.row.likelihood`, tested against it.

Every position is scored, the best one examined closely, and what can be learned from the row is recorded. BATCH rows of
one column are scored together, with 16-bit scores (`rig.estimate.search.scores`) and counts of 6 bits. The scores come
from tables (`rig.estimate.search.tables`) for SCREENS amplitudes instead of all. A band of up to 64 rows shares a
table.

The input is `SearchTables`. The output is `RowAnswers`: `stripe` holds the answers, float32 (FIELDS, rows) per column,
and the other arrays the sums and counts to learn from. Kernels get `SearchPointers` to both.

`judge_rows` serves both frames as they come and counts of whole sweeps (`rig.estimate.search.stream`).
"""

from typing import Final, NamedTuple

import numba
import numpy as np

from rig.count.lane_order import PAD, PAIRS, STEPS, pair_bytes, place_of
from rig.estimate.row.likelihood import LABEL_PX
from rig.estimate.search.closeup import Closeup, label_scores, levels_of, offsets
from rig.estimate.search.scores import (
    NOTHING,
    START,
    add_likelihoods,
    certainties,
    find_best,
    fit_lanes,
    fit_positions,
    score_rows,
)
from rig.estimate.search.tables import BATCH, NONE, OUTSIDE, SCREENS, ScreenTable, ScreenTables, Search, count_place
from rig.geometry.windows import WORD_PX
from rig.simd import Float32, Int16, Int32, Uint8
from rig.simd.functions import lift_to_powers, powers, powers_in_order
from rig.simd.memory import (
    CACHE_LINE,
    load_bytes,
    load_float32,
    load_int16,
    pointers,
    prefetch,
    read_byte,
    read_float32,
    read_int16,
    read_int32,
    store_bytes,
    store_float32,
    store_int16,
    write_byte,
    write_float32,
    write_int32,
)
from rig.simd.shuffles import lanes_between, largest_of_rows, store_folded, totals_of_rows
from rig.simd.vectors import LANES, as_bytes, larger, larger_float, smaller, smaller_float, to_float32

COUNT_LIMIT: Final = 63
"""Most whole exposures in the search; counts of more are halved until they fit. Rounding may add 1 to a count."""
EXPOSURE_PARTS: Final = 4
"""Steps per exposure in tables. Where counts are halved, exposures are fractions: 65 become 32.5, 65535 63.999."""
FIELDS: Final = 5
"""Fields of an answer: x_px, confidence, x_sd_px, signal and haze, see `StripeTable`. The confidence is the row's own,
without its neighbours; a signal can be below zero."""


class SearchTables(NamedTuple):
    """Inputs of the search in the rows of a sweep, which do not change during the sweep.

    band_rows: rows that share a table. x0: int32 (columns,), first stored pixel; window: stored pixels; limits: int16
    (columns, 2, rows + LANES), first and last stored pixel of each search window, with the first after the last if
    there is none. rows: of the picture. ambient: float32 (bands, end of the last window), photons per exposure.
    hot_start: int32 (words, rows + 1): for a window that begins at a word of WORD_PX pixels, index of the row's first
    entry in hot_at and hot_place; hot_at: int16, stored pixels whose counts are not used; hot_place: int32, their
    places in the counts of all rows of the picture. nominal: exposures for which the tables are made. faintest,
    brightest: photons of a stripe at scale 1. reach: px on either side of a stripe whose light is its own. shift:
    scores have 128 >> shift units an octave; close_shift: the same for the close-up. most: whole exposures above which
    counts are halved. quiet_step: one column in `quiet_step` is used to learn the ambient light. flux: see
    `count_fluxes`.
    """

    tables: ScreenTables
    closeup: Closeup
    band_rows: int
    x0: Int32
    window: int
    rows: int
    limits: Int16
    near_is_left: bool
    ambient: Float32
    hot_start: Int32
    hot_at: Int16
    hot_place: Int32
    nominal: np.float32
    faintest: np.float32
    brightest: np.float32
    reach: int
    shift: int
    close_shift: int
    most: int
    quiet_step: int
    flux: Float32


class RowAnswers(NamedTuple):
    """Answers of a sweep, to be filled. Lanes and lane order are those of `rig.count.lane_order`.

    stripe: float32 (columns, FIELDS, rows), NaN and confidence 0 if there is nothing. quiet: int32 (rows, PAIRS, lanes
    of the sensor + LANES, 2), in lane order: how often each pixel read 1 while it was clearly behind a stripe.
    quiet_exposures: int32 (rows, lanes of the sensor + LANES + 1), the exposures during which it was, in
    1/EXPOSURE_PARTS, stored as differences from lane to lane. light: int32, like quiet: how often each pixel within the
    windows read 1. The latest counts are not yet in quiet and light, but in quiet_here and light_here, uint8 (rows,
    PAIRS, lanes of the window, 2). lines: int32 (lines, window), counts of rows that are kept; line_start: int32
    (columns + 1,), each column's first entry in line_row, int32, the rows kept, in order."""

    stripe: Float32
    quiet: Int32
    quiet_exposures: Int32
    light: Int32
    quiet_here: Uint8
    light_here: Uint8
    lines: Int32
    line_start: Int32
    line_row: Int32


class SearchPointers(NamedTuple):
    """Pointers (`rig.simd.memory.pointers`) to tables, answers and a thread's memory, with the sizes of their arrays.

    lanes: of the window. bands: tables per column. taps: pairs of pixels with taps, T + 1 (`ScreenTables`);
    weight_pairs: pairs of the close-up. sum_lanes: of the sums over the picture. limit_rows: of `limits`. ambient: that
    of the tables if they have it (several_lines), else of the bands, ambient_px wide.
    """

    judge: SearchTables
    found: RowAnswers
    memory: int
    lanes: int
    bands: int
    taps: int
    weight_pairs: int
    sum_lanes: int
    limit_rows: int
    ambient: int
    ambient_px: int
    several_lines: bool


def pointers_of(judge: SearchTables, found: RowAnswers, memory: Uint8) -> SearchPointers:
    """Pointers to all arrays, which must outlive them. memory: of a thread, see `search_memory`."""
    tables = judge.tables
    several_lines = tables.ambient.shape[0] > 0
    ambient = tables.ambient if several_lines else judge.ambient
    return SearchPointers(
        judge=pointers(judge), found=pointers(found), memory=memory.ctypes.data, lanes=tables.lane.shape[2],
        bands=tables.lane.shape[1], taps=tables.tap.shape[4], weight_pairs=judge.closeup.weight.shape[3],
        sum_lanes=found.light.shape[2], limit_rows=judge.limits.shape[2], ambient=ambient.ctypes.data,
        ambient_px=judge.ambient.shape[1], several_lines=several_lines,
    )  # fmt: skip


def count_fluxes() -> Float32:
    """Photons per exposure estimated from n ones in k exposures, float32: log((k + 1/2) / (k - n + 1/2)).

    Nearly unbiased, and finite even at n = k. Rows are k in steps of 1/EXPOSURE_PARTS; columns are n, up to one more
    than COUNT_LIMIT, since halved counts are rounded up.
    """
    parts, n = np.mgrid[: EXPOSURE_PARTS * (COUNT_LIMIT + 1), : COUNT_LIMIT + 2]
    k = parts / EXPOSURE_PARTS
    return np.log((k + 0.5) / (np.maximum(k - n, 0) + 0.5)).astype(np.float32)


QUIET: Final = 0.9
"""Probability of a stripe within 1 px above which the pixels behind it are used to learn the ambient light."""
QUIET_STEP: Final = 8
"""If there are dark frames, one column in so many is used to learn the ambient light, else every column."""
SIGNAL_REACH_PX: Final = 2
"""Least number of pixels on either side of a stripe whose light is summed as its own."""
FEW_EXPOSURES: Final = 1
"""Exposures up to which the scores beside the best position place the line as well as a close-up."""
USUAL_PAIRS: Final = 4
"""Pairs of pixels that the close-up reads for a line of usual width."""


@numba.njit(cache=True, nogil=True)
def halvings(exposures: int, most: int) -> int:
    """Number of times that counts of this many exposures are halved: the whole exposures are then at most `most`."""
    times = 0
    while (exposures >> times) > most:
        times += 1
    return times


@numba.njit(forceinline=True)
def _fetch_ahead(desk: SearchPointers, pixels: int, table: int) -> None:
    """Prefetch table number `table`, the next column's. The processor does not do it itself: few numbers are read in
    order."""
    tables, taps = desk.judge.tables, 2 * SCREENS * desk.taps * pixels
    for at in range(0, taps, CACHE_LINE):
        prefetch(tables.tap + taps * table + at)
    for at in range(0, pixels, CACHE_LINE):
        prefetch(tables.edge + pixels * table + at)
    for at in range(0, 4 * pixels, CACHE_LINE):
        here = 4 * pixels * table + at
        prefetch(tables.position + here)
        prefetch(tables.before + here)
        prefetch(tables.scale + here)
        prefetch(tables.neutral + here)


@numba.njit(forceinline=True)
def table_for(desk: SearchPointers, search: Search, c: int, b: int, exposures: float) -> ScreenTable:
    """The table of column c and band b, adapted to this number of exposures."""
    judge, tables = desk.judge, desk.judge.tables
    pixels, table = STEPS * search.lanes, c * desk.bands + b
    constant = tables.position + 2 * SCREENS * pixels * table
    if exposures != judge.nominal:
        slope = tables.slope + 2 * SCREENS * pixels * table
        fit_positions(constant, slope, SCREENS * pixels, exposures - judge.nominal, search.constant)
        constant = search.constant
    _fetch_ahead(desk, pixels, table + desk.bands)
    none = tables.none + 4 * NONE * table
    fit_lanes(
        tables.lane + 4 * search.lanes * table, exposures, max(read_float32(none, 2), np.float32(OUTSIDE)),
        np.int64(read_float32(none, 3)), np.int64(read_float32(none, 4)), search,
    )  # fmt: skip
    x0, neutral = np.int64(read_int32(judge.x0, c)), tables.neutral + 4 * pixels * table
    band_end = min((b + 1) * judge.band_rows, judge.rows)
    if _hot_of_row(desk, x0, b * judge.band_rows) < _hot_of_row(desk, x0, band_end):
        _neutral_counts(neutral, exposures, c, judge.window, search.neutral)
    lowest = np.float32(OUTSIDE)
    ambient = pixels * table if desk.several_lines else b * desk.ambient_px + x0
    all_right = max(read_float32(none, 0) + np.float32(START), lowest)
    return ScreenTable(
        tables.edge + pixels * table, tables.tap + 2 * SCREENS * desk.taps * pixels * table, constant,
        tables.before + 4 * pixels * table, tables.scale + 4 * pixels * table,
        desk.ambient + 4 * ambient, np.int16(all_right),
        np.int16(max(read_float32(none, 1), lowest)),
        read_int32(tables.first, table) <= read_int32(tables.last, table),
    )  # fmt: skip


@numba.njit(forceinline=True)
def _hot_of_row(desk, x0, y):  # type: ignore[no-untyped-def]
    """Index of row y's first hot pixel, where those of row y - 1 end, among those of windows that begin at x0."""
    return np.int64(read_int32(desk.judge.hot_start, (x0 // WORD_PX) * (desk.judge.rows + 1) + y))


@numba.njit(cache=True, nogil=True)
def _neutral_counts(neutral: int, exposures: float, c: int, window: int, to: int) -> None:
    """Write counts that favour no position, a byte for each stored pixel; neutral, to: addresses."""
    for x in range(window):
        # Rounded up or down pseudo-randomly, so that hot pixels favour neither side on average.
        chance = np.float32((np.int32(x) * np.int32(40503) + np.int32(c) * np.int32(20011)) & np.int32(0xFFFF))
        count = np.float32(exposures) * read_float32(neutral, x) + chance * np.float32(1.0 / 65536.0)
        write_byte(to, x, np.uint8(count))


@numba.njit(forceinline=True)
def _mute_hot(desk, search, first, rows, x0):  # type: ignore[no-untyped-def]
    """Give the hot pixels of the batch's rows counts that favour no position; their own are kept in `muted`."""
    n, begin = search.n - first * search.n_bytes, _hot_of_row(desk, x0, first)
    for h in range(begin, _hot_of_row(desk, x0, first + rows)):
        place = read_int32(desk.judge.hot_place, h)
        write_byte(search.muted, h - begin, read_byte(n, place))
        write_byte(n, place, read_byte(search.neutral, read_int16(desk.judge.hot_at, h)))


@numba.njit(forceinline=True)
def _unmute_hot(desk, search, first, rows, x0):  # type: ignore[no-untyped-def]
    """Give the hot pixels their counts back: the ambient light is learned from what was counted."""
    n, begin = search.n - first * search.n_bytes, _hot_of_row(desk, x0, first)
    for h in range(begin, _hot_of_row(desk, x0, first + rows)):
        write_byte(n, read_int32(desk.judge.hot_place, h), read_byte(search.muted, h - begin))


@numba.njit(forceinline=True)
def judge_rows(
    desk: SearchPointers, search: Search, table: ScreenTable, first: int, rows: int, c: int, exposures: float
) -> None:
    """Estimate rows first..first+rows-1 (at most BATCH) of column c, all in the band to which `table` belongs.

    Their counts must be in `search.n`. Nothing is written if the table has no position to search.
    """
    if not table.searched:
        return
    _mute_hot(desk, search, first, rows, np.int64(read_int32(desk.judge.x0, c)))
    # Each step is done for all rows before the next step: the steps of one row must wait for one another.
    score_rows(table, desk.taps - 1, search, rows)
    find_best(search, rows, desk.judge.shift)
    add_likelihoods(table, search, rows, desk.judge.window, desk.judge.shift)
    stripe = desk.found.stripe + 4 * (FIELDS * desk.judge.rows * c + first)
    certainty = certainties(table, search, desk.judge.shift)
    _answer(certainty, stripe + 4 * desk.judge.rows, rows, search)
    _measure_light(desk, search, table, first, rows, c, exposures, stripe)
    # The close-up has one level behind the stripe for all columns. With other lines' haze, the level differs by column.
    if exposures <= FEW_EXPOSURES or desk.several_lines:
        _place_by_neighbours(desk, search, rows, c, stripe)
    else:
        _look_closely(desk, search, rows, c, exposures, stripe)
    if c % desk.judge.quiet_step == 0:
        _unmute_hot(desk, search, first, rows, np.int64(read_int32(desk.judge.x0, c)))
        for r in range(rows):
            if read_float32(stripe, desk.judge.rows + r) > QUIET:
                n, x = search.n + r * search.n_bytes, np.int64(read_int16(search.x, r))
                _learn_quiet(desk, search.lanes, n, first + r, c, x, exposures)


@numba.njit(forceinline=True)
def _answer(lanes, to, rows, search):  # type: ignore[no-untyped-def]
    """Write one field of the answers of the batch's first `rows` rows to address `to`."""
    if rows == BATCH:
        store_float32(to, 0, lanes)
    else:
        # The memory behind these rows may be another thread's.
        store_float32(search.answer, 0, lanes)
        for r in range(rows):
            write_float32(to, r, read_float32(search.answer, r))


@numba.njit(forceinline=True)
def _measure_light(desk, search, table, first, rows, c, exposures, stripe):  # type: ignore[no-untyped-def]
    """Move the best positions into their rows' windows; measure signal and haze there for answers and close-up."""
    limits = desk.judge.limits + 4 * desk.limit_rows * c
    low, high = load_int16(limits, first), load_int16(limits, desk.limit_rows + first)
    store_int16(search.x, 0, smaller(larger(load_int16(search.x, 0), low), high))
    # With the usual reach as a constant, the loop is unrolled.
    if desk.judge.reach == SIGNAL_REACH_PX:
        _read_light(desk, search, table, rows, exposures, SIGNAL_REACH_PX)
    else:
        _read_light(desk, search, table, rows, exposures, desk.judge.reach)
    before, ambient = load_float32(search.before, 0), load_float32(search.ambient, 0)
    scale = load_float32(search.scale, 0)
    light = load_float32(search.light, 0) - (before + ambient) * np.float32(desk.judge.reach + 0.5)
    likely = smaller_float(larger_float(light, scale * desk.judge.faintest), scale * desk.judge.brightest)
    store_int16(search.levels, 0, levels_of(before, likely))
    _answer(light, stripe + 12 * desk.judge.rows, rows, search)
    _answer(larger_float(before - ambient, np.float32(0.0)), stripe + 16 * desk.judge.rows, rows, search)


@numba.njit(forceinline=True)
def _read_light(desk, search, table, rows, exposures, reach):  # type: ignore[no-untyped-def]
    flux = desk.judge.flux + 4 * (COUNT_LIMIT + 2) * np.int64(EXPOSURE_PARTS * exposures)
    for r in range(rows):
        n, x = search.n + r * search.n_bytes, np.int64(read_int16(search.x, r))
        light = np.float32(0.0)
        for t in range(-reach, reach + 1):
            light += read_float32(flux, np.int64(read_byte(n, count_place(search, x + t))))
        write_float32(search.light, r, light)
        write_float32(search.before, r, read_float32(table.before, x))
        write_float32(search.scale, r, read_float32(table.scale, x))
        write_float32(search.ambient, r, read_float32(table.ambient, x))


@numba.njit(forceinline=True)
def _place_by_neighbours(desk, search, rows, c, stripe):  # type: ignore[no-untyped-def]
    """Refine the positions of the batch's rows by the scores beside the best ones, and write the answers."""
    lift = load_int16(search.lift, 0)
    own = powers_in_order(load_int16(search.best, 0), lift, desk.judge.shift)
    left = powers_in_order(load_int16(search.left, 0), lift, desk.judge.shift)
    right = powers_in_order(load_int16(search.right, 0), lift, desk.judge.shift)
    beside = left + right
    # Labels a pixel apart instead of a quarter.
    offset, sd = offsets(larger_float(own + beside, NOTHING), right - left, beside, 1.0)
    x = to_float32(load_int16(search.x, 0)) + np.float32(read_int32(desk.judge.x0, c))
    _answer(x + offset, stripe, rows, search)
    _answer(sd, stripe + 8 * desk.judge.rows, rows, search)


@numba.njit(forceinline=True)
def _look_closely(desk, search, rows, c, exposures, stripe):  # type: ignore[no-untyped-def]
    """Refine the positions of the batch's rows by labels a quarter of a pixel apart, and write the answers."""
    # With the usual width as a constant, the loop is unrolled.
    if desk.weight_pairs == USUAL_PAIRS:
        _compare_labels(desk, search, rows, exposures, USUAL_PAIRS)
    else:
        _compare_labels(desk, search, rows, exposures, desk.weight_pairs)
    lift = lift_to_powers(largest_of_rows(search.label), desk.judge.close_shift)
    store_int16(search.lift, 0, lift)
    for r in range(rows):
        likelihood = powers(load_int16(search.label, r * LANES), read_int16(search.lift, r), desk.judge.close_shift)
        store_folded(search.mass, r, likelihood)
        store_folded(search.moment, r, likelihood * load_float32(desk.judge.closeup.label, 0))
        store_folded(search.square, r, likelihood * load_float32(desk.judge.closeup.square, 0))
    mass, moment, square = (totals_of_rows(search.mass), totals_of_rows(search.moment), totals_of_rows(search.square))
    offset, sd = offsets(mass, moment, square, LABEL_PX)
    x = to_float32(load_int16(search.x, 0)) + np.float32(read_int32(desk.judge.x0, c))
    _answer(x + offset, stripe, rows, search)
    _answer(sd, stripe + 8 * desk.judge.rows, rows, search)


@numba.njit(forceinline=True)
def _compare_labels(desk, search, rows, exposures, pairs):  # type: ignore[no-untyped-def]
    closeup = desk.judge.closeup
    for r in range(rows):
        x, levels = np.int64(read_int16(search.x, r)), np.int64(read_int16(search.levels, r))
        weight, constant = closeup.weight + 4 * LANES * pairs * levels, closeup.constant + 4 * LANES * levels
        store_int16(search.label, r * LANES, label_scores(search, r, x, exposures, weight, constant, pairs))


@numba.njit(cache=True, nogil=True)
def _learn_quiet(desk: SearchPointers, lanes: int, n: int, y: int, c: int, x: int, exposures: float) -> None:
    """Add the whole lanes behind row y's stripe, at stored pixel x, to the quiet counts; n: address of the counts."""
    judge = desk.judge
    limits = judge.limits + 4 * desk.limit_rows * c
    if read_int16(limits, y) > read_int16(limits, desk.limit_rows + y):
        return
    begin, end = 0, judge.window // STEPS
    if judge.near_is_left:
        begin = ((x + judge.reach + 1) >> 3) + 1
    else:
        end = (x - judge.reach) >> 3
    if begin >= end:
        return
    sums = desk.found.quiet_here + 2 * PAIRS * lanes * y
    for v in range(0, lanes, LANES):
        quiet = as_bytes(lanes_between(begin - v, end - v))
        for q in range(PAIRS):
            at = 2 * (q * lanes + v)
            counts = load_bytes(n, q * pair_bytes(lanes) + 2 * (PAD + v)) & quiet
            store_bytes(sums, at, load_bytes(sums, at) + counts)
    steps = desk.found.quiet_exposures + 4 * (y * (desk.sum_lanes + 1) + np.int64(read_int32(judge.x0, c)) // STEPS)
    parts = np.int32(EXPOSURE_PARTS * exposures)
    write_int32(steps, begin, read_int32(steps, begin) + parts)
    write_int32(steps, end, read_int32(steps, end) - parts)


@numba.njit(cache=True, nogil=True)
def keep_line(n: int, lanes: int, window: int, to: int) -> None:
    """Write the counts of a row, int32 in pixel order, to a line of `RowAnswers.lines`.

    n: address of the row's counts, bytes in lane order (`rig.count.lane_order`). lanes: of these counts. window: number
    of pixels. to: address of the line."""
    for x in range(window):
        write_int32(to, x, np.int32(read_byte(n, place_of(x, lanes))))


@numba.njit(cache=True, nogil=True)
def turned(stripe: Float32, limits: Int16, first_row: int, last_row: int, out: Float32) -> None:
    """Write rows first_row..last_row-1 of answers (columns, FIELDS, rows) to out as (FIELDS, rows, columns).

    limits: as in `SearchTables`; rows without a search window have no answer.
    """
    columns, fields, _ = stripe.shape
    for y0 in range(first_row, last_row, 16):
        for c0 in range(0, columns, 16):
            for f in range(fields):
                nothing = np.float32(0.0) if f == 1 else np.float32(np.nan)
                for y in range(y0, min(y0 + 16, last_row)):
                    for c in range(c0, min(c0 + 16, columns)):
                        asked = limits[c, 0, y] <= limits[c, 1, y]
                        out[f, y, c] = stripe[c, f, y] if asked else nothing
