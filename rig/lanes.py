"""Sixteen lanes as one numba value: the vector arithmetic of the hot path, spelled out instead of hoped for.

LLVM's own vectoriser gives up on the search along a row (several short loops over one small buffer), so its kernels say
what they mean: `Lanes` is an LLVM vector of 16 numbers, legalised to whatever the processor has (AVX2, AVX-512, NEON).
Everything here is for code compiled with `numba.njit`; lanes live in registers and cannot leave a kernel.

Memory is named by its address (`address_of`), not as an array: numba counts references to every array that a compiled
function is handed, and on the way through the functions of one image row that took 0.95 us, twenty times the work
itself. Whoever takes an address keeps the array alive and the index inside it; nothing here checks.
"""

import operator
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Final

import numba
from llvmlite import binding, ir
from numba import config, types
from numba.core import cgutils
from numba.core.datamodel import models
from numba.extending import intrinsic, overload, register_model

LANES: Final = 16

_INT32 = ir.IntType(32)
intrinsic_of: Any = intrinsic
_Signature = Any
_Codegen = Callable[[Any, Any, Any, Any], Any]
VectorCode = tuple[_Signature, _Codegen]
"""What an intrinsic gives: its signature and what writes its LLVM code."""


class Lanes(types.Type):
    """Numba type of `count` integers of `bits` bits, or of as many float32."""

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
    """Lanes are passed about as the LLVM vector itself."""

    def __init__(self, manager: Any, lanes: Lanes) -> None:
        super().__init__(manager, lanes, lanes.llvm)  # type: ignore[no-untyped-call]


BYTES = Lanes(8, count=2 * LANES)
"""Two bytes a lane."""
INT16 = Lanes(16)
FLOAT32 = Lanes(32, real=True)


def _pointer(builder: Any, address: Any, index: Any, element: Any, whole: Any) -> Any:
    """Pointer to `whole`, which begins at element `index` of what lies at `address`."""
    return builder.bitcast(builder.gep(builder.inttoptr(address, element.as_pointer()), [index]), whole.as_pointer())


def _reader(numba_type: Any, element: Any, whole: Any, align: int) -> Any:
    @intrinsic_of
    def read(typing: Any, address: Any, index: Any) -> VectorCode:
        def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            loaded = builder.load(_pointer(builder, args[0], args[1], element, whole))
            loaded.align = align
            return loaded

        return numba_type(types.intp, types.intp), code

    return read


def _writer(numba_type: Any, element: Any, whole: Any, align: int) -> Any:
    @intrinsic_of
    def write(typing: Any, address: Any, index: Any, value: Any) -> VectorCode:
        def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            stored = builder.store(args[2], _pointer(builder, args[0], args[1], element, whole))
            stored.align = align
            return context.get_dummy_value()

        return types.void(types.intp, types.intp, numba_type), code

    return write


_I8, _I16, _F32 = ir.IntType(8), ir.IntType(16), ir.FloatType()
load_bytes = _reader(BYTES, _I8, BYTES.llvm, 1)
"""load_bytes(address, index): 32 bytes from `index` on."""
load_int16 = _reader(INT16, _I16, INT16.llvm, 2)
"""load_int16(address, index): 16 of the int16 at `address`, from number `index` on."""
load_float32 = _reader(FLOAT32, _F32, FLOAT32.llvm, 4)
"""load_float32(address, index): the same of float32."""
store_bytes = _writer(BYTES, _I8, BYTES.llvm, 1)
"""store_bytes(address, index, bytes): write 32 bytes."""
store_int16 = _writer(INT16, _I16, INT16.llvm, 2)
"""store_int16(address, index, lanes): write 16 int16."""
store_float32 = _writer(FLOAT32, _F32, FLOAT32.llvm, 4)
"""store_float32(address, index, lanes): write 16 float32."""
read_byte = _reader(types.uint8, _I8, _I8, 1)
read_int16 = _reader(types.int16, _I16, _I16, 2)
read_int32 = _reader(types.int32, _INT32, _INT32, 4)
read_float32 = _reader(types.float32, _F32, _F32, 4)
"""read_...(address, index): one number."""
write_byte = _writer(types.uint8, _I8, _I8, 1)
write_int16 = _writer(types.int16, _I16, _I16, 2)
write_int32 = _writer(types.int32, _INT32, _INT32, 4)
write_float32 = _writer(types.float32, _F32, _F32, 4)
"""write_...(address, index, number): one number."""


