"""Logarithm, powers of e and 2, and the error function of 16 float32 at once; the C library computes one at a time.

`logarithm` and `exponential` split off a power of two and sum a series for the rest. `error_function` is Abramowitz
and Stegun 7.1.28. Each states its error.

`powers` turns scores into likelihoods 2^(score / units). Scores are int16, and `units` = 128 >> shift. Shifted left by
`shift` bits, a score is read as the bits of a bfloat16 (`rig.simd.vectors`), whose value is linear between powers of
two. The result is exact where a score lies a whole number of octaves (factors of 2) above the score that becomes 0, and
elsewhere up to 6 % too large, 4 % on average (`MEAN_EXCESS`).
"""

import math
from typing import Any, Final

import numba
import numpy as np

from rig.simd.vectors import (
    FLOAT32,
    WIDE,
    add_saturated,
    emitted,
    from_bfloat16,
    from_bfloat16_unpacked,
    larger,
    larger_float,
    smaller_float,
    sub_saturated,
    wide,
    zero_float32,
    zero_int16,
)

_MANTISSA_BITS: Final = 23
_BIAS: Final = 127
_ROOT_HALF: Final = 0x3F3504F3
"""Bits of sqrt(1/2) as a float32: mantissas from sqrt(1/2) to sqrt(2) have the logarithms nearest to 0."""
_LOG2_E, _LN_2 = 1.0 / math.log(2.0), math.log(2.0)
_LEAST, _MOST = -87.0, 88.0
"""Limits of the exponent: e^-87 and e^88 are still normal float32 numbers."""
_TO_WHOLE: Final = 1.5 * 2.0**_MANTISSA_BITS
"""Adding and then subtracting this number rounds to the nearest whole number."""
_ERF: Final = 0.0000430638, 0.0002765672, 0.0001520143, 0.0092705272, 0.0422820123, 0.0705230784
"""Abramowitz and Stegun, Handbook of Mathematical Functions, 7.1.28, the highest power first."""


def _exponents(builder: Any, a: Any) -> Any:
    above = builder.sub(builder.bitcast(a, WIDE), wide(_ROOT_HALF))
    return builder.ashr(above, wide(_MANTISSA_BITS))


def _mantissas(builder: Any, a: Any) -> Any:
    exponents = builder.shl(_exponents(builder, a), wide(_MANTISSA_BITS))
    return builder.bitcast(builder.sub(builder.bitcast(a, WIDE), exponents), FLOAT32.llvm)


def _power(builder: Any, a: Any) -> Any:
    biased = builder.add(builder.fptosi(a, WIDE), wide(_BIAS))
    return builder.bitcast(builder.shl(biased, wide(_MANTISSA_BITS)), FLOAT32.llvm)


exponents = emitted(FLOAT32(FLOAT32), lambda builder, a: builder.sitofp(_exponents(builder, a), FLOAT32.llvm))
"""exponents(a): exponent of the power of two nearest in ratio to each lane, as float32; lanes: at least 1.2e-38."""
mantissas = emitted(FLOAT32(FLOAT32), _mantissas)
"""mantissas(a): each lane divided by 2^exponents(a), sqrt(1/2) to sqrt(2)."""
power_of_two = emitted(FLOAT32(FLOAT32), _power)
"""power_of_two(a): 2 to the power of the lanes, whole numbers from -126 to 127."""


@numba.njit(forceinline=True)
def logarithm(a):  # type: ignore[no-untyped-def]
    """Natural logarithm of lanes of at least 1.2e-38. Error: 2e-7 where |logarithm| < 1, else 2e-7 of the logarithm."""
    part = mantissas(a)
    ratio = (part - 1.0) / (part + 1.0)
    square = ratio * ratio
    series = square * (square * (square * (2.0 / 7.0) + 2.0 / 5.0) + 2.0 / 3.0) + 2.0
    return exponents(a) * _LN_2 + series * ratio


@numba.njit(forceinline=True)
def exponential(a):  # type: ignore[no-untyped-def]
    """e to the power of the lanes, which are limited to -87..88. Relative error: 1e-5 at the ends, 3e-7 near 0."""
    steps = smaller_float(larger_float(a, _LEAST), _MOST) * _LOG2_E
    whole = steps + _TO_WHOLE - _TO_WHOLE
    rest = (steps - whole) * _LN_2
    grown = rest * (1.0 / 720.0) + 1.0 / 120.0
    for below in (24.0, 6.0, 2.0, 1.0, 1.0):
        grown = grown * rest + 1.0 / below
    return grown * power_of_two(whole)


@numba.njit(forceinline=True)
def error_function(a):  # type: ignore[no-untyped-def]
    """Error function of lanes that are not negative, with an error of at most 1e-6."""
    grown = smaller_float(a, 4.0) * _ERF[0] + _ERF[1]
    for more in _ERF[2:]:
        grown = grown * smaller_float(a, 4.0) + more
    grown = grown * smaller_float(a, 4.0) + 1.0
    for _ in range(4):
        grown = grown * grown
    one = zero_float32() + 1.0
    return one - one / grown


BIAS: Final = np.int16(127 << 7)
"""Bits of 1.0 as a bfloat16."""
MEAN_EXCESS: Final = np.float32(1.040684)
"""Mean of (1 + f) / 2^f over f in 0..1: the factor by which a result of `powers` is too large on average."""


@numba.njit(inline="always")
def lift_to_powers(best, shift):  # type: ignore[no-untyped-def]
    """Number to add to scores, saturated int16, so that each lane's best score becomes 1.0 (less if it is very low)."""
    return add_saturated(sub_saturated(zero_int16(), best), np.int16(np.int64(BIAS) >> shift))


@numba.njit(inline="always")
def powers(scores, lift, shift):  # type: ignore[no-untyped-def]
    """2^(score / units) of 16-bit lanes as float32, times a factor that depends only on `lift`.

    lift: see `lift_to_powers`; scores of -lift or less give 0. Lanes are in the order UNPACKED of `rig.simd.vectors`.
    """
    return from_bfloat16_unpacked(larger(add_saturated(scores, lift), np.int16(0)) << shift)


@numba.njit(inline="always")
def powers_in_order(scores, lift, shift):  # type: ignore[no-untyped-def]
    """2^(score / units) as `powers` computes it, but with the lanes in order."""
    return from_bfloat16(larger(add_saturated(scores, lift), np.int16(0)) << shift)
