"""Close look at the best position of a row, compiled: a fast form of `rig.estimate.row.likelihood`, tested against it.

It finds the position of the line within the pixel. LABELS positions (labels), LABEL_PX apart, are compared, one per
lane of a vector. Let L and R be the flux left and right of the line, s the line's light, f_i,t its share in pixel t if
it is at label i, and l_i,t the part of pixel t that lies left of label i. With n_t ones of pixel t in K exposures,

    score_i = K constant_i + sum over t of n_t weight_i,t    for fluxes l_i,t L + (1 - l_i,t) R + s f_i,t

Here weight_i,t is logit p' at that flux, constant_i the sum of log(1 - p'). Scores, saturating int16, have
128 >> shift units an octave (factor of 2) of likelihood; shift is `close_shift` of `SearchTables`. The position is the
posterior mean over labels, float32. weight (int8) and constant (float32) are tabled over the flux before the line and
the line's light, two levels an octave. The first comes from the model, s is measured from the counts.
"""

from typing import Final, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rig.estimate.row.likelihood import FLUX_MAX, FLUX_MIN, LABEL_PX, LABELS, cell_of
from rig.estimate.search.tables import LN2, WEIGHT_LIMIT, count_place
from rig.simd import Float32
from rig.simd.memory import aligned_zeros, load_bytes, load_float32, read_int16
from rig.simd.vectors import (
    LANES,
    UNPACKED,
    add_saturated,
    as_bytes,
    dot_pairs,
    larger,
    larger_float,
    smaller,
    square_root,
    to_bfloat16,
    to_int16,
    zero_int16,
)

LEVEL_SHIFT: Final = np.uint32(22)
"""Shift that keeps the exponent and first mantissa bit of a float32: two levels an octave."""
LOWEST_OCTAVE: Final = -14
LEVEL_BASE: Final = np.uint32((127 + LOWEST_OCTAVE) << 1)
LEVELS: Final = 36
"""Number of flux levels, from 2^-14 to 2^4 photons per exposure."""
IMPOSSIBLE: Final = np.float32(-1e30)
LOWEST_SCORE: Final = np.float32(-32000.0)


class Closeup(NamedTuple):
    """Tables of the close look.

    weight: int8 (LEVELS, LEVELS, 2, reach + 1, LANES, 2), units per count, over the flux before the line, the line's
    light, last bit of the pixel's index, pair of pixels from `first_px` on, label, pixel of the pair. reach: pixels on
    either side that are looked at. constant: float32 (LEVELS, LEVELS, LANES), units per exposure. The mean over the
    labels is subtracted from both. label, square: float32 (LANES,), number of the label from the middle one, and its
    square, in the order UNPACKED; 0 for lanes without a label.
    """

    weight: NDArray[np.int8]
    constant: Float32
    label: Float32
    square: Float32


