"""Learns haze and halo from the stripes of a sweep: the light of each stripe first, then one linear fit.

The light of stripes (`likeliest_light`). A halo, a stripe's light that fog scatters to both sides, is measured relative
to the stripe's own light. The light from `rig.estimate.joint.place.light` is the sum of the pixels' fluxes, which is
limited when pixels saturate; bright stripes would be taken for dimmer ones with a stronger halo. Here the counts n of K
frames of all pixels around a stripe and around its 5 x 5 neighbours on its surface are explained by one amplitude a,

    flux = base + a scale (psi + glow),     log-likelihood = sum n log(1 - exp(-flux)) - (K - n) flux

with haze and ambient light as base, scale the stripe's light at a = 1, psi the share of the line in the pixel, and glow
that of the halo in a pixel at the stripe. The log-likelihood is concave in a and its slope convex, so Newton's method
converges from an amplitude that is too small. Saturated pixels give no information, those beside them do. If a is
hardly more than its noise, or neighbours do not agree on it, the light of a stripe is unknown and the stripe is not
used. Nor is a stripe with 2 photons per exposure or more in one pixel.

The fit (`add_equations`, `solve`). The counts beside a stripe of s photons, at the distance d along the row, show

    flux = ambient + offset + G haze(w)                 before the stripe
         = ambient + offset + share(w) G haze(w)        behind it,      on both sides + s rho(w, d)

with w the path inverse depth, share(w) the ratio of the level behind the stripe to the haze, and G and rho as in
`rig.estimate.row.inputs`. Behind stripes, haze(w) is taken from the present model. So the flux is linear in haze
(BINS), share (HALO_NODES), halo (HALO_NODES, reaches) and offset. One weighted least squares fit (float64) separates
them, because the halo follows the brightness of each stripe and the haze does not; means over the pixels before and
behind stripes could not separate them. Only the offset may be negative; it is 0 if there are dark frames. Later maps
are tested for whether a halo has appeared or vanished.
"""

import math
from dataclasses import replace
from typing import Final, NamedTuple

import numba
import numpy as np

from rig.count.volume import Counts, CountVolume
from rig.estimate.joint.place.light import FRACTIONS
from rig.estimate.joint.place.places import BLIND_FLUX, REACH_PX, Places
from rig.estimate.joint.tables import JointTables
from rig.estimate.online_learning import LearningSetting
from rig.estimate.row.em import AGAIN_LINES, PIECES, lines_of
from rig.estimate.row.inputs import (
    Lines,
    RowState,
    Sweep,
    halo_shares,
    over_bins,
    row_buffers,
    row_fluxes,
    state_of,
    sweep_of,
)
from rig.estimate.row.model import BINS, HALO_NODES, HALO_REACHES_PX, RowModel, fit_haze
from rig.estimate.row.neighbours import SAME_PX
from rig.geometry.stripe_table import StripeTable
from rig.geometry.windows import SweepGeometry, evenly_spread
from rig.simd import Bools, Float32, Float64, Int32
from rig.threads import RowWorkers

LEAST_FLUX: Final = 2e-3
"""Least flux of a pixel when its counts are weighted."""
LINE_PX: Final = 4.5
"""Pixels this far from a stripe, or farther, show nothing of the line itself."""
_REACHES: Final = np.array(HALO_REACHES_PX)
SETTLED: Final = 1e-6
MOST_SWEEPS: Final = 3000
"""`solve` stops when no number's step lowers the misfit by SETTLED, or after MOST_SWEEPS passes through all numbers."""


