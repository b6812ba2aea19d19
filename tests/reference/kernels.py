"""Compiled inner loops of the yardstick's simulator.

A row is walked from its near side (where the sheet is closest to the camera). The sheet is in front of the object
while 1/z of the plane exceeds 1/z of the object; the first change of that order ends it.
"""

from __future__ import annotations

import math

import numba
import numpy as np

JUMP = 0.02  # relative depth step between neighbouring pixels across which no stripe is seen
PROFILE_REACH_PX = 4

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX_A = np.uint64(0xBF58476D1CE4E5B9)
_MIX_B = np.uint64(0x94D049BB133111EB)
_TO_UNIT = 1.0 / 9007199254740992.0  # 2^-53
_MEAN_PER_DRAW = 20.0  # counts are drawn in parts so that exp(-mean) stays far from underflow


@numba.njit(cache=True, nogil=True)
def mixed(z):  # type: ignore[no-untyped-def]
    """Finaliser of splitmix64 (Steele, Lea and Flood 2014)."""
    z = (z ^ (z >> np.uint64(30))) * _MIX_A
    z = (z ^ (z >> np.uint64(27))) * _MIX_B
    return z ^ (z >> np.uint64(31))


@numba.njit(cache=True, nogil=True)
def stream_of(seed, column, row):  # type: ignore[no-untyped-def]
    """Start of an independent random stream for one row of one column."""
    z = mixed(np.uint64(seed) + _GOLDEN)
    z = mixed(z + np.uint64(column) * _GOLDEN + np.uint64(1))
    return mixed(z + np.uint64(row) * _GOLDEN + np.uint64(2))


@numba.njit(cache=True, nogil=True)
def find_stripes(u, v, depth, strength, planes, scanner, extinction, c0, c1, x_true, x_end, stripe):  # type: ignore[no-untyped-def]
    """Where the sheet ends on each row: fills x_true, x_end, stripe (H, columns) for columns c0..c1.

    `strength` (H, W): albedo, times the cosine where wanted. x_true: sub-pixel stripe, NaN where none. x_end: where
    the haze ends (beyond the picture where it never does). stripe: strength / Z^2 * extinction, 0 where none.
    """
    height, width = depth.shape
    for c in range(c0, c1):
        n0, n1, n2, d = planes[c]
        step = 1 if n0 / d < 0 else -1
        for y in range(height):
            x_true[y, c] = np.nan
            stripe[y, c] = 0.0
            x = 0 if step > 0 else width - 1
            last = width - 1 if step > 0 else 0
            before = (n0 * u[y, x] + n1 * v[y, x] + n2) / d - 1.0 / depth[y, x]
            if before <= 0.0:  # hidden by what stands at the border of the picture
                x_end[y, c] = x - 0.5 * step
                continue
            x_end[y, c] = last + 1.0 * step
            while x != last:
                nxt = x + step
                after = (n0 * u[y, nxt] + n1 * v[y, nxt] + n2) / d - 1.0 / depth[y, nxt]
                if after <= 0.0:
                    za, zb = depth[y, x], depth[y, nxt]
                    if abs(za - zb) > JUMP * min(za, zb):
                        x_end[y, c] = x + 0.5 * step
                        break
                    f = before / (before - after)
                    x_true[y, c] = x + step * f
                    x_end[y, c] = x + step * f
                    uu = u[y, x] + f * (u[y, nxt] - u[y, x])
                    vv = v[y, x] + f * (v[y, nxt] - v[y, x])
                    z = 1.0 / (1.0 / za + f * (1.0 / zb - 1.0 / za))
                    rho = strength[y, x] + f * (strength[y, nxt] - strength[y, x])
                    path = path_length(uu, vv, z, scanner)
                    stripe[y, c] = rho / (z * z) * math.exp(-extinction * path)
                    break
                x = nxt
                before = after


@numba.njit(cache=True, nogil=True)
def path_length(u, v, z, scanner):  # type: ignore[no-untyped-def]
    """Length in metres from the scanner to the point at depth z on the ray (u, v, 1) and on to the camera."""
    to_camera = z * math.sqrt(u * u + v * v + 1.0)
    dx, dy, dz = u * z - scanner[0], v * z - scanner[1], z - scanner[2]
    return to_camera + math.sqrt(dx * dx + dy * dy + dz * dz)


