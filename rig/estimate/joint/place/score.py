"""Score and information of stripes' places, compiled, LANES stripes to a vector.

With flux of each of the TAPS pixels around a stripe of `light` photons in K frames, and D = 1 / (e^flux - 1),

    slope = light d share / dx (and the step of haze at the centre),
    g = sum slope (n D - (K - n)),    h = sum K slope^2 D

are the slope of the log-likelihood in the stripe's place and its Fisher information, 1/px and 1/px^2, float32 (rows,
columns); `rig.estimate.joint.place.places` says what they are for. A pixel that the row does not have, or that is not
to be used, is given light in which nothing can be seen.
"""

from typing import Final

import numba
import numpy as np
from numpy.typing import NDArray

from rig.estimate.joint.place.places import (
    MOST_FLUX,
    REACH_PX,
    TAPS,
    Counts,
    Places,
    ambient_place,
    counts_of,
    nearest_pixel,
)
from rig.estimate.row.inputs import RowState, Sweep
from rig.simd.memory import (
    address_of,
    copy_floats,
    load_float32,
    read_float32,
    read_int32,
    store_float32,
    write_float32,
    write_int64,
)
from rig.simd.shuffles import EIGHT, fetch_eights
from rig.simd.vectors import LANES, larger_float, smaller_float, where_below, where_small, zero_float32

Float32 = NDArray[np.float32]

FRACTIONS: Final = 16
"""Parts of a pixel that the line's profile is told apart in."""
LEAST_FLUX: Final = np.float32(1e-5)
_SHOWS: Final = np.nextafter(MOST_FLUX, np.float32(0.0))
"""Most ambient light of a pixel that shows anything at all."""
_AMPLITUDE, _SCALE, _GLOW, _HAZE, _REST, _DISTANCE = range(6)
_LIT, _FRAMES, _SCORE, _KNOWN, _FIELDS = range(5)
_EIGHTS: Final = EIGHT * LANES
_DOUBLINGS: Final = 6


@numba.njit(cache=True, nogil=True, error_model="numpy")
def score_places(
    n_frames: NDArray[np.int32],
    sweep: Sweep,
    state: RowState,
    shares: Float32,
    around: Counts,
    x_px: Float32,
    first_row: int,
    last_row: int,
    out: Places,
) -> None:
    """Fill score and known of rows first_row..last_row-1 for stripes at x_px.

    shares: (FRACTIONS, 2, EIGHT), share of the line in each of the TAPS pixels around the one that holds its centre,
    and by how much that grows with every pixel that the centre moves on. around: of `fetch_counts`.
    """
    window, (pixels, columns) = sweep.window, (state.ambient.shape[1], x_px.shape[1])
    side, half, one = 1 if sweep.near_is_left else -1, np.float32(0.5), np.float32(1.0)
    # An odd number of cache lines: one line of numbers after the other does not push the others out of the cache.
    width = (-(-columns // LANES) | 1) * LANES
    lines, spare = np.zeros((_FIELDS, width), np.float32), np.full((width, EIGHT), MOST_FLUX, np.float32)
    taps = np.zeros((4, EIGHT, LANES), np.float32)
    ambient_places, share_places = np.empty(width, np.int64), np.empty(width, np.int64)
    # Addresses: threads that count references to the same array wait for one another.
    at, spare_at, taps_at, all_shares = address_of(lines), address_of(spare), address_of(taps), address_of(shares)
    ambient_at, shares_at = address_of(ambient_places), address_of(share_places)
    ambient = address_of(state.ambient)
    at_x, at_x0 = address_of(x_px), address_of(sweep.x0)
    around_at, to_score, to_known = address_of(around), address_of(out.score), address_of(out.known)
    known = (address_of(out.amplitude), address_of(out.scale), address_of(out.glow),
             address_of(out.haze), address_of(out.rest), address_of(out.distance))  # fmt: skip
    ambient_places[:], share_places[:] = spare_at + 4 * EIGHT * (width - 1), all_shares
    for y in range(first_row, last_row):
        for c in range(columns):
            x_line, frames = read_float32(at_x, y * columns + c), n_frames[c]
            if np.isnan(x_line) or frames == 0:
                write_float32(at, _FRAMES * width + c, np.float32(0.0))
                continue
            x = nearest_pixel(x_line)
            part = x_line + half - np.float32(x)
            # The pixel that holds the centre is in haze on its near part only.
            write_float32(at, _LIT * width + c, part if side > 0 else one - part)
            write_float32(at, _FRAMES * width + c, np.float32(frames))
            write_int64(shares_at, c, all_shares + 8 * EIGHT * min(int(part * FRACTIONS), FRACTIONS - 1))
            own, x0 = spare_at + 4 * EIGHT * c, int(read_int32(at_x0, c))
            write_int64(ambient_at, c, ambient_place(ambient, pixels, y, x, x0, window, own))
        for c in range(0, columns, LANES):
            counts_of(around, around_at, y, c, taps_at)
            _score(at + 4 * c, width, known, y * columns + c, taps_at, ambient_at + 8 * c, shares_at + 8 * c, side)
        copy_floats(at + 4 * width * _SCORE, to_score + 4 * columns * y, columns)
        copy_floats(at + 4 * width * _KNOWN, to_known + 4 * columns * y, columns)
    # Keeps the arrays alive up to here: numba would free those of which only the address is still used.
    spare[:1] = taps[:1] = lines[:1] = 0.0
    ambient_places[:1] = share_places[:1] = 0


@numba.njit(cache=True, nogil=True)
def _score(
    at: int, width: int, of: tuple[int, int, int, int, int, int], here: int, seen: int, ambient: int, shares: int,
    side: int,
) -> None:  # fmt: skip
    """Fill score and known of LANES stripes.

    of: addresses of what is known of stripes before, here: number of the first. seen: address of their counts, and room
    behind them.
    """
    share, growth, own = seen + 4 * _EIGHTS, seen + 8 * _EIGHTS, seen + 12 * _EIGHTS
    fetch_eights(ambient, 0, own)
    fetch_eights(shares, 0, share)
    fetch_eights(shares, 4 * EIGHT, growth)
    frames = load_float32(at, _FRAMES * width)
    light = load_float32(of[_AMPLITUDE], here) * load_float32(of[_SCALE], here)
    # Around its middle the halo is level.
    halo = light * load_float32(of[_GLOW], here)
    before, behind = load_float32(of[_HAZE], here) + halo, load_float32(of[_REST], here) + halo
    edge = before - behind
    middle = behind + load_float32(at, _LIT * width) * edge
    score, known, none = zero_float32(), zero_float32(), zero_float32()
    for d in range(TAPS):
        tap = d * LANES
        slope = light * load_float32(growth, tap)
        base = before if (d - REACH_PX) * side < 0 else behind
        if d == REACH_PX:
            slope = slope + edge * np.float32(side)
            base = middle
        shine = smaller_float(load_float32(own, tap), MOST_FLUX)
        unlit = where_small(frames - load_float32(seen, tap), shine, _SHOWS)
        dark = _dark_over_lit(base + shine + light * load_float32(share, tap))
        score = score + slope * ((frames - unlit) * dark - unlit)
        known = known + frames * slope * slope * dark
    score = known * load_float32(of[_DISTANCE], here) + score
    store_float32(at, _SCORE * width, where_below(score, none, none, frames))
    store_float32(at, _KNOWN * width, known)


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
