"""The choice of passes, and the counts of passes added up."""

from dataclasses import replace

import numpy as np
import pytest

from rig.adaptive import EXPOSURES, Pass, Unsettled, moved_rows, next_pass
from rig.adaptive_counts import add_pass
from rig.adaptive_thinning import thinned
from rig.config import ScanConfig
from rig.counting import CountVolume
from rig.stripes import StripeTable

COLUMNS = 200


def pass_time(columns: int, exposures: int) -> float:
    """Frames of 10 us and 2 ms of travel."""
    return columns * exposures * 1e-5 + 2e-3


def unsettled(moved, n=2) -> Unsettled:
    return Unsettled(np.zeros(COLUMNS) + moved, np.full(COLUMNS, n, np.int32))


def test_where_all_columns_wait_for_photons_alike_the_next_pass_is_a_plain_sweep() -> None:
    found = next_pass(unsettled(15.0), pass_time, 20e-3, 1)
    assert found is not None
    assert (found.first_column, found.columns) == (0, COLUMNS)


def test_columns_that_decide_nothing_are_left_out() -> None:
    moved = np.full(COLUMNS, 0.5)
    moved[120:160] = 30.0
    found = next_pass(unsettled(moved), pass_time, 8e-3, 3)
    assert found is not None
    assert 110 <= found.first_column <= 125
    assert 155 <= found.end_column <= 170


def test_with_time_to_spare_columns_where_nothing_moved_have_some_of_it() -> None:
    # Wrong answers need not move: a third of what is expected of a column is what the whole map says.
    moved = np.zeros(COLUMNS)
    moved[120:160] = 30.0
    found = next_pass(unsettled(moved), pass_time, 20e-3, 1)
    assert found is not None
    assert (found.first_column, found.columns) == (0, COLUMNS)


def test_decided_maps_and_spent_budgets_ask_for_nothing() -> None:
    assert next_pass(unsettled(0.0), pass_time, 20e-3, 3) is None
    assert next_pass(unsettled(30.0), pass_time, 1e-3, 3) is None
    assert next_pass(unsettled(30.0), lambda columns, exposures: None, 1.0, 3) is None


@pytest.mark.parametrize("passes", [1, 2, 5])
def test_a_pass_stays_within_the_budget(passes: int) -> None:
    left_s = 7.3e-3
    found = next_pass(unsettled(20.0), pass_time, left_s, passes)
    assert found is not None
    assert pass_time(found.columns, found.exposures) <= left_s
    assert found.exposures in EXPOSURES


def test_gain_is_that_of_errors_that_fall_as_one_over_the_frames() -> None:
    for n, fewer in ((2, 1), (3, 2), (4, 3), (8, 6)):
        wrong = 120.0 / n
        np.testing.assert_allclose(unsettled(120.0 / fewer - wrong, n).gain(6), wrong - 120.0 / (n + 6))


