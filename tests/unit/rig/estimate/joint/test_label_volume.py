"""The 16-bit label costs against their specification, `rig.estimate.row.likelihood`, row by row."""

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from rig.estimate.joint.labels import cost_rows, costs, grid, tables
from rig.estimate.joint.labels.cost_rows import COST_LIMIT, COUNT_BITS, EXCLUDED, _times
from rig.estimate.joint.labels.costs import SHARP, _lights, costs_of, hot_in_bands
from rig.estimate.joint.labels.grid import BAND_ROWS, PER_PX, label_grid
from rig.estimate.row.inputs import TABLE, row_buffers, row_fluxes, state_of, sweep_of
from rig.estimate.row.likelihood import add_evidence, row_scores
from rig.estimate.row.model import BINS, RowModel, pixel_shares, stripe_scale
from rig.simd.memory import pointers
from rig.threads import RowWorkers
from tests.stability.inventory import covers
from tests.unit.small_maps import simulated, volume_of

covers(grid, tables, costs, cost_rows)

WORKERS = RowWorkers(1)
ROWS, COLUMNS = 20, 48
FINE = 8
"""Steps of a pixel that positions are rounded to."""
SEEN = 80
"""Costs up to which they must be right: what costs more is not chosen."""


@cache
def sweep(rig="left", exposures=10, light="report", rows=ROWS):
    return simulated(light, exposures, rig, rows=rows, columns=COLUMNS)


def known_model(geometry, *, haze=0.14, ambient=0.005, sigma_px=0.6) -> RowModel:
    """About the light of the yardstick's report."""
    near_m, far_m = geometry.depth_range_m
    w_lo, w_hi = 0.6 / far_m, 1.15 / near_m
    per_w = (BINS - 1) / (w_hi - w_lo)
    path_m = 1.0 / (w_lo + np.arange(BINS) / per_w)
    columns = [haze * np.exp(-0.1 * (path_m - 1.5)), np.full(BINS, 0.02 * haze), stripe_scale(path_m, 0.05),
               np.zeros(BINS)]  # fmt: skip
    return RowModel(
        np.stack(columns, 1).astype(np.float32), w_lo, per_w, np.ones(geometry.rows, np.float32),
        np.ones(geometry.columns, np.float32), np.full((geometry.rows, geometry.width), ambient, np.float32),
        np.array([0.2, 0.6, 1.8, 5.0], np.float32), np.array([0.2, 0.3, 0.3, 0.2]), 0.02, sigma_px, 0.05, 0.01,
    )  # fmt: skip


def filled(model, geometry, volume, exposures, pieces=1):
    grid = label_grid(geometry)
    costs = costs_of(model, geometry, grid, exposures, WORKERS)
    out = np.full((geometry.rows, geometry.columns, grid.labels), 7, np.uint8)
    edges = np.linspace(0, geometry.rows, pieces + 1).astype(int)
    for first, last in pairwise(edges):
        room = costs.room()
        costs.fill(volume, first, last, pointers(room), out)
    return out, costs


def log_likelihood(n, k, flux):
    """Log-likelihood of each pixel's n ones in k exposures, as the specification adds it up."""
    dark, score = np.zeros(len(n), np.float32), np.zeros(len(n), np.float32)
    add_evidence(n.astype(np.float32), k, flux.astype(np.float32), np.float32(0), dark, dark, TABLE, score)
    return score.astype(float)


def place_from_near(grid, y, c, start, label):
    """Place of a label in the buffers of a row, which go from near to far; start: x of their first pixel."""
    return np.floor(FINE * grid.side * grid.x_far[y, c] + 0.5) / FINE - grid.side * start - label / PER_PX


def exact(model, geometry, volume, y, c):
    """Log-likelihoods of the labels of a row, NaN of those that cannot be."""
    grid, swept, state = label_grid(geometry), sweep_of(geometry), state_of(model)
    row = row_buffers(geometry.window, 1)
    length, first, last, start = row_fluxes(swept, state, row, y, c)
    side, k = grid.side, int(volume.n_frames[c])
    n = volume.counts[c, y, start + side * np.arange(length) - geometry.x0[c]].astype(float)
    before, behind, scale = (a[:length].astype(float) for a in (row.before, row.behind, row.scale))
    dark = log_likelihood(n, k, behind)
    edge = np.concatenate([[0.0], np.cumsum(log_likelihood(n, k, before) - dark)])
    reach = len(state.psi) - 1
    scores = np.full(grid.stripes, np.nan)
    for label in range(grid.stripes):
        t = place_from_near(grid, y, c, start, label)
        i = int(np.floor(t + 0.5))
        if not (0 <= i < length and first - 1 <= t <= last + 1):
            continue
        around = np.arange(max(i - reach, 0), min(i + reach + 1, length))
        base = np.where(around < i, before[around], behind[around])
        base[around == i] = behind[i] + (0.5 + t - i) * (before[i] - behind[i])
        share = pixel_shares(model.line_sigma_px, around - t)
        scores[label] = edge[around[0]] + max(
            (log_likelihood(n[around], k, base + light * scale[i] * share) - dark[around]).sum()
            for light in _lights(model).astype(float)
        )
    return scores


