"""Every operation on sixteen lanes against numpy, on numbers at and around the limits of the type."""

import numba
import numpy as np
import pytest

from rig.simd import shuffles as lane_shuffles
from rig.simd import vectors as lane_bfloat16
from rig.simd import vectors as lanes
from rig.simd.memory import (
    add_bytes,
    address_of,
    copy_floats,
    load_block,
    load_bytes,
    load_float32,
    load_four,
    load_int16,
    load_two_rows,
    load_widened,
    read_float32,
    read_int16,
    read_int32,
    store_bytes,
    store_float32,
    store_four,
    store_int16,
    write_float32,
    write_int16,
    write_int32,
)
from rig.simd.vectors import LANES, UNPACKED

EDGES = np.array([-32768, -32767, -20000, -256, -1, 0, 1, 2, 127, 128, 255, 256, 12345, 32000, 32766, 32767], np.int16)


def samples():
    rng = np.random.default_rng(1)
    yield EDGES, EDGES[::-1].copy()
    yield EDGES, EDGES
    for _ in range(20):
        yield tuple(rng.integers(-32768, 32768, (2, LANES)).astype(np.int16))


def compiled(operation):
    """A kernel that applies an operation to 16 lanes of two arrays."""

    @numba.njit
    def kernel(a, b, out):
        store_int16(address_of(out), 0, operation(load_int16(address_of(a), 0), load_int16(address_of(b), 0)))

    return kernel


def reduced(operation):
    @numba.njit
    def kernel(a):
        return operation(load_int16(address_of(a), 0))

    return kernel


def saturated(wide):
    return np.clip(wide, -32768, 32767)


def wide(a):
    return a.astype(np.int64)


OPERATIONS = {
    "sum": (numba.njit(lambda a, b: a + b), lambda a, b: wide(a) + b),
    "difference": (numba.njit(lambda a, b: a - b), lambda a, b: wide(a) - b),
    "product": (numba.njit(lambda a, b: a * b), lambda a, b: wide(a) * b),
    "and": (numba.njit(lambda a, b: a & b), lambda a, b: a & b),
    "or": (numba.njit(lambda a, b: a | b), lambda a, b: a | b),
    "saturated sum": (numba.njit(lambda a, b: lanes.add_saturated(a, b)), lambda a, b: saturated(wide(a) + b)),
    "saturated difference": (numba.njit(lambda a, b: lanes.sub_saturated(a, b)), lambda a, b: saturated(wide(a) - b)),
    "larger": (numba.njit(lambda a, b: lanes.larger(a, b)), np.maximum),
    "smaller": (numba.njit(lambda a, b: lanes.smaller(a, b)), np.minimum),
    "shift right": (numba.njit(lambda a, b: a >> 5), lambda a, b: a.view(np.uint16) >> 5),
    "shift left": (numba.njit(lambda a, b: a << 3), lambda a, b: wide(a) << 3),
    "with a number": (numba.njit(lambda a, b: (a & 0x55) + 7), lambda a, b: (a & 0x55) + 7),
    "scaled": (numba.njit(lambda a, b: lanes.scaled(a, b)), lambda a, b: (wide(a) * b + (1 << 14)) >> 15),
    "reversed": (numba.njit(lambda a, b: lane_shuffles.reversed_lanes(a)), lambda a, b: a[::-1]),
    "the last one everywhere": (numba.njit(lambda a, b: lane_shuffles.last_everywhere(a)), lambda a, b: 0 * a + a[-1]),
    "one lane up": (numba.njit(lambda a, b: lane_shuffles.up_1(a)), lambda a, b: np.append(0, a[:-1])),
}


@pytest.mark.parametrize("name", OPERATIONS)
def test_lanes_do_what_numpy_does(name):
    operation, wanted = OPERATIONS[name]
    kernel = compiled(operation)
    for a, b in samples():
        out = np.empty(LANES, np.int16)
        kernel(a, b, out)
        # Plain sums and products wrap round as 16 bits do.
        np.testing.assert_array_equal(out, np.asarray(wanted(a, b)).astype(np.int16))


def test_running_sums_are_sums_of_all_lanes_below():
    kernel = compiled(numba.njit(lambda a, b: lane_shuffles.running_sum(a)))
    rng = np.random.default_rng(2)
    out = np.empty(LANES, np.int16)
    for _ in range(20):
        a = rng.integers(-2000, 2000, LANES).astype(np.int16)
        kernel(a, a, out)
        np.testing.assert_array_equal(out, np.cumsum(a))