@numba.njit(cache=True, nogil=True)
def add_equations(
    lines: Lines, light: Float32, sweep: Sweep, state: RowState, halo: Float32, hot_flux: float, first_line: int,
    last_line: int, matrix: Float64, right: Float64,
) -> None:  # fmt: skip
    """Add the normal equations of lines first_line..last_line-1, weighted by the counts that the present state expects.

    Unknowns: haze in each profile bin; its share behind the stripe at each node; halo at each node and reach; offset of
    the ambient light. halo: (BINS, pixels) of `halo_shares`; light: of each line's stripe at its x_px, photons per
    exposure; hot_flux: pixels with more ambient light are left out. Only the lower triangle of the matrix is filled.
    """
    bins, number = state.profile.shape[0], len(_REACHES)
    first_share, first_halo, last = bins, bins + HALO_NODES, matrix.shape[0] - 1
    terms = 3 + 2 * number
    index, value = np.empty(terms + 1, np.int64), np.empty(terms + 1)
    row, side = row_buffers(sweep.window, 1), 1 if sweep.near_is_left else -1
    per_bin = (HALO_NODES - 1) / (bins - 1)
    for i in range(first_line, last_line):
        y, c = lines.row[i], lines.column[i]
        length, _, _, start = row_fluxes(sweep, state, row, y, c)
        if length == 0 or lines.exposures[i] == 0:
            continue
        frames, s = np.float64(lines.exposures[i]), np.float64(light[i])
        place = side * (np.float64(lines.x_px[i]) - start)
        own = row.cell[min(max(int(np.rint(place)), 0), length - 1)]
        low = min(int(own * per_bin), HALO_NODES - 2)
        part = own * per_bin - low
        for t in range(length):
            away = abs(t - place)
            ambient = np.float64(state.ambient[y, start + side * t])
            if away < LINE_PX or ambient > hot_flux:
                continue
            before, cell, gain = t < place, row.cell[t], np.float64(row.gain[t])
            expected = (row.before[t] if before else row.behind[t]) + s * halo[own, min(int(away), halo.shape[1] - 1)]
            dark = np.exp(-max(expected, LEAST_FLUX))
            weight = frames * dark / (1.0 - dark)
            n = np.float64(lines.counts[i, start + side * t - sweep.x0[c]])
            # The flux at which these counts would be expected, linearised at the present state.
            flux = (n / frames - 1.0 + dark) / dark - np.log(dark) - ambient - row.others[t]
            if before:
                index[0], value[0], used = cell, gain, 1
            else:
                node = min(int(cell * per_bin), HALO_NODES - 2)
                haze = gain * state.profile[cell, 0]
                index[0], index[1] = first_share + node, first_share + node + 1
                value[1] = haze * (cell * per_bin - node)
                value[0] = haze - value[1]
                used = 2
            for k in range(number):
                there = s * np.exp(-away / _REACHES[k]) / (2 * _REACHES[k])
                index[used], index[used + 1] = first_halo + low * number + k, first_halo + (low + 1) * number + k
                value[used], value[used + 1] = (1.0 - part) * there, part * there
                used += 2
            index[used], value[used] = last, 1.0
            for a in range(used + 1):
                for b in range(used + 1):
                    if index[a] >= index[b]:
                        matrix[index[a], index[b]] += weight * value[a] * value[b]
                right[index[a]] += weight * value[a] * flux


@numba.njit(cache=True, nogil=True)
def solve(matrix: Float64, right: Float64, free: int) -> Float64:
    """The x without negative elements that minimises x' matrix x - 2 right' x, by coordinate descent.

    free: index of an element that may be negative; -1 for none.
    """
    x, slope = np.zeros_like(right), -right
    for _ in range(MOST_SWEEPS):
        largest = 0.0
        for i in range(len(x)):
            if matrix[i, i] <= 0.0:
                continue
            to = x[i] - slope[i] / matrix[i, i]
            step = (to if i == free else max(to, 0.0)) - x[i]
            if step != 0.0:
                x[i] += step
                for j in range(len(x)):
                    slope[j] += step * matrix[j, i]
                largest = max(largest, step * step * matrix[i, i])
        if largest < SETTLED:
            break
    return x


REACH: Final = 2
"""Rows and columns to either side whose stripes on the same surface help to find the light of a stripe."""
LEAST_ASKED: Final = 10
"""A stripe's light is known only if so many of the 5 x 5 stripes around it, itself included, lie on its surface."""
LEAST_SURE: Final = 4.0
"""The light is known only if it exceeds this many standard deviations of its noise."""
DISAGREED: Final = 3.0
"""Standard deviations by which the stripes' misfit may exceed its expected value. Of answers that pass these limits
less than 1 % are no stripes (random scenes at five exposures)."""
MOST_STEPS: Final = 8
MOST_GROWTH: Final = 4.0
"""Largest factor by which an amplitude may grow or shrink in a step."""
LIGHT_SETTLED: Final = 1e-2
"""Relative step of an amplitude below which it is settled."""
LIGHT_LEAST_FLUX: Final = 1e-4
MOST_FLUX: Final = 20.0
"""Least and largest flux of a pixel, in photons per exposure, in the search for the light."""


