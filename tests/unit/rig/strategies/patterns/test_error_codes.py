"""Error-correcting codes: the words against `galois`, decoding against brute force, and the bench."""

import logging

import numpy as np
import pytest
from mpmath import mp, quad

from rig.strategies.apparatus import Budget
from rig.strategies.patterns import error_codes
from rig.strategies.patterns.error_codes import (
    CODES,
    ErrorCode,
    bch_words,
    code_book,
    correctable,
    differing_bits,
    generator,
    log_evidence,
    log_factorials,
    packed,
)
from rig.strategies.strategy import TooShort
from tests.stability.inventory import covers
from tests.unit.rig.strategies.patterns.bench import (
    Bench,
    check_time,
    confident_answers,
    geometry,
    off_columns,
    seen,
    walls,
)

covers(bch_words, code_book, correctable, generator)
STRATEGIES = [each for each in vars(error_codes).values() if isinstance(each, ErrorCode)]
GENERATORS = {
    31: "x^20 + x^18 + x^17 + x^13 + x^10 + x^9 + x^7 + x^6 + x^4 + x^2 + 1",
    63: "x^53 + x^50 + x^49 + x^48 + x^46 + x^44 + x^43 + x^40 + x^37 + x^34 + x^33 + x^29 + x^27 + x^26 + x^24 + x^22 "
    "+ x^20 + x^19 + x^18 + x^16 + x^14 + x^12 + x^6 + x^5 + x^3 + x^2 + 1",
}
"""As galois 0.4.11 prints them."""


def test_generators_and_distances_are_those_of_galois() -> None:
    for length, text in GENERATORS.items():
        powers = [1 if part == "x" else int(part[2:] or 0) if part != "1" else 0 for part in text.split(" + ")]
        assert generator(length, CODES[length][0]) == sum(1 << power for power in powers)
    assert [correctable(length, bits) for length, (bits, _) in CODES.items()] == [5, 13, 27, 59]
    assert all(apart == 2 * correctable(length, bits) + 1 for length, (bits, apart) in CODES.items())


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize(("length", "bits"), [(15, 5), (63, 10)])
def test_words_are_those_of_galois(length, bits) -> None:
    oracle = pytest.importorskip("galois").BCH(length, bits)
    assert generator(length, bits) == int(oracle.generator_poly)
    messages = np.random.default_rng(bits).integers(0, 2**bits, 50)
    as_bits = (messages[:, None] >> np.arange(bits - 1, -1, -1)) & 1
    np.testing.assert_array_equal(bch_words(length, bits, messages), np.asarray(oracle.encode(oracle.field(as_bits))))
    assert correctable(length, bits) == oracle.t


def test_codes_that_do_not_exist_are_refused() -> None:
    with pytest.raises(ValueError, match="not 32; give one of them"):
        generator(32, 6)
    with pytest.raises(ValueError, match="31 bits with 7 message bits"):
        generator(31, 7)


@covers(packed, differing_bits)
@pytest.mark.parametrize("length", [1, 31, 63, 64, 65, 255])
def test_differing_bits_are_counted_as_one_by_one(length) -> None:
    rng = np.random.default_rng(length)
    received, words = rng.integers(0, 2, (7, length)), rng.integers(0, 2, (5, length))
    by_hand = (received[:, None] != words[None]).sum(axis=2)
    np.testing.assert_array_equal(differing_bits(packed(received), packed(words)), by_hand)


@covers(log_evidence, log_factorials)
def test_the_evidence_is_its_integral() -> None:
    table = log_factorials(200)

    def log_integral(k, n):
        with mp.workdps(30):
            return float(mp.log(quad(lambda p: p**k * (1 - p) ** (n - k), [0, 1])))

    for k1, n1, k0, n0 in ((0, 5, 0, 5), (5, 5, 0, 5), (5, 5, 5, 5), (30, 60, 3, 70), (1, 1, 0, 120)):
        expected = log_integral(k1, n1) + log_integral(k0, n0)
        got = log_evidence(np.array([k1]), np.array([n1]), n1 + n0, np.array([k1 + k0]), table)
        assert got[0] == pytest.approx(expected, rel=1e-12)
    assert log_evidence(np.array([1]), np.array([50]), 100, np.array([20]), table)[0] == -np.inf


