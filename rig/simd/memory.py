"""Reads and writes of vectors and single numbers at an address in memory, and arrays that begin at a cache line.

Addresses are used instead of arrays because numba counts references to every array that a compiled function gets. In
the functions for one image row the counting takes many times as long as the work itself. So a caller makes a named
tuple of arrays, keeps it alive and passes its `pointers`; inside a kernel `address_of` gives the address of an array,
and `keep_alive` keeps one that the kernel itself has allocated. Item i of an array is at address + i x (bytes of an
item), and nothing here checks that it lies inside the array. The names say the type of the items. In an array that
begins at a cache line (`aligned_zeros`), a vector of 32 bytes at a multiple of 32 bytes lies in one cache line, so that
one line is read for it, not two.
"""

from typing import Any, Final, TypeVar

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numpy.typing import DTypeLike, NDArray

from rig.simd.vectors import BLOCK, BYTES, FLOAT32, FOUR, INT16, LANES, called, emitted, place_list

_I8, _I16, _I32, _I64, _F32 = ir.IntType(8), ir.IntType(16), ir.IntType(32), ir.IntType(64), ir.FloatType()


Arrays = TypeVar("Arrays", bound=tuple[Any, ...])


def pointers(arrays: Arrays) -> Arrays:
    """A copy of a named tuple for kernels, with each array replaced by its address, also in nested named tuples.

    Arrays must be C-contiguous, and the caller must keep them alive.
    """
    return type(arrays)(*map(_pointer_to, arrays))


