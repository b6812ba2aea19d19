"""Operations across lanes: shuffles, sums along the lanes, masks with a bit for each lane, turned blocks of numbers.

Reductions (`largest_of_rows`, `totals_of_rows`) take LANES rows at once and give one number a row, which then is one
lane of the answer. Row by row every step of a reduction would wait for the one before, and take as many instructions
for one row as here for all.

`fetch_eights` and `spread_eights` take eight numbers from each of LANES places and turn them, so that lane i of eight
vectors holds those of place i: the pixels around stripes are fetched in this way, with two instructions a stripe
instead of two a number.
"""

from collections.abc import Callable, Sequence
from typing import Any, Final

import numba
from llvmlite import ir
from numba import types

from rig.simd.vectors import (
    BLOCK,
    BYTES,
    FLOAT32,
    INT16,
    LANES,
    VectorCode,
    add_saturated,
    called,
    intrinsic_of,
    place_list,
    splat,
    vector_name,
)

_HALF: Final = LANES // 2
_I16, _I32 = ir.IntType(16), ir.IntType(32)


def _interleaved(first: int) -> Any:
    source = [place for i in range(first, first + LANES) for place in (i, 2 * LANES + i)]

    @intrinsic_of
    def interleave(typing: Any, a: Any, b: Any) -> VectorCode:
        def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            return builder.shuffle_vector(args[0], args[1], place_list(source))

        return BYTES(a, b), code

    return interleave


first_row_pairs, second_row_pairs = _interleaved(0), _interleaved(LANES)
"""first_row_pairs(a, b): bytes of a and b by turns, of the first row of each of the two; the second row's."""


def _shuffled(source: Sequence[int]) -> Any:
    """Lane i takes what lane source[i] had, 0 where that is LANES."""

    @intrinsic_of
    def shuffle(typing: Any, a: Any) -> VectorCode:
        def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            zeros = ir.Constant(signature.args[0].llvm, [0] * LANES)
            return builder.shuffle_vector(args[0], zeros, place_list(source))

        return a(a), code

    return shuffle


def _up_in_halves(by: int) -> Any:
    return _shuffled([i - by if i % _HALF >= by else LANES for i in range(LANES)])


up_1 = _shuffled([LANES, *range(LANES - 1)])
"""up_1(a): lane i takes what lane i - 1 had, the first one 0."""
_up_1_in_halves, _up_2_in_halves, _up_4_in_halves = _up_in_halves(1), _up_in_halves(2), _up_in_halves(4)
_lower_end = _shuffled([LANES] * _HALF + [_HALF - 1] * _HALF)


@numba.njit(inline="always")
def running_sum(a):  # type: ignore[no-untyped-def]
    """Saturated sum of each lane and all lanes below it."""
    # Within halves first: on x86 what crosses them takes three times as long.
    a = add_saturated(a, _up_1_in_halves(a))
    a = add_saturated(a, _up_2_in_halves(a))
    a = add_saturated(a, _up_4_in_halves(a))
    return add_saturated(a, _lower_end(a))


@intrinsic_of
def last_lane(typing: Any, a: Any) -> VectorCode:
    """last_lane(a): the highest lane of 16-bit lanes."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.extract_element(args[0], ir.Constant(_I32, LANES - 1))

    return types.int16(a), code


@intrinsic_of
def equal_mask(typing: Any, a: Any, b: Any) -> VectorCode:
    """equal_mask(a, number): bit i is set where lane i equals the number."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        number = splat(context, builder, signature.args[0], signature.args[1], args[1])
        mask = builder.bitcast(builder.icmp_signed("==", args[0], number), ir.IntType(LANES))
        return builder.zext(mask, _I32)

    return types.uint32(a, b), code


@intrinsic_of
def equal_bits(typing: Any, address: Any, index: Any, step: Any, number: Any) -> VectorCode:
    """equal_bits(address, index, step, number): bit i is set where int16 number index + i step is it, i from 0 to 7."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        at, first, by, wanted = args
        few = ir.VectorType(_I16, _HALF)
        found, pointer = ir.Constant(few, ir.Undefined), builder.inttoptr(at, _I16.as_pointer())
        for i in range(_HALF):
            here = builder.add(first, builder.mul(by, ir.Constant(by.type, i)))
            loaded = builder.load(builder.gep(pointer, [here]))
            loaded.align = 2
            found = builder.insert_element(found, loaded, ir.Constant(_I32, i))
        first_only = builder.insert_element(ir.Constant(few, ir.Undefined), wanted, ir.Constant(_I32, 0))
        all_wanted = builder.shuffle_vector(first_only, first_only, place_list([0] * (_HALF)))
        same = builder.icmp_signed("==", found, all_wanted)
        return builder.zext(builder.bitcast(same, ir.IntType(_HALF)), _I32)

    return types.uint32(types.intp, types.intp, types.intp, types.int16), code


@intrinsic_of
def lowest_bit(typing: Any, mask: Any) -> VectorCode:
    """lowest_bit(mask): number of the lowest bit that is set; 32 where none is."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 0))

    return types.uint32(types.uint32), code


@intrinsic_of
def lanes_between(typing: Any, first: Any, end: Any) -> VectorCode:
    """lanes_between(first, end): all bits of lanes first to end - 1 set, the others' clear; 16-bit lanes."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        number = ir.Constant(INT16.llvm, list(range(LANES)))
        low = splat(context, builder, INT16, types.int64, args[0])
        high = splat(context, builder, INT16, types.int64, args[1])
        inside = builder.and_(builder.icmp_signed(">=", number, low), builder.icmp_signed("<", number, high))
        return builder.sext(inside, INT16.llvm)

    return INT16(types.int64, types.int64), code


@intrinsic_of
def equal_bytes(typing: Any, a: Any, b: Any) -> VectorCode:
    """equal_bytes(a, number): bit i is set where byte i equals the number."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        number = splat(context, builder, BYTES, signature.args[1], args[1])
        return builder.bitcast(builder.icmp_signed("==", args[0], number), ir.IntType(BYTES.count))

    return types.uint32(BYTES, b), code


@intrinsic_of
def first_equal(typing: Any, a: Any, b: Any) -> VectorCode:
    """first_equal(a, number): place of the first byte of a block that equals the number; 128 where none does."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        number = splat(context, builder, BLOCK, signature.args[1], args[1])
        mask = builder.bitcast(builder.icmp_signed("==", args[0], number), ir.IntType(BLOCK.count))
        return builder.trunc(builder.cttz(mask, ir.Constant(ir.IntType(1), 0)), ir.IntType(64))

    return types.int64(BLOCK, b), code


reversed_lanes = _shuffled(range(LANES - 1, -1, -1))
"""reversed_lanes(a): the last lane first."""
last_everywhere = _shuffled([LANES - 1] * LANES)
"""last_everywhere(a): the highest lane in all of them."""


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
