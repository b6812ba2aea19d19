"""The 16-bit search against the exact row likelihood, which is what it approximates, and against whole numbers."""

from dataclasses import replace

import numba
import numpy as np
import pytest

from rig.count.lane_order import STEPS, padded_lanes, read_counts
from rig.estimate.row.em import lines_of
from rig.estimate.row.inputs import judge_line, row_buffers, state_of, sweep_of
from rig.estimate.row.likelihood import mode_of
from rig.estimate.search import prepare as judging
from rig.estimate.search import rows, stream, tables
from rig.estimate.search import scores as scores_module
from rig.estimate.search.prepare import judge_of, nothing_found, stripes_of
from rig.estimate.search.rows import COUNT_LIMIT, pointers_of, table_for
from rig.estimate.search.scores import START, score_rows
from rig.estimate.search.stream import search_counts, search_volume
from rig.estimate.search.tables import BATCH, search_in, search_memory
from rig.simd.memory import read_int16
from rig.threads import RowWorkers
from tests.reference.geometry import Geometry
from tests.stability.inventory import covers
from tests.unit.small_maps import geometry_of, learned_from, simulated, volume_of

pytestmark = pytest.mark.slow

covers(scores_module, rows, tables, judging, stream)

WORKERS = RowWorkers(1)
SURE = 0.6
"""Confidence from which two ways to the same answer must agree."""
NEAR_PX = 1.2
"""A neighbouring pixel and a sub-pixel offset: answers as near as this are the same one."""


def searched(volume, geometry, learned, exposures=None):
    """Fields of the stripe table (5, rows, columns) by the search; exposures: what it is made ready for."""
    exposures = int(np.median(volume.n_frames)) if exposures is None else exposures
    judge = judge_of(learned, geometry, exposures, WORKERS, dark=False)
    found = nothing_found(geometry, None)
    bench = search_memory(padded_lanes(geometry.window))
    search_counts(volume.counts, volume.n_frames, pointers_of(judge, found, bench), 0, geometry.rows)
    table = stripes_of(found, judge, WORKERS)
    return np.stack([table.x_px, table.confidence, table.x_sd_px, table.signal, table.haze])


def exact(volume, geometry, learned):
    """Mode and probability within 1 px (rows, columns) of the exact posterior, NaN and 0 where nothing is searched."""
    rows, columns = geometry.x_lo.shape
    x, confidence = np.full((rows, columns), np.nan), np.zeros((rows, columns))
    y, c = (a.astype(np.int32) for a in np.nonzero(geometry.x_lo <= geometry.x_hi))
    lines = lines_of(volume, (y, c))
    sweep, state = sweep_of(geometry), state_of(learned)
    row = row_buffers(geometry.window, len(learned.amplitude))
    step = 1 if geometry.near_is_left else -1
    for i in range(len(y)):
        length, first, last, start, *_ = judge_line(sweep, state, row, lines, i)
        if length:
            mode, confidence[y[i], c[i]] = mode_of(row.posterior, first, last)
            x[y[i], c[i]] = start + step * mode
    return x, confidence


def agreement(volume, geometry, learned, near_px=NEAR_PX):
    """Share of the rows that the exact posterior is sure of with the same answer, the other way round, and the
    differences of confidence where the answers are the same."""
    found, (x, confidence) = searched(volume, geometry, learned), exact(volume, geometry, learned)
    same = np.abs(found[0] - x) <= near_px
    sure, also = confidence > SURE, found[1] > SURE
    return same[sure].mean(), same[also].mean(), (found[1] - confidence)[sure & same]


@pytest.mark.parametrize(
    ("light", "exposures", "rig", "sigma_px"),
    [("report", 1, "left", 0.6), ("report", 10, "turned", 0.6), ("dense", 10, "right", 0.6),
     ("clear", 100, "left", 0.6), ("report", 10, "left", 1.8)],
)  # fmt: skip
def test_sure_answers_are_those_of_the_exact_likelihood(light, exposures, rig, sigma_px):
    sweep, learned = simulated(light, exposures, rig), replace(learned_from(light, 10, rig), line_sigma_px=sigma_px)
    # The middle of so wide a line is not known to the pixel.
    sure, also, difference = agreement(sweep.volume, sweep.geometry, learned, NEAR_PX + (sigma_px > 1))
    assert also > 0.985
    if exposures > COUNT_LIMIT:
        # Halved counts say less, but nothing else.
        assert sure > 0.95
        assert difference.mean() < 0.01
    else:
        assert sure > 0.985
        assert abs(difference.mean()) < 0.04
        assert np.abs(difference).mean() < (0.04 if sigma_px < 1 else 0.065)


