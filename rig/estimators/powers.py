"""Likelihoods from scores: 2^x read off the bits of a bfloat16, which is linear between powers of two.

A score is a whole number of units, 128 >> shift to the octave. A term is exact at whole octaves above
`nothing_below`, elsewhere up to 6 % too large, 4 % on average.
"""

from typing import Final

import numba
import numpy as np

from rig.lanes import from_bfloat16, larger, sub_saturated

BIAS: Final = np.int16(127 << 7)
"""Exponent of 1.0 as a bfloat16."""
MEAN_EXCESS: Final = np.float32(1.040684)
"""Mean of (1 + f) / 2^f over f in 0..1: by so much a term is too large on average."""


@numba.njit(inline="always")
def nothing_below(best, shift):  # type: ignore[no-untyped-def]
    """Score that counts as nothing: 127 octaves below the best one, or the lowest there is."""
    return np.int16(max(np.int64(best) - (np.int64(BIAS) >> shift), -32768))


@numba.njit(inline="always")
def powers(scores, nothing, shift):  # type: ignore[no-untyped-def]
    """2^(score / units) of 16-bit lanes as float32 in the order of `from_bfloat16`, up to a factor common to all.

    nothing: see `nothing_below`; 0 from there down.
    """
    return from_bfloat16(larger(sub_saturated(scores, nothing), np.int16(0)) << shift)


@numba.njit(inline="always")
def power(score, nothing, shift):  # type: ignore[no-untyped-def]
    """The same of one score."""
    return np.uint32((max(np.int64(score) - nothing, 0) << shift) << 16).view(np.float32)
