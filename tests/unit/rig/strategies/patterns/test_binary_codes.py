"""Binary and Gray codes: what they show, how they are read, and what they find on a bench of its own."""

import cv2
import numpy as np
import pytest

from rig.strategies.apparatus import Budget
from rig.strategies.patterns import binary_codes
from rig.strategies.patterns.binary_codes import (
    BINARY_INVERSE_SPAD,
    BinaryCode,
    bits_for,
    gray_code,
    gray_number,
    gross_errors,
    plain_code,
    plain_number,
    refined,
    two_levels,
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
    true_column,
    walls,
)

covers(plain_code, gray_code, plain_number, gray_number, bits_for, two_levels)
STRATEGIES = [each for each in vars(binary_codes).values() if isinstance(each, BinaryCode)]


@pytest.mark.parametrize("strategy", STRATEGIES, ids=lambda s: s.name)
def test_without_noise_every_pixel_gets_its_column_to_a_fraction(strategy) -> None:
    depth = walls()
    answer = strategy.measure(Bench(depth, noiseless=True, signal=2e4), geometry(), Budget(1.0), 0)
    off = np.abs(off_columns(answer, depth))
    # Pixels on either side of a step see two surfaces through their borders.
    inside = seen(depth) & (np.abs(np.gradient(depth, axis=1)) < 0.1)
    # Right on a border of a plain code several bits lie between lit and dark, and any number may come out.
    border = np.abs(np.mod(true_column(depth), 1) - 0.5) < (0.0 if strategy.gray else 0.02)
    assert np.all(off[inside & ~border] < 0.5)
    assert np.median(off[inside]) < 0.1


def test_patterns_and_columns_are_those_of_opencvs_gray_code() -> None:
    columns, rows = 500, 3
    oracle = cv2.structured_light.GrayCodePattern_create(columns, rows)
    shown = np.array(oracle.generate()[1])
    code = gray_code(9, columns)
    np.testing.assert_array_equal(shown[:18:2, 0] // 255, code)
    np.testing.assert_array_equal(shown[1:18:2, 0] // 255, 1 - code)
    rng = np.random.default_rng(5)
    images = (40 + 0.5 * shown + rng.integers(0, 9, shown.shape)).astype(np.uint8)
    light = images[:18].astype(np.float64)
    found = gray_number(light[::2] > light[1::2])
    oracle.setWhiteThreshold(5)
    for x in range(0, columns, 37):
        failed, place = oracle.getProjPixel([*images], x, 1)
        assert not failed
        assert place[0] == found[1, x] == x


@pytest.mark.parametrize(("code", "number"), [(gray_code, gray_number), (plain_code, plain_number)])
def test_a_code_tells_every_number_and_repeats(code, number) -> None:
    bits = code(6, 200)
    np.testing.assert_array_equal(number(bits.astype(bool)), np.arange(200) % 64)


def test_neighbours_differ_in_one_bit_of_gray_code_also_where_it_repeats() -> None:
    code = gray_code(5, 70).astype(int)
    assert np.all(np.abs(np.diff(code, axis=1)).sum(axis=0) == 1)


def test_as_many_bits_as_there_are_numbers() -> None:
    assert [bits_for(n) for n in (1, 2, 3, 4, 5, 256, 257)] == [1, 1, 2, 2, 3, 8, 9]


@covers(gross_errors)
def test_the_probability_that_a_number_is_right_is_that_of_its_bits() -> None:
    """Gray code of 3 bits, all read as one but the first: a bit alone may move the number by more than a column."""
    contrast = np.array([-1.0, 2.0, 0.5])[:, None, None]
    number, right = gross_errors(contrast, np.ones((3, 1, 1)), gray=True)
    assert number[0, 0] == gray_number(np.array([[False], [True], [True]]))[0] == 2
    by_hand = []
    for at, sure in enumerate((0.841344746, 0.977249868, 0.691462461)):
        bits = np.array([False, True, True])
        bits[at] = ~bits[at]
        moved = (int(gray_number(bits[:, None])[0]) - 2) % 8
        by_hand.append(sure if min(moved, 8 - moved) > 1 else 1.0)
    assert right[0, 0] == pytest.approx(np.prod(by_hand), rel=1e-6)


@covers(refined)
def test_borders_are_interpolated_along_the_row() -> None:
    """A ramp of 0.8 columns per pixel, seen through light that is spread over a column."""
    x = np.arange(80)
    column = 3.3 + 0.8 * x
    fine = np.linspace(-0.5, 0.5, 41)[:, None] + column
    bits = np.stack([2.0 * ((np.rint(fine).astype(int) ^ (np.rint(fine).astype(int) >> 1)) >> b & 1) - 1
                     for b in range(6, -1, -1)]).mean(axis=1)[:, None]  # fmt: skip
    number = gray_number(bits > 0)
    found, sd = refined(number, bits, np.full(bits.shape, 0.05))
    inside = slice(3, -3)
    assert np.abs(found[0] - column)[inside].max() < 0.2
    assert np.median(np.abs(found[0] - column)) < 0.08 < np.median(np.abs(number[0] - column))
    assert np.all((sd > 0) & (sd <= 12**-0.5 + 1e-12))


def test_confident_answers_are_right() -> None:
    for strategy in STRATEGIES:
        sure, wrong = confident_answers(strategy, 0.05)
        assert sure > 100, strategy.name
        assert wrong <= 0.1 * sure, strategy.name


def test_without_light_there_is_no_confident_answer() -> None:
    for strategy in STRATEGIES:
        answer = strategy.measure(Bench(walls(), signal=0.0), geometry(), Budget(0.05), 0)
        assert np.mean(answer.confidence >= 0.9) < 0.03, strategy.name
        assert np.all(answer.confidence[np.isnan(answer.depth_m)] == 0)


def test_the_time_is_kept_or_refused_before_any_light() -> None:
    for strategy in STRATEGIES:
        check_time(strategy, (1e-3, 0.0123, 0.05, 1.0))
    with pytest.raises(TooShort, match=r"16 patterns take 0\.00016 s, the budget is 0\.0001 s"):
        BINARY_INVERSE_SPAD.measure(Bench(walls()), geometry(), Budget(1e-4), 0)
