"""Contrast: cost of every label from its own surroundings alone, since a stripe is brighter than the pixels beside it.

With counts n of K frames at the pixels t around a label, shares w_t of the line in them (of sum 1), and p0 the share of
ones among the pixels BESIDE_PX to both sides in 2 ROWS + 1 rows,

    p = sum w_t n_t / K,    N = K / sum w_t^2
    score = N (p log(p / p0) + (1 - p) log((1 - p) / (1 - p0))) where p > p0, else 0,    in nats

The score is the log-likelihood ratio of p to p0; N is the effective number of frames with these weights, those of a
matched filter. As in `rig.estimate.joint.labels.costs`,

    cost(l) = units_per_nat (largest score of the row - score(l)),    uint8 (rows, columns, labels), <= COST_LIMIT

Of the learned model these costs need only the line's width and the hot pixels. Where fog scatters light many times, a
learned haze and halo can explain a wrong position, but cannot mislead these costs. They ignore where the haze ends.
"""

from typing import Final, NamedTuple

import numba
import numpy as np

from rig.count.volume import Counts, CountVolume
from rig.estimate.joint.labels.cost_rows import COST_LIMIT, EXCLUDED
from rig.estimate.joint.labels.costs import Costs
from rig.estimate.joint.labels.grid import FAR_PX, FRACTIONS, LABEL, LABEL_END, ODD, PHASES, START, VARIANT, VARIANTS
from rig.estimate.row.model import pixel_shares
from rig.simd import Float32, Int16, Int32, Uint8
from rig.simd.functions import logarithm
from rig.simd.memory import CACHE_LINE, address_of, load_float32, prefetch_to_write, store_bytes, store_float32
from rig.simd.shuffles import reversed_lanes
from rig.simd.vectors import LANES, as_bytes, larger_float, smaller_float, to_int16, zero_float32

ROWS: Final = 6
"""Rows to either side whose pixels also belong to a label's surroundings."""
BESIDE_PX: Final = 4, 10
"""Distances, in px, of the nearest and the farthest pixel on either side that belong to a label's surroundings."""
REACH_PX: Final = 2
"""Pixels to either side of a label that its line falls on."""
LEAST_ONES: Final = np.float32(0.5)
"""Number of ones assumed for surroundings without any."""
MOST_SHARE: Final = np.float32(1.0 - 1e-4)
"""Largest p and p0, so that scores stay finite."""
WHOLE_BITS: Final = 8
WHOLE: Final = 1 << WHOLE_BITS
"""Weights of the mean of two costs add up to this; 16 bits hold the sum."""
_AHEAD: Final = 2
"""Memory is prefetched this many rows ahead."""


class Contrast(NamedTuple):
    """Settings of the contrast costs under one model.

    place: int16 (columns, rows, PLACES) of `places_of`. hot_start, hot_x: as in `LabelTables`, of pixels that take the
    count of the pixel beside them. shares: float32 (2, FRACTIONS, taps) of the line in the pixels around its centre.
    First index: 0 for pixels from far to near, 1 from near to far. Second: the centre is -4/8 to 3/8 px off the middle
    of its pixel, towards near. frames: float32 (FRACTIONS,), N for one frame. side: 1 if near is left, else -1. width:
    pixels of a sensor's row; what is stored behind them is padding. units_per_nat: of cost.
    """

    place: Int16
    hot_start: Int32
    hot_x: Int16
    shares: Float32
    frames: Float32
    side: int
    width: int
    units_per_nat: float


