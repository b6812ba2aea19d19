"""Sixteen lanes as one numba value: the vector arithmetic of the hot path, spelled out instead of hoped for.

LLVM's own vectoriser gives up on the search along a row (several short loops over one small buffer), so its kernels say
what they mean: `Lanes` is an LLVM vector of 16 numbers, legalised to whatever the processor has (AVX2, AVX-512, NEON).
Everything here is for code compiled with `numba.njit`; lanes live in registers and cannot leave a kernel.

Memory is named by its address (`address_of`), not as an array: numba counts references to every array that a compiled
function is handed, and on the way through the functions of one image row that took 0.95 us, twenty times the work
itself. Whoever takes an address keeps the array alive and the index inside it; nothing here checks.
"""

import operator
from collections.abc import Callable
from typing import Any, Final

import numba
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.datamodel import models
from numba.extending import intrinsic, overload, register_model

LANES: Final = 16

_INT32 = ir.IntType(32)
_compiled: Any = intrinsic
_Signature = Any
_Codegen = Callable[[Any, Any, Any, Any], Any]


class Lanes(types.Type):
    """Numba type of 16 integers of `bits` bits, or of 16 float32."""

    def __init__(self, bits: int, *, real: bool = False) -> None:
        self.bits = bits
        self.real = real
        super().__init__(name=f"Lanes({'float' if real else 'int'}{bits})")

    @property
    def llvm(self) -> ir.VectorType:
        """The LLVM type."""
        return ir.VectorType(ir.FloatType() if self.real else ir.IntType(self.bits), LANES)


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    """Lanes are passed about as the LLVM vector itself."""

    def __init__(self, manager: Any, lanes: Lanes) -> None:
        super().__init__(manager, lanes, lanes.llvm)  # type: ignore[no-untyped-call]


INT8 = Lanes(8)
INT16 = Lanes(16)
FLOAT32 = Lanes(32, real=True)


def _pointer(builder: Any, address: Any, index: Any, element: Any, whole: Any) -> Any:
    """Pointer to `whole`, which begins at element `index` of what lies at `address`."""
    return builder.bitcast(builder.gep(builder.inttoptr(address, element.as_pointer()), [index]), whole.as_pointer())


def _reader(numba_type: Any, element: Any, whole: Any, align: int) -> Any:
    @_compiled
    def read(typing: Any, address: Any, index: Any) -> tuple[_Signature, _Codegen]:
        def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            loaded = builder.load(_pointer(builder, args[0], args[1], element, whole))
            loaded.align = align
            return loaded

        return numba_type(types.intp, types.intp), code

    return read


def _writer(numba_type: Any, element: Any, whole: Any, align: int) -> Any:
    @_compiled
    def write(typing: Any, address: Any, index: Any, value: Any) -> tuple[_Signature, _Codegen]:
        def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            stored = builder.store(args[2], _pointer(builder, args[0], args[1], element, whole))
            stored.align = align
            return context.get_dummy_value()

        return types.void(types.intp, types.intp, numba_type), code

    return write


_I8, _I16, _F32 = ir.IntType(8), ir.IntType(16), ir.FloatType()
load_int8 = _reader(INT8, _I8, INT8.llvm, 1)
"""load_int8(address, index): 16 bytes from `index` on."""
load_int16 = _reader(INT16, _I16, INT16.llvm, 2)
"""load_int16(address, index): 16 of the int16 at `address`, from number `index` on."""
load_float32 = _reader(FLOAT32, _F32, FLOAT32.llvm, 4)
"""load_float32(address, index): the same of float32."""
store_int16 = _writer(INT16, _I16, INT16.llvm, 2)
"""store_int16(address, index, lanes): write 16 int16."""
store_float32 = _writer(FLOAT32, _F32, FLOAT32.llvm, 4)
"""store_float32(address, index, lanes): write 16 float32."""
read_int16 = _reader(types.int16, _I16, _I16, 2)
read_int32 = _reader(types.int32, _INT32, _INT32, 4)
read_float32 = _reader(types.float32, _F32, _F32, 4)
"""read_...(address, index): one number."""
write_int16 = _writer(types.int16, _I16, _I16, 2)
write_int32 = _writer(types.int32, _INT32, _INT32, 4)
write_float32 = _writer(types.float32, _F32, _F32, 4)
"""write_...(address, index, number): one number."""


