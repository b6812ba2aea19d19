"""Inputs of the compiled row likelihood: the sweep, the learned state, and one row's fluxes in near-to-far order.

A pixel sees the point where its ray meets the column's light plane. Let w be the point's inverse depth, and c and p its
paths from the camera and from the scanner, per unit of depth. With G = row gain x column gain x c x p, the path inverse
depth w' = 2 w / (c + p), and haze, rest, S the profiles of `rig.estimate.row.model` at w',

    before = ambient + G haze(w') + others,    behind = ambient + G rest(w') + others,    scale = S(w')

in photons per exposure; `others` is the haze of laser lines lit at the same time (`others_at`). All are float32, and
fluxes are limited to FLUX_MIN..FLUX_MAX. `judge_line` computes all of them and the row's posterior.

Fog scatters the stripe's own light once more, into a halo on both sides of it. At the distance d along the row from a
stripe of s photons the halo has, per pixel,

    s rho(w', d),   rho(w', d) = sum over k of halo(w', k) exp(-|d| / HALO_REACHES_PX[k]) / (2 HALO_REACHES_PX[k])

photons. The halo is learned (`rig.estimate.joint.halo`) at HALO_NODES path inverse depths and interpolated linearly.
"""

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rig.estimate.row.likelihood import FLUX_MAX, FLUX_MIN, logit_table, none_prior, row_posterior, row_scores
from rig.estimate.row.model import HALO_REACHES_PX, RowModel, fine_profiles, line_profile
from rig.geometry.kernels import with_rays
from rig.geometry.windows import MARGIN_PX, SweepGeometry
from rig.simd import Float32, Float64, Int32


def halo_shares(model: RowModel, pixels: int) -> Float32:
    """rho (see the module) at each profile bin, at 0 to pixels - 1 px from the stripe, (BINS, pixels)."""
    reach = np.array(HALO_REACHES_PX)[:, None]
    shape = np.exp(-np.arange(pixels) / reach) / (2 * reach)
    return np.asarray(over_bins(np.asarray(model.halo), len(model.profile)) @ shape, np.float32)


def over_bins(values: NDArray[np.floating], bins: int) -> Float64:
    """Values given at HALO_NODES nodes, (nodes, n), interpolated at each profile bin: (bins, n)."""
    at = np.linspace(0, len(values) - 1, bins)
    low = np.minimum(at.astype(int), len(values) - 2)
    part = (at - low)[:, None]
    return np.asarray((1 - part) * values[low] + part * values[low + 1])


TABLE = logit_table()


class Sweep(NamedTuple):
    """Geometry of a sweep for kernels; fields as in `SweepGeometry`.

    w_near, w_far: inverse depths of the ends of the depth range. others: (columns, 0, 3) if there is one line.
    """

    window: int
    x0: Int32
    x_lo: Int32
    x_hi: Int32
    near_is_left: bool
    plane: Float64
    u: Float32
    v: Float32
    w_near: float
    w_far: float
    others: Float64


class Lines(NamedTuple):
    """Some rows of some columns, with their counts.

    counts: (lines, window) integers; row, column: int32 (lines,); exposures: int32 (lines,). x_px, trust: float32
    (lines,), the stripe position according to neighbours and its probability; a line with trust 0 is judged alone.
    """

    counts: NDArray[np.integer]
    row: Int32
    column: Int32
    exposures: Int32
    x_px: Float32
    trust: Float32


class RowState(NamedTuple):
    """A RowModel as the kernels read it: log weights instead of weights, the line's profiles instead of its width.

    psi: `line_profile`; fine: `fine_profiles`; table: `logit_table`. glow: (BINS,), the halo in the stripe's own pixel,
    as a share of the stripe's photons.
    """

    profile: Float32
    w_lo: float
    per_w: float
    row_gain: Float32
    column_gain: Float32
    ambient: Float32
    amplitude: Float32
    log_weight: Float32
    none_weight: float
    psi: Float32
    fine: Float32
    table: Float32
    glow: Float32


