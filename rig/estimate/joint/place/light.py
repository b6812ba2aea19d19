"""Light of stripes, haze around them, and score and information of their places, compiled, LANES stripes to a vector.

With counts n of K frames at the pixels t within LIGHT_PX of a stripe, haze the mean of the haze before and behind, and
glow the halo per pixel as a share of the light (`measure_light`),

    light = sum over t of (log((K + 1/2) / (K - n_t + 1/2)) - ambient_t - haze) / (1 + (2 LIGHT_PX + 1) glow)

in photons per exposure, computed as one logarithm of a product. Blind pixels (BLIND_FLUX) add nothing to the sum. Haze
is interpolated between bins of its profile, from a table in which all values of a bin lie side by side.

With the flux of each of the TAPS pixels around a stripe of `light` (scale times pooled amplitude), and
D = 1 / (e^flux - 1) (`score_places`),

    slope = light d share / dx (and the step of haze at the centre),
    g = sum slope (n D - (K - n)),    h = sum K slope^2 D

are the derivative of the log-likelihood with respect to position (1/px) and the Fisher information on it (1/px^2). For
a pixel that is missing in the row or must not be used, so much ambient light is assumed that the pixel gives no
information. Arrays are float32 (rows, columns), see `Places` (`rig.estimate.joint.place.places`).
"""

from typing import Final

import numba
import numpy as np

from rig.count.volume import Counts
from rig.estimate.joint.place.places import (
    BLIND_FLUX,
    LIGHT_PX,
    MOST_FLUX,
    REACH_PX,
    TAPS,
    Places,
    ambient_place,
    counts_of,
    nearest_pixel,
)
from rig.estimate.row.inputs import RowState, Sweep, others_at
from rig.estimate.row.likelihood import FLUX_MAX, FLUX_MIN
from rig.simd import Float32, Int32
from rig.simd.functions import logarithm
from rig.simd.memory import (
    CACHE_LINE,
    address_of,
    copy_floats,
    keep_alive,
    load_float32,
    prefetch,
    read_float32,
    read_int32,
    store_float32,
    write_float32,
    write_int64,
)
from rig.simd.shuffles import EIGHT, fetch_eights
from rig.simd.vectors import LANES, larger_float, smaller_float, square_root, where_below, where_small, zero_float32

