"""Compiled estimate of one image row: search, close look, and what the row teaches of the light.

The same `judge_row` serves frames as they come and counts that are there already (`stream_kernels`): the answers are
the same bit for bit.
"""

from typing import Final, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rig.estimators.closeup_kernels import LEVELS, Closeup, label_likelihoods, level_of, place_line
from rig.estimators.powers import MEAN_EXCESS, nothing_below, power
from rig.estimators.screen_tables import SCREENS, Tables
from rig.estimators.search_kernels import (
    Search,
    add_likelihoods,
    best_position,
    best_score,
    end_likelihoods,
    score_rows,
    search_in,
    search_memory,
    set_exposures,
    sum_edges,
)
from rig.lane_order import PAD, STEPS, place_of
from rig.lanes import (
    LANES,
    address_of,
    lanes_between,
    load_float32,
    load_int16,
    read_float32,
    read_int16,
    read_int32,
    store_float32,
    store_int16,
    total,
    write_float32,
    write_int16,
    write_int32,
)

QUIET: Final = 0.9
"""Probability within 1 px from which the pixels behind the stripe teach the ambient light."""
QUIET_STEP: Final = 8
"""Every 8th column does so where there are dark frames as well, else every one."""
COUNT_LIMIT: Final = 63
"""Largest count the search works with; counts of more exposures are halved until they fit."""
FIELDS: Final = 5
"""x_px, confidence, x_sd_px, signal, haze: see `StripeTable`."""
NO_NAN: Final = {"nnan", "nsz"}
"""For min and max without a branch, which could not be foreseen."""
NOWHERE: Final = -1
"""Position of a row without a search window."""
SIGNAL_REACH_PX: Final = 2
"""Pixels on either side whose light is the stripe's, where the line is narrower."""


class Judge(NamedTuple):
    """All that is needed to judge the rows of a sweep; fixed while the sweep lasts.

    x0: int32 (columns,), first stored pixel; window: stored pixels; limits: int16 (columns, rows, 2), first and last
    stored pixel of each search window, the first behind the last where there is none. rows: of the picture. ambient:
    float32 (bands, width padded to whole words). hot_start: int32 (rows + 1,) and hot_x: int32, pixels of each row
    whose counts say nothing. nominal: exposures the tables are for. faintest, brightest: photons of a stripe at scale
    1. reach: half the line's width in px. shift: units of the scores are 128 >> shift an octave, close_shift: of the
    close-up's. most: largest count. quiet_step: every so manieth column teaches the ambient light. flux: see
    `count_fluxes`.
    """

    tables: Tables
    closeup: Closeup
    band_rows: int
    x0: NDArray[np.int32]
    window: int
    rows: int
    limits: NDArray[np.int16]
    near_is_left: bool
    ambient: NDArray[np.float32]
    hot_start: NDArray[np.int32]
    hot_x: NDArray[np.int32]
    nominal: float
    faintest: float
    brightest: float
    reach: int
    shift: int
    close_shift: int
    most: int
    quiet_step: int
    flux: NDArray[np.float32]


class Found(NamedTuple):
    """What a sweep gives, to be filled.

    stripe: float32 (columns, FIELDS, rows), NaN and confidence 0 where there is nothing. quiet: int32 (rows, STEPS,
    lanes of the sensor and LANES more), ones of pixels while clearly behind a stripe, in lane order; quiet_exposures:
    int32 (rows, lanes + 1), their exposures as steps up and down. light: int32, like quiet, ones of every pixel within
    the windows; those since the window last moved are still in light_here, int16 (rows, STEPS, lanes of the window).
    lines: int32 (lines, window), counts of the rows
    that the learning reads; line_start: int32 (columns + 1,) and line_row: int32, the rows of each column in order.
    """

    stripe: NDArray[np.float32]
    quiet: NDArray[np.int32]
    quiet_exposures: NDArray[np.int32]
    light: NDArray[np.int32]
    quiet_here: NDArray[np.int16]
    light_here: NDArray[np.int16]
    lines: NDArray[np.int32]
    line_start: NDArray[np.int32]
    line_row: NDArray[np.int32]


class Bench(NamedTuple):
    """A thread's own memory. ambient: float32 (P,), of the band's stored pixels."""

    search: NDArray[np.int16]
    ambient: NDArray[np.float32]


