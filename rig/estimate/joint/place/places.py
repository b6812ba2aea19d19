"""Sub-pixel placing of stripes by one step of Fisher scoring, pooled over neighbours on the same surface.

The counts around each stripe n give the slope of the log-likelihood with respect to the stripe's position (the score g)
and the Fisher information h (`rig.estimate.joint.place.light`). Neighbours on one surface have the same distance d, in
px, from the position at the far end of the depth range. The pooled value

    d = sum (h_n d_n + g_n) / sum h_n

is as accurate as the maximum of their common likelihood, and 1 / sqrt(sum h_n) is its standard deviation. Before that,
the stripes' brightness is pooled; otherwise a dark stripe would be taken for a brighter one that stands on haze.

Counts are stored column by column, but answers are processed row by row, LANES columns to a vector. So the counts
around all stripes are brought into the order of the answers once, in tiles of rows and columns (`fetch_counts`). All
results are float32 (rows, columns).
"""

from typing import Final, NamedTuple

import numba
import numpy as np

from rig.count.volume import Counts
from rig.estimate.row.inputs import RowState, Sweep, fluxes_at, line_light
from rig.simd import Float32, Float64, Int32
from rig.simd.memory import address_of, prefetch, read_float32, read_int64, write_float32, write_int64
from rig.simd.shuffles import EIGHT, spread_eights
from rig.simd.vectors import LANES

REACH_PX: Final = 3
"""Pixels to either side of a stripe from which its place is computed."""
LIGHT_PX: Final = 2
"""Pixels to either side of a stripe over which its light is summed."""
CLEAR: Final = 0.9
CLEAR_SD_PX: Final = 0.2
"""The line's width is measured on stripes of more confidence than CLEAR and less deviation than CLEAR_SD_PX."""
BESIDE_PX: Final = 5, 6
"""From which to which distance, in px, the pixels beside a line show its halo and nothing of the line itself."""
BLIND_FLUX: Final = np.float32(3.0)
"""Ambient light with which a pixel fires in 95 % of all frames and shows nothing; pixels not to be used have more."""
LEAST_FRAMES: Final = 2.0
"""Least number of frames with which a line's width is measured in a halo: with fewer, the light beside the line is so
uncertain that the line seems far too narrow."""
FEW_FRAMES: Final = 3.0
"""Frames up to which the share of ones is used as the light: the flux of a full pixel would be a guess."""
DARK_FRAMES: Final = 1.5
FEW_FRAMES_FLUX: Final = 0.5
"""Flux above which a pixel of FEW_FRAMES frames or fewer counts as saturated."""


class Places(NamedTuple):
    """Light and place of each stripe, float32 (rows, columns) each.

    distance: x from the far end in px, NaN if there is no stripe; light: photons per exposure above haze and ambient
    light; scale: light at amplitude 1; amplitude: light / scale, pooled; haze, rest: flux above ambient light, before
    and behind the stripe; glow: halo per pixel at the stripe, as a share of the stripe's light; known: h of the module;
    score: h times distance, plus g; placed: the final distance; joined, joined_sd: intermediate distance and its
    standard deviation.
    """

    distance: Float32
    light: Float32
    scale: Float32
    amplitude: Float32
    haze: Float32
    rest: Float32
    glow: Float32
    score: Float32
    known: Float32
    placed: Float32
    joined: Float32
    joined_sd: Float32


@numba.njit(inline="always")
def most_shown(frames):  # type: ignore[no-untyped-def]
    """Largest flux that a number of frames measure well: that with which DARK_FRAMES of them stay dark.

    For few frames it is FEW_FRAMES_FLUX.
    """
    return np.log(frames / DARK_FRAMES) if frames > FEW_FRAMES else FEW_FRAMES_FLUX


