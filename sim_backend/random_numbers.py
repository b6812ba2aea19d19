"""Random bits and exponentials for compiled kernels.

Random bits are counters enciphered by rounds of AES, for which processors have instructions. Counter-based numbers need
no state and no order (Salmon, Moraes, Dror, Shaw, "Parallel random numbers: as easy as 1, 2, 3", SC 2011).
`counter_bits` is their ARS-5, which passes BigCrush there: five rounds whose keys step by a Weyl sequence (here the
last one mixes columns too, a bijection). Its 128 bits are the key of a few rows of a frame, under which `drawn_word`
enciphers the numbers of blocks of 8 pixels with three more rounds. Block numbers of one key differ in a few bytes,
which two rounds spread over all 16; after the third, bytes of two blocks agree as often as by chance, within 1e-7.
Single numbers that follow from a seed and a count use SplitMix64 (Steele, Lea, Flood 2014). All are uint64.

One AES round of 256 bits takes one cycle on x86 with VAES, two with AES-NI or on 64-bit ARM. Elsewhere table look-ups
give the same bits, many times as slowly.

Exponentials are written without branches or calls, so that loops over them become vector instructions. With
k = round(t) and f = k - t, |f| <= 1/2:  2^-t = 2^-k 2^f, the latter by its Taylor series. Relative errors, found with
50 digits: for `power_of_half` 3e-13 (series to f^10) and the effect of rounding t; for `one_minus_exp_minus` 4e-16 (to
r^13, with r = f ln 2 in two parts). `one_minus_exp_minus_32` is a float32 version for uses where six digits suffice.
The numbers that loops need come as a tuple from the kernel's caller (`HALVING`, `ROUGHLY`). If they were constants,
LLVM would load them anew for every vector: 24 of the 59 instructions of a loop over `power_of_half`.
"""

import math
from collections.abc import Callable
from typing import Any, Final

import numba
import numpy as np
from llvmlite import binding, ir
from numba import config, types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

KEY_ROUNDS: Final = 5
BLOCK_ROUNDS: Final = 3
_WEYL: Final = (0x9E3779B97F4A7C15, 0xBB67AE8584CAA73B)
"""Step of the round keys, low and high half: golden ratio and sqrt(3) - 1 (Salmon et al.)."""
WORD_PX: Final = 64
BLOCK_PX: Final = 8
"""Pixels of one counter, 16 bits each."""
_VECTOR_PX = 16

_I8, _I16, _I32, _I64 = (ir.IntType(bits) for bits in (8, 16, 32, 64))
_BYTES, _BLOCK, _PAIR = ir.VectorType(_I8, 16), ir.VectorType(_I64, 2), ir.VectorType(_I64, 4)
_COLUMNS = ir.VectorType(_I32, 4)
_PIXELS = ir.VectorType(_I16, _VECTOR_PX)
_PACKED: Final = (*range(8), *range(16, 24), *range(8, 16), *range(24, 32))
"""Order in which x86 packs the pixels of two vectors into 32 bits by one instruction."""
PLACE: Final = tuple(8 * (0, 2, 1, 3, 4, 6, 5, 7)[x // 8] + 7 - x % 8 for x in range(WORD_PX))
"""Index at which the level of pixel x of a word is stored, so that the bits drawn have the order of `packbits`."""

_S_BOX = bytes.fromhex(
    "637c777bf26b6fc53001672bfed7ab76ca82c97dfa5947f0add4a2af9ca472c0b7fd9326363ff7cc34a5e5f171d8311504c723c3"
    "1896059a071280e2eb27b27509832c1a1b6e5aa0523bd6b329e32f8453d100ed20fcb15b6acbbe394a4c58cfd0efaafb434d3385"
    "45f9027f503c9fa851a3408f929d38f5bcb6da2110fff3d2cd0c13ec5f974417c4a77e3d645d197360814fdc222a908846eeb814"
    "de5e0bdbe0323a0a4906245cc2d3ac629195e479e7c8376d8dd54ea96c56f4ea657aae08ba78252e1ca6b4c6e8dd741f4bbd8b8a"
    "703eb5664803f60e613557b986c11d9ee1f8981169d98e949b1e87e9ce5528df8ca1890dbfe6426841992d0fb054bb16"
)
"""S-box of AES (FIPS 197, figure 7)."""

_intrinsic: Any = intrinsic
_Code = tuple[Any, Callable[[Any, Any, Any, Any], Any]]


def _has(feature: str) -> bool:
    """Whether numba compiles for a processor with the feature: this one, unless numba's settings name another."""
    settings: Any = config
    if settings.CPU_NAME is None and settings.CPU_FEATURES is None:
        return bool(binding.get_host_cpu_features().get(feature, False))
    return f"+{feature}" in (settings.CPU_FEATURES or "").split(",")


def _call(builder: Any, name: str, result: Any, *args: Any) -> Any:
    function_type = ir.FunctionType(result, [arg.type for arg in args])
    return builder.call(cgutils.get_or_insert_function(builder.module, function_type, name), args)  # type: ignore[no-untyped-call]


def _chosen(builder: Any, a: Any, b: Any, places: Any) -> Any:
    numbers = list(places)
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(_I32, len(numbers)), numbers))


