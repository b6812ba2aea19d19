import mpmath
import numpy as np
import pytest

from rig.tradeoff import rows
from rig.tradeoff.rows import BLOCK_COLUMNS, BLOCK_ROWS, blocks_interval, blocks_of, repeats_interval, t_quantile
from tests.stability.inventory import covers

covers(rows)


@pytest.mark.parametrize("freedom", [1, 2, 3, 4, 5, 6, 9, 20, 999])
def test_the_quantile_is_that_of_students_t(freedom):
    x = freedom / (freedom + t_quantile(freedom) ** 2)
    beyond = mpmath.betainc(freedom / 2, 0.5, 0, x, regularized=True)  # both tails
    assert float(beyond) == pytest.approx(0.05, rel=2e-3)


def test_an_interval_over_repeats_follows_its_formula_and_is_never_below_zero():
    low, high = repeats_interval([1.0, 2.0, 3.0])
    assert (low, high) == (0.0, pytest.approx(2 + 4.3027 / 3**0.5))


def test_the_blocks_of_a_map_hold_its_errors_and_leave_nan_out():
    errors = np.full((BLOCK_ROWS + 3, 2 * BLOCK_COLUMNS), 2.0)
    errors[0, 0] = np.nan
    sums, numbers = blocks_of(errors)
    whole = BLOCK_ROWS * BLOCK_COLUMNS
    assert numbers.tolist() == [whole - 1, whole, 3 * BLOCK_COLUMNS, 3 * BLOCK_COLUMNS]
    assert (sums == 2 * numbers).all()


def test_an_interval_over_blocks_holds_the_true_mean_as_often_as_it_says():
    rng = np.random.default_rng(1)
    held = 0
    for seed in range(100):
        numbers = rng.integers(400, 801, 100)
        sums = numbers * rng.exponential(0.3, 100)
        low, high = blocks_interval(sums, numbers, seed)
        held += low <= 0.3 <= high
    assert held >= 88
