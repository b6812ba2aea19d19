"""Quantities with units: what is read, what is refused, and that written text reads back."""

import math
from fractions import Fraction
from typing import Annotated

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import BaseModel, Field, ValidationError

from drivers.units import (
    DIMENSIONS,
    ExactHertz,
    Metres,
    PerMetre,
    Seconds,
    format_quantity,
    parse_exact,
    parse_fraction,
    parse_quantity,
)
from tests.stability.inventory import covers

covers(parse_fraction)

DIMENSION = st.sampled_from(sorted(DIMENSIONS))
FINITE = st.floats(allow_nan=False, allow_infinity=False)


class Camera(BaseModel):
    exposure: Annotated[Seconds, Field(gt=0)] = 1e-5
    frame_rate: ExactHertz = Fraction(100_000, 3)
    depth_range: tuple[Metres, Metres] = (1.0, 8.0)
    extinction: PerMetre | None = 0.05


@pytest.mark.parametrize(
    ("text", "dimension", "value"),
    [
        *((text, "time", 1e-5) for text in ("10 us", "10 µs", "10 μs", "10us", "  +1.0e4 ns ")),
        *(("0.1us", "time", 1e-7), ("97.7 kHz", "frequency", 97_700.0), ("-3 mm", "length", -0.003)),
        *(("0.05 /m", "inverse length", 0.05), ("50 1/km", "inverse length", 0.05), ("180 deg", "angle", math.pi)),
        *(("20 ppm", "ratio", 2e-5), ("20 mm/h", "rain rate", 0.02), (".5 W", "power", 0.5)),
        ("3.28GB/s", "data rate", 3.28e9),
    ],
)
def test_a_quantity_is_read_in_si_correctly_rounded(text: str, dimension: str, value: float) -> None:
    assert parse_quantity(text, dimension) == value


@pytest.mark.parametrize(
    "text",
    [
        *(1e-5, 10, 0, True, None, [10, "us"], "10", "1e-5"),  # without a unit
        *("nan s", "inf s", "-inf s", "1e400 s", "1e9999 s", "1e-400 s", "1/0 s", "", "s", "ten s"),
        *("1 m", "1 Hz", "1 S", "1 us us", "1 us 2", "1,5 us", "1 2 us", "1us/2", "0x10 s", "١ s"),
        "1" * 100_000 + " s",  # refused at once
    ],
)
def test_what_is_no_time_is_refused_in_one_short_line(text: object) -> None:
    with pytest.raises(ValueError, match=r'like "10 us"|no unit of time; use s, ms|64-bit floats') as refused:
        parse_quantity(text, "time")
    assert "\n" not in str(refused.value)
    assert len(str(refused.value)) < 150


def test_an_exact_frequency_stays_exact() -> None:
    assert parse_exact("97.7 kHz", "frequency") == 97_700
    assert parse_exact("100000/3 Hz", "frequency") == Fraction(100_000, 3)
    assert parse_exact("0.1 Hz", "frequency") == Fraction(1, 10)


@pytest.mark.parametrize("fraction", [Fraction(100_000, 3), Fraction(-7), Fraction(0), Fraction(1, 3**20)])
def test_a_fraction_reads_back_from_its_text(fraction: Fraction) -> None:
    assert parse_fraction(str(fraction)) == fraction


@pytest.mark.parametrize("text", ["1e999999999", "1/0", "0.5", "nan", "", " 1", "1/3/4", 3, None, "9" * 5000])
def test_what_str_makes_of_no_fraction_is_refused_in_one_line_at_once(text: object) -> None:
    with pytest.raises(ValueError, match=r"\A[^\n]{1,200}\Z"):
        parse_fraction(text)


@settings(deadline=None)  # a busy machine is no failure
@given(FINITE, st.fractions(max_denominator=10**9), DIMENSION)
def test_a_number_written_as_text_reads_back_exactly(value: float, fraction: Fraction, dimension: str) -> None:
    assert parse_quantity(format_quantity(value, dimension), dimension) == value
    assert parse_exact(format_quantity(fraction, dimension), dimension) == fraction


@settings(deadline=None)  # a busy machine is no failure
@given(st.text(max_size=20), DIMENSION)
def test_any_text_gives_a_finite_number_or_one_line(text: str, dimension: str) -> None:
    try:
        value, message = parse_quantity(text, dimension), ""
    except ValueError as refused:
        value, message = 0.0, str(refused)
    assert math.isfinite(value)
    assert "\n" not in message


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_is_not_written(value: float) -> None:
    with pytest.raises(ValueError, match="no time"):
        format_quantity(value, "time")


@pytest.mark.parametrize(
    ("value", "dimension", "text"),
    [
        *((1e-5, "time", "10 us"), (1e-7, "time", "100 ns"), (1e5, "frequency", "100 kHz"), (8.0, "length", "8 m")),
        *((0.05, "inverse length", "0.05 /m"), (2e-5, "ratio", "20 ppm"), (0.0, "ratio", "0 ppm")),
        *((0.001, "ratio", "0.1 %"), (2000.0, "rate", "2000 /s"), (4e6, "acceleration", "4e6 /s2")),
        *((0.05, "power", "50 mW"), (0.02, "rain rate", "20 mm/h")),
        *((Fraction(97_700), "frequency", "97.7 kHz"), (Fraction(100_000, 3), "frequency", "100000/3 Hz")),
    ],
)
def test_text_is_written_as_people_write_it(value: float | Fraction, dimension: str, text: str) -> None:
    assert format_quantity(value, dimension) == text


def test_a_model_is_read_back_from_its_dump_and_its_schema_says_text_with_an_example() -> None:
    model = Camera()
    dumped = model.model_dump(mode="json")
    assert dumped["exposure"] == "10 us"
    assert Camera.model_validate(dumped) == model
    assert model.model_dump()["exposure"] == 1e-5
    schema = Camera.model_json_schema()["properties"]["exposure"]
    assert (schema["type"], schema["examples"]) == ("string", ["10 us"])


def test_a_model_names_the_key_and_an_example_and_checks_limits_in_si() -> None:
    with pytest.raises(ValidationError) as refused:
        Camera.model_validate({"depth_range": ["1 m", 8]})
    (error,) = refused.value.errors()
    assert error["loc"] == ("depth_range", 1)
    assert '"30 m"' in error["msg"]
    with pytest.raises(ValidationError, match="greater than 0"):
        Camera.model_validate({"exposure": "-10 us"})