@numba.njit(cache=True, nogil=True)
def add_moments(
    counts: Counts, n_frames: Int32, sweep: Sweep, state: RowState, x_px: Float32, sd_px: Float32, confidence: Float32,
    signal: Float32, first_row: int, last_row: int, sums: Float64,
) -> None:  # fmt: skip
    """Add to sums (rows, 2) the light of clear stripes within REACH_PX, and light times (its squared distance - sd^2).

    Light is in photons per exposure, without haze, halo and ambient light. Each row of sums belongs to a row of the
    picture. With a halo, stripes that saturate their pixels are left out, since the halo would be taken for their
    flanks, and stripes of fewer than LEAST_FRAMES frames.
    """
    for y in range(first_row, last_row):
        for c in range(x_px.shape[1]):
            if not (confidence[y, c] > CLEAR and sd_px[y, c] < CLEAR_SD_PX and n_frames[c] > 0):
                continue
            x = int(np.rint(x_px[y, c]))
            begin, end = x - BESIDE_PX[1], x + BESIDE_PX[1]
            if begin < max(sweep.x0[c], 0) or end >= min(sweep.x0[c] + sweep.window, sweep.u.shape[1]):
                continue
            # Pixels without a ray lie at the ends of a row.
            if np.isnan(sweep.u[y, begin]) or np.isnan(sweep.u[y, end]):
                continue
            if state.ambient[y, begin : end + 1].max() >= BLIND_FLUX:
                continue
            path_p, strength = line_light(sweep, state, y, c, x)
            before, behind, _, _, _, cell, _ = fluxes_at(sweep, state, y, x, c, path_p, strength)
            reach, frames = REACH_PX, np.float64(n_frames[c])
            if state.glow[cell] > 0.0:
                reach = BESIDE_PX[1]
                if frames < LEAST_FRAMES or signal[y, c] * state.psi[0] > most_shown(frames):
                    continue
            side = 1 if sweep.near_is_left else -1
            halo, level, wide = 0.0, 0.0, 0.0
            for t in range(x - reach, x + reach + 1):
                if REACH_PX < abs(t - x) < BESIDE_PX[0]:
                    continue
                away = t - np.float64(x_px[y, c])
                lit = min(max(0.5 - side * away, 0.0), 1.0)
                base = state.ambient[y, t] - state.ambient[y, x] + behind + lit * (before - behind)
                n = min(np.float64(counts[c, y, t - sweep.x0[c]]), frames)
                light = np.log((frames + 0.5) / (frames - n + 0.5)) if frames > FEW_FRAMES else n / frames
                light -= base if frames > FEW_FRAMES else -np.expm1(-base)
                if abs(t - x) > REACH_PX:
                    halo += light / (2 * (BESIDE_PX[1] - BESIDE_PX[0] + 1))
                    continue
                spread = away * away - sd_px[y, c] * sd_px[y, c]
                sums[y, 0] += light
                sums[y, 1] += light * spread
                level += 1.0
                wide += spread
            sums[y, 0] -= halo * level
            sums[y, 1] -= halo * wide


TAPS: Final = 2 * REACH_PX + 1
"""Number of pixels around a stripe that are used; EIGHT are fetched."""
MOST_FLUX: Final = np.float32(20.0)
"""Largest flux: it leaves a pixel dark once in 5 x 10^8 exposures. Missing pixels get it as ambient light."""
_TILE: Final = 16


@numba.njit(cache=True, nogil=True)
def fetch_counts(counts: Counts, x0: Int32, x_px: Float32, first_row: int, last_row: int, around: Counts) -> None:
    """Fetch EIGHT counts for each stripe, the first of them REACH_PX before its pixel, for rows first_row..last_row-1.

    counts: (columns, rows, window), C-contiguous; around: (rows, columns, EIGHT), filled, of the same type. Values are
    0 where no pixel was stored, and arbitrary where there is no stripe.
    """
    columns, rows, window = counts.shape
    size, column = counts.itemsize, rows * window * counts.itemsize
    source, to = address_of(counts), address_of(around)
    for top in range(first_row, last_row, _TILE):
        for left in range(0, columns, _TILE):
            for c in range(left, min(left + _TILE, columns)):
                for y in range(top, min(top + _TILE, last_row)):
                    if np.isnan(x_px[y, c]):
                        continue
                    first = nearest_pixel(x_px[y, c]) - REACH_PX - int(x0[c])
                    if 0 <= first <= window - EIGHT:
                        at = source + ((c * rows + y) * window + first) * size
                        # The processor does not prefetch the next column's counts itself.
                        prefetch(at + column)
                        for i in range(size):
                            write_int64(to + (y * columns + c) * EIGHT * size, i, read_int64(at, i))
                    else:
                        for d in range(EIGHT):
                            stored = 0 <= first + d < window
                            around[y, c, d] = counts[c, y, first + d] if stored else 0


@numba.njit(inline="always")
def nearest_pixel(x):  # type: ignore[no-untyped-def]
    """The pixel that contains x."""
    return int(np.floor(x + np.float32(0.5)))


@numba.njit(forceinline=True)
def ambient_place(ambient, width, y, x, x0, window, spare):  # type: ignore[no-untyped-def]
    """Address of a row's ambient light, from REACH_PX before pixel x on. It is copied to `spare` if a part is missing.

    ambient: address of rows of `width` pixels; spare: address of EIGHT numbers, set to MOST_FLUX for pixels that were
    not stored or lie outside the picture.
    """
    first, low, high = x - REACH_PX, max(x0, 0), min(x0 + window, width)
    if low <= first <= high - EIGHT:
        return ambient + 4 * (y * width + first)
    for d in range(EIGHT):
        there = low <= first + d < high
        write_float32(spare, d, read_float32(ambient, y * width + first + d) if there else MOST_FLUX)
    return spare


@numba.njit(forceinline=True)
def counts_of(around, at, y, c, to):  # type: ignore[no-untyped-def]
    """Write EIGHT vectors of counts of stripes c..c+LANES-1 of row y to address `to`. at: address of `around`."""
    if around.itemsize == 1 and c + LANES <= around.shape[1]:
        spread_eights(at + (y * around.shape[1] + c) * EIGHT, to)
        return
    for i in range(LANES):
        for d in range(EIGHT):
            count = np.float32(around[y, c + i, d]) if c + i < around.shape[1] else np.float32(0.0)
            write_float32(to, d * LANES + i, count)
