"""Compiled part of `rig.count.map_checks`: light that lines of counts have in common, and how smooth rows are.

A line of counts holds the counts of one image row in one column, over the window. A point is such a row and column,
its partners are others (`rig.count.map_checks`). Line 0 is a point's own; lines 1, 2 and so on are its partners'. With
n ones of a pixel in K frames and r its usual rate, line k becomes stripe-like excess,

    z = (n - K r) / sqrt(K r),    e_k(j) = mean of z over 3 px around j - mean of z 4 to 9 px away on both sides

The light in common with a partner at pixel distance s is the sum over j of e_0(j) times (the sum of e_k from
j + s - LAGS_PX to j + s + LAGS_PX, minus the mean of the same sum BESIDE_PX to either side). Smoothness is the sum of
products of neighbouring pixels. Lines are int32 (own and partners', points, window); results of `compare_lines` are
float64 (points, 3 + orders).

Broad light, mainly haze, is compared by sums of z over BIN_PX, minus the line's mean of z. With s and o in bins:

    a_k(i) = sum over bin i of (z - mean of z),    shared(partner, o) = sum over points and i of a_0(i) a_k(i + s + o)
"""

from typing import Final

import numba
import numpy as np
from numpy.typing import NDArray

from rig.geometry.windows import MARGIN_PX, WORD_PX

BIN_PX: Final = 4
"""Pixels of a bin of `follow_lines`: light of all widths is compared, and expected places are known no better."""
SPAN: Final = 26
"""Bins to either side of the expected place that are compared."""
LAGS_PX: Final = 2
"""Pixels by which a stripe may lie off the expected place, since its surface may be inclined."""

BESIDE_PX: Final = 9
"""Distance from the expected place, in pixels, at which light still in common is haze."""
LEAST_SHARED: Final = 0.25
"""Least light that the frames of one column have in common, relative to that of two rows. A laser line that stands
still has 1; one that moves by 5 px during the column has 0.4 with two frames per column."""


@numba.njit(inline="always")
def _searched(x_lo, x_hi, x0, window, width):  # type: ignore[no-untyped-def]
    """First and last searched pixel of a line, including the margin at both ends, counted from the window's first."""
    return max(x_lo - MARGIN_PX, x0, 0) - x0, min(x_hi + MARGIN_PX, x0 + window - 1, width - 1) - x0


@numba.njit(inline="always")
def _around(total, j):  # type: ignore[no-untyped-def]
    """Sum of the pixels up to LAGS_PX from pixel j. total: sums of the first 0, 1, 2, ... pixels."""
    last = total.shape[0] - 1
    return total[min(max(j + LAGS_PX + 1, 0), last)] - total[min(max(j - LAGS_PX, 0), last)]