def _table(builder: Any) -> Any:
    """A table of what each byte of a column becomes: its S-box value times 2, 1, 1 and 3, lowest byte first."""
    name = "spadrig.aes"
    known = builder.module.globals.get(name)
    if known is None:
        doubled = [s << 1 ^ (0x11B if s & 0x80 else 0) for s in _S_BOX]  # times x in the field of 256 elements
        values = [two | s << 8 | s << 16 | (two ^ s) << 24 for s, two in zip(_S_BOX, doubled, strict=True)]
        kind = ir.ArrayType(_I32, 256)
        known = ir.GlobalVariable(builder.module, kind, name)
        known.linkage, known.global_constant = "internal", True
        known.initializer = ir.Constant(kind, values)
    return known


def round_by_table(builder: Any, state: Any, key: Any) -> Any:
    """One AES round of 128 bits by table look-ups, for processors without AES instructions."""
    table, given = _table(builder), builder.bitcast(state, _BYTES)
    mixed = ir.Constant(_COLUMNS, ir.Undefined)
    for column in range(4):
        total = ir.Constant(_I32, 0)
        for row in range(4):
            byte = builder.extract_element(given, ir.Constant(_I32, (4 * column + 5 * row) % 16))
            found = builder.load(builder.gep(table, [ir.Constant(_I32, 0), builder.zext(byte, _I32)]))
            total = builder.xor(total, _call(builder, "llvm.fshl.i32", _I32, found, found, ir.Constant(_I32, 8 * row)))
        mixed = builder.insert_element(mixed, total, ir.Constant(_I32, column))
    return builder.xor(builder.bitcast(mixed, _BLOCK), key)


def round_by_arm(builder: Any, state: Any, key: Any) -> Any:
    """One AES round of 128 bits on 64-bit ARM. Its instruction adds a key before the round, so it gets 0 there, and the
    key is added at the end."""
    given, nothing = builder.bitcast(state, _BYTES), ir.Constant(_BYTES, [0] * 16)
    substituted = _call(builder, "llvm.aarch64.crypto.aese", _BYTES, given, nothing)
    mixed = _call(builder, "llvm.aarch64.crypto.aesmc", _BYTES, substituted)
    return builder.xor(builder.bitcast(mixed, _BLOCK), key)


def round_of_block(builder: Any, state: Any, key: Any) -> Any:
    """One AES round of 128 bits: SubBytes, ShiftRows, MixColumns, AddRoundKey (FIPS 197, 5.1)."""
    if not _has("aes"):
        return round_by_table(builder, state, key)
    if binding.get_process_triple().startswith(("aarch64", "arm64")):
        return round_by_arm(builder, state, key)
    return _call(builder, "llvm.x86.aesni.aesenc", _BLOCK, state, key)


def _round_of_pair(builder: Any, state: Any, key: Any) -> Any:
    """One AES round of each half of 256 bits."""
    if _has("vaes"):
        return _call(builder, "llvm.x86.aesni.aesenc.256", _PAIR, state, key)
    halves = ([_chosen(builder, v, v, places) for v in (state, key)] for places in ((0, 1), (2, 3)))
    low, high = (round_of_block(builder, *half) for half in halves)
    return _chosen(builder, low, high, range(4))


def _vector(builder: Any, kind: Any, halves: Any) -> Any:
    low, high = halves
    block = builder.insert_element(ir.Constant(_BLOCK, ir.Undefined), low, ir.Constant(_I32, 0))
    block = builder.insert_element(block, high, ir.Constant(_I32, 1))
    return block if kind is _BLOCK else _chosen(builder, block, block, (0, 1, 0, 1))


