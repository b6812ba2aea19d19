"""Compiled light of stripes for the fit of the halo: the likeliest one, of a stripe and its neighbours together.

A halo is told by what a stripe brings beside itself, over its own light. The light of `placing_light` adds up each
pixel's own flux, which ends where pixels are full: bright stripes would pass for dimmer ones with so much more halo.
Here the counts n of K frames of all pixels around a stripe and around its neighbours on the same surface are explained
by one amplitude a,

    flux = base + a scale (share + glow),   log-likelihood = sum n log(1 - exp(-flux)) - (K - n) flux

with haze and ambient light as base. It is concave in a; Newton's steps come from below, since the slope is convex. What
full pixels cannot tell those beside them do.

Where that amplitude is hardly more than its noise there may be no stripe, and where neighbours do not agree on it some
are brighter, or in a shadow: the light of such stripes is not known.
"""

import math
from typing import Final

import numba
import numpy as np
from numpy.typing import NDArray

from rig.estimators.placing_kernels import BLIND_FLUX, REACH_PX, Places
from rig.estimators.placing_pools import SAME_PX
from rig.estimators.placing_scores import FRACTIONS
from rig.estimators.row_input import Float32, State, Sweep

REACH: Final = 2
"""Rows and columns to either side whose stripes are asked."""
LEAST_ASKED: Final = 10
"""Stripes, of 25, that lie on the same surface where light is known."""
LEAST_SURE: Final = 4.0
"""Standard deviations of its noise that the light is more than."""
DISAGREED: Final = 3.0
"""Standard deviations by which the stripes' misfit may exceed what chance brings. Of the stripes that the trust of
`joint_teaching` lets through 17 to 19 % are none, and light adds up to 0.6 of the true one; of those that pass these
limits under 1 %, and 0.8 to 0.9 (random scenes 45 and 50, five exposures)."""
MOST_STEPS: Final = 8
MOST_GROWTH: Final = 4.0
"""By so much an amplitude may grow or shrink in a step."""
SETTLED: Final = 1e-2
LEAST_FLUX: Final = 1e-4
MOST_FLUX: Final = 20.0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def likeliest_light(
    counts: NDArray[np.unsignedinteger],
    n_frames: NDArray[np.int32],
    sweep: Sweep,
    state: State,
    shares: Float32,
    x_px: Float32,
    places: Places,
    rows: NDArray[np.int32],
    columns: NDArray[np.int32],
    first_line: int,
    last_line: int,
    light: Float32,
    known: NDArray[np.bool_],
) -> None:
    """Fill light, photons per exposure, and known of stripes first_line..last_line-1 of those at (rows, columns).

    counts: (columns, rows, window); shares: of `placing.profile_table`; x_px: (rows, columns), of all stripes.
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
            settled = abs(a - before) < SETTLED * before
            if settled:
                break
        light[i] = a * places.scale[y, c]
        known[i] = settled and asked >= LEAST_ASKED and a * math.sqrt(information) > LEAST_SURE
        known[i] = known[i] and misfit < asked + DISAGREED * math.sqrt(2.0 * asked)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _ask(counts, n_frames, sweep, state, shares, x_px, places, y, c, a):  # type: ignore[no-untyped-def]
    """Slope of the log-likelihood in the amplitude and how fast it falls; misfit of the stripes, and their number.

    misfit: sum of each stripe's own slope squared, over its variance.
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
                # The pixel that holds the centre is in haze on its near part only.
                lit = (part if side > 0 else 1.0 - part) if d == 0 else 1.0 if d * side < 0 else 0.0
                base = ambient + lit * places.haze[v, q] + (1.0 - lit) * places.rest[v, q]
                slope = places.scale[v, q] * np.float64(shares[fraction, 0, d + REACH_PX] + places.glow[v, q])
                flux = min(max(base + a * slope, LEAST_FLUX), MOST_FLUX)
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
