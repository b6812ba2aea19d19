"""Compiled sub-pixel placing of stripes: one step of Fisher scoring, pooled over neighbours on the same surface.

At its answer each row says how much likelier its counts become with the stripe a little further on (the score g), and
how much it knows of that at all (the information h). Neighbours on one surface share its distance d from the far end:

    d = sum (h d_n + g_n) / sum h

over them is as good as the maximum of their common likelihood, and 1 / sqrt(sum h) its standard deviation. A stripe's
brightness is pooled in the same way before: on its own a dark row is taken for a brighter one that stands on haze.
"""

from typing import Final, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rig.estimators.row_input import State, Sweep, fluxes_at, line_light

Float32 = NDArray[np.float32]

REACH_PX: Final = 3
"""Pixels to either side of a stripe that say where it is."""
LIGHT_PX: Final = 2
"""Pixels to either side that its light is summed over."""
FRACTIONS: Final = 16
"""Parts of a pixel that the line's profile is told apart in."""
SAME_PX: Final = np.float32(1.0)
"""Neighbours whose distances from the far end differ by no more lie on the same surface."""
LEAST_FLUX: Final = np.float32(1e-5)
CLEAR: Final = 0.9
CLEAR_SD_PX: Final = 0.2
"""Stripes this clear, and placed this well, tell the width of the line."""
BESIDE_PX: Final = 5, 6
"""Pixels to either side, from and to, that show how much of a halo is under a line, and nothing of the line."""
FEW_FRAMES: Final = 3.0
"""Up to so many frames counts are taken as they are: the flux of a full pixel would be a guess."""


class Places(NamedTuple):
    """Room for what is known of each stripe, float32 (rows, columns) each.

    distance: x from the far end in px, NaN where there is none; light: photons per exposure above haze and ambient;
    scale: those of amplitude 1; haze: before it; known: h of the module; score: h times distance, plus g.
    """

    distance: Float32
    light: Float32
    scale: Float32
    amplitude: Float32
    haze: Float32
    score: Float32
    known: Float32


@numba.njit(cache=True, nogil=True)
def measure_light(
    counts: NDArray[np.unsignedinteger],
    n_frames: NDArray[np.int32],
    sweep: Sweep,
    state: State,
    x_px: Float32,
    first_row: int,
    last_row: int,
    out: Places,
) -> None:
    """Fill light, scale and haze of rows first_row..last_row-1 for stripes at x_px; zeros where there is none."""
    half = np.float32(0.5)
    for y in range(first_row, last_row):
        for c in range(x_px.shape[1]):
            out.light[y, c] = out.scale[y, c] = out.haze[y, c] = 0.0
            if np.isnan(x_px[y, c]) or n_frames[c] == 0:
                continue
            frames = np.float32(n_frames[c])
            x = min(max(int(np.rint(x_px[y, c])), sweep.x_lo[y, c]), sweep.x_hi[y, c])
            path_p, strength = line_light(sweep, state, y, c, x)
            before, behind, scale, _, _, cell, _ = fluxes_at(sweep, state, y, x, c, path_p, strength)
            own = state.ambient[y, x]
            # A pixel that the picture does not have counts as one of just the expected light.
            light = -(LIGHT_PX + half) * (before + behind - own - own)
            for t in range(x - LIGHT_PX, x + LIGHT_PX + 1):
                at = t - sweep.x0[c]
                if 0 <= at < sweep.window and 0 <= t < sweep.u.shape[1]:
                    n = min(np.float32(counts[c, y, at]), frames)
                    light += np.log((frames + half) / (frames - n + half)) - state.ambient[y, t]
                else:
                    light += half * (before + behind) - own
            # What the halo adds to the light of the line grows with it.
            light /= np.float32(1.0) + np.float32(2 * LIGHT_PX + 1) * state.glow[cell]
            out.light[y, c], out.scale[y, c] = light, scale
            out.haze[y, c] = max(before - own, np.float32(0.0))


@numba.njit(cache=True, nogil=True)
def score_places(
    counts: NDArray[np.unsignedinteger],
    n_frames: NDArray[np.int32],
    sweep: Sweep,
    state: State,
    shares: Float32,
    x_px: Float32,
    side: int,
    first_row: int,
    last_row: int,
    out: Places,
) -> None:
    """Fill score and known of rows first_row..last_row-1 for stripes at x_px.

    shares: (FRACTIONS, 2, 2 REACH_PX + 1), share of the line in each pixel around the one that holds its centre, and
    by how much that grows with every pixel that the centre moves on.
    """
    half, one = np.float32(0.5), np.float32(1.0)
    for y in range(first_row, last_row):
        for c in range(x_px.shape[1]):
            out.score[y, c] = out.known[y, c] = 0.0
            if np.isnan(x_px[y, c]) or n_frames[c] == 0:
                continue
            frames = np.float32(n_frames[c])
            x = int(np.floor(x_px[y, c] + half))
            part = x_px[y, c] + half - x
            profile = shares[min(int(part * FRACTIONS), FRACTIONS - 1)]
            near = min(max(x, sweep.x_lo[y, c]), sweep.x_hi[y, c])
            path_p, strength = line_light(sweep, state, y, c, near)
            before, behind, scale, _, _, cell, _ = fluxes_at(sweep, state, y, near, c, path_p, strength)
            light = out.amplitude[y, c] * scale
            # Around its middle the halo is level.
            before += light * state.glow[cell] - state.ambient[y, near]
            behind += light * state.glow[cell] - state.ambient[y, near]
            score, known = np.float32(0.0), np.float32(0.0)
            for d in range(-REACH_PX, REACH_PX + 1):
                t = x + d
                at = t - sweep.x0[c]
                if at < 0 or at >= sweep.window or t < 0 or t >= sweep.u.shape[1]:
                    continue
                # The pixel that holds the centre is in haze on its near part only.
                lit = part if side > 0 else one - part
                base = behind + lit * (before - behind) if d == 0 else (before if d * side < 0 else behind)
                slope = light * profile[1, d + REACH_PX]
                if d == 0:
                    slope += side * (before - behind)
                flux = max(state.ambient[y, t] + base + light * profile[0, d + REACH_PX], LEAST_FLUX)
                more = np.expm1(flux)
                score += slope * (np.float32(counts[c, y, at]) * (more + one) / more - frames)
                known += frames * slope * slope / more
            out.score[y, c], out.known[y, c] = known * out.distance[y, c] + score, known