@pytest.mark.parametrize("kind", ["repetition", "bch", "hybrid"])
@pytest.mark.parametrize("numbers", [5, 20, 60, 151, 500])
def test_a_code_book_has_a_word_for_each_column_that_lights_half_of_the_time(kind, numbers) -> None:
    for frames in (100, 300, 5000):
        try:
            book = code_book(kind, numbers, frames)
        except TooShort:
            assert frames < 300
            continue
        assert len(book.words) >= numbers
        assert book.words.shape[1] <= frames
        assert len(np.unique(book.words[:numbers], axis=0)) == numbers
        assert np.all(np.abs(book.words.mean(axis=1) - 0.5) < 0.15)


def test_the_code_whose_words_differ_in_most_frames_is_taken() -> None:
    """Of 100 frames BCH(31, 11) uses 93, in 33 of which words differ, BCH(63, 10) uses 63 of which 27 differ."""
    lengths = [code_book("bch", 151, frames).words.shape[1] for frames in (31, 63, 100, 127, 1000, 5000)]
    assert lengths == [31, 63, 31, 127, 63, 255]
    assert [code_book("hybrid", 151, frames).words.shape[1] for frames in (63, 127, 5000)] == [63, 127, 127]
    assert [code_book("repetition", 151, frames).words.shape[1] for frames in (16, 96, 5000)] == [16, 96, 208]
    with pytest.raises(TooShort, match="the shortest bch code takes 31 frames, the budget has 30"):
        code_book("bch", 151, 30)


@pytest.mark.parametrize("strategy", STRATEGIES, ids=lambda s: s.name)
def test_with_plenty_of_light_every_pixel_gets_its_column(strategy) -> None:
    depth = walls()
    answer = strategy.measure(Bench(depth, noiseless=True, signal=2e4), geometry(), Budget(1.0), 0)
    off = np.abs(off_columns(answer, depth))
    inside = seen(depth) & (np.abs(np.gradient(depth, axis=1)) < 0.1)
    assert np.all(off[inside] < 0.85)
    assert np.median(off[inside]) < (0.15 if strategy.likelihood else 0.3)


def test_the_likeliest_word_is_right_more_often_than_the_nearest() -> None:
    depth, budget = walls(3), Budget(0.02)
    good = {}
    for strategy in STRATEGIES:
        answer = strategy.measure(Bench(depth, signal=2e3, seed=3), geometry(), budget, 0)
        good[strategy.name] = float(np.mean((np.abs(answer.depth_m - depth) <= 0.02 * depth)[seen(depth)]))
    assert good["bch-likelihood"] > good["bch"]
    assert good["hybrid-likelihood"] > good["hybrid"]


def test_confident_answers_are_right() -> None:
    for strategy in STRATEGIES:
        sure, wrong = confident_answers(strategy, 0.05)
        assert sure > 100, strategy.name
        assert wrong <= 0.1 * sure, (strategy.name, sure, wrong)


def test_without_light_there_is_no_confident_answer() -> None:
    for strategy in STRATEGIES:
        answer = strategy.measure(Bench(walls(), signal=0.0), geometry(), Budget(0.05), 0)
        assert np.mean(answer.confidence >= 0.9) < 0.03, strategy.name


def test_the_time_is_kept_or_refused_before_any_light() -> None:
    for strategy in STRATEGIES:
        check_time(strategy, (1e-4, 1e-3, 0.0123, 0.05, 1.0))


def test_it_says_that_it_is_for_comparison_only(caplog) -> None:
    with caplog.at_level(logging.INFO):
        error_codes.BCH.measure(Bench(walls()), geometry(), Budget(1e-3), 0)
    assert "simulation for comparison only" in caplog.text
    assert all("simulation for comparison only" in each.sentence for each in STRATEGIES)