class RowBuffers(NamedTuple):
    """Buffers of one row, used again for the next. `row_fluxes` fills `before` to `log_prior`, `judge_line` all.

    Pixels go from the nearest depth to the farthest. n: counts. before: flux of a pixel that lies before the stripe;
    behind: of one behind it. scale: stripe photons at amplitude 1. cell: nearest profile bin. gain: the factor G, by
    which the profile is multiplied. others: flux of other lines' haze, included in before and behind. w: inverse depth.
    log_prior: of positions. For the other fields see `row_scores` and `row_posterior`.
    """

    n: Float32
    before: Float32
    behind: Float32
    scale: Float32
    cell: Int32
    gain: Float32
    others: Float32
    w: Float32
    log_prior: Float32
    taps: Float32
    edge: Float32
    score: Float32
    posterior: Float32
    by_amplitude: Float64


def sweep_of(geometry: SweepGeometry) -> Sweep:
    """A sweep's geometry in the form that the kernels read."""
    near_m, far_m = geometry.depth_range_m
    # Contiguous, because kernels read most of these arrays by address.
    x0, x_lo, x_hi = (np.ascontiguousarray(a, np.int32) for a in (geometry.x0, geometry.x_lo, geometry.x_hi))
    u, v = (np.ascontiguousarray(a, np.float32) for a in (geometry.u, geometry.v))
    return Sweep(
        geometry.window, x0, x_lo, x_hi, geometry.near_is_left, geometry.plane, u, v, 1.0 / near_m, 1.0 / far_m,
        np.zeros((geometry.columns, 0, 3)) if geometry.others is None else geometry.others,
    )  # fmt: skip


def state_of(model: RowModel) -> RowState:
    """A learned state in the form that the kernels read."""
    return RowState(
        model.profile, model.w_lo, model.per_w, model.row_gain, model.column_gain, model.ambient, model.amplitude,
        np.log(np.maximum(model.weight, 1e-6)).astype(np.float32), model.none_weight, line_profile(model.line_sigma_px),
        fine_profiles(model.line_sigma_px), TABLE, halo_shares(model, 1)[:, 0].copy(),
    )  # fmt: skip


@numba.njit(cache=True, nogil=True)
def row_buffers(window: int, amplitudes: int) -> RowBuffers:
    """Buffers for rows of up to `window` pixels and this number of amplitudes."""
    return RowBuffers(
        np.empty(window, np.float32), np.empty(window, np.float32), np.empty(window, np.float32),
        np.empty(window, np.float32), np.empty(window, np.int32), np.empty(window, np.float32),
        np.empty(window, np.float32), np.empty(window, np.float32), np.empty(window, np.float32),
        np.empty((3, window), np.float32),
        np.empty(window + 1, np.float32), np.empty((amplitudes, window), np.float32), np.empty(window, np.float32),
        np.empty(amplitudes, np.float64),
    )  # fmt: skip


@numba.njit(inline="always")
def path_to_plane(px, py, pz, vy):  # type: ignore[no-untyped-def]
    """Length of the light's path to a plane's points on a row, per unit of depth. vy: ray tangent v of the row."""
    # Tangent u at which this row meets the plane infinitely far away.
    path_u = -(py * vy + pz) / px
    return np.sqrt(1.0 + path_u * path_u + vy * vy)


@numba.njit(inline="always")
def profile_place(px, py, pz, ux, vx, path_p, w_lo, per_w, bins):  # type: ignore[no-untyped-def]
    """Path from the camera to a plane's point, per unit of depth, the point's inverse depth, and fractional bin."""
    path_c = np.sqrt(np.float32(1.0) + ux * ux + vx * vx)
    w = px * ux + py * vx + pz
    return path_c, w, min(max((w * 2.0 / (path_p + path_c) - w_lo) * per_w, 0.0), bins - 1.001)


@numba.njit(inline="always")
def flux_between(ambient, gain, one, other, part):  # type: ignore[no-untyped-def]
    """Ambient flux plus gain times the profile, at `part` (0 to 1) of the way from bin value `one` to `other`."""
    return min(max(ambient + gain * (one + part * (other - one)), FLUX_MIN), FLUX_MAX)


