"""Learns the row model from the counts of a sweep by expectation-maximisation over a lattice of rows and columns.

A line here is one row of one column; only 'line width' and 'laser line' mean the laser's. In each round every line's
posterior P(j) over positions gives the probability that a pixel lies before or behind the stripe: pixel t lies before
it if the stripe is farther, with probability sum over j > t of P(j). Ones and exposures are added with these weights
per bin of path inverse depth (`learn_rows`), float64 (BINS, LEVELS). A bin's level of haze or pedestal (the level
behind the stripe) is

    level = (-log(1 - ones / exposures) - mean ambient flux) / mean G          G: see `rig.estimate.row.inputs`

Gains and amplitudes follow from the sums, too; the line width is found by trial (`fit_line_width`). Where data are few,
haze is assumed to fall exponentially with the path length.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import reduce
from operator import itemgetter
from typing import Any, Final, NamedTuple, TypeVar

import cv2
import numba
import numpy as np

from rig.count.volume import CountVolume
from rig.estimate.row.inputs import Lines, RowBuffers, RowState, Sweep, judge_line, row_buffers, state_of, sweep_of
from rig.estimate.row.likelihood import mode_of
from rig.estimate.row.model import AMPLITUDES, BINS, RowModel, fit_haze, line_profile, line_reach, stripe_scale
from rig.geometry.stripe_table import StripeTable
from rig.geometry.windows import SweepGeometry, evenly_spread
from rig.simd import Float32, Float64, Int32
from rig.threads import RowWorkers

START_LINES, START_FRAMES = 512, 8192
"""START_LINES lines are used to choose the likeliest start and the width of the laser line in a first sweep. If they
have fewer than START_FRAMES exposures together, more are used, up to FIRST_LINES."""
FIRST_LINES = 2048
LAST_LINES = 4096
"""Lines that the first and the last rounds over a first sweep read: 250 000 and 500 000 pixels in all."""
AGAIN_LINES = 8192
"""Lines from which a first sweep's model is learned again, once neighbours have helped to locate the stripes."""
NEXT_LINES = 2048
"""Lines that are read from each later sweep."""
FADE = 0.7
"""Factor on the weight of earlier sweeps, each time that one more sweep is learned from."""
WIDTH_EVIDENCE = 3.0
"""Gain of log-likelihood, in nats, above which the line width is changed."""
FIRST_ROUNDS = 8
LAST_ROUNDS = 3
"""Rounds over a first sweep. The first ones read FIRST_LINES and also fit the line width; the last ones read LAST_LINES
and also learn the gains of rows and columns. From fewer lines, noise in the gains would be taken for extinction."""
MOST_TRUST = np.float32(0.98)
"""Largest trust in a stripe position known from neighbours: the row's own counts may contradict it."""
LEVELS = 14
"""Number of sums per profile bin in an expectation, see `learn_rows`."""
PIECES = 4
"""Pieces in which lines are summed, the same for any number of threads."""
AMPLITUDE_SPAN = 3.4
"""Natural logarithm of the ratio of the largest amplitude to the smallest: a factor of 30."""
EVEN_SHARE = 0.25
"""Share of the prior over positions that stays uniform, whatever the earlier maps looked like."""
PRIOR_PHOTONS = 100.0
"""In the mean of a bin's own level and the fitted exponential, the exponential weighs as much as so many photons."""
START_EXTINCTIONS_PER_M = (0.0, 0.1, 0.4, 1.5)
"""Extinctions that are tried as a start for a first sweep: clear air to dense fog."""

Result = TypeVar("Result")


class Expectation(NamedTuple):
    """Weighted counts of one round; see `learn_rows`. rows_seen and columns_seen have no rows if gains are not to be
    learned from them."""

    levels: Float64
    rows_seen: Float64
    columns_seen: Float64
    amplitude_mass: Float64

    def plus(self, other: "Expectation") -> "Expectation":
        """The sums over the lines of both."""
        both: Any = zip(self, other, strict=True)
        return Expectation(*(one + more for one, more in both))

    def faded(self, share: float) -> "Expectation":
        """The sums times `share`."""
        sums: Any = self
        return Expectation(*(share * each for each in sums))