class Desk(NamedTuple):
    """Judge, Found and Bench as addresses and sizes, made once per call: see `rig.lanes` for why."""

    search: Search
    columns: int
    rows: int
    bands: int
    taps: int
    edge: int
    tap: int
    position: int
    slope: int
    lane: int
    none: int
    neutral: int
    before: int
    scale: int
    first: int
    last: int
    weight: int
    weight_constant: int
    weight_px: int
    label: int
    square: int
    x0: int
    limits: int
    ambient: int
    ambient_px: int
    hot_start: int
    hot_x: int
    own_ambient: int
    flux: int
    stripe: int
    quiet: int
    quiet_exposures: int
    light: int
    sum_lanes: int
    lines: int
    line_start: int
    line_row: int
    band_rows: int
    window: int
    reach: int
    shift: int
    close_shift: int
    most: int
    quiet_step: int
    near_is_left: bool
    nominal: np.float32
    faintest: np.float32
    brightest: np.float32


@numba.njit(cache=True, nogil=True)
def desk_of(judge: Judge, found: Found, bench: Bench) -> Desk:
    """Addresses of everything; the arrays must outlive it."""
    tables, closeup = judge.tables, judge.closeup
    return Desk(
        search_in(bench.search, tables.lane.shape[2]), judge.x0.shape[0], judge.rows, tables.lane.shape[1],
        tables.tap.shape[3], address_of(tables.edge), address_of(tables.tap), address_of(tables.position),
        address_of(tables.slope), address_of(tables.lane), address_of(tables.none), address_of(tables.neutral),
        address_of(tables.before), address_of(tables.scale), address_of(tables.first), address_of(tables.last),
        address_of(closeup.weight), address_of(closeup.constant), closeup.weight.shape[2],
        address_of(closeup.label), address_of(closeup.square), address_of(judge.x0), address_of(judge.limits),
        address_of(judge.ambient), judge.ambient.shape[1], address_of(judge.hot_start), address_of(judge.hot_x),
        address_of(bench.ambient), address_of(judge.flux), address_of(found.stripe), address_of(found.quiet_here),
        address_of(found.quiet_exposures), address_of(found.light_here), found.light.shape[2],
        address_of(found.lines), address_of(found.line_start), address_of(found.line_row), judge.band_rows,
        judge.window, judge.reach, judge.shift, judge.close_shift, judge.most, judge.quiet_step, judge.near_is_left,
        np.float32(judge.nominal), np.float32(judge.faintest), np.float32(judge.brightest),
    )  # fmt: skip


@numba.njit(cache=True, nogil=True)
def new_bench(lanes: int) -> Bench:
    """Memory for rows of `lanes` lanes."""
    return Bench(search_memory(lanes), np.zeros(lanes * STEPS, np.float32))


def count_fluxes() -> NDArray[np.float32]:
    """Photons per exposure that n ones in k exposures speak for, (k, n) float32: nearly unbiased, finite also at n = k.

    Halved counts are rounded up, so that n may exceed the limit by one.
    """
    k, n = np.mgrid[: COUNT_LIMIT + 1, : COUNT_LIMIT + 2]
    return np.log((k + 0.5) / (np.maximum(k - n, 0) + 0.5)).astype(np.float32)


@numba.njit(cache=True, nogil=True)
def halvings(exposures: int, most: int) -> int:
    """How often counts of so many exposures are halved."""
    times = 0
    while (exposures >> times) > most:
        times += 1
    return times


@numba.njit(cache=True, nogil=True)
def set_column(desk: Desk, c: int, b: int, exposures: float) -> None:
    """Make ready for rows of band b of column c."""
    pixels, table = STEPS * desk.search.lanes, c * desk.bands + b
    positions = 2 * SCREENS * pixels * table
    lane = desk.lane + 4 * desk.search.lanes * table
    none = desk.none + 12 * table
    set_exposures(desk.position + positions, desk.slope + positions, lane, none, exposures, desk.nominal, desk.search)
    first = b * desk.ambient_px + read_int32(desk.x0, c)
    for x in range(desk.window):
        write_float32(desk.own_ambient, x, read_float32(desk.ambient, first + x))


