"""Every operation on sixteen lanes against numpy, on numbers at and around the limits of the type."""

import numba
import numpy as np
import pytest

from rig import lanes
from rig.lanes import LANES, UNPACKED, address_of

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
        lanes.store_int16(
            address_of(out), 0, operation(lanes.load_int16(address_of(a), 0), lanes.load_int16(address_of(b), 0))
        )

    return kernel


def reduced(operation):
    @numba.njit
    def kernel(a):
        return operation(lanes.load_int16(address_of(a), 0))

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
    "one lane up": (numba.njit(lambda a, b: lanes.up_1(a)), lambda a, b: np.append(0, a[:-1])),
    "two lanes up": (numba.njit(lambda a, b: lanes.up_2(a)), lambda a, b: np.append([0] * 2, a[:-2])),
    "four lanes up": (numba.njit(lambda a, b: lanes.up_4(a)), lambda a, b: np.append([0] * 4, a[:-4])),
    "eight lanes up": (numba.njit(lambda a, b: lanes.up_8(a)), lambda a, b: np.append([0] * 8, a[:-8])),
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
    kernel = compiled(numba.njit(lambda a, b: lanes.running_sum(a)))
    rng = np.random.default_rng(2)
    out = np.empty(LANES, np.int16)
    for _ in range(20):
        a = rng.integers(-2000, 2000, LANES).astype(np.int16)
        kernel(a, a, out)
        np.testing.assert_array_equal(out, np.cumsum(a))


@pytest.mark.parametrize("sign", [-1, 1])
def test_running_sums_stop_at_the_limits(sign):
    a, out = np.full(LANES, sign * 5000, np.int16), np.empty(LANES, np.int16)
    compiled(numba.njit(lambda a, b: lanes.running_sum(a)))(a, a, out)
    np.testing.assert_array_equal(out, saturated(np.cumsum(a.astype(np.int64))))


def test_reductions():
    largest, last = reduced(lanes.largest), reduced(lanes.last_lane)
    for a, _ in samples():
        assert largest(a) == a.max()
        assert last(a) == a[-1]


def test_equal_lanes_and_their_lowest():
    @numba.njit
    def mask_of(a, number):
        mask = lanes.equal_mask(lanes.load_int16(address_of(a), 0), number)
        return mask, lanes.lowest_bit(mask)

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
        lanes.store_int16(address_of(out), 0, lanes.lanes_between(first, end))

    out = np.empty(LANES, np.int16)
    mask_of(first, end, out)
    inside = (np.arange(LANES) >= first) & (np.arange(LANES) < end)
    np.testing.assert_array_equal(out, np.where(inside, -1, 0))


def test_unsigned_bytes_are_widened():
    @numba.njit
    def widened(a, at, out):
        lanes.store_int16(address_of(out), 0, lanes.widen(lanes.load_int8(address_of(a), at)))

    a, out = np.arange(256, dtype=np.uint8), np.empty(LANES, np.int16)
    for at in (0, 1, 113, 240):
        widened(a, at, out)
        np.testing.assert_array_equal(out, a[at : at + LANES])


@numba.njit
def float_lanes(a, b, weight):
    one, other = lanes.load_float32(address_of(a), 0), lanes.load_float32(address_of(b), 0)
    return lanes.total(
        (lanes.larger_float(one, other) + one * other - other) * lanes.load_float32(address_of(weight), 0)
    )


def test_float_lanes_do_what_numpy_does():
    rng = np.random.default_rng(3)
    for _ in range(20):
        a, b = rng.normal(0, 100, (2, LANES)).astype(np.float32)
        wanted = np.maximum(a, b) + a.astype(float) * b - b
        for lane in range(LANES):
            only = np.zeros(LANES, np.float32)
            only[lane] = 1.0
            assert float_lanes(a, b, only) == pytest.approx(wanted[lane], rel=1e-5, abs=1e-2)
        assert float_lanes(a, b, np.ones(LANES, np.float32)) == pytest.approx(wanted.sum(), rel=1e-4, abs=1e-1)


def test_bfloat16_patterns_become_numbers_in_the_order_that_is_said():
    @numba.njit
    def number(a, only):
        return lanes.total(
            lanes.from_bfloat16(lanes.load_int16(address_of(a), 0)) * lanes.load_float32(address_of(only), 0)
        )

    numbers = np.array([0, 1, 2, 0.5, -3, 1e30, 1e-30, 7, 1.5, 2.5, 100, -0.25, 3e5, 1e-5, 96, 12], np.float32)
    patterns = (numbers.view(np.uint32) >> 16).astype(np.uint16).view(np.int16)
    rounded = (patterns.view(np.uint16).astype(np.uint32) << 16).view(np.float32)
    assert sorted(UNPACKED) == list(range(LANES))
    for place, lane in enumerate(UNPACKED):
        only = np.zeros(LANES, np.float32)
        only[place] = 1.0
        assert number(patterns, only) == rounded[lane]


def test_floats_lose_their_fraction_on_the_way_to_integers():
    @numba.njit
    def cut(a, out):
        lanes.store_int16(address_of(out), 0, lanes.to_int16(lanes.load_float32(address_of(a), 0)))

    a = np.array(
        [-32000, -1.9, -1, -0.5, 0, 0.5, 0.99, 1, 1.5, 2.999, 100, 255.5, 1e4, 31999.9, -12345.6, 3], np.float32
    )
    out = np.empty(LANES, np.int16)
    cut(a, out)
    np.testing.assert_array_equal(out, np.trunc(a))


def test_single_numbers_are_read_and_written_where_they_are_said_to_be():
    @numba.njit
    def move(a, b, c, x, y, z):
        lanes.write_int16(address_of(x), 2, lanes.read_int16(address_of(a), 5))
        lanes.write_int32(address_of(y), 3, lanes.read_int32(address_of(b), 4))
        lanes.write_float32(address_of(z), 4, lanes.read_float32(address_of(c), 1))

    a, b, c = np.arange(9, dtype=np.int16) - 4, np.arange(9, dtype=np.int32) * 10**8, np.arange(9, dtype=np.float32) / 8
    x, y, z = np.zeros(9, np.int16), np.zeros(9, np.int32), np.zeros(9, np.float32)
    move(a, b, c, x, y, z)
    for out, place, number in ((x, 2, a[5]), (y, 3, b[4]), (z, 4, c[1])):
        assert out[place] == number
        assert np.count_nonzero(out) == 1


def test_constants():
    @numba.njit
    def zeros(out):
        lanes.store_int16(address_of(out), 0, lanes.zero_int16())
        return lanes.total(lanes.zero_float32())

    out = np.ones(LANES, np.int16)
    assert zeros(out) == 0.0
    assert not out.any()
