"""Operations on lanes that are more than one of LLVM's own, against numpy."""

import numba
import numpy as np
import pytest

from rig.simd import memory, shuffles, vectors
from rig.simd.memory import address_of, load_bytes, load_float32, load_int16
from rig.simd.vectors import LANES, UNPACKED

INT16, FLOAT = (load_int16, memory.store_int16), (load_float32, memory.store_float32)
BYTES = load_bytes, memory.store_bytes
SIZES = {INT16: (np.int16, LANES), BYTES: (np.uint8, 2 * LANES), FLOAT: (np.float32, LANES)}


def samples(kind):
    """Pairs of operands, (count,) each."""
    dtype, count = SIZES[kind]
    rng = np.random.default_rng(1)
    for _ in range(20):
        if kind is FLOAT:
            yield tuple(rng.normal(0, 100, (2, count)).astype(dtype))
        else:
            yield tuple(rng.integers(np.iinfo(dtype).min, np.iinfo(dtype).max + 1, (2, count)).astype(dtype))


def wide(a):
    return a.astype(np.int64)


def saturated(wide):
    return np.clip(wide, -32768, 32767)


def upper_half(a):
    return a.view(np.uint32) >> 16


def number_of(patterns):
    return (patterns.view(np.uint16).astype(np.uint32) << 16).view(np.float32)


OPERATIONS = {
    "scaled": (INT16, INT16, lambda a, b: vectors.scaled(a, b), lambda a, b: (wide(a) * b + (1 << 14)) >> 15),
    "running sum": (
        # Of numbers small enough: saturated sums go by the order of their steps.
        INT16, INT16, lambda a, b: shuffles.running_sum(a & 0x7FF), lambda a, b: saturated(np.cumsum(wide(a) & 0x7FF)),
    ),
    "unpacked numbers": (
        INT16, FLOAT, lambda a, b: vectors.from_bfloat16_unpacked(a), lambda a, b: number_of(a)[list(UNPACKED)],
    ),
    "where small": (
        FLOAT, FLOAT, lambda a, b: vectors.where_small(a, b, np.float32(50.0)), lambda a, b: a * (np.abs(b) <= 50),
    ),
    "where below": (FLOAT, FLOAT, lambda a, b: vectors.where_below(a, b, a, b), np.minimum),
    "patterns of numbers": (FLOAT, INT16, lambda a, b: vectors.to_bfloat16(a), lambda a, b: upper_half(a)),
}  # fmt: skip


def applied(kind, to, operation, a, b):
    """The result of an operation on two arrays; lanes cannot leave a kernel."""
    (load, _), (_, store), compiled = kind, to, numba.njit(operation)

    @numba.njit
    def kernel(a, b, out):
        store(address_of(out), 0, compiled(load(address_of(a), 0), load(address_of(b), 0)))

    dtype, count = SIZES[to]
    out = [np.empty(count, dtype) for _ in a]
    for one, other, result in zip(a, b, out, strict=True):
        kernel(one, other, result)
    return out


@pytest.mark.parametrize("name", OPERATIONS)
def test_lanes_do_what_numpy_does(name):
    kind, to, operation, wanted = OPERATIONS[name]
    a, b = zip(*samples(kind), strict=True)
    for one, other, found in zip(a, b, applied(kind, to, operation, a, b), strict=True):
        with np.errstate(invalid="ignore"):
            right = np.asarray(wanted(one, other))
        # Numbers wrap round as 16 bits do.
        np.testing.assert_array_equal(found, right.astype(found.dtype))


@pytest.mark.parametrize("sign", [-1, 1])
def test_running_sums_stop_at_the_limits(sign):
    a = np.full(LANES, sign * 5000, np.int16)
    (found,) = applied(INT16, INT16, lambda a, b: shuffles.running_sum(a), [a], [a])
    np.testing.assert_array_equal(found, saturated(np.cumsum(wide(a))))


@pytest.mark.parametrize("one_instruction", [True, False])
def test_products_of_pairs_are_added_and_stop_at_the_limits(one_instruction, monkeypatch):
    if one_instruction and not vectors._has_avx2():
        pytest.skip("this processor has no AVX2")
    monkeypatch.setattr(vectors, "_has_avx2", lambda: one_instruction)
    rng = np.random.default_rng(2)
    counts = [rng.integers(0, largest + 1, 2 * LANES).astype(np.uint8) for largest in (1, 64, 255)]
    weights = rng.integers(-128, 128, (3, 2 * LANES)).astype(np.int8)
    weights[:, :4] = 127, 127, -128, -128
    for n, largest in zip(counts, (1, 64, 255), strict=True):
        n[:4] = largest
    found = applied(BYTES, INT16, lambda a, b: vectors.dot_pairs(a, b), counts, weights.view(np.uint8))
    for n, w, pairs in zip(counts, weights, found, strict=True):
        np.testing.assert_array_equal(pairs, saturated((n.astype(int) * w).reshape(LANES, 2).sum(axis=1)))
