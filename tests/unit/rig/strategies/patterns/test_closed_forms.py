"""Codes and phase shift against closed forms, with the program's own encoders and decoders."""

import pytest

from tests.reference.tables.strategy_checks import CASES, closed_form, drawn, phase_errors, wrong_without_noise


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.name} at {case.signal:g}, {case.ambient:g}")
def test_shares_of_wrong_columns_are_those_of_the_closed_form(case) -> None:
    expected = closed_form(case)
    assert expected == pytest.approx(case.stated, rel=0.05)
    draws = 10
    found, nearest = drawn(case, draws=draws)
    spread = (expected * (1 - expected) / (1024 * draws)) ** 0.5
    assert found == pytest.approx(expected, abs=5 * spread)
    assert nearest is None or nearest <= found


@pytest.mark.parametrize("shifts", range(3, 9))
def test_phase_shift_has_the_error_of_its_formula(shifts) -> None:
    formula, found = phase_errors(shifts)
    assert formula == pytest.approx(0.114, abs=0.0005)
    assert found == pytest.approx(formula, rel=0.02)


def test_codes_without_noise_tell_every_column() -> None:
    assert [wrong for _, wrong in wrong_without_noise()] == [0, 0]
