"""Operations across lanes: shuffles, sums along the lanes, masks with a bit for each lane, transposed blocks.

There is no formula: each operation says what lane i gets. Vectors are 16 int16 or float32, 32 or 128 bytes.

Reductions (`largest_of_rows`, `totals_of_rows`) take LANES rows at once and give one number per row, which becomes one
lane of the result. If they went row by row, every step would wait for the one before. `fetch_eights` and
`spread_eights` read eight numbers at each of LANES places in memory and transpose them: vector d gets the d-th number
of every place, its lane i that of place i.
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
    add_saturated,
    called,
    emitted,
    everywhere,
    place_list,
    vector_name,
    wide,
)

_HALF: Final = LANES // 2
_I16, _I32, _I64 = ir.IntType(16), ir.IntType(32), ir.IntType(64)


def _interleaved(first: int) -> Any:
    source = [place for i in range(first, first + LANES) for place in (i, 2 * LANES + i)]
    return emitted(BYTES(BYTES, BYTES), lambda builder, a, b: builder.shuffle_vector(a, b, place_list(source)))


first_row_pairs, second_row_pairs = _interleaved(0), _interleaved(LANES)
"""first_row_pairs(a, b), second_row_pairs(a, b): bytes of a and b alternately, the first 16 or the last 16 of each."""


def _shuffled(source: Sequence[int]) -> Any:
    """An operation in which lane i gets lane source[i], or 0 where source[i] is LANES."""
    zeros = ir.Constant(INT16.llvm, [0] * LANES)
    return emitted(INT16(INT16), lambda builder, a: builder.shuffle_vector(a, zeros, place_list(source)))


def _up_in_halves(by: int) -> Any:
    return _shuffled([i - by if i % _HALF >= by else LANES for i in range(LANES)])


up_1 = _shuffled([LANES, *range(LANES - 1)])
"""up_1(a): lane i gets lane i - 1, and the first lane 0."""
_up_1_in_halves, _up_2_in_halves, _up_4_in_halves = _up_in_halves(1), _up_in_halves(2), _up_in_halves(4)
_lower_end = _shuffled([LANES] * _HALF + [_HALF - 1] * _HALF)


@numba.njit(inline="always")
def running_sum(a):  # type: ignore[no-untyped-def]
    """Saturated sum of each lane and all lanes below it."""
    # Within halves first: on x86 a shuffle across them takes three times as long.
    a = add_saturated(a, _up_1_in_halves(a))
    a = add_saturated(a, _up_2_in_halves(a))
    a = add_saturated(a, _up_4_in_halves(a))
    return add_saturated(a, _lower_end(a))


last_lane = emitted(types.int16(INT16), lambda builder, a: builder.extract_element(a, ir.Constant(_I32, LANES - 1)))
"""last_lane(a): the highest lane of 16-bit lanes."""


def _bits_where(builder: Any, lanes: Any, number: Any) -> Any:
    """A number with a bit for each lane, set where the lane equals the number."""
    same = builder.icmp_signed("==", lanes, everywhere(builder, number, lanes.type.count))
    return builder.bitcast(same, ir.IntType(lanes.type.count))


equal_mask = emitted(
    types.uint32(INT16, types.int16), lambda builder, a, number: builder.zext(_bits_where(builder, a, number), _I32)
)
"""equal_mask(a, number): bit i is set where lane i equals the number."""


def _equal_bits(builder: Any, address: Any, index: Any, step: Any, number: Any) -> Any:
    pointer = builder.inttoptr(address, _I16.as_pointer())
    found = ir.Constant(ir.VectorType(_I16, _HALF), ir.Undefined)
    for i in range(_HALF):
        here = builder.add(index, builder.mul(step, ir.Constant(step.type, i)))
        loaded = builder.load(builder.gep(pointer, [here]))
        loaded.align = 2
        found = builder.insert_element(found, loaded, ir.Constant(_I32, i))
    return builder.zext(_bits_where(builder, found, number), _I32)


equal_bits = emitted(types.uint32(types.intp, types.intp, types.intp, types.int16), _equal_bits)
"""equal_bits(address, index, step, number): bit i, 0 to 7, is set where the int16 at index + i * step is the number."""
_NO = ir.Constant(ir.IntType(1), 0)
lowest_bit = emitted(types.uint32(types.uint32), lambda builder, mask: builder.cttz(mask, _NO))
"""lowest_bit(mask): index of the lowest bit that is set; 32 if no bit is set."""


def _lanes_between(builder: Any, first: Any, end: Any) -> Any:
    number = ir.Constant(INT16.llvm, list(range(LANES)))
    low, high = (everywhere(builder, builder.trunc(a, _I16), LANES) for a in (first, end))
    inside = builder.and_(builder.icmp_signed(">=", number, low), builder.icmp_signed("<", number, high))
    return builder.sext(inside, INT16.llvm)


lanes_between = emitted(INT16(types.int64, types.int64), _lanes_between)
"""lanes_between(first, end): all bits set in lanes first to end - 1, no others; 16-bit lanes."""
equal_bytes = emitted(types.uint32(BYTES, types.uint8), _bits_where)
"""equal_bytes(a, number): bit i is set where byte i equals the number."""
first_equal = emitted(
    types.int64(BLOCK, types.uint8),
    lambda builder, a, number: builder.trunc(builder.cttz(_bits_where(builder, a, number), _NO), _I64),
)
"""first_equal(a, number): index of the first byte of a block that equals the number; 128 if none does."""


reversed_lanes = _shuffled(range(LANES - 1, -1, -1))
"""reversed_lanes(a): the lanes in reverse order."""
last_everywhere = _shuffled([LANES - 1] * LANES)
"""last_everywhere(a): the highest lane copied to all lanes."""


FOLDED: Final = LANES // 2
"""Numbers per row that `store_folded` writes."""


def _unpacked(builder: Any, a: Any, b: Any, combine: Callable[[Any, Any], Any]) -> Any:
    """Combine the lower half of each 128 bits with the upper half, in a and in b; results of a and b alternate."""
    count, block = a.type.count, 128 // (16 if isinstance(a.type.element, ir.IntType) else 32)
    parts = []
    for first in (0, block // 2):
        places = [at for begin in range(0, count, block) for i in range(block // 2)
                  for at in (begin + first + i, count + begin + first + i)]  # fmt: skip
        parts.append(builder.shuffle_vector(a, b, place_list(places)))
    return combine(*parts)


def _reduced(builder: Any, rows: Sequence[Any], combine: Callable[[Any, Any], Any]) -> Any:
    """Combine the numbers of each row into one, in the order of the rows: as many rows as numbers in a row."""
    count = rows[0].type.count
    block = count // 2
    halves = []
    for begin in (0, block):
        # Rows in the order from which `_unpacked` makes the usual order.
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
    loaded = [builder.load(builder.gep(pointer, [ir.Constant(_I64, r)])) for r in range(rows)]
    for load in loaded:
        load.align = align
    return loaded


def _largest_of_rows(builder: Any, address: Any) -> Any:
    name = f"llvm.smax.{vector_name(INT16.llvm)}"
    rows = _loaded(builder, address, INT16.llvm, LANES, 2)
    return _reduced(builder, rows, lambda a, b: called(builder, name, INT16.llvm, a, b))


largest_of_rows = emitted(INT16(types.intp), _largest_of_rows)
"""largest_of_rows(address): the largest number of each of 16 rows of 16 int16, which lie one after another."""


def _store_folded(builder: Any, address: Any, row: Any, a: Any) -> None:
    low, high = (builder.shuffle_vector(a, a, place_list(range(i, i + FOLDED))) for i in (0, FOLDED))
    pointer = builder.inttoptr(address, ir.VectorType(ir.FloatType(), FOLDED).as_pointer())
    builder.store(builder.fadd(low, high), builder.gep(pointer, [row])).align = 4


store_folded = emitted(types.void(types.intp, types.intp, FLOAT32), _store_folded)
"""store_folded(address, row, a): write the sums of the lower and upper half of 16 float32 as row `row` there."""


def _totals_of_rows(builder: Any, address: Any) -> Any:
    rows = _loaded(builder, address, ir.VectorType(ir.FloatType(), FOLDED), LANES, 4)
    halves = [_reduced(builder, rows[i : i + FOLDED], builder.fadd) for i in (0, FOLDED)]
    return builder.shuffle_vector(*halves, place_list(range(LANES)))


totals_of_rows = emitted(FLOAT32(types.intp), _totals_of_rows)
"""totals_of_rows(address): the sum of each of 16 rows of FOLDED float32, which lie one after another."""


EIGHT: Final = 8
_EIGHT_FLOATS = ir.VectorType(ir.FloatType(), EIGHT)


def _turned(builder: Any, rows: list[Any]) -> list[Any]:
    """The columns of eight rows of eight numbers. Only the last step goes beyond half a vector, which is slower."""

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
    builder.store(vector, builder.gep(pointer, [ir.Constant(_I64, number)])).align = 4


def _fetch_eights(builder: Any, places: Any, behind: Any, to: Any) -> None:
    addresses = builder.inttoptr(places, _I64.as_pointer())
    for half in range(LANES // EIGHT):
        rows = []
        for i in range(EIGHT):
            at = builder.load(builder.gep(addresses, [ir.Constant(_I64, half * EIGHT + i)]))
            row = builder.load(builder.inttoptr(builder.add(at, behind), _EIGHT_FLOATS.as_pointer()))
            row.align = 4
            rows.append(row)
        for d, column in enumerate(_turned(builder, rows)):
            _store(builder, column, to, 2 * d + half)


fetch_eights = emitted(types.void(types.intp, types.intp, types.intp), _fetch_eights)
"""fetch_eights(places, behind, to): write eight vectors of sixteen float32 to address `to`.

places: address of sixteen addresses. Lane i of vector d gets the d-th float32 from `behind` bytes after address i on.
"""


def _spread_eights(builder: Any, source: Any, to: Any) -> None:
    both = ir.VectorType(_I32, 2 * LANES)
    loaded = builder.load(builder.inttoptr(source, both.as_pointer()))
    loaded.align = 1
    nothing = ir.Constant(both, ir.Undefined)
    for half in range(2):
        fours = builder.shuffle_vector(loaded, nothing, place_list(range(half, 2 * LANES, 2)))
        for d in range(4):
            byte = builder.and_(builder.lshr(fours, wide(8 * d)), wide(255))
            _store(builder, builder.sitofp(byte, FLOAT32.llvm), to, 4 * half + d)


spread_eights = emitted(types.void(types.intp, types.intp), _spread_eights)
"""spread_eights(source, to): write eight vectors of float32: lane i of vector d gets byte 8 i + d at `source`."""