@numba.njit(inline="always")
def address_of(array):  # type: ignore[no-untyped-def]
    """Address of an array's first element."""
    return array.ctypes.data


def _splat(context: Any, builder: Any, lanes: Lanes, number_type: Any, number: Any) -> Any:
    element = types.float32 if lanes.real else types.Integer.from_bitwidth(lanes.bits, signed=True)
    cast = context.cast(builder, number, number_type, element)
    nothing = ir.Constant(lanes.llvm, ir.Undefined)
    first = builder.insert_element(nothing, cast, ir.Constant(_INT32, 0))
    return builder.shuffle_vector(first, nothing, ir.Constant(ir.VectorType(_INT32, LANES), [0] * LANES))


def _llvm_name(vector: ir.VectorType) -> str:
    return f"v{LANES}" + ("f32" if isinstance(vector.element, ir.FloatType) else f"i{vector.element.width}")


def _call(builder: Any, name: str, result: Any, *args: Any) -> Any:
    function_type = ir.FunctionType(result, [arg.type for arg in args])
    function = cgutils.get_or_insert_function(builder.module, function_type, name)  # type: ignore[no-untyped-call]
    return builder.call(function, args)


def _binary(emit: Callable[[Any, Any, Any], Any]) -> Any:
    """An operation of lanes with lanes or with a number."""

    @_compiled
    def operation(typing: Any, a: Any, b: Any) -> tuple[_Signature, _Codegen]:
        def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            left, right = args
            if not isinstance(signature.args[1], Lanes):
                right = _splat(context, builder, signature.args[0], signature.args[1], right)
            return emit(builder, left, right)

        return a(a, b), code

    return operation


def _named(name: str) -> Any:
    return _binary(lambda builder, a, b: _call(builder, f"llvm.{name}.{_llvm_name(a.type)}", a.type, a, b))


def _is_real(value: Any) -> bool:
    return isinstance(value.type.element, ir.FloatType)


# Sums of a fixed number of products may be fused: every machine with the same instructions gives the same bits.
_add = _binary(lambda b, x, y: b.fadd(x, y, flags=("contract",)) if _is_real(x) else b.add(x, y))
_sub = _binary(lambda b, x, y: b.fsub(x, y, flags=("contract",)) if _is_real(x) else b.sub(x, y))
_mul = _binary(lambda b, x, y: b.fmul(x, y, flags=("contract",)) if _is_real(x) else b.mul(x, y))

add_saturated = _named("sadd.sat")
"""add_saturated(a, b): signed sum that stops at the limits of the type instead of wrapping round."""
sub_saturated = _named("ssub.sat")
"""sub_saturated(a, b): signed difference that stops at the limits of the type."""
larger = _named("smax")
"""larger(a, b): the larger one of two integers in each lane."""
larger_float = _named("maxnum")
"""larger_float(a, b): the larger one of two float32 in each lane."""
smaller = _named("smin")
"""smaller(a, b): the smaller one of two integers in each lane."""

