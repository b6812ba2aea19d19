"""The likelihood of one image row, exact: the specification of what `likelihood` and `joint` compute per row.

Along a row, from near to far, the light is 'haze, stripe, then less'. The counts n_t of pixels t = 0..L-1 are ones in K
one-bit frames. Hypothesis (j, m), 'the stripe is at pixel j with amplitude a_m', expects photons per exposure of

    flux_t = base_t + a_m psi_|t-j| scale_t                   psi: share of the line at 0..T px from its centre
    base_t = before_t for t < j                               haze and ambient light
           = behind_t for t > j                               pedestal and ambient light
           = (before_t + behind_t) / 2 at t = j

A pixel fires with probability p' = (1 - e)(1 - exp(-flux)) + e/2; the floor e (FLOOR) bounds the evidence of a single
pixel. Then

    log-likelihood(j, m) = sum over t of (n_t logit p'_t + K log(1 - p'_t))

is linear in the counts, so that all positions of a row cost one cumulative sum (pixels before and behind j) and 2T + 1
taps (pixels around j) per amplitude. Three more hypotheses have no stripe in the row: the whole row lies before its
stripe, or behind it, or its haze ends between two pixels and nothing shines there. With priors over positions and
amplitudes,

    P(j) ~ prior_j sum over m of weight_m exp(log-likelihood(j, m))

`row_scores` computes the log-likelihood, `row_posterior` the sum over amplitudes, `mode_of` the answer: read them in
this order. Arrays of a row are float32 (L,), scores of M amplitudes float32 (M, L). `rig.estimate.row.inputs` and
`rig.estimate.row.model` explain where `before`, `behind`, `scale` and the priors come from. Only `logit_table` and LOST
are approximations.

`rig.estimate.search` and `rig.estimate.joint.labels` are fast forms of this and are tested against it.
tests/unit/rig/estimate/row/test_likelihood.py compares this module with direct sums, in 50 digits and float64.
"""

from typing import Any, Final

import numba
import numpy as np

from rig.simd import Float32, Float64

Real = float | np.floating[Any]

FLOOR: Final = 1e-3
"""Probability e that a pixel does not follow the model; 2 to 4 % of the pixels of real sensors are defective."""
EXPONENT_LOW: Final = -21
EXPONENT_HIGH: Final = 8
CELL_BITS: Final = 8
"""`logit_table` spans fluxes from 2^EXPONENT_LOW to 2^EXPONENT_HIGH, with 2^CELL_BITS cells per octave."""
TABLE_BASE: Final = np.uint32((127 + EXPONENT_LOW) << CELL_BITS)
TABLE_SHIFT: Final = np.uint32(23 - CELL_BITS)
"""The bits of a float32 shifted right by TABLE_SHIFT, less TABLE_BASE, are the number of its cell."""
FLUX_MIN: Final = np.float32(2.0**EXPONENT_LOW)
FLUX_MAX: Final = np.float32(2.0**EXPONENT_HIGH * 0.999)
"""Smallest and largest flux in the table, photons per exposure and pixel."""
LABEL_PX: Final = 0.25
"""Spacing of the sub-pixel positions around the most probable pixel."""
LABELS: Final = 13
"""Number of sub-pixel positions, up to 1.5 px each way: wide enough for a peak, too narrow for a second one."""
LOST: Final = np.float32(24.0)
"""Hypotheses at least this many nats below the best are ignored (exp(-24) = 4e-11)."""


def logit_table() -> Float32:
    """Table (2, cells) float32 of logit p' and log(1 - p') by flux: 256 cells an octave, value at the cell's middle.

    The largest error, half a cell, changes a log-likelihood by 0.002 per count, far below its own noise.
    """
    cells = (EXPONENT_HIGH - EXPONENT_LOW) << CELL_BITS
    i = np.arange(cells)
    mantissa = 1.0 + ((i & ((1 << CELL_BITS) - 1)) + 0.5) / (1 << CELL_BITS)
    flux = np.ldexp(mantissa, (i >> CELL_BITS) + EXPONENT_LOW)
    q = (1 - FLOOR) * np.exp(-flux) + FLOOR / 2
    p = -(1 - FLOOR) * np.expm1(-flux) + FLOOR / 2
    return np.stack([np.log(p) - np.log(q), np.log(q)]).astype(np.float32)


@numba.njit(inline="always")
def cell_of(flux):  # type: ignore[no-untyped-def]
    """Cell of `logit_table` for a float32 flux of FLUX_MIN to FLUX_MAX; unsigned, for the vectoriser."""
    return np.uint64((np.float32(flux).view(np.uint32) >> TABLE_SHIFT) - TABLE_BASE)


@numba.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def add_evidence(
    n: Float32, k: Real, base: Float32, light: Real, scale: Float32, own: Float32, table: Float32, score: Float32
) -> None:
    """Add to score the log-likelihood of n ones in k frames at flux base + light * scale, less `own`.

    Arrays but `table` are equally long, fluxes at least FLUX_MIN. Written for the vectoriser: no branch, unsigned table
    index, slices from zero.
    """
    gain, loss = table[0], table[1]
    for t in range(score.shape[0]):
        flux = np.float32(min(base[t] + light * scale[t], FLUX_MAX))
        i = cell_of(flux)
        score[t] += n[t] * gain[i] + k * loss[i] - own[t]