def _weyl(kind: Any, times: int) -> Any:
    return ir.Constant(kind, [times * step % 2**64 for step in _WEYL] * (kind.count // 2))


_KEY: Any = types.UniTuple(types.uint64, 2)  # type: ignore[no-untyped-call]


@_intrinsic
def counter_bits(typing: Any, key_low: Any, key_high: Any, low: Any, high: Any) -> _Code:
    """counter_bits(key_low, key_high, low, high): 128 random bits of a counter, as two uint64, low half first."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        key = _vector(builder, _BLOCK, args[:2])
        state = builder.xor(key, _vector(builder, _BLOCK, args[2:]))
        for number in range(1, KEY_ROUNDS + 1):
            state = round_of_block(builder, state, builder.add(key, _weyl(_BLOCK, number)))
        halves = [builder.extract_element(state, ir.Constant(_I32, half)) for half in (0, 1)]
        return context.make_tuple(builder, signature.return_type, halves)

    u64 = types.uint64
    return _KEY(u64, u64, u64, u64), code


def _packed(builder: Any, pixels: list[Any]) -> Any:
    """One bit of each pixel of a word, in the order of `packbits`, from vectors in the order `PLACE`."""
    halves = [builder.bitcast(_chosen(builder, pixels[i], pixels[i + 1], _PACKED), _I32) for i in (0, 2)]
    low, high = (builder.zext(half, _I64) for half in halves)
    return builder.or_(low, builder.shl(high, ir.Constant(_I64, 32)))


def _levels_at(builder: Any, address: Any) -> list[Any]:
    """Load the levels of a word, as vectors of 16, from its address."""
    pointer, found = builder.inttoptr(address, _PIXELS.as_pointer()), []
    for part in range(WORD_PX // _VECTOR_PX):
        found.append(builder.load(builder.gep(pointer, [ir.Constant(_I64, part)])))
        found[-1].align = 2
    return found


@numba.njit(cache=True)
def block_numbers(words: int) -> NDArray[np.uint64]:
    """The block numbers that `drawn_word` takes for each word of a row, uint64 (words, 16). Each block's number is
    there twice."""
    shape = words, 2 * WORD_PX // BLOCK_PX
    return np.repeat(np.arange(words * WORD_PX // BLOCK_PX), 2).astype(np.uint64).reshape(shape)


@_intrinsic
def drawn_word(typing: Any, key: Any, blocks: Any, levels: Any) -> _Code:
    """drawn_word(key, blocks, levels): bits of 64 pixels, each 1 if its 16 random bits, as int16, exceed its level.

    key: two uint64. blocks: address of the word's `block_numbers`. levels: address of 64 int16 in the order `PLACE`,
    each 32767 minus 65536 times a probability.
    """

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        key = _vector(builder, _PAIR, [builder.extract_value(args[0], half) for half in (0, 1)])
        numbers = builder.inttoptr(args[1], _PAIR.as_pointer())
        above = []
        for part, level in enumerate(_levels_at(builder, args[2])):
            number = builder.load(builder.gep(numbers, [ir.Constant(_I64, part)]))
            number.align = 8
            state = builder.xor(key, number)
            for weyl in range(1, BLOCK_ROUNDS + 1):
                state = _round_of_pair(builder, state, _weyl(_PAIR, weyl))
            above.append(builder.icmp_signed(">", builder.bitcast(state, _PIXELS), level))
        return _packed(builder, above)

    return types.uint64(_KEY, types.intp, types.intp), code


@_intrinsic
def full_word(typing: Any, levels: Any) -> _Code:
    """full_word(levels): bits of a word, 1 for pixels whose level is stored as -32768. levels: as in `drawn_word`."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        lowest = ir.Constant(_PIXELS, [-0x8000] * _VECTOR_PX)
        return _packed(builder, [builder.icmp_signed("==", v, lowest) for v in _levels_at(builder, args[0])])

    return types.uint64(types.intp), code


@_intrinsic
def place_levels(typing: Any, values: Any, levels: Any) -> _Code:
    """place_levels(values, levels): copy the levels of 64 pixels from the first address, where they lie in pixel order,
    to the second, in the order `PLACE`.
    """

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        word = ir.VectorType(_I16, WORD_PX)
        given, placed = (builder.inttoptr(address, word.as_pointer()) for address in args)
        loaded = builder.load(given)
        stored = builder.store(_chosen(builder, loaded, loaded, [PLACE.index(x) for x in range(WORD_PX)]), placed)
        loaded.align = stored.align = 2
        return context.get_dummy_value()

    return types.void(types.intp, types.intp), code


GOLDEN = np.uint64(0x9E3779B97F4A7C15)
FRAME_STEP = np.uint64(0xD1342543DE82EF95)
"""An odd multiplier that spreads frame numbers."""
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_S27, _S30, _S31 = np.uint64(27), np.uint64(30), np.uint64(31)


def mixed(z: Any) -> Any:
    """z with its bits mixed: each bit of the result depends on all bits of z, a uint64 or an array of them. Products
    overflow on purpose; `np.errstate(over="ignore")` keeps numpy from warning of it."""
    z = (z ^ (z >> _S30)) * _MIX_1
    z = (z ^ (z >> _S27)) * _MIX_2
    return z ^ (z >> _S31)


mixed_word = numba.njit(cache=True, nogil=True, inline="always")(mixed)
"""`mixed` for compiled code."""


@numba.njit(cache=True, nogil=True)
def frame_key(seed: np.uint64, frame: np.uint64) -> np.uint64:
    """64 random bits that the seed and a frame's number determine: the start of the frame's random stream."""
    return np.uint64(mixed_word(mixed_word(seed + GOLDEN) + frame * FRAME_STEP))


LARGEST: Final = 700.0
"""Largest t; above it 1 - exp(-t) is taken as 1."""
LOG2_E: Final = 1.4426950408889634
_LN2_HIGH, _LN2_LOW = 6.93147180369123816490e-01, 1.90821492927058770002e-10
"""ln 2 in two parts, the high one with 20 zeros at its end: its product with k is exact (Cody and Waite)."""
_ROUNDER, _ROUNDER_32 = 1.5 * 2.0**52, 1.5 * 2.0**23
"""If it is added to a float64 or float32, the last bits of the sum are the nearest integer."""
_C13, _C12, _C11, _C10, _C9, _C8 = 1 / 6227020800, 1 / 479001600, 1 / 39916800, 1 / 3628800, 1 / 362880, 1 / 40320
_C7, _C6, _C5, _C4, _C3 = 1 / 5040, 1 / 720, 1 / 120, 1 / 24, 1 / 6

_SERIES = tuple(math.log(2) ** n / math.factorial(n) for n in range(11))
HALVING: Final[dict[Any, tuple[Any, ...]]] = {
    np.float64: (1010.0, _ROUNDER, *_SERIES),
    np.float32: tuple(map(np.float32, (120.0, _ROUNDER_32, *_SERIES))),
}
"""Constants of `power_of_half`, by precision: largest t, rounder, series."""
_SERIES_32 = (1 / math.factorial(n) for n in (0, 2, 3, 4, 5, 6))
ROUGHLY: Final = tuple(map(np.float32, (80.0, LOG2_E, _ROUNDER_32, math.log(2), *_SERIES_32)))
"""Constants of `one_minus_exp_minus_32`: largest t, scale, rounder, ln 2, series without its linear term."""


@_intrinsic
def _power_of_half(typing: Any, rounded: Any) -> _Code:
    """2^-k from k + _ROUNDER, float64, or k + _ROUNDER_32, float32."""
    bits, bias, mantissa = (64, 1023, 52) if rounded == types.float64 else (32, 127, 23)

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        word = ir.IntType(bits)
        exponent = builder.sub(ir.Constant(word, bias), builder.bitcast(args[0], word))
        return builder.bitcast(builder.shl(exponent, ir.Constant(word, mantissa)), args[0].type)

    return rounded(rounded), code


@numba.njit(inline="always", error_model="numpy")
def power_of_half(t, halving):  # type: ignore[no-untyped-def]
    """2^-t for t >= 0. halving: the entry of `HALVING` for the type of t."""
    most, rounder, e0, e1, e2, e3, e4, e5, e6, e7, e8, e9, e10 = halving
    t = min(t, most)
    rounded = t + rounder
    f = (rounded - rounder) - t
    f2 = f * f
    f4 = f2 * f2  # in pairs of pairs: a chain half as long as Horner's
    low, middle = e0 + f * e1 + f2 * (e2 + f * e3), e4 + f * e5 + f2 * (e6 + f * e7)
    return _power_of_half(rounded) * (low + f4 * (middle + f4 * (e8 + f * e9 + f2 * e10)))


@numba.njit(inline="always", error_model="numpy")
def one_minus_exp_minus(t):  # type: ignore[no-untyped-def]
    """1 - exp(-t) for t >= 0. Its relative error is as small for small t as for large ones."""
    t = min(t, LARGEST)
    rounded = t * LOG2_E + _ROUNDER
    k = rounded - _ROUNDER
    r = (k * _LN2_HIGH - t) + k * _LN2_LOW
    r2 = r * r
    high = _C9 + r * _C10 + r2 * (_C11 + r * _C12 + r2 * _C13)
    middle = _C5 + r * _C6 + r2 * (_C7 + r * _C8 + r2 * high)
    q = r + r2 * (0.5 + r * (_C3 + r * (_C4 + r * middle)))
    scale = _power_of_half(rounded)
    return (1.0 - scale) - scale * q


@numba.njit(inline="always", error_model="numpy")
def one_minus_exp_minus_32(t, roughly):  # type: ignore[no-untyped-def]
    """1 - exp(-t) for a float32 t >= 0, as float32, within 3e-7. roughly: `ROUGHLY`."""
    largest, log2_e, rounder, ln2, one, d2, d3, d4, d5, d6 = roughly
    t = min(t, largest)
    rounded = t * log2_e + rounder
    r = (rounded - rounder) * ln2 - t
    q = r + r * r * (d2 + r * (d3 + r * (d4 + r * (d5 + r * d6))))
    scale = _power_of_half(rounded)
    return (one - scale) - scale * q
