"""Compiled part of `rig.count.map_checks`: light that lines of counts have in common, and how smooth rows are.

With n ones of a pixel in K frames and r its usual rate, a line of counts k is turned into line-shaped excess,

    z = (n - K r) / sqrt(K r),    e_k(j) = mean of z over 3 px around j - mean of z over 3 to 8 px to both sides

and the light in common with a partner at pixel distance s is sum over j of e_0(j) (sum of e_k over j + s - LAGS_PX to
j + s + LAGS_PX, less the mean of the same BESIDE_PX to either side). Smoothness is the sum of products of neighbouring
pixels. Lines are int32 (3, points, window), results float64 (points, 3 + orders).
"""

from typing import Final

import numba
import numpy as np
from numpy.typing import NDArray

from rig.geometry.windows import MARGIN_PX, WORD_PX

LAGS_PX: Final = 2
"""Pixels by which a surface may lean between the lines that are compared."""

BESIDE_PX: Final = 9
"""Pixels from where the line should be at which light that is still in common is haze."""
LEAST_SHARED: Final = 0.25
"""Light that frames of one column have in common at least, over what all frames of two rows have: 1 for a line that
stands still, 0.4 at two frames a column for one that moves by 5 px in it."""


@numba.njit(inline="always")
def _around(total, j):  # type: ignore[no-untyped-def]
    """Sum of the pixels up to LAGS_PX from pixel j; total: of all those before each, and of all."""
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
    first: int,
    last: int,
    out: NDArray[np.float64],
) -> None:
    """Compare points first..last-1; out: (points, 3 + orders).

    lines: (3, points, window) counts of each point's line and its two partners; exposures, row, column: (3, points).
    shift: (2, points), pixels from a stripe of the line to the partner's. usual: (rows, width), mean ones per exposure
    of each pixel over the sweep, NaN where it is not to be used; least: what a lower one counts as. orders: (orders,
    WORD_PX), pixels of each word.

    Out come the light in common with each partner and by how much the sum of products of neighbouring pixels grows when
    they are taken in each order. Light in common is a product of line-shaped excess over what is usual for each pixel,
    in its standard deviations: 0 on average for noise, haze and whatever stands still. Between them comes by how much
    LEAST_SHARED of what single pixels have in common with the next row is above what their own frames have in common
    with each other: frames of one column show the same line, so that this is below 0.
    """
    window = lines.shape[2]
    line = np.zeros((3, window))
    total = np.zeros(window + 1)
    pixels = np.zeros((2, window))
    excesses = np.zeros((2, window))
    for i in range(first, last):
        for k in range(3):
            y, c = row[k, i], column[k, i]
            low = max(x_lo[y, c] - MARGIN_PX, x0[c], 0) - x0[c]
            high = min(x_hi[y, c] + MARGIN_PX, x0[c] + window - 1, usual.shape[1] - 1) - x0[c]
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
                # Pairs of different frames: a frame's own ones would be in common with themselves.
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