def differences(model, geometry, volume, exposures, columns=(0, 3, 17, 30, 47), rows=(0, 7, 19)):
    """How much costs up to SEEN differ from the exact ones by more than a tenth; labels that only one of them has."""
    out, costs = filled(model, geometry, volume, exposures)
    grid, found, alone = costs.grid, [], 0
    for y in rows:
        for c in columns:
            if geometry.x_lo[y, c] > geometry.x_hi[y, c]:
                continue
            scores = exact(model, geometry, volume, y, c)
            # Columns of other lengths have units of their own.
            worth = (SHARP + exposures) / (SHARP + volume.n_frames[c])
            wanted = worth * costs.units_per_nat * (np.nanmax(scores, initial=-np.inf) - scores)
            given = out[y, c, : grid.stripes].astype(float)
            alone += int((np.isnan(wanted) != (given == EXCLUDED)).sum())
            both = np.isfinite(wanted) & (given != EXCLUDED)
            # The best one may be a label that only other rows of the band have.
            given[both] -= given[both].min(initial=COST_LIMIT)
            compared = both & (np.minimum(wanted, given) < SEEN)
            limited = np.minimum(wanted, COST_LIMIT)[compared]
            found.append(np.maximum(np.abs(given[compared] - limited) - 0.1 * limited, 0.0))
            assert given[both].max(initial=0) <= COST_LIMIT
            assert (out[y, c, grid.stripes :] == EXCLUDED).all()
    return np.concatenate(found), alone


@pytest.mark.parametrize(("rig", "exposures"), [("left", 1), ("right", 10), ("left", 255), ("right", 1000)])
def test_costs_are_log_likelihoods(rig, exposures):
    s = sweep(rig, exposures)
    found, alone = differences(known_model(s.geometry), s.geometry, s.volume, exposures)
    assert len(found) > 100
    assert np.mean(found > 1.0) < 0.05
    assert found.max() <= 3.0
    assert alone <= 6


@pytest.mark.parametrize(("rig", "exposures"), [("left", 1), ("right", 10), ("left", 255), ("right", 1000)])
def test_costs_of_labels_on_pixel_centres_are_the_scores_of_the_specification(rig, exposures):
    s = sweep(rig, exposures)
    model = known_model(s.geometry)
    out, costs = filled(model, s.geometry, s.volume, exposures)
    grid, swept, state, light = costs.grid, sweep_of(s.geometry), state_of(model), _lights(model)
    row, label, found = row_buffers(s.geometry.window, len(light)), np.arange(costs.grid.stripes), []
    for y, c in np.ndindex(ROWS, COLUMNS):
        length, first, last, start = row_fluxes(swept, state, row, y, c)
        x = start + grid.side * np.arange(length)
        row.n[:length] = s.volume.counts[c, y, x - s.geometry.x0[c]]
        row_scores(
            row.n, np.float32(exposures), row.before, row.behind, row.scale, length, light, state.psi, state.table,
            row.taps, row.edge, row.score,
        )  # fmt: skip
        pixel = place_from_near(grid, y, c, start, label)
        centred = (pixel % 1 == 0) & (first <= pixel) & (pixel <= last)
        given = out[y, c, label[centred]].astype(float)
        # Without the row's constant, the score of its best label, which may lie between pixel centres.
        off = given + costs.units_per_nat * row.score[:, pixel[centred].astype(int)].max(axis=0)
        off = off[given < SEEN]
        found.append(np.abs(off - np.median(off)) if len(off) else off)
    found = np.concatenate(found)
    assert len(found) > 1000
    assert np.percentile(found, 90) <= 0.75  # a byte's rounding, and half of that for the 16 bits of the scores
    assert found.max() <= 2.5


@pytest.mark.parametrize(("light", "sigma_px"), [("dense", 0.5), ("clear", 0.9), ("report", 1.7)])
def test_in_any_light_and_with_any_line(light, sigma_px):
    s = sweep("left", 10, light)
    haze, ambient = {"dense": (0.31, 0.05), "clear": (1e-6, 0.002), "report": (0.14, 0.005)}[light]
    model = known_model(s.geometry, haze=haze, ambient=ambient, sigma_px=sigma_px)
    found, _ = differences(model, s.geometry, s.volume, 10)
    assert found.max() <= 3.0