def test_gaps_are_scanned_where_another_pass_would_cost_more_travel_than_they_take() -> None:
    moved = np.full(COLUMNS, 3.0)
    moved[np.arange(COLUMNS) // 20 % 2 == 0] = 30.0
    found = next_pass(unsettled(moved), pass_time, 12e-3, 3)
    assert found is not None
    assert (found.first_column, found.exposures) == (0, 4)
    assert found.columns > 180


def test_moved_rows_of_a_column_are_those_of_it_and_its_neighbours() -> None:
    moved = np.zeros(COLUMNS)
    moved[100] = 150.0
    gain = unsettled(moved).gain(2)  # as many frames again decide half of the 10 rows that each of 15 columns has
    np.testing.assert_allclose(gain[93:108], (2 / 3 * 10 + 1 / 3 * 0.75) / 2)
    np.testing.assert_allclose(np.delete(gain, np.s_[93:108]), 1 / 3 * 0.75 / 2)
    np.testing.assert_allclose(unsettled(30.0).gain(2), 15.0)  # fewer neighbours at the ends


def test_rows_that_were_not_searched_do_not_move() -> None:
    here, there = StripeTable.empty(2, 3), StripeTable.empty(2, 3)
    here.x_px[:] = [[5, 5, 5], [9, np.nan, 9]]
    there.x_px[:] = [[6, 6.5, 9], [1, 9, 9]]
    there.confidence[:] = 0.2
    searched = np.array([[True, True, False], [True, True, True]])
    np.testing.assert_array_equal(moved_rows(here, there, searched), [1, 1, 0])


def test_rows_that_hardly_can_be_stripes_do_not_count_as_moved() -> None:
    # In shadows answers move for ever, and no light decides them.
    before, now = StripeTable.empty(3, 2), StripeTable.empty(3, 2)
    before.x_px[:], now.x_px[:] = 5, 9
    before.confidence[:] = 0.9
    now.confidence[:] = [[0.02, 0.2], [0.09, 0.5], [0.3, 0.9]]
    np.testing.assert_array_equal(moved_rows(before, now, np.ones((3, 2), bool)), [1, 3])


def test_a_pass_has_the_commands_of_its_columns() -> None:
    whole = ScanConfig(
        frame_rate="100 kHz", depth_range=["1 m", "8 m"], columns=100, command_range=(-0.5, 0.5), adaptive={}
    )
    part = Pass(20, 10, 7).scan(whole)
    assert (part.columns, part.exposures, part.adaptive) == (10, 7, None)
    assert part.command_range == pytest.approx((-0.3, -0.2))
    assert Pass(0, 100, 7).scan(whole).command_range == whole.command_range


def volume(columns: int, n, counts, **other) -> CountVolume:
    fields = {"dark_counts": None, "n_dark": 0, "width": 64, "x0": np.zeros(columns, np.int32)} | other
    return CountVolume(
        counts=np.full((columns, 2, 64), counts, np.uint8),
        n_frames=np.full(columns, n, np.int32),
        column=np.arange(columns, dtype=float),
        **fields,
    )


def test_passes_add_up_column_by_column() -> None:
    dark = np.ones((2, 64), np.uint32)
    total = volume(4, 3, 1, dark_counts=dark, n_dark=2)
    part = volume(2, 9, 5, dark_counts=2 * dark, n_dark=3, dark_frames=np.full(64, 1, np.int32))
    part = replace(part, column=part.column + 0.5)
    found = add_pass(total, Pass(1, 2, 9), part)
    np.testing.assert_array_equal(found.n_frames, [3, 12, 12, 3])
    np.testing.assert_array_equal(found.counts[:, 0, 0], [1, 6, 6, 1])
    np.testing.assert_allclose(found.column, [0, 1 + 9 * 0.5 / 12, 2 + 9 * 0.5 / 12, 3])
    np.testing.assert_array_equal(found.dark_counts, 3 * dark)
    np.testing.assert_array_equal(found.dark_frames, 3)
    assert found.n_dark == 5


def test_counts_are_widened_before_they_overflow_and_lost_columns_stay_lost() -> None:
    total = replace(volume(2, 0, 0), column=np.array([np.nan, np.nan]))
    found = add_pass(add_pass(total, Pass(1, 1, 200), volume(1, 200, 200)), Pass(1, 1, 100), volume(1, 100, 100))
    assert found.counts.dtype == np.uint16
    np.testing.assert_array_equal(found.counts[:, 0, 0], [0, 300])
    np.testing.assert_array_equal(found.column, [np.nan, 1.0])
    with pytest.raises(ValueError, match="other windows"):
        add_pass(found, Pass(0, 1, 2), volume(1, 2, 1, x0=np.full(1, 64, np.int32)))


@pytest.mark.parametrize(("n", "m"), [(1, 0), (2, 1), (3, 2), (4, 3), (7, 6), (12, 9)])
def test_thinned_counts_are_those_of_three_quarters_of_the_frames(n: int, m: int) -> None:
    rng = np.random.default_rng(1)
    rate = 0.3
    whole = replace(volume(40, n, 0), counts=rng.binomial(n, rate, (40, 64, 64)).astype(np.uint8))
    fewer = thinned(whole)
    np.testing.assert_array_equal(fewer.n_frames, m)
    assert np.all(fewer.counts <= np.minimum(whole.counts, m))
    assert np.all(fewer.counts >= whole.counts.astype(int) - (n - m))
    sd = np.sqrt(m * rate * (1 - rate) / fewer.counts.size)
    assert abs(fewer.counts.mean() - m * rate) < 4 * sd + 4e-3  # quantiles are those of 256 draws
    assert fewer.counts.var() == pytest.approx(m * rate * (1 - rate), rel=0.03)
