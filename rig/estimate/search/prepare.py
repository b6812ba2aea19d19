"""Makes the tables of the search along a row: a fast form of `rig.estimate.row.likelihood`, tested against it.

They are made per column and band of rows, from a model and a geometry. This module decides how many rows share a table
(`rows_of_band`). It also chooses the unit of likelihood, and the exposures above which counts are halved, so that no
16-bit sum overflows (`judge_of`). tests/unit/rig/estimate/search/test_prepare.py checks those bounds.
"""

from typing import Any

import numpy as np

from rig.count.lane_order import PAIRS, STEPS, padded_lanes, pair_bytes, pixel_order, places_of
from rig.estimate.row.inputs import TABLE, RowState, Sweep, state_of, sweep_of
from rig.estimate.row.model import RowModel
from rig.estimate.search.closeup import closeup_tables, label_weights, largest_score
from rig.estimate.search.rows import (
    COUNT_LIMIT,
    EXPOSURE_PARTS,
    FIELDS,
    QUIET_STEP,
    SIGNAL_REACH_PX,
    RowAnswers,
    SearchTables,
    count_fluxes,
    halvings,
    turned,
)
from rig.estimate.search.tables import NONE, SCREENS, WEIGHT_LIMIT, ScreenTables, fill_tables
from rig.geometry.stripe_table import StripeTable
from rig.geometry.windows import WORD_PX, SweepGeometry
from rig.simd import Bools, Float32, Float64, Int16, Int32
from rig.simd.memory import aligned_zeros
from rig.simd.vectors import LANES
from rig.threads import RowWorkers

BAND_ROWS = (64, 32, 16, 8, 4)
"""Numbers of rows that may share a table: `rows_of_band` takes the largest for which the line hardly shifts."""
BAND_SHEAR_PX = 1
TAP_SHARE = 0.06
"""Least share of the line in a pixel that is read to score a position."""
SCORE_LIMIT = 12500
"""Largest sum of taps times counts: less than half the range of 16 bits, so that the sum of two does not wrap round."""
MOST_HALVINGS = 6
CLOSE_SHIFT = 3
"""Weights of the close-up have 128 >> 3 = 16 units an octave, or fewer: 8 bits then reach 8 octaves."""
CLOSE_LIMIT = 60000
"""Largest sum of a label's weights in units, each times the largest count. It may exceed the range of 16 bits, in which
sums saturate, since no line fills all pixels."""
LOOKED_AT = 32
"""Number of columns from whose weights the unit for all columns is chosen."""
ROUGH_UNITS = 4.0
"""Units per octave with which no weight reaches its limit: a logit is between -11 and 11 octaves."""
CUT = 1.25
"""Factor by which the largest weights may exceed WEIGHT_LIMIT. They are then cut to it."""
FRAMES_OVER_TWICE = 8
"""A column may have this many frames more than twice the nominal number before its counts are halved."""
HOT_FACTOR, HOT_FLUX = 4.0, 0.02
"""A pixel is hot for the search if its ambient light exceeds HOT_FACTOR times the band's plus HOT_FLUX photons."""
LEAST_VEIL = 0.1
"""Ratio of haze to ambient light above which other lines' haze is tabled. There is then no close-up."""