@numba.njit(cache=True, nogil=True)
def label_weights(
    ambient: float, share: float, near_is_left: bool, fine: Float32, table: Float32
) -> tuple[Float32, Float32]:
    """Weight of a count for each label, (LEVELS, LEVELS, F, LABELS), and of an exposure, (LEVELS, LEVELS, LABELS).

    Both are in octaves of likelihood, with the mean over the labels subtracted. LEVELS: of the flux before the line,
    then of the line's light. ambient: photons per exposure; share: ratio of the pedestal (level behind the stripe) to
    the haze; fine: (LABELS, F) as `fine_profiles` of `rig.estimate.row.model`; table: `logit_table`.
    """
    pixels = fine.shape[1]
    reach = (pixels - 1) // 2
    weight = np.zeros((LEVELS, LEVELS, pixels, LABELS), np.float32)
    constant = np.zeros((LEVELS, LEVELS, LABELS), np.float32)
    octave = np.float32(1.0 / LN2)
    for a in range(LEVELS):
        before = np.float32(level_flux(a))
        behind = np.float32(min(ambient + share * max(before - ambient, 0.0), before))
        left, right = (before, behind) if near_is_left else (behind, before)
        for b in range(LEVELS):
            light = np.float32(level_flux(b))
            for t in range(pixels):
                for i in range(LABELS):
                    offset = (i - LABELS // 2) * LABEL_PX
                    of_left = np.float32(min(max(offset - (t - reach) + 0.5, 0.0), 1.0))
                    flux = of_left * left + (np.float32(1.0) - of_left) * right + light * fine[i, t]
                    cell = cell_of(min(max(flux, FLUX_MIN), FLUX_MAX))
                    weight[a, b, t, i] = table[0, cell] * octave
                    constant[a, b, i] += table[1, cell] * octave
                weight[a, b, t] -= weight[a, b, t].mean()
            constant[a, b] -= constant[a, b].mean()
    return weight, constant


def closeup_tables(weight: Float32, constant: Float32, units: int) -> Closeup:
    """Tables with `units` units an octave, from `label_weights`."""
    pixels = weight.shape[2]
    reach = (pixels - 1) // 2
    whole = _cut(weight, units).astype(np.int8)
    pairs = aligned_zeros((LEVELS, LEVELS, 2, reach + 1, LANES, 2), np.int8)
    for odd in range(2):
        for t in range(pixels):
            at = t - reach - first_px(odd, reach)
            pairs[:, :, odd, at // 2, :LABELS, at % 2] = whole[:, :, t]
    padded = aligned_zeros((LEVELS, LEVELS, LANES), np.float32)
    padded[...] = IMPOSSIBLE
    padded[:, :, :LABELS] = constant * units
    number = np.array(UNPACKED)
    index = np.where(number < LABELS, number - LABELS // 2, 0).astype(np.float32)
    return Closeup(pairs, padded, index, index * index)


def largest_score(weight: Float32, units: int) -> float:
    """Largest sum of a label's weights (absolute values), with `units` units an octave, from `label_weights`."""
    return float(np.abs(_cut(weight, units)).sum(axis=2).max())


def _cut(weight: Float32, units: int) -> Float32:
    """Weights in whole units, cut to what 8 bits hold."""
    return np.clip(np.rint(weight * np.float32(units)), -WEIGHT_LIMIT, WEIGHT_LIMIT)


@numba.njit(inline="always", cache=True)  # called from Python too
def first_px(odd, reach):  # type: ignore[no-untyped-def]
    """First pixel of the pairs that cover a pixel and `reach` on either side, relative to it. odd: its last bit."""
    return (odd - reach) // 2 * 2 - odd


@numba.njit(inline="always")
def level_flux(level):  # type: ignore[no-untyped-def]
    """Flux in the middle of a level: 1.25 or 1.75 times a power of two."""
    return (1.25 + 0.5 * (level & 1)) * 2.0 ** (LOWEST_OCTAVE + (level >> 1))


@numba.njit(inline="always")
def levels_of(before, signal):  # type: ignore[no-untyped-def]
    """Index of the pair of levels in the tables, 16-bit lanes, for fluxes in float32 lanes."""
    return _level_of_each(before) * np.int16(LEVELS) + _level_of_each(signal)


@numba.njit(inline="always")
def _level_of_each(flux):  # type: ignore[no-untyped-def]
    # The upper half of a float32 holds all bits that count.
    octave = (to_bfloat16(flux) >> np.int16(LEVEL_SHIFT - 16)) - np.int16(LEVEL_BASE)
    return smaller(larger(octave, np.int16(0)), np.int16(LEVELS - 1))


@numba.njit(forceinline=True)
def label_scores(search, r, x, exposures, weight, constant, pairs):  # type: ignore[no-untyped-def]
    """Score of each label, 16-bit lanes, for a line near pixel x of row r of the batch.

    weight, constant: addresses of the two levels' weights, for even x, and of their constants; pairs: reach + 1.
    """
    n = search.n + r * search.n_bytes
    score = to_int16(larger_float(load_float32(constant, 0) * np.float32(exposures), LOWEST_SCORE))
    weight += 2 * LANES * pairs * (x & 1)
    first = x + first_px(x & 1, pairs - 1)
    for p in range(pairs):
        two = as_bytes(zero_int16() + read_int16(n + count_place(search, first + 2 * p), 0))
        score = add_saturated(score, dot_pairs(two, load_bytes(weight, 2 * LANES * p)))
    return score


@numba.njit(forceinline=True)
def offsets(mass, moment, square, label_px):  # type: ignore[no-untyped-def]
    """Offset of each line from the middle of its pixel in px, positive to the right, and its standard deviation;
    float32 lanes.

    mass, moment, square: sums over the labels of their likelihoods, of these times the labels' numbers, and times the
    squared numbers; label_px: distance from one label to the next.
    """
    mean = moment / mass
    variance = larger_float(square / mass - mean * mean, np.float32(0.0))
    return mean * np.float32(label_px), square_root(variance + np.float32(1.0 / 12.0)) * np.float32(label_px)