@numba.njit(cache=True, nogil=True, error_model="numpy")
def likeliest_light(
    counts: Counts, n_frames: Int32, sweep: Sweep, state: RowState, shares: Float32, x_px: Float32, places: Places,
    rows: Int32, columns: Int32, first_line: int, last_line: int, light: Float32, known: Bools,
) -> None:  # fmt: skip
    """Fill items first_line..last_line-1 of `light`, photons per exposure, and `known`, whether that is reliable.

    Stripe i is at rows[i], columns[i]. counts: of a `CountVolume`; shares: of `profile_table`; x_px: of all stripes.
    """
    for i in range(first_line, last_line):
        y, c = rows[i], columns[i]
        a, information, misfit, asked, settled = np.float64(places.amplitude[y, c]), 0.0, 0.0, 0, False
        for _ in range(MOST_STEPS):
            score, information, misfit, asked = _ask(counts, n_frames, sweep, state, shares, x_px, places, y, c, a)
            if asked < LEAST_ASKED or information <= 0.0:
                break
            before = a
            a = min(max(a + score / information, a / MOST_GROWTH), a * MOST_GROWTH)
            settled = abs(a - before) < LIGHT_SETTLED * before
            if settled:
                break
        light[i] = a * places.scale[y, c]
        known[i] = settled and asked >= LEAST_ASKED and a * math.sqrt(information) > LEAST_SURE
        known[i] = known[i] and misfit < asked + DISAGREED * math.sqrt(2.0 * asked)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _ask(counts, n_frames, sweep, state, shares, x_px, places, y, c, a):  # type: ignore[no-untyped-def]
    """Ask the stripe at (y, c) and those around on its surface about amplitude a. Returns the first derivative of the
    log-likelihood by a, the negative of the second derivative, the misfit of the stripes, and their number.

    The misfit is a sum over the stripes: the square of each one's contribution to the first derivative, divided by the
    variance of that contribution. Its expected value is about the number of stripes.
    """
    side, pixels = 1 if sweep.near_is_left else -1, sweep.u.shape[1]
    score, information, misfit, asked = 0.0, 0.0, 0.0, 0
    for v in range(max(y - REACH, 0), min(y + REACH + 1, x_px.shape[0])):
        for q in range(max(c - REACH, 0), min(c + REACH + 1, x_px.shape[1])):
            # NaN where there is no stripe.
            if not abs(places.distance[v, q] - places.distance[y, c]) <= SAME_PX or n_frames[q] == 0:
                continue
            x, frames = int(np.floor(x_px[v, q] + 0.5)), np.float64(n_frames[q])
            part = x_px[v, q] + 0.5 - x
            fraction = min(int(part * FRACTIONS), FRACTIONS - 1)
            own_score, own_variance = 0.0, 0.0
            for d in range(-REACH_PX, REACH_PX + 1):
                t = x + d
                if not max(sweep.x0[q], 0) <= t < min(sweep.x0[q] + sweep.window, pixels):
                    continue
                ambient = np.float64(state.ambient[v, t])
                if ambient >= BLIND_FLUX:
                    continue
                # The pixel that holds the stripe's centre is in haze on its near part only.
                lit = (part if side > 0 else 1.0 - part) if d == 0 else 1.0 if d * side < 0 else 0.0
                base = ambient + lit * places.haze[v, q] + (1.0 - lit) * places.rest[v, q]
                slope = places.scale[v, q] * np.float64(shares[fraction, 0, d + REACH_PX] + places.glow[v, q])
                flux = min(max(base + a * slope, LIGHT_LEAST_FLUX), MOST_FLUX)
                dark = 1.0 / np.expm1(flux)
                n = min(np.float64(counts[q, v, t - sweep.x0[q]]), frames)
                own_score += slope * (n * dark - (frames - n))
                own_variance += frames * slope * slope * dark
                information += n * slope * slope * dark * (1.0 + dark)
            asked += 1
            score += own_score
            if own_variance > 0.0:
                misfit += own_score * own_score / own_variance
    return score, information, misfit, asked


