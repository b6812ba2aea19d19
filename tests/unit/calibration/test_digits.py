"""Numbers that people read have no powers of ten, however large or small; but for condition numbers."""

from math import inf, nan

import pytest

from calibration import errors
from calibration.errors import condition_text, digits, in_mm, mm
from tests.stability.inventory import covers

covers(errors)


@pytest.mark.parametrize(
    ("length_m", "said"),
    [(1.4812, "1480"), (0.0123456, "12.3"), (150.0, "150000"), (1.2345e-8, "0.0000123"), (-0.2, "-200"), (0.0, "0"),
     (-0.0, "0"), (nan, "-"), (inf, "inf"), (-inf, "-inf")],
)  # fmt: skip
def test_lengths_are_no_powers_of_ten(length_m: float, said: str) -> None:
    assert in_mm(length_m) == said
    assert mm(length_m) == f"{said} mm"


def test_as_many_digits_as_are_asked_for_count() -> None:
    assert [digits(1234.5, count) for count in (1, 2, 3)] == ["1000", "1200", "1230"]


def test_a_condition_number_is_a_power_of_ten() -> None:
    assert [condition_text(value) for value in (1.0, 3.14e7, 2e18, inf, nan)] == [
        "1.0e+00",
        "3.1e+07",
        "2.0e+18",
        "inf",
        "inf",
    ]