@numba.njit(cache=True, nogil=True)
def _mute_hot(desk: Desk, n: int, y: int, c: int, table: int, exposures: float) -> None:
    """Give the hot pixels of row y counts that speak for no position."""
    x0, lanes = read_int32(desk.x0, c), desk.search.lanes
    for h in range(read_int32(desk.hot_start, y), read_int32(desk.hot_start, y + 1)):
        x = np.int64(read_int32(desk.hot_x, h))
        at = x - x0
        if 0 <= at < desk.window:
            # Rounded up or down as by chance, so that hot pixels lean to neither side on average.
            chance = ((x * 40503 + y * 30011 + c * 20011) & 0xFFFF) / 65536.0
            neutral = read_float32(desk.neutral, table * STEPS * lanes + at)
            write_int16(n, place_of(at, lanes), np.int16(exposures * neutral + chance))


@numba.njit(cache=True, nogil=True)
def judge_rows(desk: Desk, first: int, rows: int, c: int, b: int, exposures: float) -> None:
    """Estimate rows first..first+rows-1 (at most BATCH) of column c, all of band b.

    Their counts are the rows of the batch in desk.search, made ready by `set_column`.
    """
    search = desk.search
    pixels, table = STEPS * search.lanes, c * desk.bands + b
    if read_int32(desk.first, table) > read_int32(desk.last, table):
        return
    edge, tap = desk.edge + 2 * pixels * table, desk.tap + 2 * SCREENS * desk.taps * pixels * table
    if read_int32(desk.hot_start, first) < read_int32(desk.hot_start, first + rows):
        for r in range(rows):
            _mute_hot(desk, search.n + r * search.n_bytes, first + r, c, table, exposures)
    sum_edges(edge, search, rows)
    score_rows(edge, tap, (desk.taps - 1) // 2, search, rows)
    # Each part for all rows before the next: one row's parts wait for one another, different rows' do not.
    _find(search, rows, desk.window, desk.shift)
    _measure_light(desk, first, rows, c, table, exposures)
    _look_closely(desk, first, rows, c, exposures)
    if c % desk.quiet_step == 0:
        for r in range(rows):
            x = np.int64(read_int32(search.x, r))
            if x != NOWHERE and read_float32(search.confidence, r) > QUIET:
                _learn_quiet(desk, search.n + r * search.n_bytes, first + r, c, x, exposures)


@numba.njit(cache=True, nogil=True, fastmath=NO_NAN)
def _find(search: Search, rows: int, window: int, shift: int) -> None:
    """Best position of each row of the batch, and the probability of lying within 1 px of it."""
    lanes = search.lanes
    for r in range(rows):
        write_int32(search.x, r, np.int32(best_position(search, r, best_score(search, r))))
    for r in range(rows):
        x = np.int64(read_int32(search.x, r))
        best = np.int64(read_int16(search.score + r * search.score_bytes, (x & 7) * lanes + (x >> 3)))
        add_likelihoods(search, r, best, shift)
    for r in range(rows):
        score, x = search.score + r * search.score_bytes, np.int64(read_int32(search.x, r))
        best = np.int64(read_int16(score, (x & 7) * lanes + (x >> 3)))
        nothing = nothing_below(best, shift)
        own, near = power(best, nothing, shift), np.float32(0.0)
        if x > 0:
            near += power(read_int16(score, ((x - 1) & 7) * lanes + ((x - 1) >> 3)), nothing, shift)
        if x + 1 < window:
            near += power(read_int16(score, ((x + 1) & 7) * lanes + ((x + 1) >> 3)), nothing, shift)
        # The best position's own term is exact, the others are too large by the same share on average.
        others = total(load_float32(search.mass, r * LANES)) + end_likelihoods(search, r, best, shift) - own
        own *= MEAN_EXCESS
        write_float32(search.confidence, r, min((own + near) / (own + others), np.float32(1.0)))


@numba.njit(cache=True, nogil=True, fastmath=NO_NAN)
def _measure_light(desk: Desk, first: int, rows: int, c: int, table: int, exposures: float) -> None:
    """Signal and haze of the batch's rows, from row `first` of the picture on, for answers and close-up."""
    search = desk.search
    lanes = search.lanes
    pixels = STEPS * lanes
    stripe = desk.stripe + 4 * FIELDS * desk.rows * c
    limits = desk.limits + 4 * desk.rows * c
    flux = desk.flux + 4 * (COUNT_LIMIT + 2) * np.int64(exposures)
    for r in range(rows):
        n = search.n + r * search.n_bytes
        y = first + r
        low, high = np.int64(read_int16(limits, 2 * y)), np.int64(read_int16(limits, 2 * y + 1))
        if low > high:
            write_int32(search.x, r, np.int32(NOWHERE))
            continue
        x = min(max(np.int64(read_int32(search.x, r)), low), high)
        light = np.float32(0.0)
        for at in range(x - desk.reach, x + desk.reach + 1):
            light += read_float32(flux, read_int16(n, place_of(at, lanes)))
        before, scale = read_float32(desk.before, table * pixels + x), read_float32(desk.scale, table * pixels + x)
        ambient = read_float32(desk.own_ambient, x)
        light -= np.float32(0.5) * (before + ambient) * np.float32(2 * desk.reach + 1)
        signal = min(max(light, desk.faintest * scale), desk.brightest * scale)
        write_int32(search.x, r, np.int32(x))
        write_int32(search.levels, r, np.int32(level_of(before) * LEVELS + level_of(signal)))
        write_float32(stripe, 3 * desk.rows + y, signal)
        write_float32(stripe, 4 * desk.rows + y, max(before - ambient, np.float32(0.0)))


@numba.njit(cache=True, nogil=True, fastmath=NO_NAN)
def _look_closely(desk: Desk, first: int, rows: int, c: int, exposures: float) -> None:
    """Place the lines of the batch's rows, and write the answers."""
    search = desk.search
    x0 = np.int64(read_int32(desk.x0, c))
    stripe = desk.stripe + 4 * FIELDS * desk.rows * c
    for r in range(rows):
        x, levels = np.int64(read_int32(search.x, r)), np.int64(read_int32(search.levels, r))
        if x != NOWHERE:
            likelihood = label_likelihoods(
                search.n + r * search.n_bytes, search.lanes, x, exposures,
                desk.weight + 2 * LANES * desk.weight_px * levels, desk.weight_constant + 4 * LANES * levels,
                desk.weight_px, desk.close_shift,
            )  # fmt: skip
            store_float32(search.mass, r * LANES, likelihood)
    for r in range(rows):
        x, y = np.int64(read_int32(search.x, r)), first + r
        if x != NOWHERE:
            offset, sd = place_line(load_float32(search.mass, r * LANES), desk.label, desk.square)
            write_float32(stripe, y, np.float32(x0 + x) + offset)
            write_float32(stripe, desk.rows + y, read_float32(search.confidence, r))
            write_float32(stripe, 2 * desk.rows + y, sd)


@numba.njit(cache=True, nogil=True)
def _learn_quiet(desk: Desk, n: int, y: int, c: int, x: int, exposures: float) -> None:
    """Add the whole lanes behind the stripe at stored pixel x to the quiet counts."""
    lanes = desk.search.lanes
    stride = lanes + 2 * PAD
    begin, end = 0, desk.window // STEPS
    if desk.near_is_left:
        begin = ((x + desk.reach + 1) >> 3) + 1
    else:
        end = (x - desk.reach) >> 3
    if begin >= end:
        return
    sums = desk.quiet + 2 * y * STEPS * lanes
    for v in range(0, lanes, LANES):
        quiet = lanes_between(begin - v, end - v)
        for s in range(STEPS):
            at = s * lanes + v
            counts = load_int16(n, s * stride + PAD + v) & quiet
            store_int16(sums, at, load_int16(sums, at) + counts)
    steps = desk.quiet_exposures + 4 * (y * (desk.sum_lanes + 1) + np.int64(read_int32(desk.x0, c)) // STEPS)
    write_int32(steps, begin, read_int32(steps, begin) + np.int32(exposures))
    write_int32(steps, end, read_int32(steps, end) - np.int32(exposures))


@numba.njit(cache=True, nogil=True)
def keep_line(n: int, lanes: int, window: int, to: int) -> None:
    """Write the counts of a row in pixel order, int32, where the learning reads them; n, to: addresses."""
    for x in range(window):
        write_int32(to, x, np.int32(read_int16(n, place_of(x, lanes))))


@numba.njit(cache=True, nogil=True)
def turned(stripe: NDArray[np.float32], first_row: int, last_row: int, out: NDArray[np.float32]) -> None:
    """Rows first_row..last_row-1 of answers (columns, FIELDS, rows) as (FIELDS, rows, columns)."""
    columns, fields, _ = stripe.shape
    for y0 in range(first_row, last_row, 16):
        for c0 in range(0, columns, 16):
            for f in range(fields):
                for y in range(y0, min(y0 + 16, last_row)):
                    for c in range(c0, min(c0 + 16, columns)):
                        out[f, y, c] = stripe[c, f, y]