@pytest.mark.parametrize("sign", [-1, 1])
def test_running_sums_stop_at_the_limits(sign):
    a, out = np.full(LANES, sign * 5000, np.int16), np.empty(LANES, np.int16)
    compiled(numba.njit(lambda a, b: lane_shuffles.running_sum(a)))(a, a, out)
    np.testing.assert_array_equal(out, saturated(np.cumsum(a.astype(np.int64))))


def test_the_last_lane():
    last = reduced(lane_shuffles.last_lane)
    for a, _ in samples():
        assert last(a) == a[-1]


def test_equal_lanes_and_their_lowest():
    @numba.njit
    def mask_of(a, number):
        mask = lane_shuffles.equal_mask(load_int16(address_of(a), 0), number)
        return mask, lane_shuffles.lowest_bit(mask)

    for a, b in samples():
        for number in (a[3], a[15], b[0]):
            equal = np.flatnonzero(a == number)
            mask, lowest = mask_of(a, number)
            assert mask == sum(1 << int(i) for i in equal)
            assert lowest == (equal[0] if len(equal) else 32)


@pytest.mark.parametrize(("first", "end"), [(0, 16), (-20, 40), (3, 4), (5, 5), (7, 2), (16, 20), (-5, 0), (15, 16)])
def test_lanes_between(first, end):
    @numba.njit
    def mask_of(first, end, out):
        store_int16(address_of(out), 0, lane_shuffles.lanes_between(first, end))

    out = np.empty(LANES, np.int16)
    mask_of(first, end, out)
    inside = (np.arange(LANES) >= first) & (np.arange(LANES) < end)
    np.testing.assert_array_equal(out, np.where(inside, -1, 0))


def bytes_kernel(operation):
    """A kernel that applies an operation to 32 bytes of each of two arrays."""

    @numba.njit
    def kernel(a, b, out):
        one, other = load_bytes(address_of(a), 0), load_bytes(address_of(b), 0)
        store_bytes(address_of(out), 0, operation(one, other))

    return kernel


def random_bytes(seed, n=2 * LANES):
    return np.random.default_rng(seed).integers(0, 256, n).astype(np.uint8)


@pytest.mark.parametrize(
    ("operation", "wanted"),
    [
        (numba.njit(lambda a, b: a + b), lambda a, b: a + b),
        (numba.njit(lambda a, b: (a >> 3) & 0x55), lambda a, b: (a >> 3) & 0x55),
        (numba.njit(lambda a, b: (a & 0xAA) | (b << 2)), lambda a, b: (a & 0xAA) | (b << 2)),
        (
            numba.njit(lambda a, b: lane_shuffles.first_row_pairs(a, b)),
            lambda a, b: np.stack([a[:LANES], b[:LANES]], axis=1).ravel(),
        ),
        (
            numba.njit(lambda a, b: lane_shuffles.second_row_pairs(a, b)),
            lambda a, b: np.stack([a[LANES:], b[LANES:]], axis=1).ravel(),
        ),
        (
            numba.njit(lambda a, b: lanes.add_saturated_unsigned(a, b)),
            lambda a, b: np.minimum(wide(a) + b, 255),
        ),
        (
            numba.njit(lambda a, b: lanes.sub_saturated_unsigned(a, b)),
            lambda a, b: np.maximum(wide(a) - b, 0),
        ),
        (numba.njit(lambda a, b: lanes.smaller_unsigned(a, b)), np.minimum),
        (numba.njit(lambda a, b: lanes.smaller_unsigned(a, 200)), lambda a, b: np.minimum(a, 200)),
    ],
)
def test_bytes_do_what_numpy_does(operation, wanted):
    kernel = bytes_kernel(operation)
    for seed in range(5):
        a, b, out = random_bytes(seed), random_bytes(seed + 100), np.empty(2 * LANES, np.uint8)
        kernel(a, b, out)
        np.testing.assert_array_equal(out, wanted(a, b))


def test_two_rows_of_bytes_are_loaded_side_by_side():
    @numba.njit
    def loaded(a, first, second, out):
        store_bytes(address_of(out), 0, load_two_rows(address_of(a), first, second))

    a, out = random_bytes(1, 100), np.empty(2 * LANES, np.uint8)
    for first, second in ((0, 16), (3, 77), (50, 50)):
        loaded(a, first, second, out)
        np.testing.assert_array_equal(out, np.concatenate([a[first : first + LANES], a[second : second + LANES]]))


