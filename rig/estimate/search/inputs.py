"""Arrays of the search along a row: `SearchTables` go in, `RowAnswers` come out, `SearchPointers` are the addresses.

The search is a fast form of `rig.estimate.row.likelihood`, see `rig.estimate.search.rows`.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.estimate.search.closeup import Closeup
from rig.estimate.search.tables import ScreenTables
from rig.simd.memory import pointers

COUNT_LIMIT: Final = 63
"""Largest count the search works with; counts of more exposures are halved until they fit."""
EXPOSURE_PARTS: Final = 4
"""Steps per exposure: where counts are halved exposures become fractions, 65 become 32.5, 65535 become 63.999."""
FIELDS: Final = 5
"""Fields of an answer: x_px, confidence, x_sd_px, signal and haze, see `StripeTable`."""


class SearchTables(NamedTuple):
    """Inputs of the search in the rows of a sweep, fixed while the sweep lasts.

    x0: int32 (columns,), first stored pixel; window: stored pixels; limits: int16 (columns, 2, rows + LANES), first and
    last stored pixel of each search window, the first behind the last where there is none. rows: of the picture.
    ambient: float32 (bands, width padded to whole words). hot_start: int32 (words, rows + 1), for windows that begin at
    each word the first entry of each row in hot_at, int16, stored pixels whose counts say nothing, and hot_place,
    int32, their places in the counts of all rows of the picture. nominal: exposures the tables are for. faintest,
    brightest: photons of a stripe at scale 1. reach: half the line's width in px. shift: units of the scores are
    128 >> shift an octave, close_shift: of the close-up's. most: largest count. quiet_step: one column in so many
    teaches the ambient light. flux: see `count_fluxes`.
    """

    tables: ScreenTables
    closeup: Closeup
    band_rows: int
    x0: NDArray[np.int32]
    window: int
    rows: int
    limits: NDArray[np.int16]
    near_is_left: bool
    ambient: NDArray[np.float32]
    hot_start: NDArray[np.int32]
    hot_at: NDArray[np.int16]
    hot_place: NDArray[np.int32]
    nominal: np.float32
    faintest: np.float32
    brightest: np.float32
    reach: int
    shift: int
    close_shift: int
    most: int
    quiet_step: int
    flux: NDArray[np.float32]


class RowAnswers(NamedTuple):
    """Answers of a sweep, to be filled.

    stripe: float32 (columns, FIELDS, rows), NaN and confidence 0 where there is nothing. quiet: int32 (rows, PAIRS,
    lanes of the sensor + LANES, 2), ones of pixels while clearly behind a stripe, in lane order; quiet_exposures: int32
    (rows, lanes + 1), their exposures in 1/EXPOSURE_PARTS as steps up and down. light: int32, like quiet, ones of every
    pixel within the windows. The latest ones of both are still in quiet_here and light_here, uint8 (rows, PAIRS, lanes
    of the window, 2). lines: int32 (lines, window), counts of the rows that the learning reads; line_start:
    int32 (columns + 1,) and line_row: int32, the rows of each column in order.
    """

    stripe: NDArray[np.float32]
    quiet: NDArray[np.int32]
    quiet_exposures: NDArray[np.int32]
    light: NDArray[np.int32]
    quiet_here: NDArray[np.uint8]
    light_here: NDArray[np.uint8]
    lines: NDArray[np.int32]
    line_start: NDArray[np.int32]
    line_row: NDArray[np.int32]


class SearchPointers(NamedTuple):
    """Pointers (`rig.simd.memory.pointers`) to tables, answers and a thread's memory, with the sizes of their arrays.

    bands, taps: tables of a column, and pairs that a table has taps for; weight_pairs: the same of the close-up.
    lanes: of the window, sum_lanes: of the sums over the picture. limit_rows: of `limits`. ambient: that of the
    tables where they have it (several_lines), else of the bands, ambient_px wide.
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


def pointers_of(judge: SearchTables, found: RowAnswers, memory: NDArray[np.uint8]) -> SearchPointers:
    """Pointers to everything; the arrays must outlive them. memory: of a thread, see `search_memory`."""
    tables = judge.tables
    several_lines = tables.ambient.shape[0] > 0
    ambient = tables.ambient if several_lines else judge.ambient
    return SearchPointers(
        judge=pointers(judge),
        found=pointers(found),
        memory=memory.ctypes.data,
        lanes=tables.lane.shape[2],
        bands=tables.lane.shape[1],
        taps=tables.tap.shape[4],
        weight_pairs=judge.closeup.weight.shape[3],
        sum_lanes=found.light.shape[2],
        limit_rows=judge.limits.shape[2],
        ambient=ambient.ctypes.data,
        ambient_px=judge.ambient.shape[1],
        several_lines=several_lines,
    )


def count_fluxes() -> NDArray[np.float32]:
    """Photons per exposure that n ones in k exposures speak for, float32: log (k + 1/2) / (k - n + 1/2).

    Nearly unbiased, finite also at n = k. Rows are k in steps of 1/EXPOSURE_PARTS, columns n: up to one more than
    COUNT_LIMIT, since halved counts are rounded up.
    """
    parts, n = np.mgrid[: EXPOSURE_PARTS * (COUNT_LIMIT + 1), : COUNT_LIMIT + 2]
    k = parts / EXPOSURE_PARTS
    return np.log((k + 0.5) / (np.maximum(k - n, 0) + 0.5)).astype(np.float32)