@intrinsic_of
def prefetch(typing: Any, address: Any) -> VectorCode:
    """prefetch(address): fetch the cache line there into the second cache; any address will do."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pointer = builder.inttoptr(args[0], _I8.as_pointer())
        # To be read, next to last of the levels of locality, data.
        how = [ir.Constant(_INT32, number) for number in (0, 2, 1)]
        called(builder, "llvm.prefetch.p0", ir.VoidType(), pointer, *how)
        return context.get_dummy_value()

    return types.void(types.intp), code


@numba.njit(inline="always")
def address_of(array):  # type: ignore[no-untyped-def]
    """Address of an array's first element."""
    return array.ctypes.data


def _splat(context: Any, builder: Any, lanes: Lanes, number_type: Any, number: Any) -> Any:
    element = types.float32 if lanes.real else types.Integer.from_bitwidth(lanes.bits, signed=True)
    cast = context.cast(builder, number, number_type, element)
    nothing = ir.Constant(lanes.llvm, ir.Undefined)
    first = builder.insert_element(nothing, cast, ir.Constant(_INT32, 0))
    return builder.shuffle_vector(first, nothing, place_list([0] * lanes.count))


def place_list(indices: Iterable[int]) -> Any:
    """Which elements a shuffle takes."""
    places = list(indices)
    return ir.Constant(ir.VectorType(_INT32, len(places)), places)


def vector_name(vector: ir.VectorType) -> str:
    """What LLVM calls a vector in the names of its intrinsics."""
    return f"v{vector.count}" + ("f32" if isinstance(vector.element, ir.FloatType) else f"i{vector.element.width}")


def called(builder: Any, name: str, result: Any, *args: Any) -> Any:
    """The result of a call of an LLVM intrinsic."""
    function_type = ir.FunctionType(result, [arg.type for arg in args])
    function = cgutils.get_or_insert_function(builder.module, function_type, name)  # type: ignore[no-untyped-call]
    return builder.call(function, args)


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
smaller_float = _named("minnum")
"""smaller_float(a, b): the smaller one of two float32 in each lane."""

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


def _conversion(to: Lanes, emit: Callable[[Any, Any], Any]) -> Any:
    @intrinsic_of
    def convert(typing: Any, a: Any) -> VectorCode:
        def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            return emit(builder, args[0])

        return to(a), code

    return convert


UNPACKED: Final = (0, 1, 2, 3, 8, 9, 10, 11, 4, 5, 6, 7, 12, 13, 14, 15)
"""Which lane stands where after `from_bfloat16_unpacked`: the order that costs an x86 processor one instruction."""
_WIDE = ir.VectorType(_INT32, LANES)


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


as_bytes = _conversion(BYTES, lambda builder, a: builder.bitcast(a, BYTES.llvm))
"""as_bytes(a): the two bytes of each 16-bit lane."""
from_bfloat16 = _conversion(FLOAT32, _as_float)
"""from_bfloat16(a): 16-bit patterns, the upper halves of float32 numbers, as those numbers."""
from_bfloat16_unpacked = _conversion(FLOAT32, _unpacked)
"""from_bfloat16_unpacked(a): the same in the order UNPACKED."""
to_bfloat16 = _conversion(INT16, _upper_half)
"""to_bfloat16(a): upper halves of float32 lanes as 16-bit patterns."""
to_int16 = _conversion(INT16, lambda b, a: b.trunc(b.fptosi(a, _WIDE), INT16.llvm))
"""to_int16(a): float32 lanes, which must fit, without their fraction."""
to_float32 = _conversion(FLOAT32, lambda b, a: b.sitofp(b.sext(a, _WIDE), FLOAT32.llvm))
"""to_float32(a): 16-bit lanes as numbers."""
square_root = _conversion(FLOAT32, lambda b, a: called(b, f"llvm.sqrt.{vector_name(a.type)}", a.type, a))
"""square_root(a): of float32 lanes."""


@intrinsic_of
def add_bytes(typing: Any, address: Any, index: Any, counts: Any) -> VectorCode:
    """add_bytes(address, index, counts): add 32 unsigned bytes to as many int32 at `address`, from `index` on."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        wide = ir.VectorType(_INT32, 2 * LANES)
        pointer = _pointer(builder, args[0], args[1], _INT32, wide)
        before = builder.load(pointer)
        stored = builder.store(builder.add(before, builder.zext(args[2], wide)), pointer)
        before.align = stored.align = 4
        return context.get_dummy_value()

    return types.void(types.intp, types.intp, BYTES), code


@intrinsic_of
def load_two_rows(typing: Any, address: Any, first: Any, second: Any) -> VectorCode:
    """load_two_rows(address, first, second): 16 bytes from `first` on, and behind them 16 bytes from `second` on."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        half = ir.VectorType(_I8, LANES)
        rows = [builder.load(_pointer(builder, args[0], at, _I8, half)) for at in args[1:]]
        for row in rows:
            row.align = 1
        return builder.shuffle_vector(*rows, place_list(range(2 * LANES)))

    return BYTES(types.intp, types.intp, types.intp), code


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


