"""Compiled estimate of rows: search, close look, and what each row teaches of the light, from counters or from counts.

The same `judge_row` serves frames as they come (counters in bit planes, `search_frames`) and counts that are there
already (`search_counts`): the answers are the same bit for bit.
"""

from typing import Final, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rig.counting_kernels import CHUNK, FEW_FRAMES, PLANES, add_frames, clear
from rig.estimators.closeup_kernels import Closeup, level_of, place_line
from rig.estimators.screen_tables import Tables
from rig.estimators.search_kernels import (
    MEAN_EXCESS,
    Search,
    best_position,
    mass_of,
    none_mass,
    power,
    score_row,
    search_buffers,
    set_exposures,
)
from rig.lane_order import PAD, STEPS, halve_counts, place_of, read_counts, read_planes, sum_counts

QUIET: Final = 0.9
"""Probability within 1 px from which the pixels behind the stripe teach the ambient light."""
QUIET_STEP: Final = 8
"""Every 8th column does so where there are dark frames as well, else every one."""
COUNT_LIMIT: Final = 63
"""Largest count the search works with; counts of more exposures are halved until they fit."""
FIELDS: Final = 5
"""x_px, confidence, x_sd_px, signal, haze: see `StripeTable`."""
SIGNAL_REACH_PX: Final = 2
"""Pixels on either side whose light is the stripe's, where the line is narrower."""
NO_COLUMN: Final = -1


class Judge(NamedTuple):
    """All that is needed to judge the rows of a sweep; fixed while the sweep lasts.

    x0: int32 (columns,), first stored pixel; window: stored pixels; x_lo, x_hi: int32 (rows, columns), search windows.
    ambient: float32 (bands, width padded to whole words). hot_start: int32 (rows + 1,) and hot_x: int32, pixels of each
    row whose counts say nothing. faintest, brightest: photons of a stripe at scale 1. reach: half the line's width in
    px. shift: units of the scores are 128 >> shift an octave. quiet_step: every so manieth column teaches the ambient light.
    """

    tables: Tables
    closeup: Closeup
    band_rows: int
    x0: NDArray[np.int32]
    window: int
    x_lo: NDArray[np.int32]
    x_hi: NDArray[np.int32]
    near_is_left: bool
    ambient: NDArray[np.float32]
    hot_start: NDArray[np.int32]
    hot_x: NDArray[np.int32]
    faintest: float
    brightest: float
    reach: int
    shift: int
    quiet_step: int


class Found(NamedTuple):
    """What a sweep gives, to be filled.

    stripe: float32 (FIELDS, rows, columns), NaN and confidence 0 where there is nothing. quiet: int32 (rows, STEPS,
    lanes of the sensor and LANES more), ones of pixels while clearly behind a stripe, in lane order; quiet_exposures:
    int32 (rows, lanes + 1), their exposures as steps up and down. light: int16, like quiet, ones of every pixel within
    the windows since they were last carried to light_carried, int32. lines: int32 (lines, window), counts of the rows
    that the learning reads; line_start: int32 (columns + 1,) and line_row: int32, the rows of each column in order.
    """

    stripe: NDArray[np.float32]
    quiet: NDArray[np.int32]
    quiet_exposures: NDArray[np.int32]
    light: NDArray[np.int16]
    light_carried: NDArray[np.int32]
    lines: NDArray[np.int32]
    line_start: NDArray[np.int32]
    line_row: NDArray[np.int32]


class Bench(NamedTuple):
    """A thread's own buffers. flux: float32 (COUNT_LIMIT + 1,), photons that each count speaks for."""

    search: Search
    ambient: NDArray[np.float32]
    flux: NDArray[np.float32]


@numba.njit(cache=True, nogil=True)
def new_bench(lanes: int) -> Bench:
    """Buffers for rows of `lanes` lanes."""
    return Bench(
        search_buffers(lanes), np.zeros(lanes * STEPS, np.float32), np.zeros(COUNT_LIMIT + 1, np.float32)
    )


@numba.njit(cache=True, nogil=True)
def halvings(exposures: int) -> int:
    """How often counts of so many exposures are halved."""
    times = 0
    while (exposures >> times) > COUNT_LIMIT:
        times += 1
    return times


@numba.njit(cache=True, nogil=True)
def set_column(judge: Judge, bench: Bench, c: int, b: int, exposures: float) -> None:
    """Make ready for rows of band b of column c."""
    set_exposures(judge.tables, c, b, exposures, bench.search)
    x0 = judge.x0[c]
    for x in range(judge.window):
        bench.ambient[x] = judge.ambient[b, x0 + x]


@numba.njit(cache=True, nogil=True)
def set_flux(exposures: float, flux: NDArray[np.float32]) -> None:
    """Photons per exposure that each count speaks for: nearly unbiased, and finite also where every frame fired."""
    for n in range(flux.shape[0]):
        flux[n] = np.log((exposures + 0.5) / (max(exposures - n, 0.0) + 0.5))


