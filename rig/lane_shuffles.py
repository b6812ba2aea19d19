"""What goes from lane to lane: shuffles, sums along the lanes, and masks with a bit for each lane."""

from collections.abc import Sequence
from typing import Any, Final

import numba
from llvmlite import ir
from numba import types

from rig.lanes import BLOCK, BYTES, INT16, LANES, VectorCode, add_saturated, intrinsic_of, place_list, splat

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