def _has_avx2() -> bool:
    """Whether numba compiles for a processor with AVX2: this one, unless its settings name another."""
    settings: Any = config
    if settings.CPU_NAME is None and settings.CPU_FEATURES is None:
        return bool(binding.get_host_cpu_features().get("avx2", False))
    return "+avx2" in (settings.CPU_FEATURES or "")


@intrinsic_of
def dot_pairs(typing: Any, counts: Any, weights: Any) -> VectorCode:
    """dot_pairs(counts, weights): in each lane the sum of its two products, 16 bits, stopping at their limits.

    counts: unsigned bytes; weights: signed.
    """
    # LLVM has no name of its own for what is one instruction on x86, and does not always recognise it.
    one_instruction = _has_avx2()

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        if one_instruction:
            return called(builder, "llvm.x86.avx2.pmadd.ub.sw", INT16.llvm, *args)
        nothing = ir.Constant(BYTES.llvm, ir.Undefined)

        def product(place: int) -> Any:
            places = place_list(range(place, 2 * LANES, 2))
            n = builder.zext(builder.shuffle_vector(args[0], nothing, places), _WIDE)
            return builder.mul(n, builder.sext(builder.shuffle_vector(args[1], nothing, places), _WIDE))

        low, high = ir.Constant(_WIDE, [-32768] * LANES), ir.Constant(_WIDE, [32767] * LANES)
        both = builder.add(product(0), product(1))
        both = builder.select(builder.icmp_signed(">", both, low), both, low)
        both = builder.select(builder.icmp_signed("<", both, high), both, high)
        return builder.trunc(both, INT16.llvm)

    return INT16(BYTES, BYTES), code


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


_HALF = LANES // 2
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
        return builder.extract_element(args[0], ir.Constant(_INT32, LANES - 1))

    return types.int16(a), code


@intrinsic_of
def equal_mask(typing: Any, a: Any, b: Any) -> VectorCode:
    """equal_mask(a, number): bit i is set where lane i equals the number."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        number = _splat(context, builder, signature.args[0], signature.args[1], args[1])
        mask = builder.bitcast(builder.icmp_signed("==", args[0], number), ir.IntType(LANES))
        return builder.zext(mask, _INT32)

    return types.uint32(a, b), code


@intrinsic_of
def equal_bits(typing: Any, address: Any, index: Any, step: Any, number: Any) -> VectorCode:
    """equal_bits(address, index, step, number): bit i is set where int16 number index + i step is it, i from 0 to 7."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        at, first, by, wanted = args
        few = ir.VectorType(_I16, LANES // 2)
        found, pointer = ir.Constant(few, ir.Undefined), builder.inttoptr(at, _I16.as_pointer())
        for i in range(LANES // 2):
            here = builder.add(first, builder.mul(by, ir.Constant(by.type, i)))
            loaded = builder.load(builder.gep(pointer, [here]))
            loaded.align = 2
            found = builder.insert_element(found, loaded, ir.Constant(_INT32, i))
        first_only = builder.insert_element(ir.Constant(few, ir.Undefined), wanted, ir.Constant(_INT32, 0))
        all_wanted = builder.shuffle_vector(first_only, first_only, place_list([0] * (LANES // 2)))
        same = builder.icmp_signed("==", found, all_wanted)
        return builder.zext(builder.bitcast(same, ir.IntType(LANES // 2)), _INT32)

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
        low = _splat(context, builder, INT16, types.int64, args[0])
        high = _splat(context, builder, INT16, types.int64, args[1])
        inside = builder.and_(builder.icmp_signed(">=", number, low), builder.icmp_signed("<", number, high))
        return builder.sext(inside, INT16.llvm)

    return INT16(types.int64, types.int64), code


def _constant(lanes: Lanes, number: float) -> Any:
    @intrinsic_of
    def constant(typing: Any) -> VectorCode:
        def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            return ir.Constant(lanes.llvm, [number] * lanes.count)

        return lanes(), code

    return constant


zero_bytes = _constant(BYTES, 0)
zero_int16 = _constant(INT16, 0)
zero_float32 = _constant(FLOAT32, 0.0)
