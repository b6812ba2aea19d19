"""Sixteen lanes as one numba value: explicit vector arithmetic for the code that takes most of the time.

LLVM's own vectoriser fails on the search along a row (several short loops over one small buffer), so that search uses
vectors explicitly: `Lanes` is an LLVM vector of 16 numbers, which LLVM maps to the processor's instructions (AVX2,
AVX-512, NEON). Everything here is for code compiled with `numba.njit`. Lanes live in registers and cannot leave a
kernel. `rig.simd.memory` reads and writes them; `rig.simd.shuffles` moves numbers between lanes.

A bfloat16 is the upper half of a float32: two bytes with 8 bits of precision and the full range.
"""

import operator
from collections.abc import Callable, Iterable
from inspect import Parameter, Signature
from typing import Any, Final

from llvmlite import binding, ir
from numba import config, types
from numba.core import cgutils
from numba.core.datamodel import models
from numba.extending import intrinsic, overload, register_model

LANES: Final = 16
"""Numbers in a vector."""

_INT32 = ir.IntType(32)
intrinsic_of: Any = intrinsic
_Signature = Any
_Codegen = Callable[[Any, Any, Any, Any], Any]
VectorCode = tuple[_Signature, _Codegen]
"""Result of an intrinsic: its signature, and the function that writes its LLVM code."""


class Lanes(types.Type):
    """Numba type of a vector of `count` integers of `bits` bits or, if `real`, of `count` float32."""

    def __init__(self, bits: int, *, real: bool = False, count: int = LANES) -> None:
        self.bits = bits
        self.real = real
        self.count = count
        super().__init__(name=f"Lanes({'float' if real else 'int'}{bits} x {count})")

    @property
    def llvm(self) -> ir.VectorType:
        """The LLVM type."""
        return ir.VectorType(ir.FloatType() if self.real else ir.IntType(self.bits), self.count)


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    """Data model in which lanes are the LLVM vector itself."""

    def __init__(self, manager: Any, lanes: Lanes) -> None:
        super().__init__(manager, lanes, lanes.llvm)  # type: ignore[no-untyped-call]


BYTES = Lanes(8, count=2 * LANES)
"""32 bytes, two for each lane."""
BLOCK = Lanes(8, count=8 * LANES)
"""128 bytes, in as many registers as needed."""
INT16 = Lanes(16)
FLOAT32 = Lanes(32, real=True)
FOUR = Lanes(32, real=True, count=4)
"""Four float32."""


def _splat(context: Any, builder: Any, lanes: Lanes, number_type: Any, number: Any) -> Any:
    """A number of any type, copied to all lanes."""
    element = types.float32 if lanes.real else types.Integer.from_bitwidth(lanes.bits, signed=True)
    return everywhere(builder, context.cast(builder, number, number_type, element), lanes.count)


def everywhere(builder: Any, number: Any, count: int) -> Any:
    """A vector with `count` copies of one number."""
    nothing = ir.Constant(ir.VectorType(number.type, count), ir.Undefined)
    first = builder.insert_element(nothing, number, ir.Constant(_INT32, 0))
    return builder.shuffle_vector(first, nothing, place_list([0] * count))


def place_list(indices: Iterable[int]) -> Any:
    """The indices of the elements that a shuffle takes, as an LLVM constant."""
    places = list(indices)
    return ir.Constant(ir.VectorType(_INT32, len(places)), places)


def vector_name(vector: ir.VectorType) -> str:
    """The name of a vector type as it appears in names of LLVM's intrinsics, such as v16i16."""
    return f"v{vector.count}" + ("f32" if isinstance(vector.element, ir.FloatType) else f"i{vector.element.width}")


def called(builder: Any, name: str, result: Any, *args: Any) -> Any:
    """The result of a call to an LLVM intrinsic."""
    function_type = ir.FunctionType(result, [arg.type for arg in args])
    function = cgutils.get_or_insert_function(builder.module, function_type, name)  # type: ignore[no-untyped-call]
    return builder.call(function, args)


def emitted(signature: Any, emit: Callable[..., Any]) -> Any:
    """An intrinsic of this signature. emit(builder, *arguments) writes its LLVM code and returns the result, if any."""

    def operation(typing: Any, *types_given: Any) -> VectorCode:
        def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            result = emit(builder, *args)
            return context.get_dummy_value() if result is None else result

        return signature, code

    # numba reads the number of arguments from the signature.
    names = ("typing", *(f"a{i}" for i in range(len(signature.args))))
    parameters = [Parameter(name, Parameter.POSITIONAL_OR_KEYWORD) for name in names]
    operation.__signature__ = Signature(parameters)  # type: ignore[attr-defined]
    return intrinsic_of(operation)


def _binary(emit: Callable[[Any, Any, Any], Any]) -> Any:
    """An operation of lanes with lanes or with a number."""

    @intrinsic_of
    def operation(typing: Any, a: Any, b: Any) -> VectorCode:
        def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            left, right = args
            if not isinstance(signature.args[1], Lanes):
                right = _splat(context, builder, signature.args[0], signature.args[1], right)
            return emit(builder, left, right)

        return a(a, b), code

    return operation