@numba.njit(cache=True, nogil=True)
def compare_lines(
    lines: NDArray[np.int32],
    exposures: NDArray[np.int32],
    row: NDArray[np.int32],
    column: NDArray[np.int32],
    shift: NDArray[np.int32],
    x0: NDArray[np.int32],
    x_lo: NDArray[np.int32],
    x_hi: NDArray[np.int32],
    usual: NDArray[np.float32],
    least: float,
    orders: NDArray[np.int64],
    out: NDArray[np.float64],
) -> None:
    """Compare the line of each point with its first two partners: the next row of the same column, and the same row in
    the nearest partner column. Writes to out (points, 3 + orders).

    lines: (3, points, window) counts of each point's line and its first two partners; exposures, row, column: (3 or
    more, points), with at least 1 exposure in each of these three lines. shift: (2 or more, points), pixels from the
    stripe at the point to that at the partner. x0: (columns,), first stored pixel; x_lo, x_hi: (rows, columns), first
    and last pixel of each search window. usual: (rows, width), mean ones per exposure of each pixel over the sweep, NaN
    for unusable pixels; least: replaces lower r in sqrt(K r).
    orders: (orders, WORD_PX), pixels of each word.

    The first two outputs are the light in common with each partner, which is 0 on average for noise, haze and anything
    that stands still. The third is LEAST_SHARED times the light that single pixels have in common with the next row,
    minus the light that their own frames have in common. It is 0 for one frame, and negative on average if all frames
    show the stripe at one place. The others are, for each order, the increase of the sum of products of neighbouring
    pixels if pixels are taken in that order.
    """
    window = lines.shape[2]
    line = np.zeros((3, window))
    total = np.zeros(window + 1)
    pixels = np.zeros((2, window))
    excesses = np.zeros((2, window))
    for i in range(lines.shape[1]):
        for k in range(3):
            y, c = row[k, i], column[k, i]
            low, high = _searched(x_lo[y, c], x_hi[y, c], x0[c], window, usual.shape[1])
            for j in range(window):
                excess = 0.0
                if low <= j <= high and not np.isnan(usual[y, x0[c] + j]):
                    rate = usual[y, x0[c] + j]
                    excess = (lines[k, i, j] - exposures[k, i] * rate) / np.sqrt(exposures[k, i] * max(rate, least))
                total[j + 1] = total[j] + excess
                if k < 2:
                    excesses[k, j] = excess
            for j in range(window):
                line[k, j] = 0.0
                if low <= j <= high:
                    before = total[max(j - 3, 0)] - total[max(j - 9, 0)]
                    behind = total[min(j + 10, window)] - total[min(j + 4, window)]
                    line[k, j] = (total[min(j + 2, window)] - total[max(j - 1, 0)]) / 3.0 - (before + behind) / 12.0
        for k in range(1, 3):
            to = shift[k - 1, i] + x0[column[0, i]] - x0[column[k, i]]
            total[0] = 0.0
            for j in range(window):
                total[j + 1] = total[j] + line[k, j]
            common = 0.0
            for j in range(window):
                near = _around(total, j + to)
                beside = _around(total, j + to - BESIDE_PX) + _around(total, j + to + BESIDE_PX)
                common += line[0, j] * (near - 0.5 * beside)
            out[i, k - 1] = common
        frames, to = exposures[0, i], shift[0, i]
        shared = 0.0
        for j in range(BESIDE_PX + abs(to) if frames > 1 else window, window - BESIDE_PX - abs(to)):
            excess = excesses[0, j]
            if excess != 0.0:
                rate = usual[row[0, i], x0[column[0, i]] + j]
                # Only pairs of different frames count: the ones of a frame agree with themselves.
                alone = lines[0, i, j] * (1.0 - 2.0 * rate) + frames * rate * rate
                own = (excess * excess - alone / (frames * max(rate, least))) * frames / (frames - 1.0)
                own -= 0.5 * excess * (excesses[0, j - BESIDE_PX] + excesses[0, j + BESIDE_PX])
                other = excesses[1, j + to] - 0.5 * (excesses[1, j + to - BESIDE_PX] + excesses[1, j + to + BESIDE_PX])
                shared += LEAST_SHARED * excess * other - own
        out[i, 2] = shared
        for j in range(window):
            pixels[0, j] = lines[0, i, j]
        for order in range(orders.shape[0]):
            for j in range(window):
                pixels[1, j] = lines[0, i, j // WORD_PX * WORD_PX + orders[order, j % WORD_PX]]
            grows = 0.0
            for j in range(window - 1):
                grows += pixels[1, j] * pixels[1, j + 1] - pixels[0, j] * pixels[0, j + 1]
            out[i, 3 + order] = grows


@numba.njit(inline="always")
def _mean(line, low, high, x, away, reach_px):  # type: ignore[no-untyped-def]
    """Mean of the pixels x + away * (first to last of reach_px) of a line; NaN if they are not all in low..high."""
    first, last = x + away * reach_px[0], x + away * reach_px[1]
    if min(first, last) < low or max(first, last) > high:
        return np.nan
    total = 0.0
    for j in range(min(first, last), max(first, last) + 1):
        total += line[j]
    return total / (reach_px[1] - reach_px[0] + 1)


_I, _F, _D, _N = numba.int32[:, :], numba.float32[:, :], numba.float64[:, :], numba.int32[:]
_PAIR = numba.types.UniTuple(numba.int64, 2)  # type: ignore[no-untyped-call]


# Compiled at import: it is first called when a map has enough sure answers, and compiling would hold up the stream.
@numba.njit(
    [
        (counts[:, :, ::1], _N, _N, _N, _N, _N, numba.int64[:], numba.int64, _PAIR, _PAIR, _N, _I, _I, numba.int64,
         numba.float64[:], numba.int64[:])
        for counts in (numba.uint8, numba.uint16, numba.uint32, numba.int32)
    ],
    cache=True, nogil=True,
)  # fmt: skip
def add_contrast(
    counts: NDArray[np.integer],
    a: NDArray[np.int32],
    b: NDArray[np.int32],
    row: NDArray[np.int32],
    column: NDArray[np.int32],
    exposures: NDArray[np.int32],
    x: NDArray[np.int64],
    away: int,
    line_px: tuple[int, int],
    behind_px: tuple[int, int],
    x0: NDArray[np.int32],
    x_lo: NDArray[np.int32],
    x_hi: NDArray[np.int32],
    width: int,
    contrast: NDArray[np.float64],
    asked: NDArray[np.int64],
) -> None:
    """Add to `contrast` (n,), for each line counts[a, b], the mean ones per exposure at x, less those behind it.

    row, column, exposures: of each line. x: (n,), pixels of the sensor. away: 1 or -1, direction towards far depths.
    line_px, behind_px: first and last pixel of both means, from x on towards far depths. asked: (n,), goes up by one;
    lines on which not all of these pixels were searched change neither.
    """
    for i in range(x.shape[0]):
        c = column[i]
        low, high = _searched(x_lo[row[i], c], x_hi[row[i], c], x0[c], counts.shape[2], width)
        line, at = counts[a[i], b[i]], x[i] - x0[c]
        found = _mean(line, low, high, at, away, line_px) - _mean(line, low, high, at, away, behind_px)
        if not np.isnan(found):
            contrast[i] += found / exposures[i]
            asked[i] += 1


@numba.njit(inline="always")
def _in_bins(px):  # type: ignore[no-untyped-def]
    return int(np.floor(px / BIN_PX + 0.5))


@numba.njit
def _add_products(a, b, margin, to, out):  # type: ignore[no-untyped-def]
    """Add to out[o + reach] the sum over i of a(i) b(i + to + o), for o from -reach to reach; nothing if |to| > bins.
    `margin` zeros stand before and behind the bins of a and b."""
    reach = out.shape[0] // 2
    bins = a.shape[0] - 2 * margin
    if abs(to) > bins:
        return
    for i in range(margin, margin + bins):
        if a[i] != 0.0:
            for o in range(out.shape[0]):
                out[o] += a[i] * b[i + to + o - reach]


# Compiled at import: it is first called after a wide sweep, and compiling then would hold up the stream.
@numba.njit(
    (numba.int32[:, :, ::1], _I, _I, _I, _I, numba.int32[:], _I, _I, _F, _F, _D, _D, numba.float64[:]),
    cache=True, nogil=True,
)  # fmt: skip
def follow_lines(
    lines: NDArray[np.int32],
    exposures: NDArray[np.int32],
    row: NDArray[np.int32],
    column: NDArray[np.int32],
    shift: NDArray[np.int32],
    x0: NDArray[np.int32],
    x_lo: NDArray[np.int32],
    x_hi: NDArray[np.int32],
    usual: NDArray[np.float32],
    weight: NDArray[np.float32],
    rows: NDArray[np.float64],
    shared: NDArray[np.float64],
    noise: NDArray[np.float64],
) -> None:
    """Add the light that points have in common with their partners, by distance from the expected place, to the last
    three arrays.

    lines to x_hi: as for `compare_lines`, with all partners. usual, weight: (rows, width), mean ones r per exposure of
    each pixel over the sweep and 1 / sqrt(r), with a least r; both 0 for unusable pixels. rows: (partner columns, 5),
    light in common with the next row, up to 2 bins to either side of where it is expected, for points whose partner
    column has frames. shared: (partner columns, 2 SPAN + 1), light in common with the partner column, from SPAN bins
    short of the place that the planes predict to SPAN bins beyond. noise: (partner columns,), variance of each sum of
    `shared` from photon noise.
    """
    window = lines.shape[2]
    bins = window // BIN_PX
    margin = bins + SPAN
    z = np.zeros(window)
    light = np.zeros((lines.shape[0], bins + 2 * margin))  # with room for every place that is looked at
    power = np.zeros(lines.shape[0])
    for i in range(lines.shape[1]):
        for k in range(lines.shape[0]):
            light[k] = 0.0
            power[k] = 0.0
            if exposures[k, i] == 0:
                continue
            y, c = row[k, i], column[k, i]
            low, high = _searched(x_lo[y, c], x_hi[y, c], x0[c], window, usual.shape[1])
            scale, total, known = 1.0 / np.sqrt(exposures[k, i]), 0.0, 0
            for j in range(low, high + 1):
                x = x0[c] + j
                z[j] = (lines[k, i, j] - exposures[k, i] * usual[y, x]) * weight[y, x] * scale
                total += z[j]
                known += weight[y, x] > 0.0
            mean = total / max(known, 1)
            for j in range(low, high + 1):
                if weight[y, x0[c] + j] > 0.0:
                    light[k, margin + j // BIN_PX] += z[j] - mean
            for b in range(margin, margin + bins):
                power[k] += light[k, b] * light[k, b]
        for partner in range(rows.shape[0]):
            k = partner + 2
            if exposures[0, i] == 0 or exposures[1, i] == 0 or exposures[k, i] == 0:
                continue
            # A bin is light plus noise, so a product has noise from light times noise (twice) and noise times noise.
            noise[partner] += BIN_PX * max(power[0] + power[k] - BIN_PX * bins, BIN_PX * bins)
            _add_products(light[0], light[1], margin, _in_bins(shift[0, i]), rows[partner])
            to = _in_bins(shift[k - 1, i] + x0[column[0, i]] - x0[column[k, i]])
            # Offsets are counted along the motion, whichever way that is.
            _add_products(
                light[0], light[k], margin, to, shared[partner] if shift[k - 1, i] >= 0 else shared[partner, ::-1]
            )