@numba.njit
def compiled_scores(desk, c, band, counts, exposures, out, lane, constant):
    """The search's own scores (rows, STEPS, lanes) of counts (rows, window), and the constants that it used."""
    search = search_in(desk.memory, desk.lanes)
    table = table_for(desk, search, c, band, exposures)
    for r in range(counts.shape[0]):
        read_counts(counts[r], 0, search.n + r * search.n_bytes, search.lanes)
    score_rows(table, desk.taps - 1, search, counts.shape[0])
    for r in range(counts.shape[0]):
        for i in range(STEPS * desk.lanes):
            out[r, i] = read_int16(search.score + r * search.score_bytes, i)
    for i in range(desk.lanes):
        lane[i] = read_int16(search.lane, i)
    for i in range(2 * STEPS * desk.lanes):
        constant[i] = read_int16(table.constant, i)


def scores(judge, c, band, counts, exposures):
    """Scores (rows, pixels) of the search for rows of counts (rows, window), and those of whole numbers without limits.

    Also whether all that goes into the latter stays within 16 bits.
    """
    tables = judge.tables
    lanes = tables.lane.shape[2]
    bench, found = search_memory(lanes), nothing_found(simulated().geometry, None)
    desk = pointers_of(judge, found, bench)
    raw, lane, constant = (np.zeros(n, np.int16) for n in (len(counts) * STEPS * lanes, lanes, 2 * STEPS * lanes))
    compiled_scores(desk, c, band, counts, np.float32(exposures), raw.reshape(len(counts), -1), lane, constant)

    def pixels(a):
        """Numbers (..., STEPS * lanes) in pixel order, 64 bits."""
        return a.reshape(*a.shape[:-1], STEPS, lanes).swapaxes(-1, -2).reshape(*a.shape[:-1], -1).astype(np.int64)

    found = pixels(raw.reshape(len(counts), -1))
    constant, lane = pixels(constant.reshape(2, -1)), lane.astype(np.int64)
    # However many lanes: their sum is the table's, rounded once.
    drift = np.cumsum(lane) - exposures * tables.lane[c, band].astype(np.float64)
    assert np.abs(drift).max() < 1.0 or np.abs(lane).max() >= 32000
    edge = tables.edge[c, band].transpose(1, 0, 2).reshape(-1).astype(np.int64)
    tap = tables.tap[c, band].astype(np.int64)
    reach = tap.shape[2] - 1
    wanted, inside = np.empty_like(found), np.empty(found.shape, bool)
    pad = 2 * (reach + 2)
    for r, row in enumerate(counts):
        n = np.zeros(STEPS * lanes + 2 * pad, np.int64)
        n[pad : pad + len(row)] = row
        own = n[pad : pad + STEPS * lanes]
        of_pixel = own * edge
        of_lane = of_pixel.reshape(lanes, STEPS)
        rises = of_lane.sum(axis=1) + lane
        within = np.cumsum(of_lane, axis=1) - of_lane
        # The level of the pair: what the odd pixel adds stands in its taps.
        level_in = np.repeat(within[:, ::2], 2, axis=1)
        assert np.abs(of_lane.sum(axis=1)).max() < 32768
        through = np.append(0, np.cumsum(rises))
        level = START + through[:-1, None] + level_in
        kept = np.maximum.accumulate(through) - np.minimum.accumulate(through) < 32767
        kept &= np.logical_and.accumulate(np.abs(START + through) < 32767)
        kept[1:] &= np.abs(rises) < 32768
        taps = np.zeros((2, STEPS * lanes), np.int64)
        for x in range(STEPS * lanes):
            s, i = x % STEPS, x // STEPS
            first = 2 * (x // 2 + ((s - reach) // 2 - s // 2)) + pad
            pairs = n[first : first + 2 * (reach + 1)].reshape(reach + 1, 2)
            taps[:, x] = (tap[:, s, :, i] * pairs).sum(axis=(1, 2))
        assert np.abs(taps).max() < 32768
        wanted[r] = level.ravel() + (taps + constant).max(axis=0)
        # Positions that are not searched have a constant of -32000: they only must not win.
        inside[r] = np.repeat(kept[:-1], STEPS) & (np.abs(level.ravel()) < 32767) & (constant > -31000).all(axis=0)
    return found, wanted, inside


def judged_rows(rig, exposures, light="report"):
    geometry = simulated(light, rig=rig).geometry
    judge = judge_of(learned_from(light, 10, rig), geometry, exposures, WORKERS, dark=False)
    return judge, geometry


def hard_rows(rng, window, exposures):
    """Dark, full, random, alternating and half-full rows."""
    rows = rng.integers(0, exposures + 1, (BATCH, window))
    rows[0], rows[1] = 0, exposures
    rows[2] = exposures * (np.arange(window) % 2)
    rows[3] = exposures * (np.arange(window) < window // 2)
    rows[4] = exposures * (np.arange(window) >= window // 2)
    rows[5] = exposures * (rng.random(window) < 0.05)
    return rows.astype(np.uint16)


@pytest.mark.parametrize(
    ("light", "rig", "exposures"),
    [
        ("report", "left", 1),
        pytest.param("dense", "turned", 63, marks=pytest.mark.long),
        pytest.param("clear", "right", 63, marks=pytest.mark.long),
    ],
)
def test_scores_of_any_counts_are_sums_of_whole_numbers_and_stop_at_the_limits(light, rig, exposures):
    judge, geometry = judged_rows(rig, exposures, light)
    rng = np.random.default_rng(exposures)
    checked = 0
    for c in range(0, geometry.columns, 31):
        for band in range(judge.tables.lane.shape[1]):
            found, wanted, inside = scores(judge, c, band, hard_rows(rng, judge.window, exposures), exposures)
            np.testing.assert_array_equal(found[inside], np.clip(wanted, -32768, 32767)[inside])
            checked += inside.sum()
    assert checked > 1000


EXTREMES = {
    "dark": {"ambient": 1e-6, "haze": 1e-6},
    "daylight": {"ambient": 5.0, "haze": 1.0},
    "thick": {"haze": 50.0},
    "blinding": {"light": 100.0},
    "faint": {"light": 1e-4},
    "wide line": {"sigma": 2.4},
    "narrow line": {"sigma": 0.25},
}


@pytest.mark.parametrize("name", EXTREMES)
def test_extreme_models_neither_wrap_round_nor_leave_the_numbers(name):
    rig = "left"
    change, base, sweep = EXTREMES[name], learned_from(rig=rig), simulated(rig=rig)
    profile = base.profile.copy()
    profile[:, :2] *= np.float32(change.get("haze", 1.0))
    learned = replace(
        base, profile=profile, amplitude=base.amplitude * np.float32(change.get("light", 1.0)),
        ambient=np.full_like(base.ambient, change["ambient"]) if "ambient" in change else base.ambient,
        line_sigma_px=change.get("sigma", base.line_sigma_px),
    )  # fmt: skip
    rng = np.random.default_rng(1)
    for exposures in (1, 63):
        judge = judge_of(learned, sweep.geometry, exposures, WORKERS, dark=False)
        for c in range(0, sweep.geometry.columns, 31):
            found, wanted, inside = scores(judge, c, 0, hard_rows(rng, judge.window, exposures), exposures)
            np.testing.assert_array_equal(found[inside], np.clip(wanted, -32768, 32767)[inside])
        stripe = searched(
            volume_of(simulated("report", exposures, rig).counts, sweep.geometry, exposures), sweep.geometry, learned
        )
        assert np.isfinite(stripe[:, sweep.geometry.x_lo <= sweep.geometry.x_hi]).all()


def stored(geometry, window, depth_range_m):
    """The geometry with windows of so many pixels, of which those in a smaller depth range are searched."""
    part = geometry_of(Geometry.build(width=512, height=geometry.rows, columns=geometry.columns), depth_range_m)
    low = np.where(part.x_lo <= part.x_hi, part.x_lo, geometry.width).min(axis=0)
    x0 = np.clip(low // 64 * 64, 0, geometry.width - window).astype(np.int32)
    return replace(part, x0=x0, window=window)


@pytest.mark.parametrize(("window", "exposures"), [(64, 10), (192, 1), (448, 10)])
def test_windows_of_any_size_are_searched_as_exactly(window, exposures):
    sweep, learned = simulated(exposures=exposures), learned_from()
    geometry = stored(sweep.geometry, window, (3.0, 4.0))
    sure, also, difference = agreement(volume_of(sweep.counts, geometry, exposures), geometry, learned)
    assert min(sure, also) > 0.985
    assert abs(difference.mean()) < 0.04
    assert np.abs(difference).mean() < 0.04


def test_halved_counts_keep_their_light():
    """65 exposures become 32.5: half an exposure left out would make pixels behind the stripe 1.6 % too bright."""
    exposures = 65
    size = {"rows": 64, "columns": 128}
    sweep, learned = simulated("report", exposures, **size), learned_from("report", exposures, **size)
    judge = judge_of(learned, sweep.geometry, exposures, WORKERS, dark=False)
    ones, lit = search_volume(sweep.volume, sweep.geometry, judge, WORKERS)[1]
    assert ones.sum() / lit.sum() == pytest.approx(-np.expm1(-sweep.point.light.ambient), rel=0.006)