def _pointer_to(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.ctypes.data
    return pointers(value) if isinstance(value, tuple) else value


@numba.njit(inline="always")
def address_of(array):  # type: ignore[no-untyped-def]
    """Address of an array's first element. Signed: numba makes a float of a signed plus an unsigned number."""
    return np.int64(array.ctypes.data)


@numba.njit(cache=True, nogil=True)
def keep_alive(*arrays):  # type: ignore[no-untyped-def]
    """Keep arrays that a kernel has allocated alive up to this call.

    Numba frees an array after its last use by name, even if its address is used later: another thread may then get that
    memory.
    """


def _pointer(builder: Any, address: Any, index: Any, element: Any, whole: Any) -> Any:
    """Pointer of type `whole` to item `index` of an array at `address`, whose items are of type `element`."""
    return builder.bitcast(builder.gep(builder.inttoptr(address, element.as_pointer()), [index]), whole.as_pointer())


def _load(builder: Any, address: Any, index: Any, element: Any, whole: Any, align: int) -> Any:
    loaded = builder.load(_pointer(builder, address, index, element, whole))
    loaded.align = align
    return loaded


def _reader(numba_type: Any, element: Any, whole: Any, align: int) -> Any:
    def read(builder: Any, address: Any, index: Any) -> Any:
        return _load(builder, address, index, element, whole, align)

    return emitted(numba_type(types.intp, types.intp), read)


def _writer(numba_type: Any, element: Any, whole: Any, align: int) -> Any:
    def write(builder: Any, address: Any, index: Any, value: Any) -> None:
        builder.store(value, _pointer(builder, address, index, element, whole)).align = align

    return emitted(types.void(types.intp, types.intp, numba_type), write)


load_bytes = _reader(BYTES, _I8, BYTES.llvm, 1)
"""load_bytes(address, index): 32 bytes from `index` on."""
load_block = _reader(BLOCK, _I8, BLOCK.llvm, 1)
"""load_block(address, index): 128 bytes from `index` on."""
load_int16 = _reader(INT16, _I16, INT16.llvm, 2)
"""load_int16(address, index): 16 of the int16 at `address`, from `index` on."""
load_float32 = _reader(FLOAT32, _F32, FLOAT32.llvm, 4)
"""load_float32(address, index): 16 of the float32 at `address`, from `index` on."""
load_four = _reader(FOUR, _F32, FOUR.llvm, 4)
"""load_four(address, index): four of the float32 at `address`, from `index` on."""
store_bytes = _writer(BYTES, _I8, BYTES.llvm, 1)
"""store_bytes(address, index, bytes): write 32 bytes."""
store_int16 = _writer(INT16, _I16, INT16.llvm, 2)
"""store_int16(address, index, lanes): write 16 int16."""
store_float32 = _writer(FLOAT32, _F32, FLOAT32.llvm, 4)
"""store_float32(address, index, lanes): write 16 float32."""
store_four = _writer(FOUR, _F32, FOUR.llvm, 4)
"""store_four(address, index, lanes): write four float32."""
_WHOLE = (types.uint8, _I8, 1), (types.int16, _I16, 2), (types.int32, _I32, 4), (types.int64, _I64, 1)
_NUMBERS = *_WHOLE, (types.float32, _F32, 4)
read_byte, read_int16, read_int32, read_int64, read_float32 = (_reader(kind, a, a, at) for kind, a, at in _NUMBERS)
"""read_...(address, index): the number at `index` in the array at `address`."""
write_byte, write_int16, write_int32, write_int64, write_float32 = (_writer(kind, a, a, at) for kind, a, at in _NUMBERS)
"""write_...(address, index, number): write the number at `index` in the array at `address`."""


@numba.njit(cache=True, nogil=True)
def copy_floats(source: int, to: int, number: int) -> None:
    """Copy `number` float32 from address `source` to address `to`, 16 at a time; numba copies them one by one."""
    whole = number - number % LANES
    for i in range(0, whole, LANES):
        store_float32(to, i, load_float32(source, i))
    for i in range(whole, number):
        write_float32(to, i, read_float32(source, i))


_HALF = ir.VectorType(_I8, LANES)


def _add_bytes(builder: Any, address: Any, index: Any, counts: Any) -> None:
    wide = ir.VectorType(_I32, 2 * LANES)
    pointer = _pointer(builder, address, index, _I32, wide)
    before = builder.load(pointer)
    stored = builder.store(builder.add(before, builder.zext(counts, wide)), pointer)
    before.align = stored.align = 4


add_bytes = emitted(types.void(types.intp, types.intp, BYTES), _add_bytes)
"""add_bytes(address, index, counts): add 32 unsigned bytes to as many int32 at `address`, from `index` on."""


def _load_two_rows(builder: Any, address: Any, first: Any, second: Any) -> Any:
    rows = [_load(builder, address, at, _I8, _HALF, 1) for at in (first, second)]
    return builder.shuffle_vector(*rows, place_list(range(2 * LANES)))


load_two_rows = emitted(BYTES(types.intp, types.intp, types.intp), _load_two_rows)
"""load_two_rows(address, first, second): 16 bytes from `first` on, then 16 bytes from `second` on."""


def _prefetch(to_write: int, locality: int) -> Any:
    def fetch(builder: Any, address: Any) -> None:
        how = [ir.Constant(_I32, number) for number in (to_write, locality, 1)]
        called(builder, "llvm.prefetch.p0", ir.VoidType(), builder.inttoptr(address, _I8.as_pointer()), *how)

    return emitted(types.void(types.intp), fetch)


prefetch = _prefetch(0, 2)
"""prefetch(address): fetch the cache line at an address, valid or not, into the second-level cache."""
prefetch_to_write = _prefetch(1, 3)
"""prefetch_to_write(address): fetch the cache line into the first-level cache, out of other cores' caches."""


load_widened = emitted(
    INT16(types.intp, types.intp), lambda b, address, i: b.zext(_load(b, address, i, _I8, _HALF, 1), INT16.llvm)
)
"""load_widened(address, index): 16 unsigned bytes from `index` on as lanes of 16 bits."""


def _load_counts(builder: Any, address: Any, index: Any) -> Any:
    # As signed numbers, which every processor converts to float32 in one instruction.
    wide = builder.zext(_load(builder, address, index, _I8, _HALF, 1), ir.VectorType(_I32, LANES))
    return builder.sitofp(wide, FLOAT32.llvm)


load_counts = emitted(FLOAT32(types.intp, types.intp), _load_counts)
"""load_counts(address, index): 16 unsigned bytes from `index` on as float32."""
CACHE_LINE: Final = 64
"""Bytes of a cache line."""


def aligned_zeros(shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
    """A contiguous array of zeros that begins at a cache line."""
    size = int(np.prod(shape, dtype=np.int64)) * np.dtype(dtype).itemsize
    memory = np.zeros(size + CACHE_LINE, np.uint8)
    begin = -memory.ctypes.data % CACHE_LINE
    return memory[begin : begin + size].view(dtype).reshape(shape)
