"""Compiled inner loops of the yardstick's simulator.

A row is walked from its near side (where the sheet is closest to the camera). The sheet is in front of the object
while 1/z of the plane exceeds 1/z of the object; the first change of that order ends it.
"""

import math
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

JUMP = 0.02  # relative depth step between neighbouring pixels across which no stripe is seen
PROFILE_REACH_PX = 4

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX_A = np.uint64(0xBF58476D1CE4E5B9)
_MIX_B = np.uint64(0x94D049BB133111EB)
_TO_UNIT = 1.0 / 9007199254740992.0  # 2^-53
_MEAN_PER_DRAW = 20.0  # counts are drawn in parts so that exp(-mean) stays far from underflow


class Optics(NamedTuple):
    """Quantities that all stripes share: rays (H, W), planes (columns, 4), where the light comes from, medium, sensor.

    ambient: (H, W), with the dark counts of each pixel. halo_px: reaches of the halo's two exponentials.
    """

    u: NDArray[np.float64]
    v: NDArray[np.float64]
    planes: NDArray[np.float64]
    scanner: NDArray[np.float64]
    extinction: float
    haze: float
    ambient: NDArray[np.float64]
    sigma_px: float
    halo_px: tuple[float, float]


class Ends(NamedTuple):
    """Ends of the sheet and the light that it leaves there, arrays (H, columns); photons per exposure, 0 where nothing.

    halo: its total over both sides; pedestal: per pixel just behind the end; second: stripe of a nearer surface that
    light passes.
    """

    x_true: NDArray[np.float64]
    x_end: NDArray[np.float64]
    stripe: NDArray[np.float64]
    halo: NDArray[np.float64]
    pedestal: NDArray[np.float64]
    x_second: NDArray[np.float64]
    second: NDArray[np.float64]


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
    """Find where the sheet ends on each row: fills x_true, x_end, stripe (H, columns) for columns c0..c1.

    `strength` (H, W): albedo. x_true: sub-pixel stripe, NaN where none. x_end: where the haze ends (beyond the picture
    where it never does). stripe: strength / Z^2 * extinction, 0 where none.
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
def flux_row(optics, ends, y, c, out):  # type: ignore[no-untyped-def]
    """Photons per exposure of row y (W,) into `out`; the pixel that the object's edge cuts keeps its lit share."""
    width = out.shape[0]
    n0, n1, n2, d = optics.planes[c]
    step = 1.0 if n0 / d < 0 else -1.0
    x_end = ends.x_end[y, c]
    for x in range(width):
        lit = min(1.0, max(0.0, (x_end - x) * step + 0.5))
        out[x] = optics.ambient[y, x]
        if lit > 0.0 and optics.haze > 0.0:
            u, v = optics.u[y, x], optics.v[y, x]
            inverse_z = (n0 * u + n1 * v + n2) / d
            out[x] += optics.haze * lit * haze_at(u, v, inverse_z, optics.scanner, optics.extinction)
        if lit < 1.0 and ends.pedestal[y, c] > 0.0:
            behind_px = max(0.0, (x - x_end) * step)
            out[x] += ends.pedestal[y, c] * (1.0 - lit) * math.exp(-behind_px / optics.halo_px[1])
    add_line(ends.x_true[y, c], ends.stripe[y, c], optics.sigma_px, out)
    add_line(ends.x_second[y, c], ends.second[y, c], optics.sigma_px, out)
    if ends.halo[y, c] > 0.0:
        for reach_px in optics.halo_px:
            # integral over a pixel of exp(-|r| / reach) / (2 reach), an even share for each reach
            share = 0.5 * math.sinh(0.5 / reach_px)
            for x in range(width):
                out[x] += ends.halo[y, c] * share * math.exp(-abs(x - ends.x_true[y, c]) / reach_px)


@numba.njit(cache=True, nogil=True)
def add_line(x_line, light, sigma_px, out):  # type: ignore[no-untyped-def]
    """Add a Gaussian line of `light` photons at x_line, integrated over the pixels; nothing where there is none."""
    if light <= 0.0:
        return
    centre = round(x_line)
    scale = 1.0 / (sigma_px * math.sqrt(2.0))
    for x in range(max(0, centre - PROFILE_REACH_PX), min(out.shape[0], centre + PROFILE_REACH_PX + 1)):
        share = 0.5 * (math.erf((x + 0.5 - x_line) * scale) - math.erf((x - 0.5 - x_line) * scale))
        out[x] += light * share


@numba.njit(cache=True, nogil=True)
def flux_columns(optics, ends, c0, c1, out):  # type: ignore[no-untyped-def]
    """Photons per exposure of columns c0..c1 into out (c1 - c0, H, W)."""
    row = np.empty(out.shape[2], np.float64)
    for c in range(c0, c1):
        for y in range(out.shape[1]):
            flux_row(optics, ends, y, c, row)
            out[c - c0, y, :] = row


@numba.njit(cache=True, nogil=True)
def draw_counts(optics, ends, exposures, seed, x0, c0, c1, out):  # type: ignore[no-untyped-def]
    """Binomial counts of columns c0..c1 into out (columns, H, window): inversion, one uniform number a pixel and part.

    The window of column c begins at pixel x0[c] and may pass the picture's end, where it stays 0; what is drawn for a
    pixel does not depend on the window.
    """
    width, window = optics.u.shape[1], out.shape[2]
    row = np.empty(width, np.float64)
    for c in range(c0, c1):
        stop = min(width, x0[c] + window)
        for y in range(out.shape[1]):
            flux_row(optics, ends, y, c, row[:stop])
            state = stream_of(seed, c, y)
            for x in range(stop):
                part = max(1, min(exposures, int(_MEAN_PER_DRAW / max(row[x], 1e-9))))
                if x < x0[c]:
                    state += _GOLDEN * np.uint64((exposures + part - 1) // part)
                    continue
                odds = math.expm1(row[x])
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
                out[c, y, x - x0[c]] = total


@numba.njit(cache=True, nogil=True)
def sub_pixel_information(optics, ends, step_px, rows, c0, c1, out):  # type: ignore[no-untyped-def]
    """Fisher information of one exposure on the place of stripe and haze's end, sum of lambda'^2 / (e^lambda - 1).

    `rows`: which rows of out (H, columns) are filled, 0 where there is no stripe. The derivative is a central
    difference over +-step_px; amplitude and light are taken as known.
    """
    width = optics.u.shape[1]
    here, less, more = np.empty(width), np.empty(width), np.empty(width)
    for c in range(c0, c1):
        for y in rows:
            out[y, c] = 0.0
            if ends.stripe[y, c] <= 0.0:
                continue
            flux_row(optics, ends, y, c, here)
            x_true, x_end = ends.x_true[y, c], ends.x_end[y, c]
            ends.x_true[y, c], ends.x_end[y, c] = x_true - step_px, x_end - step_px
            flux_row(optics, ends, y, c, less)
            ends.x_true[y, c], ends.x_end[y, c] = x_true + step_px, x_end + step_px
            flux_row(optics, ends, y, c, more)
            ends.x_true[y, c], ends.x_end[y, c] = x_true, x_end
            for x in range(width):
                slope = (more[x] - less[x]) / (2.0 * step_px)
                out[y, c] += slope * slope / math.expm1(here[x])


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