def _named(name: str) -> Any:
    return _binary(lambda builder, a, b: called(builder, f"llvm.{name}.{vector_name(a.type)}", a.type, a, b))


def _is_real(value: Any) -> bool:
    return isinstance(value.type.element, ir.FloatType)


# Products and sums may be fused ("contract"). Machines with the same instructions still give the same bits.
_add = _binary(lambda b, x, y: b.fadd(x, y, flags=("contract",)) if _is_real(x) else b.add(x, y))
_sub = _binary(lambda b, x, y: b.fsub(x, y, flags=("contract",)) if _is_real(x) else b.sub(x, y))
_mul = _binary(lambda b, x, y: b.fmul(x, y, flags=("contract",)) if _is_real(x) else b.mul(x, y))

add_saturated = _named("sadd.sat")
"""add_saturated(a, b): signed sum that stops at the limits of the type instead of wrapping round."""
sub_saturated = _named("ssub.sat")
"""sub_saturated(a, b): signed difference that stops at the limits of the type."""
larger = _named("smax")
"""larger(a, b): the larger one of two signed integers in each lane."""
larger_float = _named("maxnum")
"""larger_float(a, b): the larger one of two float32 in each lane, ignoring a NaN."""
smaller = _named("smin")
"""smaller(a, b): the smaller one of two signed integers in each lane."""
smaller_float = _named("minnum")
"""smaller_float(a, b): the smaller one of two float32 in each lane, ignoring a NaN."""

add_saturated_unsigned = _named("uadd.sat")
"""add_saturated_unsigned(a, b): sum of unsigned integers that stops at the largest of the type."""
sub_saturated_unsigned = _named("usub.sat")
"""sub_saturated_unsigned(a, b): difference of unsigned integers that stops at 0."""
smaller_unsigned = _named("umin")
"""smaller_unsigned(a, b): the smaller one of two unsigned integers in each lane."""

for _operator, _operation in (
    (operator.add, _add),
    (operator.sub, _sub),
    (operator.mul, _mul),
    (operator.truediv, _binary(lambda b, x, y: b.fdiv(x, y))),
    (operator.and_, _binary(lambda b, x, y: b.and_(x, y))),
    (operator.or_, _binary(lambda b, x, y: b.or_(x, y))),
    (operator.rshift, _binary(lambda b, x, y: b.lshr(x, y))),
    (operator.lshift, _binary(lambda b, x, y: b.shl(x, y))),
):

    def _overload(operation: Any) -> Any:
        def of_lanes(a, b):  # type: ignore[no-untyped-def]
            return (lambda a, b: operation(a, b)) if isinstance(a, Lanes) else None

        return of_lanes

    overload(_operator)(_overload(_operation))


WIDE = ir.VectorType(_INT32, LANES)
"""LLVM type of 32-bit lanes."""


def wide(number: int) -> Any:
    """An integer in 32-bit lanes, as an LLVM constant."""
    return ir.Constant(WIDE, [number] * LANES)


as_bytes = emitted(BYTES(INT16), lambda builder, a: builder.bitcast(a, BYTES.llvm))
"""as_bytes(a): the two bytes of each 16-bit lane, the lower one first."""
to_int16 = emitted(INT16(FLOAT32), lambda b, a: b.trunc(b.fptosi(a, WIDE), INT16.llvm))
"""to_int16(a): float32 lanes without their fraction; they must fit."""
to_float32 = emitted(FLOAT32(INT16), lambda b, a: b.sitofp(b.sext(a, WIDE), FLOAT32.llvm))
"""to_float32(a): signed 16-bit lanes as float32."""
square_root = emitted(FLOAT32(FLOAT32), lambda b, a: called(b, f"llvm.sqrt.{vector_name(a.type)}", a.type, a))
"""square_root(a): square root of float32 lanes."""


def _has_avx2() -> bool:
    """Whether this processor has AVX2; if numba's settings name one, whether they list AVX2 among its features."""
    settings: Any = config
    if settings.CPU_NAME is None and settings.CPU_FEATURES is None:
        return bool(binding.get_host_cpu_features().get("avx2", False))
    return "+avx2" in (settings.CPU_FEATURES or "")


def _dot_pairs(builder: Any, counts: Any, weights: Any) -> Any:
    # One instruction on x86. LLVM has no portable intrinsic for it, and does not always recognise the pattern.
    if _has_avx2():
        return called(builder, "llvm.x86.avx2.pmadd.ub.sw", INT16.llvm, counts, weights)
    nothing = ir.Constant(BYTES.llvm, ir.Undefined)

    def product(place: int) -> Any:
        places = place_list(range(place, 2 * LANES, 2))
        n = builder.zext(builder.shuffle_vector(counts, nothing, places), WIDE)
        return builder.mul(n, builder.sext(builder.shuffle_vector(weights, nothing, places), WIDE))

    low, high = wide(-32768), wide(32767)
    both = builder.add(product(0), product(1))
    both = builder.select(builder.icmp_signed(">", both, low), both, low)
    both = builder.select(builder.icmp_signed("<", both, high), both, high)
    return builder.trunc(both, INT16.llvm)


