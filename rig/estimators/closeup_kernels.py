"""Compiled close look at the best position of a row: where within the pixel the line lies, and how bright it is.

The counts of the few pixels around the position are compared with lines a quarter pixel apart, all at once: one label
to a lane. What a count says of each label is tabled over the two fluxes that matter, haze and line, half an octave
apart; the line's brightness is taken from the counts themselves.
"""

from typing import Final, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rig.estimators.powers import nothing_below, powers
from rig.estimators.row_kernels import FLUX_MAX, FLUX_MIN, LABEL_PX, LABELS, cell_of
from rig.estimators.screen_tables import LN2
from rig.lane_order import place_of
from rig.lanes import (
    LANES,
    UNPACKED,
    add_saturated,
    larger_float,
    largest,
    load_float32,
    load_int16,
    read_int16,
    to_int16,
    total,
)

LEVEL_SHIFT: Final = np.uint32(22)
"""Two levels an octave: the exponent and the first bit behind it of a float32."""
LOWEST_OCTAVE: Final = -14
LEVEL_BASE: Final = np.uint32((127 + LOWEST_OCTAVE) << 1)
LEVELS: Final = 36
"""2^-14 to 2^4 photons per exposure."""
IMPOSSIBLE: Final = np.float32(-1e30)
LOWEST_SCORE: Final = np.float32(-32000.0)


class Closeup(NamedTuple):
    """Tables of the close look.

    weight: int16 (LEVELS, LEVELS, F, LANES) over haze, line, pixel from -R to R, label: units per count; constant:
    float32 (LEVELS, LEVELS, LANES), units per exposure. Units as of the search, 128 >> shift an octave. label, square:
    float32 (LANES,), number of the label from the middle one, and squared, in the order UNPACKED.
    """

    weight: NDArray[np.int16]
    constant: NDArray[np.float32]
    label: NDArray[np.float32]
    square: NDArray[np.float32]


@numba.njit(cache=True, nogil=True)
def closeup_tables(
    ambient: float,
    share: float,
    near_is_left: bool,
    fine: NDArray[np.float32],
    table: NDArray[np.float32],
    units: float,
) -> Closeup:
    """Tables for ambient light of so many photons per exposure and a pedestal of so large a share of the haze.

    fine: (LABELS, F) as `row_model.fine_profiles`; table: `logit_table`.
    """
    pixels = fine.shape[1]
    reach = (pixels - 1) // 2
    weight = np.zeros((LEVELS, LEVELS, pixels, LANES), np.int16)
    constant = np.zeros((LEVELS, LEVELS, LANES), np.float32)
    per_nat = np.float32(units / LN2)
    gain, loss = table[0], table[1]
    for a in range(LEVELS):
        before = np.float32(level_flux(a))
        behind = np.float32(min(ambient + share * max(before - ambient, 0.0), before))
        left, right = (before, behind) if near_is_left else (behind, before)
        for b in range(LEVELS):
            light = np.float32(level_flux(b))
            out = weight[a, b]
            constant[a, b, LABELS:] = IMPOSSIBLE
            for i in range(LABELS):
                offset = (i - LABELS // 2) * LABEL_PX
                for t in range(pixels):
                    of_left = np.float32(min(max(offset - (t - reach) + 0.5, 0.0), 1.0))
                    flux = of_left * left + (np.float32(1.0) - of_left) * right + light * fine[i, t]
                    cell = cell_of(min(max(flux, FLUX_MIN), FLUX_MAX))
                    own = cell_of(min(max(right, FLUX_MIN), FLUX_MAX))
                    out[t, i] = np.int16(round((gain[cell] - gain[own]) * per_nat))
                    constant[a, b, i] += (loss[cell] - loss[own]) * per_nat
    index, square = np.zeros(LANES, np.float32), np.zeros(LANES, np.float32)
    for i in range(LANES):
        label = UNPACKED[i]
        if label < LABELS:
            index[i] = label - LABELS // 2
            square[i] = (label - LABELS // 2) ** 2
    return Closeup(weight, constant, index, square)


@numba.njit(inline="always")
def level_of(flux):  # type: ignore[no-untyped-def]
    """Level that a flux in photons per exposure lies in."""
    octave = np.int64(np.float32(flux).view(np.uint32) >> LEVEL_SHIFT) - np.int64(LEVEL_BASE)
    return min(max(octave, 0), LEVELS - 1)


@numba.njit(inline="always")
def level_flux(level):  # type: ignore[no-untyped-def]
    """Flux in the middle of a level: 1.25 or 1.75 times a power of two."""
    return (1.25 + 0.5 * (level & 1)) * 2.0 ** (LOWEST_OCTAVE + (level >> 1))


@numba.njit(inline="always")
def label_likelihoods(n, lanes, x, exposures, weight, constant, pixels, shift):  # type: ignore[no-untyped-def]
    """Likelihood of each label as float32 lanes in the order UNPACKED, for a line near pixel x.

    n: address of the row's counts, of so many lanes; weight: of the F = `pixels` vectors of the two levels, constant:
    of theirs.
    """
    score = to_int16(larger_float(load_float32(constant, 0) * np.float32(exposures), LOWEST_SCORE))
    first = x - (pixels - 1) // 2
    for t in range(pixels):
        count = read_int16(n, place_of(first + t, lanes))
        score = add_saturated(score, load_int16(weight, t * LANES) * count)
    return powers(score, nothing_below(largest(score), shift), shift)


@numba.njit(inline="always")
def place_line(likelihood, index, square):  # type: ignore[no-untyped-def]
    """Offset of the line from the middle of its pixel in px, to the right, and its standard deviation.

    index, square: addresses of those of `Closeup`.
    """
    mass = total(likelihood)
    mean = total(likelihood * load_float32(index, 0)) / mass
    variance = total(likelihood * load_float32(square, 0)) / mass - mean * mean
    label_px = np.float32(LABEL_PX)
    return label_px * mean, label_px * np.sqrt(max(variance, np.float32(0.0)) + np.float32(1.0 / 12.0))