@numba.njit(cache=True, nogil=True)
def haze_at(u, v, inverse_z, scanner, extinction):  # type: ignore[no-untyped-def]
    """|q_p||q_c| exp(-extinction z (|q_p| + |q_c|)) of a free sheet; 0 where the ray never meets it."""
    if inverse_z <= 0.0:
        return 0.0
    z = 1.0 / inverse_z
    q_c = math.sqrt(u * u + v * v + 1.0)
    dx, dy, dz = u * z - scanner[0], v * z - scanner[1], z - scanner[2]
    r_p = math.sqrt(dx * dx + dy * dy + dz * dz)
    return r_p * inverse_z * q_c * math.exp(-extinction * (z * q_c + r_p))


@numba.njit(cache=True, nogil=True)
def flux_row(u, v, plane, scanner, extinction, haze, ambient, sigma_px, x_true, x_end, stripe, out):  # type: ignore[no-untyped-def]
    """Photons per exposure of one row (W,) into `out`; the pixel that the object's edge cuts keeps its lit share."""
    width = out.shape[0]
    n0, n1, n2, d = plane
    step = 1.0 if n0 / d < 0 else -1.0
    for x in range(width):
        lit = min(1.0, max(0.0, (x_end - x) * step + 0.5))
        out[x] = ambient
        if lit > 0.0 and haze > 0.0:
            out[x] += haze * lit * haze_at(u[x], v[x], (n0 * u[x] + n1 * v[x] + n2) / d, scanner, extinction)
    if stripe > 0.0:
        centre = round(x_true)
        scale = 1.0 / (sigma_px * math.sqrt(2.0))
        for x in range(max(0, centre - PROFILE_REACH_PX), min(width, centre + PROFILE_REACH_PX + 1)):
            share = 0.5 * (math.erf((x + 0.5 - x_true) * scale) - math.erf((x - 0.5 - x_true) * scale))
            out[x] += stripe * share


@numba.njit(cache=True, nogil=True)
def flux_columns(u, v, planes, scanner, extinction, haze, ambient, sigma_px, x_true, x_end, stripe, c0, c1, out):  # type: ignore[no-untyped-def]
    """Photons per exposure of columns c0..c1 into out (c1 - c0, H, W)."""
    row = np.empty(u.shape[1], np.float64)
    for c in range(c0, c1):
        for y in range(u.shape[0]):
            flux_row(
                u[y], v[y], planes[c], scanner, extinction, haze, ambient, sigma_px,
                x_true[y, c], x_end[y, c], stripe[y, c], row,
            )  # fmt: skip
            out[c - c0, y, :] = row


@numba.njit(cache=True, nogil=True)
def draw_counts(  # type: ignore[no-untyped-def]
    u, v, planes, scanner, extinction, haze, ambient, sigma_px, x_true, x_end, stripe, exposures, seed, c0, c1, out
):
    """Binomial counts of columns c0..c1 into out (columns, H, W): inversion, one uniform number a pixel and part."""
    width = u.shape[1]
    row = np.empty(width, np.float64)
    for c in range(c0, c1):
        for y in range(u.shape[0]):
            flux_row(
                u[y], v[y], planes[c], scanner, extinction, haze, ambient, sigma_px,
                x_true[y, c], x_end[y, c], stripe[y, c], row,
            )  # fmt: skip
            state = stream_of(seed, c, y)
            for x in range(width):
                odds = math.expm1(row[x])
                part = max(1, min(exposures, int(_MEAN_PER_DRAW / max(row[x], 1e-9))))
                left = exposures
                total = 0
                while left > 0:
                    trials = min(left, part)
                    left -= trials
                    state += _GOLDEN
                    uniform = (mixed(state) >> np.uint64(11)) * _TO_UNIT
                    term = math.exp(-row[x] * trials)
                    n = 0
                    while uniform >= term and n < trials:
                        uniform -= term
                        term *= odds * (trials - n) / (n + 1)
                        n += 1
                    total += n
                out[c, y, x] = total


@numba.njit(cache=True, nogil=True)
def scatter_frames(counts, exposures, seed, column, out):  # type: ignore[no-untyped-def]
    """Spread the counts (H, W) of a column over its frames at random: bits (exposures, H, row bytes), MSB first."""
    height, width = counts.shape
    out[:] = 0
    for y in range(height):
        state = stream_of(np.uint64(seed) ^ np.uint64(0x5DEECE66D), column, y)
        for x in range(width):
            wanted = int(counts[y, x])
            if wanted == 0:
                continue
            bit = np.uint8(128 >> (x & 7))
            for k in range(exposures):
                state += _GOLDEN
                uniform = (mixed(state) >> np.uint64(11)) * _TO_UNIT
                if uniform * (exposures - k) < wanted:
                    out[k, y, x >> 3] |= bit
                    wanted -= 1
                    if wanted == 0:
                        break
