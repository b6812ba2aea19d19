"""Compiled sweeps of the row likelihood: one pass that learns, one that estimates."""

from typing import Final

import numba
import numpy as np
from numpy.typing import NDArray

from rig.estimators.row_kernels import LABELS, load_row, mode_of, none_prior, refine, row_posterior, row_scores
from rig.geometry import MARGIN_PX

CUT: Final = 0.05
"""Share of the depth range outside the picture up to which a row tells how often the stripe is missing."""
CERTAIN: Final = 0.6
"""Probability within 1 px from which a row teaches the level behind the stripe."""


@numba.njit(cache=True, nogil=True)
def learn_rows(
    counts: NDArray[np.unsignedinteger],
    n_frames: NDArray[np.int32],
    x0: NDArray[np.int32],
    x_lo: NDArray[np.int32],
    x_hi: NDArray[np.int32],
    near_is_left: bool,
    plane: NDArray[np.float64],
    u: NDArray[np.float32],
    v: NDArray[np.float32],
    ambient: NDArray[np.float32],
    profile: NDArray[np.float32],
    profile_lo: float,
    profile_per_w: float,
    row_gain: NDArray[np.float32],
    amplitude: NDArray[np.float32],
    log_weight: NDArray[np.float32],
    none_weight: float,
    w_near: float,
    w_far: float,
    psi: NDArray[np.float32],
    table: NDArray[np.float32],
    row_of: NDArray[np.int32],
    column_of: NDArray[np.int32],
    hot_flux: float,
    levels: NDArray[np.float64],
    rows_seen: NDArray[np.float64],
    amplitude_mass: NDArray[np.float64],
) -> float:
    """Expectation step over the listed (row, column) pairs; returns the log evidence.

    Adds to levels (bins, 8): ones, exposures and geometry-weighted exposures before the stripe, then the same behind it,
    each weighted with the probability of being there, then stripes, and stripes if all positions were alike; rows_seen (rows, 2): ones before the stripe that haze explains,
    and those expected; amplitude_mass (M + 1,): rows per amplitude, the last one 'no stripe'.
    """
    window = counts.shape[2]
    amplitudes = amplitude.shape[0]
    n = np.empty(window, np.float32)
    before = np.empty(window, np.float32)
    behind = np.empty(window, np.float32)
    scale = np.empty(window, np.float32)
    cell = np.empty(window, np.int32)
    gain = np.empty(window, np.float32)
    w = np.empty(window, np.float32)
    log_prior = np.empty(window, np.float32)
    taps = np.empty((3, window), np.float32)
    edge = np.empty(window + 1, np.float32)
    score = np.empty((amplitudes, window), np.float32)
    posterior = np.empty(window, np.float32)
    mass = np.empty(amplitudes, np.float64)
    reach = psi.shape[0]
    evidence = 0.0
    for i in range(row_of.shape[0]):
        y, c = row_of[i], column_of[i]
        if n_frames[c] == 0 or x_lo[y, c] > x_hi[y, c]:
            continue
        length, first, start = load_row(
            counts[c, y], x0[c], y, x_lo[y, c], x_hi[y, c], MARGIN_PX, near_is_left, plane[c], u, v, ambient, profile,
            profile_lo, profile_per_w, row_gain[y], n, before, behind, scale, cell, gain, w, log_prior,
        )  # fmt: skip
        last = first + x_hi[y, c] - x_lo[y, c]
        first, last = max(first, 0), min(last, length - 1)
        if first > last:
            continue
        k = np.float32(n_frames[c])
        row_scores(n, k, before, behind, scale, length, amplitude, psi, table, taps, edge, score)
        prior = none_prior(w_near, w_far, w[first], w[last], none_weight)
        none, row_evidence = row_posterior(score, edge, length, first, last, log_weight, log_prior, prior, posterior, mass)
        for t in range(length):
            evidence += taps[1, t]
        evidence += row_evidence
        if prior[0] + prior[1] < none_weight + CUT:  # else the picture's border cuts the row off
            for m in range(amplitudes):
                amplitude_mass[m] += mass[m]
            amplitude_mass[amplitudes] += none
            for j in range(first, last + 1):
                levels[cell[j], 6] += posterior[j]
                levels[cell[j], 7] += (1.0 - none) / (last - first + 1)
        if none > 0.5:
            continue
        # Doubtful rows would teach the level behind the stripe their own guess; haze before it is plentiful anyway.
        certain = mode_of(posterior, first, last)[1] > CERTAIN
        passed = 0.0
        for t in range(length):
            passed += posterior[t]
            # Room for the stripe's own width on both sides.
            ahead = 0.0
            near = posterior[t]
            for d in range(1, reach + 1):
                if t + d < length:
                    ahead += posterior[t + d]
                if t - d >= 0:
                    near += posterior[t - d]
            x = start + t if near_is_left else start - t
            if ambient[y, x] > hot_flux:
                continue
            p_before = max(1.0 - none - passed - ahead, 0.0)
            p_behind = max(passed - near, 0.0)
            b = cell[t]
            levels[b, 0] += p_before * n[t]
            levels[b, 1] += p_before * k
            levels[b, 2] += p_before * k * gain[t]
            if certain:
                levels[b, 3] += p_behind * n[t]
                levels[b, 4] += p_behind * k
                levels[b, 5] += p_behind * k * gain[t]
            rows_seen[y, 0] += p_before * n[t]
            rows_seen[y, 1] += p_before * k * -np.expm1(-before[t])
    return evidence