@numba.njit(cache=True, nogil=True, fastmath={"reassoc", "contract", "nsz"}, error_model="numpy")
def pool_row(distance: Float32, first: Float32, second: Float32, y: int, reach: int, sums: Float32) -> None:
    """Sums (2, columns) of `first` and `second` over the neighbours of row y on the same surface, itself included."""
    rows, columns = distance.shape
    sums[:] = 0.0
    own = distance[y]
    for other in range(max(y - reach, 0), min(y + reach + 1, rows)):
        for shift in range(-reach, reach + 1):
            begin, end = max(0, -shift), min(columns, columns - shift)
            here, there = own[begin:end], distance[other, begin + shift : end + shift]
            a, b = first[other, begin + shift : end + shift], second[other, begin + shift : end + shift]
            to_a, to_b = sums[0, begin:end], sums[1, begin:end]
            for i in range(len(here)):
                same = abs(there[i] - here[i]) <= SAME_PX
                to_a[i] += a[i] if same else np.float32(0.0)
                to_b[i] += b[i] if same else np.float32(0.0)


@numba.njit(cache=True, nogil=True)
def pool_amplitude(
    reach: int, faintest: float, brightest: float, first_row: int, last_row: int, places: Places
) -> None:
    """Fill amplitude: brightness of each stripe over that of its scale, pooled over neighbours, between two limits."""
    amplitude = places.amplitude
    sums = np.empty((2, amplitude.shape[1]), np.float32)
    for y in range(first_row, last_row):
        pool_row(places.distance, places.light, places.scale, y, reach, sums)
        for c in range(amplitude.shape[1]):
            own = sums[0, c] / max(sums[1, c], np.float32(1e-12))
            amplitude[y, c] = min(max(own, np.float32(faintest)), np.float32(brightest))


@numba.njit(cache=True, nogil=True)
def pool_places(
    places: Places, reaches: tuple[int, ...], enough: float, first_row: int, last_row: int, moved: Float32, sd: Float32
) -> None:
    """By how far in x each stripe is to move, and the standard deviation of where it is then, in px.

    reaches: sizes of the neighbourhood, smallest first; the first one that knows `enough` (1/px^2) is taken.
    """
    columns = moved.shape[1]
    sums = np.empty((2, columns), np.float32)
    for y in range(first_row, last_row):
        waiting = columns
        for i in range(len(reaches)):
            if waiting == 0:
                break
            pool_row(places.distance, places.score, places.known, y, reaches[i], sums)
            waiting = 0
            for c in range(columns):
                if i > 0 and sd[y, c] >= 0.0:
                    continue
                known = sums[1, c]
                if known < enough and i < len(reaches) - 1:
                    sd[y, c] = -1.0
                    waiting += 1
                    continue
                step = sums[0, c] / max(known, np.float32(1e-12)) - places.distance[y, c]
                moved[y, c] = min(max(step, np.float32(-1.0)), np.float32(1.0)) if known > 0.0 else np.float32(0.0)
                sd[y, c] = min(np.float32(1.0) / np.sqrt(max(known, np.float32(1e-12))), np.float32(1.0))


@numba.njit(cache=True, nogil=True)
def add_moments(
    counts: NDArray[np.unsignedinteger],
    n_frames: NDArray[np.int32],
    sweep: Sweep,
    state: State,
    x_px: Float32,
    sd_px: Float32,
    confidence: Float32,
    first_row: int,
    last_row: int,
    sums: NDArray[np.float64],
) -> None:
    """Add to sums (rows, 2) the light of clear stripes within REACH_PX, and that times its squared distance less sd^2.

    Light above haze, halo and ambient, photons; what is added to a row of sums comes from that row of the picture.
    """
    for y in range(first_row, last_row):
        for c in range(x_px.shape[1]):
            if not (confidence[y, c] > CLEAR and sd_px[y, c] < CLEAR_SD_PX and n_frames[c] > 0):
                continue
            x = int(np.rint(x_px[y, c]))
            path_p, strength = line_light(sweep, state, y, c, x)
            before, behind, _, _, _, cell, _ = fluxes_at(sweep, state, y, x, c, path_p, strength)
            reach = BESIDE_PX[1] if state.glow[cell] > 0.0 else REACH_PX
            if x - reach < max(sweep.x0[c], 0) or x + reach >= min(sweep.x0[c] + sweep.window, sweep.u.shape[1]):
                continue
            side = 1 if sweep.near_is_left else -1
            frames = np.float64(n_frames[c])
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