for _operator, _operation in (
    (operator.add, _add),
    (operator.sub, _sub),
    (operator.mul, _mul),
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


def _conversion(to: Lanes, emit: Callable[[Any, Any], Any]) -> Any:
    @_compiled
    def convert(typing: Any, a: Any) -> tuple[_Signature, _Codegen]:
        def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            return emit(builder, args[0])

        return to(a), code

    return convert


UNPACKED: Final = (0, 1, 2, 3, 8, 9, 10, 11, 4, 5, 6, 7, 12, 13, 14, 15)
"""Which lane stands where after `from_bfloat16`: the order that costs an x86 processor one instruction."""


def _as_float(builder: Any, bits: Any) -> Any:
    # A zero in front of each number (at the lower address) is the lower half of a float32.
    zeros = ir.Constant(bits.type, [0] * LANES)
    pairs = [index for lane in UNPACKED for index in (LANES, lane)]
    wide = builder.shuffle_vector(bits, zeros, ir.Constant(ir.VectorType(_INT32, 2 * LANES), pairs))
    return builder.bitcast(wide, FLOAT32.llvm)


widen = _conversion(INT16, lambda builder, a: builder.zext(a, INT16.llvm))
"""widen(a): unsigned 8-bit lanes as 16-bit ones."""
from_bfloat16 = _conversion(FLOAT32, _as_float)
"""from_bfloat16(a): 16-bit patterns, the upper halves of float32 numbers, as those numbers, in the order UNPACKED."""
to_int16 = _conversion(INT16, lambda b, a: b.trunc(b.fptosi(a, ir.VectorType(_INT32, LANES)), INT16.llvm))
"""to_int16(a): float32 lanes, which must fit, without their fraction."""


def _shifted(by: int) -> Any:
    """Lane i takes what lane i - by had, and 0 where there is none."""

    @_compiled
    def shift(typing: Any, a: Any) -> tuple[_Signature, _Codegen]:
        def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            zeros = ir.Constant(signature.args[0].llvm, [0] * LANES)
            source = [i - by if 0 <= i - by < LANES else LANES for i in range(LANES)]
            return builder.shuffle_vector(args[0], zeros, ir.Constant(ir.VectorType(_INT32, LANES), source))

        return a(a), code

    return shift


up_1, up_2, up_4, up_8 = _shifted(1), _shifted(2), _shifted(4), _shifted(8)


@numba.njit(inline="always")
def running_sum(a):  # type: ignore[no-untyped-def]
    """Saturated sum of each lane and all lanes below it."""
    a = add_saturated(a, up_1(a))
    a = add_saturated(a, up_2(a))
    a = add_saturated(a, up_4(a))
    return add_saturated(a, up_8(a))


def _reduction(name: str, result: Any) -> Any:
    @_compiled
    def reduce(typing: Any, a: Any) -> tuple[_Signature, _Codegen]:
        def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            vector = args[0].type
            return _call(builder, f"llvm.vector.reduce.{name}.{_llvm_name(vector)}", vector.element, args[0])

        return result(a), code

    return reduce


largest = _reduction("smax", types.int16)
"""largest(a): the largest of 16 integers of 16 bits."""


@_compiled
def total(typing: Any, a: Any) -> tuple[_Signature, _Codegen]:
    """total(a): sum of 16 float32 lanes, by halves: the order is fixed."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        value = args[0]
        half = LANES // 2
        while half:
            index = ir.VectorType(_INT32, half)
            low = builder.shuffle_vector(value, value, ir.Constant(index, list(range(half))))
            high = builder.shuffle_vector(value, value, ir.Constant(index, list(range(half, 2 * half))))
            value = builder.fadd(low, high)
            half //= 2
        return builder.extract_element(value, ir.Constant(_INT32, 0))

    return types.float32(a), code


@_compiled
def last_lane(typing: Any, a: Any) -> tuple[_Signature, _Codegen]:
    """last_lane(a): the highest lane of 16-bit lanes."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.extract_element(args[0], ir.Constant(_INT32, LANES - 1))

    return types.int16(a), code


@_compiled
def equal_mask(typing: Any, a: Any, b: Any) -> tuple[_Signature, _Codegen]:
    """equal_mask(a, number): bit i is set where lane i equals the number."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        number = _splat(context, builder, signature.args[0], signature.args[1], args[1])
        mask = builder.bitcast(builder.icmp_signed("==", args[0], number), ir.IntType(LANES))
        return builder.zext(mask, _INT32)

    return types.uint32(a, b), code


@_compiled
def lowest_bit(typing: Any, mask: Any) -> tuple[_Signature, _Codegen]:
    """lowest_bit(mask): number of the lowest bit that is set; 32 where none is."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 0))

    return types.uint32(types.uint32), code


@_compiled
def lanes_between(typing: Any, first: Any, end: Any) -> tuple[_Signature, _Codegen]:
    """lanes_between(first, end): all bits of lanes first to end - 1 set, the others' clear; 16-bit lanes."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        number = ir.Constant(INT16.llvm, list(range(LANES)))
        low = _splat(context, builder, INT16, types.int64, args[0])
        high = _splat(context, builder, INT16, types.int64, args[1])
        inside = builder.and_(builder.icmp_signed(">=", number, low), builder.icmp_signed("<", number, high))
        return builder.sext(inside, INT16.llvm)

    return INT16(types.int64, types.int64), code


def _constant(lanes: Lanes, number: float) -> Any:
    @_compiled
    def constant(typing: Any) -> tuple[_Signature, _Codegen]:
        def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            return ir.Constant(lanes.llvm, [number] * LANES)

        return lanes(), code

    return constant


zero_int16 = _constant(INT16, 0)
zero_float32 = _constant(FLOAT32, 0.0)