def judge_of(
    model: RowModel, geometry: SweepGeometry, exposures: int, workers: RowWorkers, *, dark: bool
) -> SearchTables:
    """All tables that the search needs to judge a sweep under `model`, for columns of about `exposures` frames.

    dark: whether the sweep has dark frames; fewer columns are then needed to learn the ambient light.
    """
    band_rows = rows_of_band(geometry)
    sweep, state = _banded(sweep_of(geometry), state_of(model), band_rows)
    light, log_share = _lights(model)
    reach = _taps(state.psi)
    bands, columns = state.ambient.shape[0], geometry.columns
    veil = geometry.others is not None and model.profile[:, 0].max() > LEAST_VEIL * np.median(model.ambient)
    tables = _empty_tables(columns, bands, padded_lanes(geometry.window), reach, others=bool(veil))
    most = min(2 * exposures + FRAMES_OVER_TWICE, COUNT_LIMIT)
    nominal = exposures / 2.0 ** halvings(exposures, most)
    largest_sum, largest = _largest(sweep, state, light, reach)
    for shift in range(MOST_HALVINGS + 1):
        units = 128 >> shift
        if most * largest_sum * units <= SCORE_LIMIT and largest * units <= CUT * WEIGHT_LIMIT:
            break

    def work(first: int, last: int) -> None:
        fill_tables(sweep, state, light, log_share, float(128 >> shift), nominal, first, last, tables)

    workers.over(bands, work)
    haze, rest = model.profile[:, 0], model.profile[:, 1]
    share = float(rest.sum() / max(haze.sum(), 1e-9))
    weight, constant = label_weights(float(np.median(state.ambient)), share, geometry.near_is_left, state.fine, TABLE)
    close_shift = next(
        i for i in range(CLOSE_SHIFT, MOST_HALVINGS + 1)
        if most * largest_score(weight, 128 >> i) <= CLOSE_LIMIT or i == MOST_HALVINGS
    )  # fmt: skip
    closeup = closeup_tables(weight, constant, 128 >> close_shift)
    expected = np.repeat(state.ambient, band_rows, axis=0)[: geometry.rows]
    hot_start, hot_at, hot_place = _hot_of_windows(model.ambient > HOT_FACTOR * expected + HOT_FLUX, geometry)
    padded = np.zeros((bands, int(geometry.x0.max(initial=0)) + geometry.window), np.float32)
    padded[:, : geometry.width] = state.ambient[:, : padded.shape[1]]
    return SearchTables(
        tables=tables, closeup=closeup, band_rows=band_rows, x0=geometry.x0, window=geometry.window, rows=geometry.rows,
        limits=_limits(geometry), near_is_left=geometry.near_is_left, ambient=padded, hot_start=hot_start,
        hot_at=hot_at, hot_place=hot_place, nominal=np.float32(nominal), faintest=np.float32(model.amplitude[0]),
        brightest=np.float32(model.amplitude[-1]), reach=signal_reach(state.psi), shift=shift,
        close_shift=close_shift, most=most, quiet_step=QUIET_STEP if dark else 1, flux=count_fluxes(),
    )  # fmt: skip


def _taps(psi: Float32) -> int:
    """Pixels on either side of a line's centre that are read to score a position. psi: see `row_scores`."""
    return max(1, int(np.count_nonzero(psi[1:] > TAP_SHARE)))


def signal_reach(psi: Float32) -> int:
    """Pixels on either side of a line's centre whose light is summed as the stripe's."""
    return max(SIGNAL_REACH_PX, _taps(psi))


def _hot_of_windows(hot: Bools, geometry: SweepGeometry) -> tuple[Int32, Int16, Int32]:
    """hot_start, hot_at and hot_place of `SearchTables`; hot: (rows, width)."""
    lanes, rows = padded_lanes(geometry.window), geometry.rows
    starts, at, places = [], [np.zeros(0, np.int16)], [np.zeros(0, np.int32)]
    before = 0
    for x0 in range(0, int(geometry.x0.max(initial=0)) + 1, WORD_PX):
        # Hot pixels of windows that no column has are left out.
        inside = hot[:, x0 : x0 + geometry.window] if x0 in geometry.x0 else hot[:, :0]
        y, x = (np.ascontiguousarray(index) for index in np.nonzero(inside))  # or another kernel would be compiled
        starts.append(before + np.searchsorted(y, np.arange(rows + 1)))
        at.append(x.astype(np.int16))
        places.append(PAIRS * pair_bytes(lanes) * y.astype(np.int32) + places_of(x, lanes))
        before += len(y)
    return np.array(starts, np.int32), np.concatenate(at), np.concatenate(places)