@numba.njit(cache=True, nogil=True)
def mute_hot(judge: Judge, search: Search, y: int, c: int, b: int, exposures: float) -> None:
    """Give the hot pixels of row y counts that speak for no position."""
    for h in range(judge.hot_start[y], judge.hot_start[y + 1]):
        x = judge.hot_x[h]
        at = x - judge.x0[c]
        if 0 <= at < judge.window:
            # Rounded up or down as by chance, so that hot pixels lean to neither side on average.
            chance = ((x * 40503 + y * 30011 + c * 20011) & 0xFFFF) / 65536.0
            neutral = np.int16(exposures * judge.tables.neutral[c, b, at] + chance)
            search.n[place_of(search.n, at)] = neutral


@numba.njit(cache=True, nogil=True)
def judge_row(judge: Judge, bench: Bench, y: int, c: int, b: int, exposures: float, found: Found) -> None:
    """Estimate row y of column c from the counts in bench.search, made ready by `set_column`."""
    low, high = judge.x_lo[y, c] - judge.x0[c], judge.x_hi[y, c] - judge.x0[c]
    tables, search = judge.tables, bench.search
    if low > high or tables.first[c, b] > tables.last[c, b]:
        return
    if judge.hot_start[y] < judge.hot_start[y + 1]:
        mute_hot(judge, search, y, c, b, exposures)
    lanes = search.start.shape[0]
    best, all_left = score_row(tables.edge[c, b], tables.tap[c, b], search)
    x = best_position(search, best)
    near = np.float32(0.0)
    if x > 0:
        near += power(np.int64(search.score[((x - 1) % STEPS) * lanes + (x - 1) // STEPS]) - best, judge.shift)
    if x + 1 < judge.window:
        near += power(np.int64(search.score[((x + 1) % STEPS) * lanes + (x + 1) // STEPS]) - best, judge.shift)
    # The best position's own term is exactly 1, the others are too large by the same share on average.
    others = mass_of(search, best, judge.shift) - np.float32(1.0)
    others += none_mass(search, tables.none[c, b], all_left, best, judge.shift)
    confidence = (MEAN_EXCESS + near) / (MEAN_EXCESS + others)
    x = min(max(x, low, 0), high, judge.window - 1)
    light = np.float32(0.0)
    for at in range(x - judge.reach, x + judge.reach + 1):
        light += bench.flux[min(search.n[place_of(search.n, at)], COUNT_LIMIT)]
    before, ambient, scale = tables.before[c, b, x], bench.ambient[x], tables.scale[c, b, x]
    light -= np.float32(0.5) * (before + ambient) * np.float32(2 * judge.reach + 1)
    signal = min(max(light, judge.faintest * scale), judge.brightest * scale)
    offset, sd = place_line(search.n, x, exposures, level_of(before), level_of(signal), judge.closeup)
    stripe = found.stripe
    stripe[0, y, c] = judge.x0[c] + x + offset
    stripe[1, y, c] = min(confidence, np.float32(1.0))
    stripe[2, y, c] = sd
    stripe[3, y, c] = signal
    stripe[4, y, c] = max(before - ambient, np.float32(0.0))
    if confidence > QUIET and c % judge.quiet_step == 0:
        _learn_quiet(judge, search.n, y, c, x, exposures, found)


@numba.njit(cache=True, nogil=True)
def _learn_quiet(judge: Judge, n: NDArray[np.int16], y: int, c: int, x: int, exposures: float, found: Found) -> None:
    """Add the whole lanes behind the stripe at stored pixel x to the quiet counts."""
    stride = n.shape[0] // STEPS
    lane = judge.x0[c] // STEPS
    begin, end = 0, judge.window // STEPS
    if judge.near_is_left:
        begin = (x + judge.reach + 1) // STEPS + 1
    else:
        end = (x - judge.reach) // STEPS
    if begin >= end:
        return
    for s in range(STEPS):
        counts = n[s * stride + PAD + begin : s * stride + PAD + end]
        sums = found.quiet[y, s, lane + begin : lane + end]
        for i in range(counts.shape[0]):
            sums[i] += counts[i]
    found.quiet_exposures[y, lane + begin] += np.int32(exposures)
    found.quiet_exposures[y, lane + end] -= np.int32(exposures)


@numba.njit(cache=True, nogil=True)
def keep_line(n: NDArray[np.int16], y: int, c: int, found: Found) -> None:
    """Keep the counts of row y of column c where the learning reads them."""
    for i in range(found.line_start[c], found.line_start[c + 1]):
        if found.line_row[i] == y:
            line = found.lines[i]
            for x in range(line.shape[0]):
                line[x] = n[place_of(n, x)]