def test_turned_and_distorted_rigs():
    s = sweep("turned", 10)
    found, alone = differences(known_model(s.geometry), s.geometry, s.volume, 10, columns=(0, 9, 20, 31, 47))
    # Light and geometry are those of the band's middle row there.
    assert np.percentile(found, 90) <= 2.0
    assert found.max() <= 8.0
    assert alone <= 10


@pytest.mark.parametrize("ones", [0, 1], ids=["dark", "saturated"])
def test_rows_of_zeros_or_ones_stay_in_range(ones):
    s = sweep()
    for exposures, dtype in ((1, np.uint8), (60000, np.uint16)):
        counts = np.full_like(s.counts, exposures * ones, dtype)
        volume = volume_of(counts, s.geometry, exposures)
        found, _ = differences(known_model(s.geometry), s.geometry, volume, exposures, columns=(3, 20), rows=(5,))
        # So unlikely a row lies outside of what 16 bits hold, but its best answer is the right one.
        assert found.max(initial=0) <= (2.0 if exposures < 100 else COST_LIMIT)


@pytest.mark.parametrize("frames", [2, 40])
def test_a_column_of_another_length_costs_what_it_would_among_its_like(frames):
    s = sweep("left", frames)
    model, exposures = known_model(s.geometry), np.full(COLUMNS, 10, np.int32)
    alike, costs = filled(model, s.geometry, s.volume, frames)
    exposures[20] = frames
    among, _ = filled(model, s.geometry, volume_of(s.counts, s.geometry, exposures), 10)
    stripes = costs.grid.stripes
    own, other = (a[:, 20, :stripes].astype(float) for a in (alike, among))
    compared = (np.minimum(own, other) < SEEN) & (own != EXCLUDED)
    assert np.count_nonzero(compared) > 100
    assert np.abs(other[compared] - own[compared]).max() <= 3.0


def test_rows_may_be_filled_in_any_pieces():
    s = sweep("turned", 3, rows=70)
    model = known_model(s.geometry)
    whole, _ = filled(model, s.geometry, s.volume, 3)
    np.testing.assert_array_equal(filled(model, s.geometry, s.volume, 3, 5)[0], whole)
    assert not (whole == 7).all(axis=2).any()


def test_hot_pixels_say_nothing():
    s = sweep()
    clean, costs = filled(known_model(s.geometry), s.geometry, s.volume, 10)
    hot = np.random.default_rng(1).random((ROWS, s.geometry.width)) < 0.02
    counts = np.where(hot, np.uint8(10), s.counts)
    model = known_model(s.geometry)
    model = replace(model, ambient=np.where(hot, np.float32(4.0), model.ambient))
    spoilt, _ = filled(model, s.geometry, volume_of(counts, s.geometry, 10), 10)
    blind, _ = filled(known_model(s.geometry), s.geometry, volume_of(counts, s.geometry, 10), 10)
    stripes = costs.grid.stripes
    best, aware, unaware = (a[:, :, :stripes].argmin(axis=2) for a in (clean, spoilt, blind))
    assert np.mean(np.abs(best - aware) <= 2) > 0.93
    assert np.mean(np.abs(best - unaware) <= 2) < 0.85


@pytest.mark.parametrize("usual", [1, 10, 20_000])
def test_no_column_counts_for_more_than_the_longest_that_tables_are_made_for(usual):
    """Counts of columns of other lengths are multiplied to one scale: products must fit 16 bits."""
    geometry = sweep().geometry
    ways = costs_of(known_model(geometry), geometry, label_grid(geometry), usual, WORKERS).ways
    most = ways.most * 2.0 ** (COUNT_BITS - ways.bits)
    assert most <= np.iinfo(np.int16).max
    lengths = (*range(300), *range(300, 65_536, 111))
    times = np.array([_times(frames, ways) for frames in lengths])
    assert (np.array(lengths) * times <= most * (1 + 1e-9)).all()
    whole = times >= 1
    np.testing.assert_array_equal(times[whole], np.rint(times[whole]))
    assert _times(usual, ways) == 2.0 ** (COUNT_BITS - ways.bits)


def test_a_hot_pixel_of_a_short_last_band_is_found_beside_the_rows_before_it():
    ambient = np.full((2 * BAND_ROWS + 1, 6), 0.01, np.float32)
    ambient[[3, -1], [2, 4]] = 5.0
    assert np.argwhere(hot_in_bands(ambient)).tolist() == [[3, 2], [2 * BAND_ROWS, 4]]