def nothing_found(geometry: SweepGeometry, lines: tuple[Int32, Int32] | None) -> RowAnswers:
    """Empty results of a sweep; lines: (rows, columns) whose counts are to be kept, sorted by column; None: none."""
    rows, columns = geometry.rows, geometry.columns
    lanes = -(-geometry.width // WORD_PX) * WORD_PX // STEPS + LANES
    stripe = np.full((columns, FIELDS, rows), np.nan, np.float32)
    stripe[:, 1] = 0.0
    line_row, line_column = (np.zeros(0, np.int32),) * 2 if lines is None else lines
    return RowAnswers(
        stripe=stripe, quiet=np.zeros((rows, PAIRS, lanes, 2), np.int32),
        quiet_exposures=np.zeros((rows, lanes + 1), np.int32), light=np.zeros((rows, PAIRS, lanes, 2), np.int32),
        quiet_here=aligned_zeros((rows, PAIRS, padded_lanes(geometry.window), 2), np.uint8),
        light_here=aligned_zeros((rows, PAIRS, padded_lanes(geometry.window), 2), np.uint8),
        lines=np.zeros((len(line_row), geometry.window), np.int32),
        line_start=np.searchsorted(line_column, np.arange(columns + 1)).astype(np.int32),
        line_row=np.ascontiguousarray(line_row),
    )  # fmt: skip


def clear_found(found: RowAnswers) -> None:
    """Reset `found` to the state in which `nothing_found` returns it."""
    found.stripe.fill(np.nan)
    found.stripe[:, 1] = 0.0
    for sums in (found.quiet, found.quiet_exposures, found.light, found.quiet_here, found.light_here, found.lines):
        sums.fill(0)


def stripes_of(found: RowAnswers, judge: SearchTables, workers: RowWorkers) -> StripeTable:
    """The stripe table of a sweep that was judged with `judge`."""
    columns, fields, rows = found.stripe.shape
    out = np.empty((fields, rows, columns), np.float32)
    workers.over(rows, lambda first, last: turned(found.stripe, judge.limits, first, last, out))
    return StripeTable(*out)


def quiet_of(found: RowAnswers, width: int) -> Float64:
    """Ones and exposures of pixels while clearly behind a stripe, float64 (2, rows, width). Halved counts are added
    with halved exposures."""
    exposures = np.repeat(np.cumsum(found.quiet_exposures[:, :-1], axis=1), STEPS, axis=1)[:, :width]
    return np.stack([pixel_order(found.quiet, width), exposures / EXPOSURE_PARTS])


def _limits(geometry: SweepGeometry) -> Int16:
    low = np.maximum(geometry.x_lo - geometry.x0, 0)
    high = np.minimum(geometry.x_hi - geometry.x0, geometry.window - 1)
    limits = np.zeros((geometry.columns, 2, geometry.rows + LANES), np.int16)
    limits[:, 0] = 1
    both = np.where(geometry.x_lo <= geometry.x_hi, np.stack([low, high]), [[[1]], [[0]]])
    limits[:, :, : geometry.rows] = both.transpose(2, 0, 1)
    return limits


def rows_of_band(geometry: SweepGeometry) -> int:
    """The largest of BAND_ROWS over which 99 % of windows shift by at most BAND_SHEAR_PX; else the smallest."""
    inside = (geometry.x_lo <= geometry.x_hi) & (geometry.x_lo > 0) & (geometry.x_hi < geometry.width - 1)
    for rows in BAND_ROWS:
        first = np.arange(0, geometry.rows, rows)
        last = np.minimum(first + rows, geometry.rows) - 1
        both = inside[first] & inside[last]
        shear = np.abs(geometry.x_lo[first] - geometry.x_lo[last])
        if not both.any() or np.percentile(shear[both], 99) <= BAND_SHEAR_PX:
            return rows
    return BAND_ROWS[-1]


def _lights(model: RowModel) -> tuple[Float32, Float32]:
    """Amplitudes of the search, geometric means of the dim and the bright half of the learned ones, and the logarithm
    of each half's probability."""
    log_q, weight = np.log(model.amplitude.astype(np.float64)), np.maximum(model.weight, 1e-6)
    halves = np.array_split(np.arange(len(log_q)), SCREENS)
    shares = np.array([weight[half].sum() for half in halves])
    means = np.array([(log_q[half] * weight[half]).sum() for half in halves]) / shares
    return np.exp(means).astype(np.float32), np.log(shares).astype(np.float32)


def _banded(sweep: Sweep, state: RowState, band_rows: int) -> tuple[Sweep, RowState]:
    """Sweep and state with one row per band: rays of the middle row, union of windows, mean ambient light and gain."""
    rows = sweep.u.shape[0]
    first = np.arange(0, rows, band_rows)
    middle = np.minimum(first + band_rows // 2, rows - 1)
    seen = sweep.x_lo <= sweep.x_hi
    x_lo = np.minimum.reduceat(np.where(seen, sweep.x_lo, np.iinfo(np.int32).max), first, axis=0)
    x_hi = np.maximum.reduceat(np.where(seen, sweep.x_hi, -1), first, axis=0)
    ambient = np.stack([_usual_mean(state.ambient[a : a + band_rows]) for a in first])
    gain = np.add.reduceat(state.row_gain, first) / np.diff(np.append(first, rows))
    return (
        sweep._replace(
            u=np.ascontiguousarray(sweep.u[middle]), v=np.ascontiguousarray(sweep.v[middle]),
            x_lo=x_lo.astype(np.int32), x_hi=x_hi.astype(np.int32),
        ),
        state._replace(ambient=ambient, row_gain=gain.astype(np.float32)),
    )  # fmt: skip


def _usual_mean(ambient: Float32) -> Float32:
    """Mean (width,) of ambient light (rows, width) over the rows on which a pixel is not hot."""
    usual = ambient <= HOT_FACTOR * np.median(ambient, axis=0) + HOT_FLUX
    return np.asarray((np.where(usual, ambient, 0.0).sum(0) / usual.sum(0)).astype(np.float32))


def _empty_tables(columns: int, bands: int, lanes: int, reach: int, *, others: bool = False) -> ScreenTables:
    pixels = lanes * STEPS

    def of(*shape: int, dtype: type = np.float32) -> Any:
        return aligned_zeros((columns, bands, *shape), dtype)

    return ScreenTables(
        edge=of(PAIRS, lanes, 2, dtype=np.int8), tap=of(SCREENS, STEPS, reach + 1, lanes, 2, dtype=np.int8),
        position=of(SCREENS, pixels, dtype=np.int16), slope=of(SCREENS, pixels, dtype=np.int16), lane=of(lanes),
        none=of(NONE), neutral=of(pixels), before=of(pixels), scale=of(pixels), first=of(dtype=np.int32),
        last=of(dtype=np.int32), ambient=of(pixels) if others else aligned_zeros((0, bands, pixels), np.float32),
    )  # fmt: skip


def _largest(sweep: Sweep, state: RowState, light: Float32, reach: int) -> tuple[float, float]:
    """Two magnitudes in octaves (factors of two of likelihood), from the tables of the middle band of some columns.

    The first is the largest sum of a position's taps, or half the largest sum of a lane's edge weights if that is more.
    The second is the largest tap. All are absolute values.
    """
    columns = np.unique(np.linspace(0, sweep.plane.shape[0] - 1, LOOKED_AT).astype(np.int64))
    middle = slice(sweep.u.shape[0] // 2, sweep.u.shape[0] // 2 + 1)
    x_lo, x_hi = (np.ascontiguousarray(x[middle, columns]) for x in (sweep.x_lo, sweep.x_hi))
    few = sweep._replace(
        x0=sweep.x0[columns], plane=sweep.plane[columns], x_lo=x_lo, x_hi=x_hi, u=sweep.u[middle], v=sweep.v[middle],
        others=sweep.others[columns],
    )  # fmt: skip
    part = state._replace(
        ambient=state.ambient[middle], row_gain=state.row_gain[middle], column_gain=state.column_gain[columns]
    )
    tables = _empty_tables(len(columns), 1, padded_lanes(sweep.window), reach)
    fill_tables(few, part, light, np.zeros(SCREENS, np.float32), ROUGH_UNITS, 1.0, 0, 1, tables)
    tap, edge = np.abs(tables.tap.astype(np.int64)), np.abs(tables.edge.astype(np.int64))
    taps = tap.sum(axis=(4, 6)).max(initial=1)
    edges = edge.sum(axis=(2, 4)).max(initial=1)
    return float(max(taps, edges / 2)) / ROUGH_UNITS, float(tap.max(initial=1)) / ROUGH_UNITS