def contrast_of(costs: Costs, line_sigma_px: float, width: int) -> Contrast:
    """Settings for a line and a sensor of these widths, with the places, hot pixels and units of a model's costs."""
    distance = np.arange(-REACH_PX, REACH_PX + 1) - (np.arange(FRACTIONS)[:, None] - FRACTIONS // 2) / FRACTIONS
    shares = pixel_shares(line_sigma_px, distance)
    shares /= shares.sum(axis=1, keepdims=True)
    return Contrast(
        costs.place, costs.tables.hot_start, costs.tables.hot_x, np.stack([shares, shares[:, ::-1]]),
        1.0 / np.square(shares).sum(axis=1), costs.grid.side, width, costs.units_per_nat,
    )  # fmt: skip


def share_of(belief: float) -> int:
    """Weight of the model's costs in their mean with the contrast costs, in 1 / WHOLE: a half under full belief."""
    return round(WHOLE * belief / (1.0 + belief))


def cost_contrast(volume: CountVolume, contrast: Contrast, first: int, last: int, cost: Uint8, share: int) -> None:
    """Replace the costs of rows first..last-1 by the weighted mean of these costs and the contrast costs.

    share: weight of the former costs in 1 / WHOLE; 0 for the contrast costs alone.

    cost: uint8 (rows, columns, labels) of all rows. EXCLUDED labels and columns without frames keep their costs.
    Threads may fill different rows at once.
    """
    _fill(volume.counts, volume.n_frames, volume.x0, contrast, first, last, share, cost)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _fill(
    counts: Counts, n_frames: Int32, x0: Int32, contrast: Contrast, first_row: int, last_row: int, share: int,
    cost: Uint8,
) -> None:  # fmt: skip
    (columns, rows, window), labels, side = counts.shape, cost.shape[2], contrast.side
    # Whole vectors may begin at any pixel, and end behind the last one.
    total, running = np.zeros(window, np.float32), np.zeros(window + 2 * BESIDE_PX[1] + LANES, np.float32)
    n, pixels, seen = np.zeros(window + 2 * REACH_PX + LANES, np.float32), np.ones(window + LANES, np.float32), 0
    score, own = np.zeros((PHASES, window + 2 * LANES), np.float32), np.zeros(PHASES * (window + LANES), np.uint8)
    for c in range(columns):
        frames, begin = n_frames[c], max(first_row - ROWS, 0)
        if frames == 0:
            continue
        if seen != min(window, contrast.width - x0[c]):
            seen = min(window, contrast.width - x0[c])
            _note_pixels_beside(seen, pixels)
        total[:] = 0.0
        for y in range(begin, min(first_row + ROWS, rows)):
            total += _mended(counts[c, y], contrast, y, x0[c], n)
        for y in range(first_row, last_row):
            if y + ROWS < rows:
                total += _mended(counts[c, y + ROWS], contrast, y + ROWS, x0[c], n)
            if y - ROWS > begin:
                total -= _mended(counts[c, y - ROWS - 1], contrast, y - ROWS - 1, x0[c], n)
            here = contrast.place[c, y]
            if here[VARIANT] < 0 or here[LABEL] >= here[LABEL_END]:
                continue
            # Of the pixels that hold labels, those that were stored, low..high-1.
            far = int(here[START]) - x0[c] - side * (FAR_PX + (here[LABEL] + here[ODD]) // PHASES)
            near = int(here[START]) - x0[c] - side * (FAR_PX + (here[LABEL_END] - 1 + here[ODD]) // PHASES)
            low, high = max(min(far, near), 0), min(max(far, near) + 1, window)
            if low >= high:
                continue
            for line in range(0, labels, CACHE_LINE):
                prefetch_to_write(address_of(cost) + (min(y + _AHEAD, rows - 1) * columns + c) * labels + line)
            _mended(counts[c, y], contrast, y, x0[c], n)
            _add_up(total, running)
            around = min(y + ROWS, rows - 1) - max(y - ROWS, 0) + 1
            for phase in range(PHASES):
                off = here[VARIANT] + VARIANTS * phase
                _score_pixels(
                    n, running, pixels, contrast.shares[1 if side > 0 else 0, off], around * frames, frames,
                    contrast.frames[off] * frames, low, high, score[phase],
                )  # fmt: skip
            none = _write_own(score, low, high, side, contrast.units_per_nat, own)
            # `own` begins with the first stored pixel, `skipped` pixels after the farthest one that holds a label.
            skipped = far - (high - 1) if side > 0 else low - far
            shift = (here[LABEL] + here[ODD]) % PHASES - PHASES * skipped - here[LABEL]
            first, end = max(int(here[LABEL]), -shift), min(int(here[LABEL_END]), PHASES * (high - low) - shift)
            _write_costs(own[first + shift :], share, cost[y, c, first:end])
            own[:] = none
            _write_costs(own, share, cost[y, c, here[LABEL] : first])
            _write_costs(own, share, cost[y, c, end : here[LABEL_END]])


@numba.njit(cache=True, nogil=True)
def _mended(counts: Counts, contrast: Contrast, y: int, x0: int, n: Float32) -> Float32:
    """Fill n, from REACH_PX on, with a row's counts, and return this part. A hot pixel gets its neighbour's count."""
    window = counts.shape[0]
    mended = n[REACH_PX : REACH_PX + window]
    for t in range(window):
        mended[t] = counts[t]
    for h in range(contrast.hot_start[y], contrast.hot_start[y + 1]):
        t = contrast.hot_x[h] - x0
        if 0 <= t < window:
            mended[t] = mended[t - 1 if t > 0 else t + 1]
    return mended


@numba.njit(cache=True, nogil=True)
def _note_pixels_beside(seen: int, pixels: Float32) -> None:
    """Fill `pixels`, for the first `seen` pixels of a row: 1 over the number of surrounding pixels among these."""
    begin, end = BESIDE_PX
    for t in range(seen):
        left = max(t - begin + 1, 0) - max(t - end, 0)
        right = min(t + end + 1, seen) - min(t + begin, seen)
        pixels[t] = 1.0 / max(left + right, 1)


@numba.njit(cache=True, nogil=True)
def _add_up(total: Float32, running: Float32) -> None:
    """Fill `running`: item BESIDE_PX[1] + t + 1 is the sum of items 0 to t of total, or of all if t is beyond the last.

    float32 is exact for sums below 2^24.
    """
    ones = np.float32(0.0)
    for t in range(total.shape[0]):
        ones += total[t]
        running[BESIDE_PX[1] + t + 1] = ones
    running[BESIDE_PX[1] + total.shape[0] + 1 :] = ones


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _score_pixels(
    n: Float32, running: Float32, pixels: Float32, shares: Float32, seen: float, frames: float, pooled: float,
    low: int, high: int, score: Float32,
) -> None:  # fmt: skip
    """Fill `score` for pixels low..high-1 from item LANES + low on, and set the LANES items behind them to 0.

    n: counts from REACH_PX before the window on. seen: frames x rows of the surroundings. pooled: N of the module.
    """
    at, sums, one_over, to = address_of(n), address_of(running), address_of(pixels), address_of(score)
    (begin, end), one, none = BESIDE_PX, np.float32(1.0), zero_float32()
    per_frame, per_seen, nats = one / np.float32(frames), one / np.float32(seen), np.float32(pooled)
    for t in range(low, high, LANES):
        # Sums up to pixel t are `end` places further on.
        ones = load_float32(sums, t + end - begin + 1) - load_float32(sums, t)
        ones = ones + load_float32(sums, t + 2 * end + 1) - load_float32(sums, t + end + begin)
        p0 = larger_float(ones, none + LEAST_ONES) * load_float32(one_over, t) * per_seen
        p0 = smaller_float(p0, none + MOST_SHARE)
        p = load_float32(at, t) * shares[0]
        for d in range(1, 2 * REACH_PX + 1):
            p = p + load_float32(at, t + d) * shares[d]
        p = smaller_float(larger_float(p * per_frame, p0), none + MOST_SHARE)
        q, q0 = none + one - p, none + one - p0
        store_float32(to, t + LANES, (p * logarithm(p / p0) + q * logarithm(q / q0)) * nats)
    score[high + LANES : high + 2 * LANES] = 0.0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _write_own(score: Float32, low: int, high: int, side: int, units: float, own: Uint8) -> int:
    """Fill own with the costs of pixels low..high-1 from far to near, two a pixel. Returns the cost of score 0."""
    width, at, to, best = score.shape[1], address_of(score), address_of(own), zero_float32()
    for t in range(low + LANES, high + LANES, LANES):
        best = larger_float(best, larger_float(load_float32(at, t), load_float32(at, width + t)))
    store_float32(at, 0, best)
    largest = score[0, :LANES].max()
    most = zero_float32() + np.float32(COST_LIMIT)
    level, per_nat = zero_float32() + largest, zero_float32() + np.float32(units)
    for i in range(0, high - low, LANES):
        t = high - i if side > 0 else low + LANES + i
        far = to_int16(smaller_float((level - load_float32(at, t)) * per_nat, most))
        near = to_int16(smaller_float((level - load_float32(at, width + t)) * per_nat, most))
        if side > 0:
            far, near = reversed_lanes(far), reversed_lanes(near)
        store_bytes(to, PHASES * i, as_bytes(far | near << 8))
    return int(min(largest * np.float32(units), np.float32(COST_LIMIT)))


@numba.njit(cache=True, nogil=True)
def _write_costs(own: Uint8, share: int, cost: Uint8) -> None:
    """Write the weighted mean of cost and own to cost (labels,), except where cost is EXCLUDED."""
    model, other, half = np.uint16(share), np.uint16(WHOLE - share), np.uint16(WHOLE // 2)
    for label in range(cost.shape[0]):
        before = cost[label]
        mean = np.uint8((np.uint16(before) * model + np.uint16(own[label]) * other + half) >> np.uint16(WHOLE_BITS))
        cost[label] = before if before == EXCLUDED else mean