_SHOWS: Final = np.nextafter(BLIND_FLUX, np.float32(0.0))
"""Most ambient light with which a pixel still shows a stripe's light."""
_LEAST: Final = np.float32(1e-37)
_PX, _PY, _PZ, _GAIN, _U, _V, _BIN, _PATHS, _PART, _OTHERS, _FRAMES = range(11)
_LIGHT, _SCALE, _HAZE, _REST, _GLOW, _FIELDS = range(11, 17)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def measure_light(
    n_frames: Int32, sweep: Sweep, state: RowState, around: Counts, x_px: Float32, first_row: int, last_row: int,
    out: Places,
) -> None:  # fmt: skip
    """Fill light, scale, haze, rest and glow of rows first_row..last_row-1 for stripes at x_px; 0 where there is none.

    around: of `fetch_counts`. Haze is taken at the nearest searched pixel.
    """
    columns, (pixels, last_bin) = x_px.shape[1], (sweep.u.shape[1], np.float32(state.profile.shape[0] - 1.001))
    window, several, bins = sweep.window, sweep.others.shape[1] > 0, _bins(state.profile, state.glow)
    # An odd number of cache lines per row of `lines`, so that its rows do not displace one another in the cache.
    width = (-(-columns // LANES) | 1) * LANES
    lines, spare = np.zeros((_FIELDS, width), np.float32), np.full((width, EIGHT), MOST_FLUX, np.float32)
    taps = np.zeros((2, EIGHT, LANES), np.float32)
    ambient_places, bin_places = np.empty(width, np.int64), np.empty(width, np.int64)
    # Addresses, since threads that count references to the same array wait for one another.
    at, spare_at, bins_at, taps_at = address_of(lines), address_of(spare), address_of(bins), address_of(taps)
    ambient_at, bin_at = address_of(ambient_places), address_of(bin_places)
    at_x, at_x0 = address_of(x_px), address_of(sweep.x0)
    at_u, at_v, ambient = address_of(sweep.u), address_of(sweep.v), address_of(state.ambient)
    at_lo, at_hi, around_at = address_of(sweep.x_lo), address_of(sweep.x_hi), address_of(around)
    found = (address_of(out.light), address_of(out.scale), address_of(out.haze), address_of(out.rest),
             address_of(out.glow))  # fmt: skip
    ambient_places[:], bin_places[:], lines[_PX] = spare_at + 4 * EIGHT * (width - 1), bins_at, 1.0
    for c in range(columns):
        lines[_PX, c], lines[_PY, c], lines[_PZ, c] = sweep.plane[c, 0], sweep.plane[c, 1], sweep.plane[c, 2]
        lines[_GAIN, c] = state.column_gain[c]
    for y in range(first_row, last_row):
        # The next row lies on other pages, so the processor does not prefetch it itself.
        for line in range(4 * pixels * (y + 1), 4 * pixels * (y + 2), CACHE_LINE):
            prefetch(at_u + line)
            prefetch(at_v + line)
            prefetch(ambient + line)
        for c in range(columns):
            x_line, frames = read_float32(at_x, y * columns + c), n_frames[c]
            if np.isnan(x_line) or frames == 0:
                write_float32(at, _FRAMES * width + c, np.float32(0.0))
                continue
            x = nearest_pixel(x_line)
            searched = max(x, int(read_int32(at_lo, y * columns + c)))
            searched = min(searched, int(read_int32(at_hi, y * columns + c)))
            write_float32(at, _U * width + c, read_float32(at_u, y * pixels + searched))
            write_float32(at, _V * width + c, read_float32(at_v, y * pixels + searched))
            write_float32(at, _FRAMES * width + c, np.float32(frames))
            own, x0 = spare_at + 4 * EIGHT * c, int(read_int32(at_x0, c))
            write_int64(ambient_at, c, ambient_place(ambient, pixels, y, x, x0, window, own))
            if several:
                lines[_OTHERS, c] = others_at(sweep, state, y, c, searched)
        _find_bins(at, width, state.row_gain[y], np.float32(state.w_lo), np.float32(state.per_w), last_bin)
        for c in range(columns):
            place = read_float32(at, _BIN * width + c)
            i = int(place)
            write_float32(at, _PART * width + c, place - np.float32(i))
            write_int64(bin_at, c, bins_at + 4 * EIGHT * i)
        for c in range(0, columns, LANES):
            counts_of(around, around_at, y, c, taps_at)
            _measure(at + 4 * c, width, taps_at, ambient_at + 8 * c, bin_at + 8 * c)
        for i in range(len(found)):
            copy_floats(at + 4 * width * (_LIGHT + i), found[i] + 4 * columns * y, columns)
    keep_alive(spare, bins, taps, lines, ambient_places, bin_places)


@numba.njit(cache=True, nogil=True)
def _bins(profile: Float32, glow: Float32) -> Float32:
    """Table (bins, EIGHT) of haze before and behind a stripe, its scale and glow, and the steps to the next bin."""
    bins = np.zeros((profile.shape[0], EIGHT), np.float32)
    half = EIGHT // 2
    bins[:, : half - 1], bins[:, half - 1] = profile[:, : half - 1], glow
    bins[:-1, half:] = bins[1:, :half] - bins[:-1, :half]
    return bins


@numba.njit(cache=True, nogil=True)
def _find_bins(at: int, width: int, gain: np.float32, w_lo: np.float32, per_w: np.float32, last: np.float32) -> None:
    """Write each stripe's fractional bin of the profile, and the factor G of haze there (`rig.estimate.row.inputs`)."""
    for c in range(0, width, LANES):
        px, py = load_float32(at, _PX * width + c), load_float32(at, _PY * width + c)
        pz, u, v = load_float32(at, _PZ * width + c), load_float32(at, _U * width + c), load_float32(at, _V * width + c)
        down = v * v + np.float32(1.0)
        along = (py * v + pz) / px
        path_p, path_c = square_root(down + along * along), square_root(down + u * u)
        w = px * u + (py * v + pz)
        place = (w * np.float32(2.0) / (path_p + path_c) - w_lo) * per_w
        store_float32(at, _BIN * width + c, smaller_float(larger_float(place, np.float32(0.0)), last))
        store_float32(at, _PATHS * width + c, path_p * path_c * load_float32(at, _GAIN * width + c) * gain)


@numba.njit(cache=True, nogil=True)
def _measure(at: int, width: int, taps: int, ambient: int, bins: int) -> None:
    """Write light, scale, haze, rest, glow of LANES stripes; taps: address of their counts, with room behind them."""
    near = taps + 4 * EIGHT * LANES
    one, none, half = zero_float32() + np.float32(1.0), zero_float32(), np.float32(0.5)
    fetch_eights(ambient, 0, near)
    frames = load_float32(at, _FRAMES * width)
    inverse = one / (frames + half)
    dark, shown, light = one, none, none
    for d in range(REACH_PX - LIGHT_PX, REACH_PX + LIGHT_PX + 1):
        own = load_float32(near, d * LANES)
        unlit = larger_float(frames - load_float32(taps, d * LANES), np.float32(0.0))
        shows = where_small(one, own, _SHOWS)
        dark = dark * ((unlit + half) * inverse * shows + (one - shows))
        shown, light = shown + shows, light - where_small(own, own, _SHOWS)
    own = load_float32(near, REACH_PX * LANES)
    own = where_small(own, own, _SHOWS)
    fetch_eights(bins, 0, near)
    part, paths = load_float32(at, _PART * width), load_float32(at, _PATHS * width)
    others = load_float32(at, _OTHERS * width)
    before = _flux(own + paths * (load_float32(near, 0) + part * load_float32(near, 4 * LANES)), others)
    behind = _flux(own + paths * (load_float32(near, LANES) + part * load_float32(near, 5 * LANES)), others)
    halo = load_float32(near, 3 * LANES) + part * load_float32(near, 7 * LANES)
    # Missing and blind pixels add nothing, as if they had just the expected light.
    light = light - logarithm(larger_float(dark, _LEAST)) - shown * ((before + behind) * half - own)
    # The halo adds light in proportion to that of the line.
    light = light / (one + halo * np.float32(2 * LIGHT_PX + 1))
    scale = load_float32(near, 2 * LANES) + part * load_float32(near, 6 * LANES)
    store_float32(at, _LIGHT * width, where_below(light, none, none, frames))
    store_float32(at, _SCALE * width, where_below(scale, none, none, frames))
    store_float32(at, _HAZE * width, where_below(larger_float(before - own, none), none, none, frames))
    store_float32(at, _REST * width, where_below(larger_float(behind - own, none), none, none, frames))
    store_float32(at, _GLOW * width, where_below(halo, none, none, frames))


@numba.njit(forceinline=True)
def _flux(own, others):  # type: ignore[no-untyped-def]
    return smaller_float(smaller_float(larger_float(own, FLUX_MIN), FLUX_MAX) + others, FLUX_MAX)


FRACTIONS: Final = 16
"""Positions within a pixel for which the line's profile is tabled."""
LEAST_FLUX: Final = np.float32(1e-5)
_VISIBLE: Final = np.nextafter(MOST_FLUX, np.float32(0.0))
"""Most ambient light with which a pixel still gives information on the stripe's position."""
_OF_AMPLITUDE, _OF_SCALE, _OF_GLOW, _OF_HAZE, _OF_REST, _OF_DISTANCE = range(6)
_LIT, _TAKEN, _SCORE, _KNOWN, _SCORE_FIELDS = range(5)
_EIGHTS: Final = EIGHT * LANES
_DOUBLINGS: Final = 6


@numba.njit(cache=True, nogil=True, error_model="numpy")
def score_places(
    n_frames: Int32, sweep: Sweep, state: RowState, shares: Float32, around: Counts, x_px: Float32, first_row: int,
    last_row: int, out: Places,
) -> None:  # fmt: skip
    """Fill score and known of rows first_row..last_row-1 for stripes at x_px.

    shares: (FRACTIONS, 2, EIGHT), share of the line in each of the TAPS pixels around the one that holds its centre,
    and the derivative of the share with respect to the centre's position in px. around: of `fetch_counts`. out: with
    distance, and all that `weigh_light` fills.
    """
    window, (pixels, columns) = sweep.window, (state.ambient.shape[1], x_px.shape[1])
    side, half, one = 1 if sweep.near_is_left else -1, np.float32(0.5), np.float32(1.0)
    # An odd number of cache lines per row of `lines`, so that its rows do not displace one another in the cache.
    width = (-(-columns // LANES) | 1) * LANES
    lines, spare = np.zeros((_SCORE_FIELDS, width), np.float32), np.full((width, EIGHT), MOST_FLUX, np.float32)
    taps = np.zeros((4, EIGHT, LANES), np.float32)
    ambient_places, share_places = np.empty(width, np.int64), np.empty(width, np.int64)
    # Addresses, since threads that count references to the same array wait for one another.
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
                write_float32(at, _TAKEN * width + c, np.float32(0.0))
                continue
            x = nearest_pixel(x_line)
            part = x_line + half - np.float32(x)
            # The pixel that holds the centre is in haze on its near part only.
            write_float32(at, _LIT * width + c, part if side > 0 else one - part)
            write_float32(at, _TAKEN * width + c, np.float32(frames))
            write_int64(shares_at, c, all_shares + 8 * EIGHT * min(int(part * FRACTIONS), FRACTIONS - 1))
            own, x0 = spare_at + 4 * EIGHT * c, int(read_int32(at_x0, c))
            write_int64(ambient_at, c, ambient_place(ambient, pixels, y, x, x0, window, own))
        for c in range(0, columns, LANES):
            counts_of(around, around_at, y, c, taps_at)
            _score(at + 4 * c, width, known, y * columns + c, taps_at, ambient_at + 8 * c, shares_at + 8 * c, side)
        copy_floats(at + 4 * width * _SCORE, to_score + 4 * columns * y, columns)
        copy_floats(at + 4 * width * _KNOWN, to_known + 4 * columns * y, columns)
    keep_alive(spare, taps, lines, ambient_places, share_places)


@numba.njit(cache=True, nogil=True)
def _score(
    at: int, width: int, of: tuple[int, int, int, int, int, int], here: int, seen: int, ambient: int, shares: int,
    side: int,
) -> None:  # fmt: skip
    """Fill score and known of LANES stripes.

    of: addresses of the fields of all stripes; here: index of the first of the LANES. seen: address of the counts of
    the LANES, with room behind them.
    """
    share, growth, own = seen + 4 * _EIGHTS, seen + 8 * _EIGHTS, seen + 12 * _EIGHTS
    fetch_eights(ambient, 0, own)
    fetch_eights(shares, 0, share)
    fetch_eights(shares, 4 * EIGHT, growth)
    frames = load_float32(at, _TAKEN * width)
    light = load_float32(of[_OF_AMPLITUDE], here) * load_float32(of[_OF_SCALE], here)
    # Near the stripe the halo is level.
    halo = light * load_float32(of[_OF_GLOW], here)
    before, behind = load_float32(of[_OF_HAZE], here) + halo, load_float32(of[_OF_REST], here) + halo
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
        unlit = where_small(frames - load_float32(seen, tap), shine, _VISIBLE)
        dark = _dark_over_lit(base + shine + light * load_float32(share, tap))
        score = score + slope * ((frames - unlit) * dark - unlit)
        known = known + frames * slope * slope * dark
    score = known * load_float32(of[_OF_DISTANCE], here) + score
    store_float32(at, _SCORE * width, where_below(score, none, none, frames))
    store_float32(at, _KNOWN * width, known)


@numba.njit(forceinline=True)
def _dark_over_lit(flux):  # type: ignore[no-untyped-def]
    """1 / (e^flux - 1): the probability that a pixel stays dark, divided by that of firing."""
    part = smaller_float(larger_float(flux, LEAST_FLUX), MOST_FLUX) * np.float32(2.0**-_DOUBLINGS)
    grown = part * np.float32(1 / 5040) + np.float32(1 / 720)
    for below in (120.0, 24.0, 6.0, 2.0, 1.0):
        grown = grown * part + np.float32(1.0 / below)
    grown = grown * part
    # All terms are positive, so no digits cancel.
    for _ in range(_DOUBLINGS):
        grown = grown * (grown + np.float32(2.0))
    return (zero_float32() + np.float32(1.0)) / grown