@numba.njit(cache=True, nogil=True)
def estimate_rows(
    counts: NDArray[np.unsignedinteger],
    n_frames: NDArray[np.int32],
    x0: NDArray[np.int32],
    x_lo: NDArray[np.int32],
    x_hi: NDArray[np.int32],
    near_is_left: bool,
    plane: NDArray[np.float64],
    u: NDArray[np.float32],
    v: NDArray[np.float32],
    ambient: NDArray[np.float32],
    profile: NDArray[np.float32],
    profile_lo: float,
    profile_per_w: float,
    row_gain: NDArray[np.float32],
    amplitude: NDArray[np.float32],
    log_weight: NDArray[np.float32],
    none_weight: float,
    w_near: float,
    w_far: float,
    psi: NDArray[np.float32],
    fine: NDArray[np.float32],
    table: NDArray[np.float32],
    first_row: int,
    last_row: int,
    out: NDArray[np.float32],
    quiet: NDArray[np.uint32],
) -> None:
    """Best position of every column on rows first_row..last_row-1.

    out: (5, rows, columns): x_px, confidence, x_sd_px, signal, haze (see StripeTable).
    quiet: (2, rows, width): ones and exposures of each pixel while it lay clearly behind the stripe.
    """
    window = counts.shape[2]
    amplitudes = amplitude.shape[0]
    n = np.empty(window, np.float32)
    before = np.empty(window, np.float32)
    behind = np.empty(window, np.float32)
    scale = np.empty(window, np.float32)
    cell = np.empty(window, np.int32)
    gain = np.empty(window, np.float32)
    w = np.empty(window, np.float32)
    log_prior = np.empty(window, np.float32)
    taps = np.empty((3, window), np.float32)
    edge = np.empty(window + 1, np.float32)
    score = np.empty((amplitudes, window), np.float32)
    posterior = np.empty(window, np.float32)
    mass = np.empty(amplitudes, np.float64)
    labels = np.empty(LABELS, np.float64)
    reach = psi.shape[0] - 1
    step = 1 if near_is_left else -1
    for c in range(counts.shape[0]):
        if n_frames[c] == 0:
            continue
        k = np.float32(n_frames[c])
        for y in range(first_row, last_row):
            if x_lo[y, c] > x_hi[y, c]:
                continue
            length, first, start = load_row(
                counts[c, y], x0[c], y, x_lo[y, c], x_hi[y, c], MARGIN_PX, near_is_left, plane[c], u, v, ambient,
                profile, profile_lo, profile_per_w, row_gain[y], n, before, behind, scale, cell, gain, w, log_prior,
            )  # fmt: skip
            last = first + x_hi[y, c] - x_lo[y, c]
            first, last = max(first, 0), min(last, length - 1)
            if first > last:
                continue
            row_scores(n, k, before, behind, scale, length, amplitude, psi, table, taps, edge, score)
            prior = none_prior(w_near, w_far, w[first], w[last], none_weight)
            row_posterior(score, edge, length, first, last, log_weight, log_prior, prior, posterior, mass)
            mode, near = mode_of(posterior, first, last)
            offset, sd = refine(
                n, k, before, behind, scale, length, mode, score, edge, taps, amplitude, log_weight, fine, table, labels
            )
            best = 0
            for m in range(1, amplitudes):
                if score[m, mode] + log_weight[m] > score[best, mode] + log_weight[best]:
                    best = m
            out[0, y, c] = start + step * (mode + offset)
            out[1, y, c] = near
            out[2, y, c] = sd
            out[3, y, c] = amplitude[best] * scale[mode]
            out[4, y, c] = max(before[mode] - ambient[y, start + step * mode], np.float32(0.0))
            if near > 0.9:
                for t in range(mode + reach + 2, length):
                    quiet[0, y, start + step * t] += np.uint32(n[t])
                    quiet[1, y, start + step * t] += np.uint32(k)



@numba.njit(cache=True, nogil=True)
def window_sums(
    counts: NDArray[np.unsignedinteger],
    n_frames: NDArray[np.int32],
    x0: NDArray[np.int32],
    x_lo: NDArray[np.int32],
    x_hi: NDArray[np.int32],
    rows: int,
    width: int,
) -> NDArray[np.uint32]:
    """Ones and exposures (2, rows, width) of every pixel over the columns in whose search window it lies."""
    out = np.zeros((2, rows, width), np.uint32)
    for c in range(counts.shape[0]):
        for y in range(rows):
            for x in range(max(x_lo[y, c], x0[c]), min(x_hi[y, c], x0[c] + counts.shape[2] - 1, width - 1) + 1):
                out[0, y, x] += counts[c, y, x - x0[c]]
                out[1, y, x] += n_frames[c]
    return out