dot_pairs = emitted(INT16(BYTES, BYTES), _dot_pairs)
"""dot_pairs(counts, weights): counts times weights, summed over each lane's two bytes and limited to 16 bits.

counts: unsigned bytes; weights: signed bytes.
"""


def _constant(lanes: Lanes, number: float) -> Any:
    return emitted(lanes(), lambda builder: ir.Constant(lanes.llvm, [number] * lanes.count))


zero_bytes = _constant(BYTES, 0)
zero_int16 = _constant(INT16, 0)
zero_float32 = _constant(FLOAT32, 0.0)
zero_four = _constant(FOUR, 0.0)


@intrinsic_of
def smallest_byte(typing: Any, a: Any) -> VectorCode:
    """smallest_byte(a): the smallest of the unsigned bytes."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return called(builder, f"llvm.vector.reduce.umin.{vector_name(args[0].type)}", ir.IntType(8), args[0])

    return types.uint8(a), code


def _extreme(name: str) -> Any:
    def emit(builder: Any, part: Any) -> Any:
        while part.type.count > 1:
            half = part.type.count // 2
            parts = [builder.shuffle_vector(part, part, place_list(range(i, i + half))) for i in (0, half)]
            part = called(builder, f"llvm.{name}.{vector_name(parts[0].type)}", parts[0].type, *parts)
        return builder.extract_element(part, ir.Constant(_INT32, 0))

    return emitted(types.float32(FLOAT32), emit)


largest_float, smallest_float = _extreme("maxnum"), _extreme("minnum")
"""largest_float(a), smallest_float(a): the largest or the smallest of float32 lanes, ignoring NaN."""


def _where_small(builder: Any, values: Any, sizes: Any, limit: Any) -> Any:
    size = called(builder, f"llvm.fabs.{vector_name(FLOAT32.llvm)}", FLOAT32.llvm, sizes)
    small = builder.fcmp_ordered("<=", size, everywhere(builder, limit, LANES))
    return builder.select(small, values, ir.Constant(FLOAT32.llvm, [0.0] * LANES))


where_small = emitted(FLOAT32(FLOAT32, FLOAT32, types.float32), _where_small)
"""where_small(values, sizes, limit): `values`, but 0 where |sizes| is more than `limit` or NaN; float32 lanes."""


@intrinsic_of
def where_below(typing: Any, values: Any, others: Any, sizes: Any, limits: Any) -> VectorCode:
    """where_below(values, others, sizes, limits): `values` where sizes < limits, else `others`; float32 lanes."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        limit = args[3]
        if not isinstance(signature.args[3], Lanes):
            limit = _splat(context, builder, FLOAT32, signature.args[3], limit)
        return builder.select(builder.fcmp_ordered("<", args[2], limit), args[0], args[1])

    return FLOAT32(FLOAT32, FLOAT32, FLOAT32, limits), code


def _scaled(builder: Any, a: Any, weights: Any) -> Any:
    if _has_avx2():
        return called(builder, "llvm.x86.avx2.pmul.hr.sw", INT16.llvm, a, weights)
    product = builder.mul(builder.sext(a, WIDE), builder.sext(weights, WIDE))
    return builder.trunc(builder.ashr(builder.add(product, wide(1 << 14)), wide(15)), INT16.llvm)


scaled = emitted(INT16(INT16, INT16), _scaled)
"""scaled(a, weights): a * weights / 2^15, rounded, of signed 16-bit lanes; they must not both be -32768."""

UNPACKED: Final = (0, 1, 2, 3, 8, 9, 10, 11, 4, 5, 6, 7, 12, 13, 14, 15)
"""Order of the lanes after `from_bfloat16_unpacked`, which an x86 processor produces with one instruction."""


def _unpacked(builder: Any, bits: Any) -> Any:
    # A zero before each number (at the lower address) is the lower half of the float32.
    zeros = ir.Constant(bits.type, [0] * LANES)
    pairs = [index for lane in UNPACKED for index in (LANES, lane)]
    return builder.bitcast(builder.shuffle_vector(bits, zeros, place_list(pairs)), FLOAT32.llvm)


from_bfloat16 = emitted(FLOAT32(INT16), lambda b, a: b.bitcast(b.shl(b.zext(a, WIDE), wide(16)), FLOAT32.llvm))
"""from_bfloat16(a): 16-bit patterns, the upper halves of float32 numbers, as those numbers."""
from_bfloat16_unpacked = emitted(FLOAT32(INT16), _unpacked)
"""from_bfloat16_unpacked(a): those numbers in the order UNPACKED."""
to_bfloat16 = emitted(INT16(FLOAT32), lambda b, a: b.trunc(b.lshr(b.bitcast(a, WIDE), wide(16)), INT16.llvm))
"""to_bfloat16(a): upper halves of float32 lanes as 16-bit patterns."""