@numba.njit(cache=True, nogil=True)
def row_scores(
    n: Float32, k: Real, before: Float32, behind: Float32, scale: Float32, length: int, amplitude: Float32,
    psi: Float32, table: Float32, taps: Float32, edge: Float32, score: Float32,
) -> None:  # fmt: skip
    """Log-likelihood of every position and amplitude relative to 'everything is behind'.

    n: (length,) ones of the k exposures. psi: (T + 1,) share of the stripe at 0..T px from its centre. table: of
    `logit_table`. Writes score (M, length); edge (length + 1,), the score of a change from before to behind just in
    front of pixel t, without a stripe; and taps (3, length): each pixel's log-likelihood if it lies before the stripe,
    the same behind it, and the mean of its two fluxes.
    """
    n, before, behind, scale = n[:length], before[:length], behind[:length], scale[:length]
    near, far, middle = taps[0, :length], taps[1, :length], taps[2, :length]
    for t in range(length):
        near[t] = far[t] = 0.0
        middle[t] = np.float32(0.5) * (before[t] + behind[t])
    dark = np.float32(0.0)
    add_evidence(n, k, before, dark, scale, near, table, near)
    add_evidence(n, k, behind, dark, scale, far, table, far)
    edge[0] = 0.0
    total = 0.0
    for t in range(length):
        total += near[t] - far[t]
        edge[t + 1] = total
    for m in range(amplitude.shape[0]):
        row = score[m, :length]
        for t in range(length):
            row[t] = edge[t]
        add_evidence(n, k, middle, amplitude[m] * psi[0], scale, far, table, row)
        for d in range(1, psi.shape[0]):
            # The same pixel serves as tap of the stripe d px behind it, and of the one d px nearer.
            light, m_px = amplitude[m] * psi[d], length - d
            add_evidence(n[:m_px], k, before[:m_px], light, scale[:m_px], near[:m_px], table, row[d:])
            add_evidence(n[d:], k, behind[d:], light, scale[d:], far[d:], table, row[:m_px])


@numba.njit(cache=True, nogil=True)
def none_prior(
    near: float, far: float, w_first: float, w_last: float, none_weight: float
) -> tuple[float, float, float]:
    """The three priors `none` of `row_posterior`, from the part of the depth range that the picture shows.

    near, far: inverse depths of the ends of the depth range; w_first, w_last: of the first and last position.
    Positions beyond the picture's border are as likely, per inverse depth, as those in the picture.
    """
    span = near - far
    cut_near = min(max((near - w_first) / span, 0.0), 1.0)
    cut_far = min(max((w_last - far) / span, 0.0), 1.0)
    rest = 1.0 - none_weight
    # Where hardly any of the depth range is in the picture, its few positions keep at least a tenth.
    cut = cut_near + cut_far
    if cut > 0.9:
        cut_near, cut_far = cut_near * 0.9 / cut, cut_far * 0.9 / cut
    third = none_weight / 3.0
    return third + rest * cut_near, third + rest * cut_far, third


@numba.njit(cache=True, nogil=True)
def row_posterior(
    score: Float32, edge: Float32, length: int, first: int, last: int, log_weight: Float32, log_prior: Float32,
    none: tuple[float, float, float], posterior: Float32, by_amplitude: Float64,
) -> tuple[float, float]:  # fmt: skip
    """Fill `posterior` (length,), the probability of each position, and `by_amplitude` (M,), that of each amplitude.

    first, last: ends of the positions that a stripe may have; all others get 0. none: prior of a row that lies entirely
    behind its stripe, of one entirely before it, and of one whose haze ends without a stripe. log_prior: of positions,
    up to a constant; log_weight: of amplitudes. Returns the probability of 'no stripe' and the row's log evidence,
    relative to 'everything is behind'.
    """
    mass = 0.0
    for j in range(first, last + 1):
        posterior[j] = np.exp(log_prior[j])
        mass += posterior[j]
    log_share = np.log((1.0 - none[0] - none[1] - none[2]) / mass)
    best = np.float32(-1e30)
    for m in range(score.shape[0]):
        top = np.float32(-1e30)
        for j in range(first, last + 1):
            top = max(top, score[m, j] + log_prior[j])
        best = max(best, top + log_weight[m])
    log_step = np.log(none[2] / (length + 1)) - log_share
    log_behind, log_before = np.log(none[0]) - log_share, np.log(none[1]) - log_share
    for t in range(length + 1):
        best = max(best, edge[t] + log_step)
    best = max(best, edge[0] + log_behind, edge[length] + log_before)
    total_none = np.exp(edge[0] + log_behind - best) + np.exp(edge[length] + log_before - best)
    for t in range(length + 1):
        s = edge[t] + log_step - best
        if s > -LOST:
            total_none += np.exp(s)
    for t in range(length):
        posterior[t] = 0.0
    total = total_none
    for m in range(score.shape[0]):
        subtotal = 0.0
        for j in range(first, last + 1):
            s = score[m, j] + log_prior[j] + log_weight[m] - best
            if s > -LOST:
                p = np.exp(s)
                posterior[j] += p
                subtotal += p
        by_amplitude[m] = subtotal
        total += subtotal
    if total <= 0.0:
        return 1.0, 0.0
    inverse = 1.0 / total
    for j in range(first, last + 1):
        posterior[j] *= inverse
    for m in range(score.shape[0]):
        by_amplitude[m] *= inverse
    return total_none * inverse, np.log(total) + best + log_share


@numba.njit(cache=True, nogil=True)
def mode_of(posterior: Float32, first: int, last: int) -> tuple[int, float]:
    """Most probable position, the smallest index among equal ones, and the probability of lying within 1 px of it."""
    mode = first
    for j in range(first, last + 1):
        if posterior[j] > posterior[mode]:
            mode = j
    near = posterior[mode]
    for j in (mode - 1, mode + 1):
        if first <= j <= last:
            near += posterior[j]
    return mode, min(near, np.float32(1.0))