def lattice(geometry: SweepGeometry, lines: int) -> tuple[Int32, Int32]:
    """Rows and columns, int32 (n,) each, of at most `lines` pairs, spread in a fixed pattern over those with a search
    window."""
    y, c = np.nonzero(geometry.x_lo <= geometry.x_hi)
    pick = evenly_spread(len(y), lines)
    return y[pick].astype(np.int32), c[pick].astype(np.int32)


def lines_of(volume: CountVolume, where: tuple[Int32, Int32], known: StripeTable | None = None) -> Lines:
    """The lines of a volume at `where`, (rows, columns).

    known: stripes that were estimated with the help of the neighbours' counts.
    """
    rows, columns = where
    x_px, trust = (np.zeros(len(rows), np.float32) for _ in range(2))
    if known is not None:
        x_px = known.x_px[rows, columns]
        trust = np.where(np.isnan(x_px), np.float32(0.0), known.confidence[rows, columns] * MOST_TRUST)
    return Lines(volume.counts[columns, rows].astype(np.int32), rows, columns, volume.n_frames[columns], x_px, trust)


def expect(
    lines: Lines, geometry: SweepGeometry, model: RowModel, workers: RowWorkers, *, gains: bool = False
) -> Expectation:
    """The expectation step of `model` over some lines. gains: whether gains of rows and columns are to be learned."""
    sweep, state, hot_flux = sweep_of(geometry), state_of(model), model.hot_flux()

    def expect_piece(piece: Lines) -> Expectation:
        levels, mass = np.zeros((BINS, LEVELS)), np.zeros(len(state.amplitude) + 1)
        rows_seen, columns_seen = (np.zeros((n if gains else 0, 2)) for n in (geometry.rows, geometry.columns))
        learn_rows(sweep, state, piece, hot_flux, levels, rows_seen, columns_seen, mass)
        return Expectation(levels, rows_seen, columns_seen, mass)

    return reduce(Expectation.plus, _of_pieces(lines, expect_piece, workers))


def evidence(
    lines: Lines, geometry: SweepGeometry, model: RowModel, workers: RowWorkers, *, reach_px: int | None = None
) -> float:
    """Natural logarithm of the probability of the counts of some lines, up to a constant of the counts.

    reach_px: of `line_profile`, None for the line's own.
    """
    sweep, state = sweep_of(geometry), state_of(model)
    if reach_px is not None:
        state = state._replace(psi=line_profile(model.line_sigma_px, reach_px))
    return sum(_of_pieces(lines, lambda piece: rows_evidence(sweep, state, piece), workers))


def _of_pieces(lines: Lines, work: Callable[[Lines], Result], workers: RowWorkers) -> list[Result]:
    """Results for PIECES pieces of the lines, in order. Sums of them do not depend on the number of threads."""
    edges = np.linspace(0, len(lines.row), PIECES + 1).astype(int)
    results: dict[int, Result] = {}

    def some(first: int, last: int) -> None:
        for i in range(first, last):
            results[i] = work(_some(lines, slice(edges[i], edges[i + 1])))

    workers.over(PIECES, some)
    return [results[i] for i in range(PIECES)]


def _some(lines: Lines, part: slice) -> Lines:
    some: Any = (each[part] for each in lines)
    return Lines(*some)


