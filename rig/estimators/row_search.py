"""Compiled estimate of one row: search, close look, and what the row teaches of the ambient light."""

from typing import Final, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rig.estimators.closeup_kernels import Closeup, level_of, place_line
from rig.estimators.screen_tables import STEPS, Tables
from rig.estimators.search_kernels import (
    MEAN_EXCESS,
    PAD,
    START,
    Search,
    best_position,
    mass_of,
    none_mass,
    power,
    read_counts,
    score_row,
    search_buffers,
    set_exposures,
)

QUIET: Final = 0.9
"""Probability within 1 px from which the pixels behind the stripe teach the ambient light."""
QUIET_STEP: Final = 4
"""Every 4th column does so."""
COUNT_LIMIT: Final = 255
"""Largest count the search works with; more exposures are divided by a power of two."""
FIELDS: Final = 5
"""x_px, confidence, x_sd_px, signal, haze: see `StripeTable`."""


class Search0(NamedTuple):
    pass


@numba.njit(cache=True, nogil=True)
def count_flux(exposures: float, flux: NDArray[np.float32]) -> None:
    """Photons per exposure that each count from 0 on speaks for, nearly unbiased and finite; flux: (n,) to be filled."""
    for n in range(flux.shape[0]):
        flux[n] = np.log((exposures + 0.5) / (max(exposures - n, 0.0) + 0.5))


@numba.njit(cache=True, nogil=True)
def judge_counts(
    search: Search,
    tables: Tables,
    closeup: Closeup,
    c: int,
    b: int,
    exposures: float,
    flux: NDArray[np.float32],
    ambient: NDArray[np.float32],
    brightest: float,
    faintest: float,
    reach: int,
    shift: int,
    low: int,
    high: int,
    x0: int,
    near_is_left: bool,
    answer: NDArray[np.float32],
) -> int:
    """Estimate the row in search.n with table (c, b), whose constants are set; returns the stored pixel found.

    answer: (FIELDS,) is filled. flux: see `count_flux`. ambient: (P,) of the band in stored pixels. low, high: first and
    last stored pixel that the row itself allows.
    """
    lanes = search.start.shape[0]
    stride = lanes + 2 * PAD
    best, all_left = score_row(tables.edge[c, b], tables.tap[c, b], search)
    x = best_position(search, best)
    mass = np.float32(1.0) + (mass_of(search, best, shift) - np.float32(1.0)) / MEAN_EXCESS
    none = none_mass(search, tables.none[c, b], all_left, best, shift) / MEAN_EXCESS
    near = np.float32(1.0)
    for at in (x - 1, x + 1):
        if 0 <= at < lanes * STEPS:
            near += power(np.int64(search.score[(at % STEPS) * lanes + at // STEPS]) - best, shift) / MEAN_EXCESS
    x = min(max(x, low), high)
    light = np.float32(0.0)
    for d in range(-reach, reach + 1):
        at = x + d
        count = np.int64(search.n[(at % STEPS) * stride + PAD + at // STEPS])
        light += flux[min(count, flux.shape[0] - 1)]
    before = tables.before[c, b, x]
    base = np.float32(0.5) * (before + ambient[x]) * np.float32(2 * reach + 1)
    scale = tables.scale[c, b, x]
    signal = min(max(light - base, faintest * scale), brightest * scale)
    offset, sd = place_line(search, x, exposures, level_of(before), level_of(signal), closeup)
    answer[0] = x0 + x + offset
    answer[1] = min(near / (mass + none), np.float32(1.0))
    answer[2] = sd
    answer[3] = signal
    answer[4] = max(before - ambient[x], np.float32(0.0))
    return x


@numba.njit(cache=True, nogil=True)
def search_volume(
    counts: NDArray[np.unsignedinteger],
    n_frames: NDArray[np.int32],
    x0: NDArray[np.int32],
    x_lo: NDArray[np.int32],
    x_hi: NDArray[np.int32],
    near_is_left: bool,
    tables: Tables,
    closeup: Closeup,
    ambient: NDArray[np.float32],
    hot_start: NDArray[np.int32],
    hot_x: NDArray[np.int32],
    light: NDArray[np.float32],
    reach: int,
    shift: int,
    band_rows: int,
    first_row: int,
    last_row: int,
    out: NDArray[np.float32],
    quiet: NDArray[np.uint32],
) -> None:
    columns, rows, window = counts.shape
    lanes = tables.lane.shape[2]
    stride = lanes + 2 * PAD
    search = search_buffers(lanes)
    band_ambient = np.zeros(lanes * STEPS, np.float32)
    answer = np.empty(FIELDS, np.float32)
    flux = np.empty(COUNT_LIMIT + 1, np.float32)
    for c in range(columns):
        k = n_frames[c]
        if k == 0:
            continue
        halvings = 0
        while (k >> halvings) > COUNT_LIMIT:
            halvings += 1
        exposures = np.float32(k / 2.0**halvings)
        count_flux(exposures, flux)
        for y in range(first_row, last_row):
            b = y // band_rows
            if y == first_row or y % band_rows == 0:
                set_exposures(tables, c, b, exposures, search)
                stored = min(window, ambient.shape[1] - x0[c])
                band_ambient[:stored] = ambient[b, x0[c] : x0[c] + stored]
            if x_lo[y, c] > x_hi[y, c] or tables.first[c, b] > tables.last[c, b]:
                continue
            read_counts(counts[c, y], halvings, search)
            for h in range(hot_start[y], hot_start[y + 1]):
                at = hot_x[h] - x0[c]
                if 0 <= at < window:
                    neutral = exposures * tables.neutral[c, b, at]
                    # Rounded up or down by chance, so that hot pixels lean to neither side on average.
                    chance = ((hot_x[h] * 40503 + y * 30011 + c * 20011) & 0xFFFF) / 65536.0
                    search.n[(at % STEPS) * stride + PAD + at // STEPS] = np.int16(neutral + chance)
            x = judge_counts(
                search, tables, closeup, c, b, exposures, flux, band_ambient, light[1], light[0], reach, shift,
                max(x_lo[y, c] - x0[c], 0), min(x_hi[y, c] - x0[c], window - 1), x0[c], near_is_left, answer,
            )
            for i in range(FIELDS):
                out[i, y, c] = answer[i]
            if answer[1] > QUIET and c % QUIET_STEP == 0:
                begin = x + reach + 2 if near_is_left else 0
                end = min(window, quiet.shape[2] - x0[c]) if near_is_left else x - reach - 1
                for at in range(begin, end):
                    quiet[0, y, x0[c] + at] += np.uint32(counts[c, y, at])
                    quiet[1, y, x0[c] + at] += np.uint32(k)
