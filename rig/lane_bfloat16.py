"""Lanes of bfloat16, the upper halves of float32 numbers: two bytes with 8 bits of precision and all of the range."""

from typing import Any, Final

from llvmlite import ir

from rig.lanes import FLOAT32, INT16, LANES, conversion, place_list

_WIDE = ir.VectorType(ir.IntType(32), LANES)

UNPACKED: Final = (0, 1, 2, 3, 8, 9, 10, 11, 4, 5, 6, 7, 12, 13, 14, 15)
"""Which lane stands where after `from_bfloat16_unpacked`: the order that costs an x86 processor one instruction."""


def _unpacked(builder: Any, bits: Any) -> Any:
    # A zero in front of each number (at the lower address) is the lower half of a float32.
    zeros = ir.Constant(bits.type, [0] * LANES)
    pairs = [index for lane in UNPACKED for index in (LANES, lane)]
    wide = builder.shuffle_vector(bits, zeros, place_list(pairs))
    return builder.bitcast(wide, FLOAT32.llvm)


def _as_float(builder: Any, bits: Any) -> Any:
    wide = builder.shl(builder.zext(bits, _WIDE), ir.Constant(_WIDE, [16] * LANES))
    return builder.bitcast(wide, FLOAT32.llvm)


def _upper_half(builder: Any, a: Any) -> Any:
    return builder.trunc(builder.lshr(builder.bitcast(a, _WIDE), ir.Constant(_WIDE, [16] * LANES)), INT16.llvm)


from_bfloat16 = conversion(FLOAT32, _as_float)
"""from_bfloat16(a): 16-bit patterns, the upper halves of float32 numbers, as those numbers."""
from_bfloat16_unpacked = conversion(FLOAT32, _unpacked)
"""from_bfloat16_unpacked(a): the same in the order UNPACKED."""
to_bfloat16 = conversion(INT16, _upper_half)
"""to_bfloat16(a): upper halves of float32 lanes as 16-bit patterns."""