@pytest.mark.parametrize("one_instruction", [True, False])
def test_products_of_pairs_are_added_and_stop_at_the_limits(one_instruction, monkeypatch):
    if one_instruction and not lanes._has_avx2():
        pytest.skip("this processor has no AVX2")
    monkeypatch.setattr(lanes, "_has_avx2", lambda: one_instruction)

    @numba.njit
    def dot(counts, weights, out):
        pairs = lanes.dot_pairs(load_bytes(address_of(counts), 0), load_bytes(address_of(weights), 0))
        store_int16(address_of(out), 0, pairs)

    rng = np.random.default_rng(2)
    for largest in (1, 64, 255):
        counts = rng.integers(0, largest + 1, 2 * LANES).astype(np.uint8)
        weights = rng.integers(-128, 128, 2 * LANES).astype(np.int8)
        counts[:4], weights[:4] = largest, (127, 127, -128, -128)
        out = np.empty(LANES, np.int16)
        dot(counts, weights, out)
        sums = (counts.astype(int) * weights).reshape(LANES, 2).sum(axis=1)
        np.testing.assert_array_equal(out, np.clip(sums, -32768, 32767))


def test_bytes_are_added_to_wide_numbers():
    @numba.njit
    def add(sums, a):
        add_bytes(address_of(sums), 3, load_bytes(address_of(a), 0))

    sums, a = np.arange(40, dtype=np.int32) * 10**6, random_bytes(5)
    wanted = sums.copy()
    wanted[3:35] += a
    add(sums, a)
    np.testing.assert_array_equal(sums, wanted)


def test_bytes_of_16_bit_lanes_and_equal_numbers_a_step_apart():
    @numba.njit
    def split(a, out):
        store_bytes(address_of(out), 0, lanes.as_bytes(load_int16(address_of(a), 0)))

    @numba.njit
    def mask(a, at, step, number):
        return lane_shuffles.equal_bits(address_of(a), at, step, number)

    out = np.empty(2 * LANES, np.uint8)
    split(EDGES, out)
    np.testing.assert_array_equal(out, EDGES.view(np.uint8))
    a = np.random.default_rng(3).integers(0, 4, 200).astype(np.int16)
    for at, step in ((0, 16), (5, 7), (100, 1)):
        equal = a[at : at + 8 * step : step] == 2
        assert mask(a, at, step, np.int16(2)) == sum(1 << i for i in range(8) if equal[i])


FLOATS = {
    "arithmetic": (
        numba.njit(lambda a, b: lanes.larger_float(a, b) + a * b - b),
        lambda a, b: np.maximum(a, b) + a * b - b,
    ),
    "smaller": (numba.njit(lambda a, b: lanes.smaller_float(a, b)), np.minimum),
    "quotient": (numba.njit(lambda a, b: a / (b * b + np.float32(1.0))), lambda a, b: a / (b * b + 1.0)),
    "root": (numba.njit(lambda a, b: lanes.square_root(a * a)), lambda a, b: np.abs(a)),
    "halves and back": (
        numba.njit(lambda a, b: lane_bfloat16.from_bfloat16(lane_bfloat16.to_bfloat16(a))),
        lambda a, b: (a.astype(np.float32).view(np.uint32) & 0xFFFF0000).view(np.float32),
    ),
    "whole numbers and back": (numba.njit(lambda a, b: lanes.to_float32(lanes.to_int16(a))), lambda a, b: np.trunc(a)),
}


@pytest.mark.parametrize("name", FLOATS)
def test_float_lanes_do_what_numpy_does(name):
    operation, wanted = FLOATS[name]

    @numba.njit
    def kernel(a, b, out):
        one, other = load_float32(address_of(a), 0), load_float32(address_of(b), 0)
        store_float32(address_of(out), 0, operation(one, other))

    rng = np.random.default_rng(3)
    for _ in range(20):
        a, b = rng.normal(0, 100, (2, LANES)).astype(np.float32)
        out = np.empty(LANES, np.float32)
        kernel(a, b, out)
        np.testing.assert_allclose(out, wanted(a.astype(float), b.astype(float)), rtol=1e-5, atol=1e-2)


def test_bfloat16_patterns_become_numbers_in_the_order_that_is_said():
    @numba.njit
    def numbers_of(a, out, unpacked):
        patterns = load_int16(address_of(a), 0)
        store_float32(address_of(out), 0, lane_bfloat16.from_bfloat16(patterns))
        store_float32(address_of(unpacked), 0, lane_bfloat16.from_bfloat16_unpacked(patterns))

    numbers = np.array([0, 1, 2, 0.5, -3, 1e30, 1e-30, 7, 1.5, 2.5, 100, -0.25, 3e5, 1e-5, 96, 12], np.float32)
    patterns = (numbers.view(np.uint32) >> 16).astype(np.uint16).view(np.int16)
    rounded = (patterns.view(np.uint16).astype(np.uint32) << 16).view(np.float32)
    out, unpacked = np.empty((2, LANES), np.float32)
    numbers_of(patterns, out, unpacked)
    np.testing.assert_array_equal(out, rounded)
    assert sorted(UNPACKED) == list(range(LANES))
    np.testing.assert_array_equal(unpacked, rounded[list(UNPACKED)])