CLEAR: Final = np.float32(0.5)
"""A stripe is clear if its confidence exceeds this."""
MOST_PEAK: Final = 2.0
"""Photons per exposure in one pixel from which on a stripe is not used. Its light would be known from its flanks only,
and with a line a little wider than learned it would be taken for a dimmer stripe with a stronger halo."""
DETECT_LINES: Final = AGAIN_LINES // 4
"""Number of clear stripes with which a map is tested for a halo."""
MEASURE_LINES: Final = 4 * AGAIN_LINES
"""Number of clear stripes with which the halo is measured, once the first map has one."""
FEWEST_LIGHTS: Final = 64
"""Least number of stripes of known light with which a later map is tested for a halo."""
LEAST_EVIDENCE, LEAST_PER_EXPOSURE = 30.0, 0.02
"""Least reduction of the fit's chi squared by a halo, altogether and per exposure of the stripes. Noise reduces it by 2
to 10 altogether. The wings of a line that moves or is not sharp reduce it by 0.01 per exposure, fog of optical depth
0.2 by 0.02 to 0.05, of 1 by more than 0.15."""
SMOOTH_HAZE, SMOOTH_SHARE, SMOOTH_HALO, SMALL_HALO = 3e4, 300.0, 3.0, 0.1
"""Factors on squares that are added to the misfit: of second differences of the haze, of steps of its share behind the
stripe, of steps of the halo, and of the halo itself. They decide only where there are no data."""
_SHARE, _HALO = BINS, BINS + HALO_NODES
_SIZE = _HALO + HALO_NODES * len(HALO_REACHES_PX) + 1


class BrightLines(NamedTuple):
    """Lines with a clear stripe of known light, from which a halo can be learned, and this light in photons per
    exposure."""

    lines: Lines
    light: Float32


def bright_lines(
    volume: CountVolume, tables: JointTables, stripes: StripeTable, places: Places, workers: RowWorkers,
    number: int = DETECT_LINES,
) -> BrightLines:  # fmt: skip
    """Lines of known light, less than MOST_PEAK in a pixel, among up to `number` lines with a clear stripe spread
    evenly over a map.

    tables: those that the map was made with; places: of its stripes.
    """
    y, c = np.nonzero(stripes.confidence > CLEAR)
    pick = evenly_spread(len(y), number)
    rows, columns = y[pick].astype(np.int32), c[pick].astype(np.int32)
    light, known = np.empty(len(rows), np.float32), np.empty(len(rows), np.bool_)
    seen = volume.counts, volume.n_frames, tables.sweep, tables.state, tables.shares, stripes.x_px, places
    workers.over(len(rows), lambda first, last: likeliest_light(*seen, rows, columns, first, last, light, known))
    known &= light * tables.state.psi[0] < MOST_PEAK
    return BrightLines(lines_of(volume, (rows[known], columns[known]), stripes), light[known])


def learn_first_halo(
    volume: CountVolume, geometry: SweepGeometry, model: RowModel, ambient: Float32, tables: JointTables,
    stripes: StripeTable, places: Places, workers: RowWorkers,
) -> RowModel:  # fmt: skip
    """The first map's model with the halo of `learn_halo`. Call it again with the map that is made with the new model.

    With several laser lines at once the model stays as it is, since other lines' haze would be taken for a halo.
    """
    if geometry.others is not None:
        return model
    number = MEASURE_LINES if model.halo.any() else DETECT_LINES
    seen = bright_lines(volume, tables, stripes, places, workers, number)
    return learn_halo(seen, geometry, model, ambient, workers, dark=volume.dark_counts is not None)


def halfway(before: RowModel, after: RowModel) -> RowModel:
    """`after` with the mean of both models' halos; with its own halo if one of the models has none.

    Which stripes are found depends on the halo, and the halo on these stripes. With whole steps the model swings from
    lesson to lesson (docs/decisions/0032-dense-fog-what-misleads-the-lessons.md).
    """
    if not (before.halo.any() and after.halo.any()):
        return after
    return replace(after, halo=np.asarray((before.halo + after.halo) / 2, np.float32))


def learn_next_halo(setting: LearningSetting, seen: BrightLines, workers: RowWorkers) -> RowModel:
    """The model of a later lesson. A halo is added when the map begins to show one, and removed when it shows none.
    Nothing changes with fewer than FEWEST_LIGHTS stripes of known light, with several laser lines at once, or if the
    model has no halo and its extinction is unknown.

    A halo that stays is not changed. If it were learned anew from so few lines in lesson after lesson, halo, haze and
    the level behind stripes would drift against each other (in steady fog errors grow by 10 to 25 % in eight maps).
    """
    model = setting.model
    if setting.geometry.others is not None or (not model.halo.any() and np.isnan(model.extinction_per_m)):
        return model
    if len(seen.light) < FEWEST_LIGHTS:
        return model
    found = learn_halo(seen, setting.geometry, model, model.ambient, workers, dark=setting.dark)
    return model if found.halo.any() == model.halo.any() else found


