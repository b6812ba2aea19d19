"""Reductions over the lanes of sixteen rows at once: one number a row, which then is one lane of the answer.

Taken row by row, every step of a reduction waits for the one before; and it takes as many instructions for one row as
here for sixteen.
"""

from collections.abc import Callable, Sequence
from typing import Any, Final

from llvmlite import ir
from numba import types

from rig.lanes import FLOAT32, INT16, LANES, VectorCode, called, intrinsic_of, place_list, vector_name

FOLDED: Final = LANES // 2
"""Numbers that `store_folded` leaves of a row."""


def _unpacked(builder: Any, a: Any, b: Any, combine: Callable[[Any, Any], Any]) -> Any:
    """Numbers of a and b by turns, the lower half of each 128 bits combined with the upper one."""
    count, block = a.type.count, 128 // (16 if isinstance(a.type.element, ir.IntType) else 32)
    parts = []
    for first in (0, block // 2):
        places = [at for begin in range(0, count, block) for i in range(block // 2)
                  for at in (begin + first + i, count + begin + first + i)]  # fmt: skip
        parts.append(builder.shuffle_vector(a, b, place_list(places)))
    return combine(*parts)


def _reduced(builder: Any, rows: Sequence[Any], combine: Callable[[Any, Any], Any]) -> Any:
    """One number a row out of as many rows as 256 bits hold numbers, in order."""
    count = rows[0].type.count
    block = count // 2
    halves = []
    for begin in (0, block):
        # Rows in an order that unpacking turns into the usual one.
        order = [int(f"{i:0{block.bit_length() - 1}b}"[::-1], 2) for i in range(block)]
        level = [rows[begin + i] for i in order]
        while len(level) > 1:
            level = [_unpacked(builder, a, b, combine) for a, b in zip(level[::2], level[1::2], strict=True)]
        halves.append(level[0])
    low = [*range(block), *range(count, count + block)]
    high = [at + block for at in low]
    return combine(*(builder.shuffle_vector(*halves, place_list(places)) for places in (low, high)))


def _loaded(builder: Any, address: Any, vector: Any, rows: int, align: int) -> list[Any]:
    pointer = builder.inttoptr(address, vector.as_pointer())
    loaded = [builder.load(builder.gep(pointer, [ir.Constant(ir.IntType(64), r)])) for r in range(rows)]
    for load in loaded:
        load.align = align
    return loaded


@intrinsic_of
def largest_of_rows(typing: Any, address: Any) -> VectorCode:
    """largest_of_rows(address): the largest one of each of 16 rows of 16 integers of 16 bits, one row after another."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        rows = _loaded(builder, args[0], INT16.llvm, LANES, 2)
        name = f"llvm.smax.{vector_name(INT16.llvm)}"
        return _reduced(builder, rows, lambda a, b: called(builder, name, INT16.llvm, a, b))

    return INT16(types.intp), code


@intrinsic_of
def store_folded(typing: Any, address: Any, row: Any, a: Any) -> VectorCode:
    """store_folded(address, row, a): sums of the lower and the upper half of 16 float32, as row `row` of FOLDED."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        low = builder.shuffle_vector(args[2], args[2], place_list(range(FOLDED)))
        high = builder.shuffle_vector(args[2], args[2], place_list(range(FOLDED, LANES)))
        pointer = builder.inttoptr(args[0], ir.VectorType(ir.FloatType(), FOLDED).as_pointer())
        stored = builder.store(builder.fadd(low, high), builder.gep(pointer, [args[1]]))
        stored.align = 4
        return context.get_dummy_value()

    return types.void(types.intp, types.intp, FLOAT32), code


@intrinsic_of
def totals_of_rows(typing: Any, address: Any) -> VectorCode:
    """totals_of_rows(address): sum of each of 16 rows of FOLDED float32, one row after another."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        rows = _loaded(builder, args[0], ir.VectorType(ir.FloatType(), FOLDED), LANES, 4)
        halves = [_reduced(builder, rows[i : i + FOLDED], builder.fadd) for i in (0, FOLDED)]
        return builder.shuffle_vector(*halves, place_list(range(LANES)))

    return FLOAT32(types.intp), code
