"""Compiled score and information of stripes' places, see `placing_kernels`, sixteen stripes to a vector.

Of each row, first what the pixels around every stripe counted and should have counted is laid out pixel by pixel from
the stripe, stripe beside stripe; the arithmetic then goes along the row. A pixel that the row does not have, or that is
not to be used, is given light in which nothing can be seen.
"""

from typing import Final

import numba
import numpy as np
from numpy.typing import NDArray

from rig.estimators.label_volume_buffers import signed_address
from rig.estimators.placing_kernels import REACH_PX, Places
from rig.estimators.row_input import State, Sweep
from rig.lane_memory import load_float32, store_float32
from rig.lanes import LANES, larger_float, smaller_float, zero_float32

Float32 = NDArray[np.float32]

FRACTIONS: Final = 16
"""Parts of a pixel that the line's profile is told apart in."""
LEAST_FLUX: Final = np.float32(1e-5)
MOST_FLUX: Final = np.float32(20.0)
"""In more light no pixel stays dark in a thousand million exposures."""
TAPS: Final = 2 * REACH_PX + 1
_SEEN, _AMBIENT, _SHARE, _GROWTH = range(4)
_BEFORE, _BEHIND, _LIGHT, _LIT, _FRAMES, _SCORE, _KNOWN = range(7)
_DOUBLINGS: Final = 6


@numba.njit(cache=True, nogil=True, error_model="numpy")
def score_places(
    counts: NDArray[np.unsignedinteger],
    n_frames: NDArray[np.int32],
    sweep: Sweep,
    state: State,
    shares: Float32,
    x_px: Float32,
    first_row: int,
    last_row: int,
    out: Places,
) -> None:
    """Fill score and known of rows first_row..last_row-1 for stripes at x_px.

    shares: (FRACTIONS, 2, TAPS), share of the line in each pixel around the one that holds its centre, and by how much
    that grows with every pixel that the centre moves on.
    """
    columns = x_px.shape[1]
    side = 1 if sweep.near_is_left else -1
    # An odd number of cache lines: rows of one pixel after the other do not push each other out of the cache.
    width = (-(-columns // LANES) | 1) * LANES
    around, stripe = np.zeros((TAPS, 4, width), np.float32), np.zeros((7, width), np.float32)
    around[:, _AMBIENT] = MOST_FLUX
    for y in range(first_row, last_row):
        _lay_out(counts, n_frames, sweep, state, shares, x_px, side, y, out, around, stripe)
        _score(signed_address(around), signed_address(stripe), width, side)
        for c in range(columns):
            known = stripe[_KNOWN, c]
            there = stripe[_FRAMES, c] > 0.0
            out.score[y, c] = known * out.distance[y, c] + stripe[_SCORE, c] if there else np.float32(0.0)
            out.known[y, c] = known


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _lay_out(
    counts: NDArray[np.unsignedinteger], n_frames: NDArray[np.int32], sweep: Sweep, state: State, shares: Float32,
    x_px: Float32, side: int, y: int, places: Places, around: Float32, stripe: Float32,
) -> None:  # fmt: skip
    """Fill around (TAPS, 4, width) and the first five of stripe (7, width), without frames where there is none."""
    half, one = np.float32(0.5), np.float32(1.0)
    # Named apart: every use of a tuple with arrays in the loop would count references to all of them.
    ambient, x0, window, picture = state.ambient, sweep.x0, sweep.window, sweep.u.shape[1]
    amplitude, scale, glow, haze, rest = places.amplitude, places.scale, places.glow, places.haze, places.rest
    for c in range(x_px.shape[1]):
        stripe[_FRAMES, c] = stripe[_LIGHT, c] = stripe[_BEFORE, c] = stripe[_BEHIND, c] = 0.0
        if np.isnan(x_px[y, c]) or n_frames[c] == 0:
            continue
        frames = np.float32(n_frames[c])
        x = int(np.floor(x_px[y, c] + half))
        part = x_px[y, c] + half - x
        light = amplitude[y, c] * scale[y, c]
        # Around its middle the halo is level.
        halo = light * glow[y, c]
        stripe[_FRAMES, c], stripe[_LIGHT, c] = frames, light
        stripe[_BEFORE, c], stripe[_BEHIND, c] = haze[y, c] + halo, rest[y, c] + halo
        # The pixel that holds the centre is in haze on its near part only.
        stripe[_LIT, c] = part if side > 0 else one - part
        profile, first = np.uint64(min(int(part * FRACTIONS), FRACTIONS - 1)), x - REACH_PX
        # Whole numbers without sign: an index that may be negative would be looked at.
        at, t = np.uint64(first - x0[c]), np.uint64(first)
        inside = max(x0[c], 0) <= first <= min(x0[c] + window, picture) - TAPS
        for d in range(TAPS):
            around[d, _SHARE, c], around[d, _GROWTH, c] = shares[profile, 0, d], shares[profile, 1, d]
            if inside or (0 <= first + d - x0[c] < window and 0 <= first + d < picture):
                own = ambient[y, t + np.uint64(d)]
                around[d, _SEEN, c] = np.float32(counts[c, y, at + np.uint64(d)]) if own < MOST_FLUX else frames
                around[d, _AMBIENT, c] = own
            else:
                around[d, _SEEN, c], around[d, _AMBIENT, c] = frames, MOST_FLUX


@numba.njit(cache=True, nogil=True)
def _score(around: int, stripe: int, width: int, side: int) -> None:
    """Fill score and known of stripe from all else; both by their addresses."""
    for c in range(0, width, LANES):
        before, behind = load_float32(stripe, _BEFORE * width + c), load_float32(stripe, _BEHIND * width + c)
        light, frames = load_float32(stripe, _LIGHT * width + c), load_float32(stripe, _FRAMES * width + c)
        edge = before - behind
        middle = behind + load_float32(stripe, _LIT * width + c) * edge
        score, known = zero_float32(), zero_float32()
        for d in range(TAPS):
            tap = 4 * d * width + c
            slope = light * load_float32(around, tap + _GROWTH * width)
            base = before if (d - REACH_PX) * side < 0 else behind
            if d == REACH_PX:
                slope = slope + edge * np.float32(side)
                base = middle
            base = base + load_float32(around, tap + _AMBIENT * width)
            dark = _dark_over_lit(base + light * load_float32(around, tap + _SHARE * width))
            seen = load_float32(around, tap)
            score = score + slope * (seen * dark + (seen - frames))
            known = known + frames * slope * slope * dark
        store_float32(stripe, _SCORE * width + c, score)
        store_float32(stripe, _KNOWN * width + c, known)


@numba.njit(forceinline=True)
def _dark_over_lit(flux):  # type: ignore[no-untyped-def]
    """1 / (e^flux - 1): how often a pixel stays dark over how often it does not."""
    part = smaller_float(larger_float(flux, LEAST_FLUX), MOST_FLUX) * np.float32(2.0**-_DOUBLINGS)
    grown = part * np.float32(1 / 5040) + np.float32(1 / 720)
    for below in (120.0, 24.0, 6.0, 2.0, 1.0):
        grown = grown * part + np.float32(1.0 / below)
    grown = grown * part
    # All terms are positive: nothing is lost to rounding on the way up.
    for _ in range(_DOUBLINGS):
        grown = grown * (grown + np.float32(2.0))
    return (zero_float32() + np.float32(1.0)) / grown
