"""Likelihoods from scores: 2^x read off the bits of a bfloat16, which is linear between powers of two.

A score is a whole number of units, 128 >> shift to the octave. A term is exact at whole octaves above
`nothing_below`, elsewhere up to 6 % too large, 4 % on average.
"""

from typing import Final

import numba
import numpy as np

from rig.lane_bfloat16 import from_bfloat16, from_bfloat16_unpacked
from rig.lanes import add_saturated, larger, sub_saturated, zero_int16

BIAS: Final = np.int16(127 << 7)
"""Exponent of 1.0 as a bfloat16."""
MEAN_EXCESS: Final = np.float32(1.040684)
"""Mean of (1 + f) / 2^f over f in 0..1: by so much a term is too large on average."""


@numba.njit(inline="always")
def lift_to_powers(best, shift):  # type: ignore[no-untyped-def]
    """What to add to scores so that nothing is at 0, 127 octaves below each lane's best score or at the lowest."""
    return add_saturated(sub_saturated(zero_int16(), best), np.int16(np.int64(BIAS) >> shift))


@numba.njit(inline="always")
def powers(scores, lift, shift):  # type: ignore[no-untyped-def]
    """2^(score / units) of 16-bit lanes as float32 in the order UNPACKED, up to a factor common to all.

    lift: see `lift_to_powers`; what is below nothing is 0.
    """
    return from_bfloat16_unpacked(larger(add_saturated(scores, lift), np.int16(0)) << shift)


@numba.njit(inline="always")
def powers_in_order(scores, lift, shift):  # type: ignore[no-untyped-def]
    """The same in order."""
    return from_bfloat16(larger(add_saturated(scores, lift), np.int16(0)) << shift)
