"""AES rounds against FIPS 197, with and without instructions for them, and the order of a word's pixels."""

from collections.abc import Callable
from typing import Any

import numba
import numpy as np
import pytest
from llvmlite import binding, ir
from numba import types
from numba.extending import intrinsic

from sim_backend import random_numbers as random_lanes
from sim_backend.random_numbers import PLACE, block_numbers, counter_bits, drawn_word, full_word, place_levels

START_OF_ROUND = 0x193DE3BEA0F4E22B9AC68D2AE9F84808
ROUND_KEY = 0xA0FAFE1788542CB123A339392A6C7605
AFTER_ROUND = 0xA49C7FF2689F352B6B5BEA43026A5049
"""FIPS 197, appendix B: round 1 of its example, first byte highest."""


def _halves(number: int) -> list[np.uint64]:
    return [np.uint64(half) for half in np.frombuffer(number.to_bytes(16, "big"), np.uint64)]


def _compiled(code_of_round: Callable[..., Any]) -> Any:
    make: Any = intrinsic

    @make
    def one_round(typing, s0, s1, k0, k1):  # type: ignore[no-untyped-def]
        def code(context, builder, signature, args):  # type: ignore[no-untyped-def]
            given = [random_lanes._vector(builder, random_lanes._BLOCK, halves) for halves in (args[:2], args[2:])]
            state = code_of_round(builder, *given)
            halves = [builder.extract_element(state, ir.Constant(ir.IntType(32), i)) for i in (0, 1)]
            return context.make_tuple(builder, signature.return_type, halves)

        return types.UniTuple(types.uint64, 2)(*[types.uint64] * 4), code

    return numba.njit(lambda a, b, c, d: one_round(a, b, c, d))


@pytest.mark.parametrize("way", ["this processor", "tables"])
def test_a_round_is_that_of_the_standard(way: str) -> None:
    code = random_lanes.round_of_block if way == "this processor" else random_lanes.round_by_table
    found = _compiled(code)(*_halves(START_OF_ROUND), *_halves(ROUND_KEY))
    assert list(found) == _halves(AFTER_ROUND)


def test_the_round_for_arm_compiles() -> None:
    module, block = ir.Module(), ir.VectorType(ir.IntType(64), 2)
    module.triple = "aarch64-unknown-linux-gnu"
    function = ir.Function(module, ir.FunctionType(block, [block, block]), "one_round")
    builder = ir.IRBuilder(function.append_basic_block())
    builder.ret(random_lanes.round_by_arm(builder, *function.args))
    binding.initialize_all_targets()
    binding.initialize_all_asmprinters()
    try:
        target = binding.Target.from_triple(module.triple)
    except RuntimeError:
        pytest.skip("this LLVM knows no ARM")
    written = target.create_target_machine(features="+aes").emit_assembly(binding.parse_assembly(str(module)))
    assert "aese" in written
    assert "aesmc" in written


def test_numbers_without_instructions_are_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    def both(seed, row, levels, blocks):  # type: ignore[no-untyped-def]
        key = counter_bits(seed, seed, np.uint64(7), row)
        return key, drawn_word(key, blocks.ctypes.data, levels.ctypes.data)

    args = np.uint64(5), np.uint64(9), np.full(64, 12000, np.int16), block_numbers(4)[3]
    expected = numba.njit(both)(*args)
    monkeypatch.setattr(random_lanes, "_has", lambda feature: False)
    assert numba.njit(both)(*args) == expected


@numba.njit
def _words(values, key, blocks, levels, words):  # type: ignore[no-untyped-def]
    place_levels(values.ctypes.data, levels.ctypes.data)
    for i in range(len(words)):
        block = blocks.ctypes.data + i % len(blocks) * blocks.shape[1] * 8
        drawn = drawn_word((key, np.uint64(i // len(blocks))), block, levels.ctypes.data)
        words[i] = drawn | full_word(levels.ctypes.data)


def test_levels_belong_to_pixels_in_packbits_order() -> None:
    rng = np.random.default_rng(1)
    values = rng.integers(-(2**15), 2**15, 64).astype(np.int16)
    values[[0, 7, 8, 63]] = -(2**15), 2**15 - 1, 2**15 - 1, -(2**15)
    levels, words = np.zeros(64, np.int16), np.zeros(4000, np.uint64)
    _words(values, np.uint64(11), block_numbers(8), levels, words)
    assert np.array_equal(levels[list(PLACE)], values)
    rate = np.unpackbits(words.view(np.uint8).reshape(4000, 8), axis=1).mean(axis=0)
    p = (2**15 - 1 - values.astype(np.float64)) / 2**16
    np.testing.assert_allclose(rate, p, rtol=0, atol=4.5 * np.sqrt(0.25 / 4000))
    assert rate[[0, 7, 8, 63]].tolist() == [1, 0, 0, 1]