@numba.njit(inline="always")
def line_light(sweep, state, y, c, middle):  # type: ignore[no-untyped-def]
    """Length p of the light's path to the plane's points on row y, per unit of depth, and G / c (both: see the module).

    middle: pixel of the row whose v is used.
    """
    plane = sweep.plane[c]
    path_p = path_to_plane(plane[0], plane[1], plane[2], sweep.v[y, middle])
    return path_p, state.row_gain[y] * state.column_gain[c] * path_p


@numba.njit(inline="always")
def others_at(sweep, state, y, c, x):  # type: ignore[no-untyped-def]
    """Haze at one pixel from the laser lines lit together with column c's; the same before and behind c's stripe.

    The positions of the other lines' stripes are unknown. The probability that a line's haze has not ended at the pixel
    is taken as the share of the depth range, in inverse depth, behind the pixel's point on that line's plane.
    """
    profile, light = state.profile, 0.0
    ux, vx = np.float64(sweep.u[y, x]), np.float64(sweep.v[y, x])
    path_c = np.sqrt(1.0 + ux * ux + vx * vx)
    for other in range(sweep.others.shape[1]):
        plane = sweep.others[c, other]
        path_p = path_to_plane(plane[0], plane[1], plane[2], vx)
        w = plane[0] * ux + plane[1] * vx + plane[2]
        there = min(max((w - sweep.w_far) / (sweep.w_near - sweep.w_far), 0.0), 1.0)
        b = min(max((w * 2.0 / (path_p + path_c) - state.w_lo) * state.per_w, 0.0), profile.shape[0] - 1.001)
        i = int(b)
        haze = profile[i, 0] + (b - i) * (profile[i + 1, 0] - profile[i, 0])
        rest = profile[i, 1] + (b - i) * (profile[i + 1, 1] - profile[i, 1])
        light += path_p * (there * haze + (1.0 - there) * rest)
    return np.float32(state.row_gain[y] * path_c * light)


@numba.njit(inline="always")
def fluxes_of(plane, ux, vx, ambient, profile, w_lo, per_w, path_p, strength):  # type: ignore[no-untyped-def]
    """Flux before and behind the stripe, its scale, G, inverse depth and nearest bin of one pixel, without other lines.

    ux, vx: the pixel's ray. path_p, strength: of `line_light`.
    """
    path_c, w, b = profile_place(plane[0], plane[1], plane[2], ux, vx, path_p, w_lo, per_w, profile.shape[0])
    i = int(b)
    f = np.float32(b - i)
    gain = strength * path_c
    before = flux_between(ambient, gain, profile[i, 0], profile[i + 1, 0], f)
    behind = flux_between(ambient, gain, profile[i, 1], profile[i + 1, 1], f)
    return before, behind, profile[i, 2] + f * (profile[i + 1, 2] - profile[i, 2]), gain, w, int(b + 0.5)


@numba.njit(inline="always")
def fluxes_at(sweep, state, y, x, c, path_p, strength):  # type: ignore[no-untyped-def]
    """`fluxes_of` for pixel x of row y and column c, with other lines' haze added to both fluxes and returned last."""
    before, behind, scale, gain, w, cell = fluxes_of(
        sweep.plane[c], sweep.u[y, x], sweep.v[y, x], state.ambient[y, x], state.profile, state.w_lo, state.per_w,
        path_p, strength,
    )  # fmt: skip
    others = np.float32(0.0)
    if sweep.others.shape[1] > 0:
        others = others_at(sweep, state, y, c, x)
        before, behind = min(before + others, FLUX_MAX), min(behind + others, FLUX_MAX)
    return before, behind, scale, gain, w, cell, others