def _every(lines: Lines, wanted: int) -> Lines:
    """At least `wanted` of the lines, and fewer than twice as many, evenly spread; all if there are no more."""
    return _some(lines, slice(None, None, max(len(lines.row) // wanted, 1)))


def learn_first(volume: CountVolume, geometry: SweepGeometry, ambient: Float32, workers: RowWorkers) -> RowModel:
    """Learn the row model from a first sweep: try several starts and refine the likeliest."""
    first, last = (lines_of(volume, lattice(geometry, lines)) for lines in (FIRST_LINES, LAST_LINES))
    few = _every(first, max(START_LINES, START_FRAMES // max(volume.exposures, 1)))
    guessed = volume.dark_counts is None
    starts = []
    for extinction in START_EXTINCTIONS_PER_M:
        model = start_model(volume, geometry, ambient, extinction)
        for _ in range(2):
            model = maximise(model, expect(few, geometry, model, workers), spread=True, free_ambient=guessed)
        starts.append((evidence(few, geometry, model, workers), model))
    model = max(starts, key=itemgetter(0))[1]
    moves = True
    for i in range(FIRST_ROUNDS):
        model = maximise(model, expect(first, geometry, model, workers), spread=True, free_ambient=guessed)
        # A width that did not change is tried again only in the last two of these rounds: the model is nearly known.
        if moves or i >= FIRST_ROUNDS - 2:
            width = model.line_sigma_px
            model = fit_line_width(few, geometry, model, workers)
            moves = model.line_sigma_px != width
    for _ in range(LAST_ROUNDS):
        seen = expect(last, geometry, model, workers, gains=True)
        model = maximise(model, seen, spread=False, free_ambient=guessed)
    return model


def next_lattice(geometry: SweepGeometry) -> tuple[Int32, Int32]:
    """The (rows, columns) from which a model is updated from sweep to sweep, sorted by column."""
    rows, columns = lattice(geometry, NEXT_LINES)
    order = np.lexsort((rows, columns))
    return rows[order], columns[order]


def learn_next(
    lines: Lines, geometry: SweepGeometry, model: RowModel, before: Expectation | None, workers: RowWorkers
) -> tuple[RowModel, Expectation]:
    """The model updated with lines of one more sweep, those of `next_lattice`, and the sums for the next call.

    before: the sums returned by the previous call, None at first; they are multiplied by FADE. The line width is not
    changed if lines have positions known from neighbours, since these depend on the width.
    """
    seen = expect(lines, geometry, model, workers)
    if before is not None:
        seen = seen.plus(before.faded(FADE))
    model = maximise(model, seen, spread=False)
    if lines.trust.any():
        return model, seen
    return fit_line_width(_every(lines, START_LINES), geometry, model, workers), seen


def learn_again(
    volume: CountVolume,
    geometry: SweepGeometry,
    model: RowModel,
    ambient: Float32,
    known: StripeTable,
    workers: RowWorkers,
) -> RowModel:
    """The model of a first sweep, learned again with stripes `known` from more than their own rows."""
    lines = lines_of(volume, lattice(geometry, AGAIN_LINES), known)
    model = replace(model, ambient=ambient)
    seen = expect(lines, geometry, model, workers, gains=True)
    return maximise(model, seen, spread=True, free_ambient=volume.dark_counts is None)


def fit_line_width(lines: Lines, geometry: SweepGeometry, model: RowModel, workers: RowWorkers) -> RowModel:
    """The model with another line width, one step away, if that makes the counts clearly likelier; else as it is.

    All widths are judged by the same pixels around a stripe. With the pixels farther out that a wider line has, the
    halo of dense fog would be taken for a wide line.
    """
    reach_px = line_reach(model.line_sigma_px)
    tried = [
        replace(model, line_sigma_px=float(np.clip(model.line_sigma_px * f, 0.25, 2.4))) for f in (0.87, 1.0, 1.15)
    ]
    found = [evidence(lines, geometry, m, workers, reach_px=reach_px) for m in tried]
    best = int(np.argmax(found))
    return tried[best] if found[best] > found[1] + WIDTH_EVIDENCE else model


def path_bins(geometry: SweepGeometry) -> tuple[float, float]:
    """First path inverse depth, in 1/m, and bins per 1/m, with room for the margins outside the depth range."""
    near_m, far_m = geometry.depth_range_m
    # Paths are longer than depths towards the picture's corners, by up to a third with usual fields of view.
    w_lo, w_hi = 0.6 / far_m, 1.15 / near_m
    return w_lo, (BINS - 1) / (w_hi - w_lo)


def start_model(volume: CountVolume, geometry: SweepGeometry, ambient: Float32, extinction_per_m: float) -> RowModel:
    """Row model with haze of a guessed extinction that matches the mean level of the nearest pixels."""
    w_lo, per_w = path_bins(geometry)
    path_m = 1.0 / (w_lo + np.arange(BINS) / per_w)
    level = _near_level(volume, geometry)
    typical = float(np.median(ambient))
    near_m = geometry.depth_range_m[0] * 1.2
    haze = max(level - typical, 0.0) * np.exp(-2.0 * extinction_per_m * np.maximum(path_m - near_m, 0.0))
    columns = [haze, np.zeros(BINS), stripe_scale(path_m, extinction_per_m), np.zeros(BINS)]
    profile = np.stack(columns, 1).astype(np.float32)
    amplitude = np.geomspace(0.03, 30.0, AMPLITUDES).astype(np.float32)
    row_gain, column_gain = np.ones(geometry.rows, np.float32), np.ones(geometry.columns, np.float32)
    weight = np.full(AMPLITUDES, 1.0 / AMPLITUDES)
    return RowModel(
        profile, w_lo, per_w, row_gain, column_gain, ambient, amplitude, weight, 0.02, 0.8, extinction_per_m, np.nan
    )


def _near_level(volume: CountVolume, geometry: SweepGeometry) -> float:
    """Mean flux of the nearest eighth of the search windows, where hardly any stripe lies."""
    rows, columns = lattice(geometry, 4096)
    lo, hi = geometry.x_lo[rows, columns], geometry.x_hi[rows, columns]
    share = np.maximum((hi - lo + 1) // 8, 1)
    first = np.where(geometry.near_is_left, lo, hi - share + 1) - volume.x0[columns]
    # One entry for each of these pixels: number of its row and column, and its place in the window.
    line = np.repeat(np.arange(len(rows)), share)
    place = first[line] + np.arange(len(line)) - np.repeat(np.cumsum(share) - share, share)
    ones = volume.counts[columns[line], rows[line], place].sum(dtype=np.int64)
    exposures = np.dot(volume.n_frames[columns].astype(np.int64), share)
    return flux(float(ones), float(exposures))


def flux(ones: float, exposures: float) -> float:
    """Photons per exposure from ones among exposures; finite if all are ones, 0 without exposures."""
    return float(np.log1p(ones / (exposures - ones + 0.5))) if exposures > 0 else 0.0


def maximise(model: RowModel, seen: Expectation, *, spread: bool, free_ambient: bool = False) -> RowModel:
    """The model that explains the weighted counts best. If `model` has a halo, only the prior over positions and the
    probability of 'no stripe' are changed.

    spread: whether the amplitude grid may move. free_ambient: whether the level of ambient light was guessed and is
    learned as well. The strength of the haze per row and column is learned if `seen` was made for it. It would drift if
    it were learned from few lines or from map to map.
    """
    if model.halo.any():
        # A single row cannot tell a halo from haze; `rig.estimate.joint.halo` can.
        profile = np.column_stack([model.profile[:, :3], _position_prior(seen.levels)]).astype(np.float32)
        return replace(model, profile=profile, none_weight=_amplitudes(model, seen.amplitude_mass, False)[2])
    path_m = model.path_m()
    typical = float(np.median(model.ambient))
    haze, haze_variance = _level(seen.levels[:, 0:4])
    rest, rest_variance = _level(seen.levels[:, 4:8])
    excess, share = _split_rest(rest, rest_variance, haze)
    if free_ambient:
        shift = max(excess, 1e-6 - typical)
        model = replace(model, ambient=np.maximum(model.ambient + np.float32(shift), np.float32(1e-6)))
        typical += shift
        haze = haze - shift
    fit = fit_haze(path_m, haze, haze_variance)
    fitted = fit.amplitude * np.exp(-2.0 * fit.extinction_per_m * path_m) if fit else np.zeros(BINS)
    before = _blend(haze, haze_variance, fitted)
    behind = share * before
    resolved = fit is not None and np.isfinite(fit.extinction_sd_per_m)
    extinction = fit.extinction_per_m if fit is not None and resolved else 0.0
    scale = stripe_scale(path_m, extinction)
    profile = np.stack([before, behind, scale, _position_prior(seen.levels)], 1).astype(np.float32)
    amplitude, weight, none = _amplitudes(model, seen.amplitude_mass, spread)
    # The stated extinction comes only from rows with a certain stripe: a stripe taken for haze would flatten the decay.
    clear = fit_haze(path_m, *_level(seen.levels[:, 8:12]))
    if len(seen.rows_seen):
        model = replace(
            model,
            row_gain=_gain(model.row_gain, seen.rows_seen, typical, before),
            column_gain=_gain(model.column_gain, seen.columns_seen, typical, before),
        )
    return replace(
        model, profile=profile, amplitude=amplitude, weight=weight, none_weight=none,
        extinction_per_m=clear.extinction_per_m if clear else np.nan,
        extinction_sd_per_m=clear.extinction_sd_per_m if clear else np.nan,
    )  # fmt: skip


def _split_rest(rest: Float64, variance: Float64, haze: Float64) -> tuple[float, float]:
    """Split the level behind the stripe into ambient light not yet subtracted and a share (0 to 1) of the haze.

    Weighted fit of rest = excess + share * haze over the bins. The share stands for light scattered twice or more. Both
    results are 0 with fewer than 4 bins; the share is 0 if the haze hardly varies.
    """
    known = np.isfinite(rest) & np.isfinite(haze) & (variance > 0)
    if known.sum() < 4:
        return 0.0, 0.0
    weight, x, y = 1.0 / variance[known], np.maximum(haze[known], 0.0), rest[known]
    mean_x, mean_y = np.average(x, weights=weight), np.average(y, weights=weight)
    spread = float(np.average((x - mean_x) ** 2, weights=weight))
    # A haze as even as this cannot be told from ambient light.
    if spread < 1e-4 * mean_x**2 + 1e-12:
        return float(mean_y), 0.0
    share = float(np.clip(np.average((x - mean_x) * (y - mean_y), weights=weight) / spread, 0.0, 1.0))
    return float(mean_y - share * mean_x), share


def _level(sums: Float64) -> tuple[Float64, Float64]:
    """Flux above ambient at G = 1 (`rig.estimate.row.inputs`), and its variance, (BINS,); NaN with few exposures.

    sums: (BINS, 4), ones, exposures, exposures times G, exposures times ambient flux.
    """
    ones, exposures, geometric, ambient = sums.T
    few = exposures < 50
    weight = np.where(few, 1.0, exposures)
    gain = np.where(few, 1.0, geometric) / weight
    some = np.where(few, 0.0, ones)
    total = np.log1p(some / (weight - some + 0.5))
    variance = np.expm1(total) / weight + 1.0 / weight**2
    level = (total - ambient / weight) / gain
    return np.where(few, np.nan, level), np.where(few, np.nan, variance / gain**2)


def _blend(level: Float64, variance: Float64, fitted: Float64) -> Float64:
    """Each bin's own level where it has many photons, the fitted curve where it has few."""
    own = np.where(np.isfinite(level), 1.0 / np.maximum(variance, 1e-12), 0.0)
    prior = PRIOR_PHOTONS / np.maximum(fitted, 1e-4) ** 2
    return np.maximum((own * np.nan_to_num(level) + prior * fitted) / (own + prior), 0.0)


def _amplitudes(model: RowModel, mass: Float64, spread: bool) -> tuple[Float32, Float64, float]:
    total = float(mass.sum())
    none = float(np.clip(mass[-1] / max(total, 1.0), 0.005, 0.5))
    weight = (mass[:-1] + 1.0) / (mass[:-1].sum() + len(mass) - 1)
    if not spread or mass.sum() < 100.0:
        return model.amplitude, weight, none
    # The grid ends at the brightest stripes that occur and reaches down to those a single row can hardly show.
    log_q = np.log(model.amplitude.astype(np.float64))
    step = log_q[1] - log_q[0]
    below = np.cumsum(weight)
    top = float(np.interp(0.97, below, log_q + 0.5 * step))
    moved = np.linspace(top - AMPLITUDE_SPAN, top, AMPLITUDES)
    density = np.exp(np.interp(moved, log_q, np.log(weight)))
    return np.exp(moved).astype(np.float32), density / density.sum(), none


def _position_prior(levels: Float64) -> Float64:
    """Log of the smoothed density of stripes over the bins (BINS,), relative to an even one.

    It decides only in rows with hardly any photons. A quarter of the density stays even: no place loses over 1.4 nats.
    """
    kernel = np.array([1.0, 2.0, 3.0, 2.0, 1.0])
    found, even = (np.convolve(np.pad(levels[:, i], 2), kernel, "valid") for i in (12, 13))
    density = (found + 1e-9) / (even + 1e-9)
    return np.asarray(np.log(EVEN_SHARE + (1.0 - EVEN_SHARE) * density))


def _gain(gain: Float32, seen: Float64, ambient: float, before: Float64) -> Float32:
    """Strength of the haze per row or column, smoothed over 65 of them; 1 on average. Unchanged if haze is weak.

    seen: (n, 2), ones before the stripe and those expected with the present gain.
    """
    ones, expected = (
        cv2.blur(np.ascontiguousarray(seen[:, i : i + 1]), (1, 65), borderType=cv2.BORDER_REFLECT).ravel()
        for i in (0, 1)
    )
    haze_share = float(before.mean() / (before.mean() + ambient + 1e-9))
    if haze_share < 0.3:
        return gain
    # 100 counts as expected are added, so that a few counts change little.
    learned = gain * np.clip((ones + 100.0) / (expected + 100.0), 0.5, 2.0)
    return np.asarray(np.clip(learned / learned.mean(), 0.2, 5.0), dtype=np.float32)


CUT: Final = 0.05
"""Amplitudes, 'no stripe' and positions are learned from rows with less than this share of their prior beyond the
picture's border."""
CERTAIN: Final = 0.6
"""The level behind the stripe is learned from rows with more than this probability of a stripe within 1 px."""
CLEAR: Final = 0.97
CLEAR_PX: Final = 6
"""The extinction is learned from rows more certain than CLEAR, at pixels more than CLEAR_PX before their stripe."""
LEAST_OWN: Final = 1e-3
"""With several laser lines: least haze of a column's own line relative to the others'; less counts as this much."""


@numba.njit(cache=True, nogil=True)
def learn_rows(
    sweep: Sweep, state: RowState, lines: Lines, hot_flux: float, levels: Float64, rows_seen: Float64,
    columns_seen: Float64, amplitude_mass: Float64,
) -> None:  # fmt: skip
    """Do the expectation step over some lines.

    Rows in which 'no stripe' has a probability of 0.5 or more add nothing to levels 0 to 11, rows_seen and
    columns_seen. Added to levels (bins, LEVELS), in columns:
    - 0 to 3, of pixels before the stripe: ones, exposures, exposures times G (`rig.estimate.row.inputs`), exposures
      times ambient flux, all weighted by the probability that the pixel lies before the stripe;
    - 4 to 7: the same for pixels behind the stripe, in rows more certain than CERTAIN; other lines' haze is ambient;
    - 8 to 11: as 0 to 3, unweighted, for pixels more than CLEAR_PX before the stripe in rows more certain than CLEAR;
    - 12 and 13: stripes, and stripes if all positions were equally likely (see CUT).
    Added to rows_seen (rows, 2) and columns_seen (columns, 2): ones before the stripe and those expected. Nothing is if
    both have length 0. Added to amplitude_mass (M + 1,): rows per amplitude, last those with 'no stripe' (see CUT).
    Pixels with more ambient flux than hot_flux are left out of levels 0 to 11, rows_seen and columns_seen.
    """
    amplitudes = state.amplitude.shape[0]
    row = row_buffers(sweep.window, amplitudes)
    for i in range(lines.row.shape[0]):
        length, first, last, start, none, cut, _ = judge_line(sweep, state, row, lines, i)
        if length == 0:
            continue
        if cut < CUT:
            for m in range(amplitudes):
                amplitude_mass[m] += row.by_amplitude[m]
            amplitude_mass[amplitudes] += none
            for j in range(first, last + 1):
                levels[row.cell[j], 12] += row.posterior[j]
                levels[row.cell[j], 13] += (1.0 - none) / (last - first + 1)
        if none < 0.5:
            where = lines.row[i], lines.column[i], lines.exposures[i]
            _learn_levels(
                sweep, state, row, where, (length, first, last, start), none, hot_flux, levels, rows_seen, columns_seen
            )


@numba.njit(cache=True, nogil=True)
def rows_evidence(sweep: Sweep, state: RowState, lines: Lines) -> float:
    """Log evidence of some lines together, each as `judge_line` gives it."""
    row = row_buffers(sweep.window, state.amplitude.shape[0])
    total = 0.0
    for i in range(lines.row.shape[0]):
        total += judge_line(sweep, state, row, lines, i)[6]
    return total


@numba.njit(cache=True, nogil=True)
def _learn_levels(
    sweep: Sweep, state: RowState, row: RowBuffers, where: tuple[int, int, int], span: tuple[int, int, int, int],
    none: float, hot_flux: float, levels: Float64, rows_seen: Float64,
    columns_seen: Float64,
) -> None:  # fmt: skip
    """Add one row's pixels to the levels before and behind the stripe.

    where: row, column and exposures; span: what `row_fluxes` returned for it.
    """
    (y, c, k), (length, first, last, start) = where, span
    step = 1 if sweep.near_is_left else -1
    reach = state.psi.shape[0]
    # Local names, as in `row_fluxes`.
    n, before, cell, gain_of, posterior = row.n, row.before, row.cell, row.gain, row.posterior
    others_of, ambient_of = row.others, state.ambient
    # A doubtful row's pixels behind the stripe would confirm its own guess. For haze, all rows are used.
    mode, near_mass = mode_of(posterior, first, last)
    certain, clear = near_mass > CERTAIN, near_mass > CLEAR
    gains = rows_seen.shape[0] > 0
    passed = 0.0
    for t in range(length):
        passed += posterior[t]
        ambient = ambient_of[y, start + step * t]
        if ambient > hot_flux:
            continue
        gain, others = gain_of[t], others_of[t]
        if others > 0.0:
            # Other lines' haze has the same profile: the factor of the profile grows by their share.
            own = before[t] - ambient - others
            gain *= 1.0 + others / max(own, LEAST_OWN * others)
        # Pixels within the stripe's width count for neither side.
        ahead = 0.0
        near = posterior[t]
        for d in range(1, reach + 1):
            if t + d < length:
                ahead += posterior[t + d]
            if t - d >= 0:
                near += posterior[t - d]
        is_before = max(1.0 - none - passed - ahead, 0.0)
        b = cell[t]
        if is_before > 0.0:
            levels[b, 0] += is_before * n[t]
            levels[b, 1] += is_before * k
            levels[b, 2] += is_before * k * gain
            levels[b, 3] += is_before * k * ambient
            if gains:
                expected = is_before * k * -np.expm1(-before[t])
                rows_seen[y, 0] += is_before * n[t]
                rows_seen[y, 1] += expected
                columns_seen[c, 0] += is_before * n[t]
                columns_seen[c, 1] += expected
        if clear and t < mode - CLEAR_PX:
            levels[b, 8] += n[t]
            levels[b, 9] += k
            levels[b, 10] += k * gain
            levels[b, 11] += k * ambient
        if certain:
            is_behind = max(passed - near, 0.0)
            if is_behind > 0.0:
                levels[b, 4] += is_behind * n[t]
                levels[b, 5] += is_behind * k
                levels[b, 6] += is_behind * k * gain_of[t]
                levels[b, 7] += is_behind * k * (ambient + others)