def test_floats_lose_their_fraction_on_the_way_to_integers():
    @numba.njit
    def cut(a, out):
        store_int16(address_of(out), 0, lanes.to_int16(load_float32(address_of(a), 0)))

    a = np.array(
        [-32000, -1.9, -1, -0.5, 0, 0.5, 0.99, 1, 1.5, 2.999, 100, 255.5, 1e4, 31999.9, -12345.6, 3], np.float32
    )
    out = np.empty(LANES, np.int16)
    cut(a, out)
    np.testing.assert_array_equal(out, np.trunc(a))


def test_single_numbers_are_read_and_written_where_they_are_said_to_be():
    @numba.njit
    def move(a, b, c, x, y, z):
        write_int16(address_of(x), 2, read_int16(address_of(a), 5))
        write_int32(address_of(y), 3, read_int32(address_of(b), 4))
        write_float32(address_of(z), 4, read_float32(address_of(c), 1))

    a, b, c = np.arange(9, dtype=np.int16) - 4, np.arange(9, dtype=np.int32) * 10**8, np.arange(9, dtype=np.float32) / 8
    x, y, z = np.zeros(9, np.int16), np.zeros(9, np.int32), np.zeros(9, np.float32)
    move(a, b, c, x, y, z)
    for out, place, number in ((x, 2, a[5]), (y, 3, b[4]), (z, 4, c[1])):
        assert out[place] == number
        assert np.count_nonzero(out) == 1


def test_constants():
    @numba.njit
    def zeros(numbers, fractions, counts):
        store_int16(address_of(numbers), 0, lanes.zero_int16())
        store_float32(address_of(fractions), 0, lanes.zero_float32())
        store_bytes(address_of(counts), 0, lanes.zero_bytes())

    out = np.ones(LANES, np.int16), np.ones(LANES, np.float32), np.ones(2 * LANES, np.uint8)
    zeros(*out)
    assert not any(a.any() for a in out)


def test_the_smallest_byte_and_where_bytes_equal_a_number():
    @numba.njit
    def found(a, number):
        one, block = load_bytes(address_of(a), 0), load_block(address_of(a), 0)
        places = lane_shuffles.equal_bytes(one, number), lane_shuffles.first_equal(block, number)
        return *places, lanes.smallest_byte(one), lanes.smallest_byte(block)

    for seed in range(20):
        a = random_bytes(seed, 8 * LANES) | np.uint8(seed)
        for number in (a[0], a[70], a[127], np.uint8(0)):
            equal = np.flatnonzero(a == number)
            mask, first, least, least_of_all = found(a, number)
            assert mask == sum(1 << int(i) for i in equal if i < 2 * LANES)
            assert first == (equal[0] if len(equal) else 8 * LANES)
            assert (least, least_of_all) == (a[: 2 * LANES].min(), a.min())


def test_four_numbers_are_scaled_and_added():
    @numba.njit
    def scale(a, by, out):
        store_four(address_of(out), 1, lanes.zero_four() + load_four(address_of(a), 2) * by)

    a, out = np.arange(8, dtype=np.float32), np.zeros(8, np.float32)
    scale(a, np.float32(0.25), out)
    np.testing.assert_array_equal(out, [0, 0.5, 0.75, 1, 1.25, 0, 0, 0])


def test_bytes_become_wider_lanes():
    @numba.njit
    def kernel(a, out):
        store_int16(address_of(out), 0, load_widened(address_of(a), 3))

    a, out = np.arange(120, 152, dtype=np.uint8), np.empty(LANES, np.int16)
    a[5] = 255
    kernel(a, out)
    np.testing.assert_array_equal(out, a[3 : 3 + LANES])


@pytest.mark.parametrize("number", [0, 1, LANES - 1, LANES, LANES + 3, 5 * LANES])
def test_copies_are_as_long_as_asked(number) -> None:
    source, to = np.arange(1.0, 100.0, dtype=np.float32), np.zeros(99, np.float32)
    copy_floats(source.ctypes.data, to.ctypes.data, number)
    np.testing.assert_array_equal(to[:number], source[:number])
    assert not to[number:].any()