def learn_halo(
    seen: BrightLines, geometry: SweepGeometry, model: RowModel, ambient: Float32, workers: RowWorkers, *, dark: bool
) -> RowModel:
    """The model with the halo that these stripes show, and the medium under it; without a halo if they show none.

    With a halo, haze, the level behind stripes, extinction and ambient light change too. The scale of stripes is kept,
    since their light is based on it. ambient: of each pixel, (rows, width), start value of the fit. dark: whether dark
    frames have measured it.
    """
    matrix, right = _equations(seen, geometry, replace(model, ambient=ambient), workers)
    free = -1 if dark else _SIZE - 1
    if free < 0:
        # Dark frames have measured the ambient light.
        matrix[-1], matrix[:, -1], right[-1] = 0.0, 0.0, 0.0
    smoothed = matrix + _smoothness()
    found = solve(smoothed, right, free)
    plain = np.r_[0:_HALO, _SIZE - 1]
    without = np.zeros(_SIZE)
    without[plain] = solve(smoothed[np.ix_(plain, plain)], right[plain], len(plain) - 1 if free >= 0 else -1)
    least = max(LEAST_EVIDENCE, LEAST_PER_EXPOSURE * float(seen.lines.exposures.sum()))
    if _misfit(matrix, right, without) - _misfit(matrix, right, found) < least:
        return replace(model, halo=np.zeros_like(model.halo))
    halo = found[_HALO:-1].reshape(HALO_NODES, -1).astype(np.float32)
    profile = model.profile.copy()
    profile[:, 0] = found[:_SHARE]
    profile[:, 1] = model.profile[:, 0] * over_bins(np.minimum(found[_SHARE:_HALO, None], 1.0), BINS)[:, 0]
    haze = np.diagonal(matrix)[:BINS]
    known = haze > 0
    variance = np.where(known, 1.0 / np.where(known, haze, 1.0), np.nan)
    fit = fit_haze(model.path_m(), np.where(known, found[:BINS], np.nan), variance)
    return replace(
        model, profile=profile, halo=halo, ambient=np.maximum(ambient + np.float32(found[-1]), np.float32(1e-6)),
        extinction_per_m=fit.extinction_per_m if fit else np.nan,
        extinction_sd_per_m=fit.extinction_sd_per_m if fit else np.nan,
    )  # fmt: skip


def _equations(
    seen: BrightLines, geometry: SweepGeometry, model: RowModel, workers: RowWorkers
) -> tuple[Float64, Float64]:
    sweep, state = sweep_of(geometry), state_of(model)
    shares, hot_flux = halo_shares(model, geometry.width), model.hot_flux()
    # Fixed pieces, added in order: the sums do not depend on the number of threads.
    edges = np.linspace(0, len(seen.light), PIECES + 1).astype(int)
    matrices, rights = np.zeros((PIECES, _SIZE, _SIZE)), np.zeros((PIECES, _SIZE))

    def work(first: int, last: int) -> None:
        for i in range(first, last):
            add_equations(
                seen.lines, seen.light, sweep, state, shares, hot_flux, edges[i], edges[i + 1],
                matrices[i], rights[i],
            )  # fmt: skip

    workers.over(PIECES, work)
    half = matrices.sum(axis=0)
    return half + np.tril(half, -1).T, rights.sum(axis=0)


def _smoothness() -> Float64:
    out = np.zeros((_SIZE, _SIZE))

    def add(places: list[int], taps: list[float], strength: float) -> None:
        out[np.ix_(places, places)] += strength * np.outer(taps, taps)

    for i in range(1, BINS - 1):
        add([i - 1, i, i + 1], [1, -2, 1], SMOOTH_HAZE)
    for i in range(_SHARE, _HALO - 1):
        add([i, i + 1], [1, -1], SMOOTH_SHARE)
    for i in range(_HALO, _SIZE - 1):
        add([i], [1], SMALL_HALO)
        if i + len(HALO_REACHES_PX) < _SIZE - 1:
            add([i, i + len(HALO_REACHES_PX)], [1, -1], SMOOTH_HALO)
    return out


def _misfit(matrix: Float64, right: Float64, x: Float64) -> float:
    return float(x @ matrix @ x - 2 * right @ x)
