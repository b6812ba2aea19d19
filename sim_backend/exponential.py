"""Exponentials for kernels, straight-line, so that loops over them become vector instructions; libm's are calls.

With k = round(t) and f = k - t, |f| <= 1/2:  2^-t = 2^-k 2^f, the latter by its Taylor series. Relative error against
50 digits: `power_of_half` 3e-13 (series to f^10) and what rounding t brings, `one_minus_exp_minus` 4e-16 (to r^13, with
r = f ln 2 in two parts). `roughly_one_minus_exp_minus` is for where six digits will do, in float32.

What loops need of numbers comes as a tuple that the kernel's caller hands it (`HALVING`, `ROUGHLY`): of numbers that it
knows, LLVM fetches each anew for every vector, 24 of 59 instructions of a loop over `power_of_half`."""

import math
from collections.abc import Callable
from typing import Any, Final

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

LARGEST: Final = 700.0
"""Above it 1 - exp(-t) is taken as 1."""
LOG2_E: Final = 1.4426950408889634
_LN2_HIGH, _LN2_LOW = 6.93147180369123816490e-01, 1.90821492927058770002e-10
"""ln 2 in two parts, the high one with 20 zeros at its end: its product with k is exact (Cody and Waite)."""
_ROUNDER, _ROUNDER_32 = 1.5 * 2.0**52, 1.5 * 2.0**23
"""Added to a float64 or float32 it leaves the nearest integer in the last bits."""
_C13, _C12, _C11, _C10, _C9, _C8 = 1 / 6227020800, 1 / 479001600, 1 / 39916800, 1 / 3628800, 1 / 362880, 1 / 40320
_C7, _C6, _C5, _C4, _C3 = 1 / 5040, 1 / 720, 1 / 120, 1 / 24, 1 / 6

_SERIES = tuple(math.log(2) ** n / math.factorial(n) for n in range(11))
HALVING: Final[dict[Any, tuple[Any, ...]]] = {
    np.float64: (1010.0, _ROUNDER, *_SERIES),
    np.float32: tuple(map(np.float32, (120.0, _ROUNDER_32, *_SERIES))),
}
"""Of `power_of_half`, by precision: the most halvings, above which it stays what it is there; rounder; series."""
_SERIES_32 = (1 / math.factorial(n) for n in (0, 2, 3, 4, 5, 6))
ROUGHLY: Final = tuple(map(np.float32, (80.0, LOG2_E, _ROUNDER_32, math.log(2), *_SERIES_32)))
"""Of `roughly_one_minus_exp_minus`: largest t, scale, rounder, ln 2, series without its linear term; float32."""

_intrinsic: Any = intrinsic
_Code = tuple[Any, Callable[[Any, Any, Any, Any], Any]]


@_intrinsic
def _power_of_half(typing: Any, rounded: Any) -> _Code:
    """2^-k from k + _ROUNDER, float64, or k + _ROUNDER_32, float32."""
    bits, bias, mantissa = (64, 1023, 52) if rounded == types.float64 else (32, 127, 23)

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        word = ir.IntType(bits)
        exponent = builder.sub(ir.Constant(word, bias), builder.bitcast(args[0], word))
        return builder.bitcast(builder.shl(exponent, ir.Constant(word, mantissa)), args[0].type)

    return rounded(rounded), code


@numba.njit(inline="always", error_model="numpy")
def power_of_half(t, halving):  # type: ignore[no-untyped-def]
    """2^-t of a t >= 0; halving: `HALVING` of its precision."""
    most, rounder, e0, e1, e2, e3, e4, e5, e6, e7, e8, e9, e10 = halving
    t = min(t, most)
    rounded = t + rounder
    f = (rounded - rounder) - t
    f2 = f * f
    f4 = f2 * f2  # in pairs of pairs: a chain half as long as Horner's
    low, middle = e0 + f * e1 + f2 * (e2 + f * e3), e4 + f * e5 + f2 * (e6 + f * e7)
    return _power_of_half(rounded) * (low + f4 * (middle + f4 * (e8 + f * e9 + f2 * e10)))


@numba.njit(inline="always", error_model="numpy")
def one_minus_exp_minus(t):  # type: ignore[no-untyped-def]
    """1 - exp(-t) of a t >= 0, to the same relative error however small t is."""
    t = min(t, LARGEST)
    rounded = t * LOG2_E + _ROUNDER
    k = rounded - _ROUNDER
    r = (k * _LN2_HIGH - t) + k * _LN2_LOW
    r2 = r * r
    high = _C9 + r * _C10 + r2 * (_C11 + r * _C12 + r2 * _C13)
    middle = _C5 + r * _C6 + r2 * (_C7 + r * _C8 + r2 * high)
    q = r + r2 * (0.5 + r * (_C3 + r * (_C4 + r * middle)))
    scale = _power_of_half(rounded)
    return (1.0 - scale) - scale * q


@numba.njit(inline="always", error_model="numpy")
def roughly_one_minus_exp_minus(t, roughly):  # type: ignore[no-untyped-def]
    """1 - exp(-t) of a float32 t >= 0 as float32, within 3e-7; roughly: `ROUGHLY`."""
    largest, log2_e, rounder, ln2, one, d2, d3, d4, d5, d6 = roughly
    t = min(t, largest)
    rounded = t * log2_e + rounder
    r = (rounded - rounder) * ln2 - t
    q = r + r * r * (d2 + r * (d3 + r * (d4 + r * (d5 + r * d6))))
    scale = _power_of_half(rounded)
    return (one - scale) - scale * q