@numba.njit(cache=True, nogil=True)
def row_fluxes(sweep: Sweep, state: RowState, row: RowBuffers, y: int, c: int) -> tuple[int, int, int, int]:
    """Fill the buffers `before` to `log_prior` for row y of column c. They do not depend on the counts.

    Returns (length, first and last index that a stripe may have, x of index 0); pixel t is x + t if near_is_left,
    else x - t. The length is 0 if there is nothing to search.
    """
    lo, hi, x0 = sweep.x_lo[y, c], sweep.x_hi[y, c], sweep.x0[c]
    if lo > hi:
        return 0, 0, -1, 0
    u, profile = sweep.u, state.profile
    first, last = with_rays(
        u, y, max(lo - MARGIN_PX, x0, 0), min(hi + MARGIN_PX, x0 + sweep.window - 1, u.shape[1] - 1)
    )
    length = last - first + 1
    start, step = (first, 1) if sweep.near_is_left else (last, -1)
    begin = lo - first if sweep.near_is_left else last - hi
    end = min(begin + hi - lo, length - 1)
    begin = max(begin, 0)
    if begin > end:
        return 0, 0, -1, 0
    path_p, strength = line_light(sweep, state, y, c, (first + last) // 2)
    # Local names: each use of a tuple in the loop would count references to all of its arrays.
    v, ambient, w_lo, per_w = sweep.v, state.ambient, state.w_lo, state.per_w
    plane = sweep.plane[c, 0], sweep.plane[c, 1], sweep.plane[c, 2]
    to_before, to_behind, to_scale, to_cell, to_gain = row.before, row.behind, row.scale, row.cell, row.gain
    to_others, to_w, to_prior = row.others, row.w, row.log_prior
    for t in range(length):
        x = start + step * t
        before, behind, scale, gain, w, cell = fluxes_of(
            plane, u[y, x], v[y, x], ambient[y, x], profile, w_lo, per_w, path_p, strength
        )
        to_before[t], to_behind[t], to_scale[t], to_cell[t], to_gain[t] = before, behind, scale, cell, gain
        to_others[t], to_w[t], to_prior[t] = 0.0, w, profile[cell, 3]
    if sweep.others.shape[1] > 0:
        for t in range(length):
            others = others_at(sweep, state, y, c, start + step * t)
            to_others[t] = others
            to_before[t], to_behind[t] = min(to_before[t] + others, FLUX_MAX), min(to_behind[t] + others, FLUX_MAX)
    return length, begin, end, start


@numba.njit(cache=True, nogil=True)
def judge_line(
    sweep: Sweep, state: RowState, row: RowBuffers, lines: Lines, i: int
) -> tuple[int, int, int, int, float, float, float]:
    """Compute the posterior of line i and write it to `row`.

    Returns the values of `row_fluxes` (the length is also 0 if there are no exposures), then the probability of 'no
    stripe', the part of the prior that lies beyond the picture's border, and the log evidence.
    """
    c = lines.column[i]
    length, first, last, start = row_fluxes(sweep, state, row, lines.row[i], c)
    if length == 0 or lines.exposures[i] == 0:
        return 0, 0, -1, 0, 1.0, 0.0, 0.0
    step = 1 if sweep.near_is_left else -1
    for t in range(length):
        row.n[t] = lines.counts[i, start + step * t - sweep.x0[c]]
    row_scores(
        row.n, np.float32(lines.exposures[i]), row.before, row.behind, row.scale, length, state.amplitude, state.psi,
        state.table, row.taps, row.edge, row.score,
    )  # fmt: skip
    if lines.trust[i] > 0.0:
        _heed_neighbours(row, first, last, (lines.x_px[i] - start) * step, lines.trust[i])
    prior = none_prior(sweep.w_near, sweep.w_far, row.w[first], row.w[last], state.none_weight)
    none, evidence = row_posterior(
        row.score, row.edge, length, first, last, state.log_weight, row.log_prior, prior, row.posterior,
        row.by_amplitude,
    )  # fmt: skip
    for t in range(length):
        evidence += row.taps[1, t]
    return length, first, last, start, none, prior[0] + prior[1] - 2.0 * prior[2], evidence


@numba.njit(cache=True, nogil=True)
def _heed_neighbours(row: RowBuffers, first: int, last: int, place: float, trust: float) -> None:
    """Change the prior of positions for a stripe that lies within about a pixel of `place` with probability `trust`."""
    mass = 0.0
    for t in range(first, last + 1):
        mass += np.exp(row.log_prior[t])
    for t in range(first, last + 1):
        near = np.exp(-0.5 * (t - place) ** 2) / np.sqrt(2.0 * np.pi)
        row.log_prior[t] = np.log((1.0 - trust) * np.exp(row.log_prior[t]) / mass + trust * near + 1e-9)
