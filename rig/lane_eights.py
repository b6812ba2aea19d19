"""Eight numbers from each of sixteen places, turned so that lane i of eight vectors holds those of place i.

What lies around stripes is fetched in this way: row by row, as it lies in memory, with two instructions a stripe,
instead of with two a number.
"""

from typing import Any, Final

from llvmlite import ir
from numba import types

from rig.lanes import FLOAT32, LANES, VectorCode, intrinsic_of, place_list

EIGHT: Final = 8
_EIGHT_FLOATS = ir.VectorType(ir.FloatType(), EIGHT)
_I64 = ir.IntType(64)
_WIDE = ir.VectorType(ir.IntType(32), LANES)


def _turned(builder: Any, rows: list[Any]) -> list[Any]:
    """Columns of eight rows of eight, in steps that stay within halves but for the last: those are the quick ones."""

    def mixed(a: Any, b: Any, places: list[int]) -> Any:
        return builder.shuffle_vector(a, b, place_list([*places, *(i + EIGHT // 2 for i in places)]))

    low, high = [0, 8, 1, 9], [2, 10, 3, 11]
    pairs = [mixed(rows[i], rows[i + 1], places) for i in range(0, EIGHT, 2) for places in (low, high)]
    fours = []
    for i in (0, 4):
        for a, b in ((pairs[i], pairs[i + 2]), (pairs[i + 1], pairs[i + 3])):
            fours += [mixed(a, b, [0, 1, 8, 9]), mixed(a, b, [2, 3, 10, 11])]
    halves = [0, 1, 2, 3, 8, 9, 10, 11], [4, 5, 6, 7, 12, 13, 14, 15]
    return [builder.shuffle_vector(fours[k], fours[k + 4], place_list(half)) for half in halves for k in range(4)]


def _store(builder: Any, vector: Any, to: Any, number: int) -> None:
    pointer = builder.inttoptr(to, vector.type.as_pointer())
    stored = builder.store(vector, builder.gep(pointer, [ir.Constant(_I64, number)]))
    stored.align = 4


@intrinsic_of
def fetch_eights(typing: Any, places: Any, behind: Any, to: Any) -> VectorCode:
    """fetch_eights(places, behind, to): write eight vectors; places: address of sixteen addresses.

    Eight float32 each, `behind` bytes from there on.
    """

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        addresses = builder.inttoptr(args[0], _I64.as_pointer())
        for half in range(LANES // EIGHT):
            rows = []
            for i in range(EIGHT):
                at = builder.load(builder.gep(addresses, [ir.Constant(_I64, half * EIGHT + i)]))
                row = builder.load(builder.inttoptr(builder.add(at, args[1]), _EIGHT_FLOATS.as_pointer()))
                row.align = 4
                rows.append(row)
            for d, column in enumerate(_turned(builder, rows)):
                _store(builder, column, args[2], 2 * d + half)
        return context.get_dummy_value()

    return types.void(types.intp, types.intp, types.intp), code


@intrinsic_of
def spread_eights(typing: Any, source: Any, to: Any) -> VectorCode:
    """spread_eights(source, to): write eight vectors from sixteen times eight unsigned bytes, one after another."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        both = ir.VectorType(ir.IntType(32), 2 * LANES)
        loaded = builder.load(builder.inttoptr(args[0], both.as_pointer()))
        loaded.align = 1
        nothing = ir.Constant(both, ir.Undefined)
        for half in range(2):
            fours = builder.shuffle_vector(loaded, nothing, place_list(range(half, 2 * LANES, 2)))
            for d in range(4):
                moved = builder.lshr(fours, ir.Constant(_WIDE, [8 * d] * LANES))
                byte = builder.and_(moved, ir.Constant(_WIDE, [255] * LANES))
                _store(builder, builder.sitofp(byte, FLOAT32.llvm), args[1], 4 * half + d)
        return context.get_dummy_value()

    return types.void(types.intp, types.intp), code
