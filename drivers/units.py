"""Quantities with units in config files: text such as "10 us" on disk, a number in code. The number is in SI units,
except that rain rates are in m/h.

A field typed `Seconds` takes text such as "10 us" and nothing else. A bare number, another dimension, NaN and infinity
are refused. Values written back (`model_dump(mode="json")`) are text again and read back to the very same number.
"""

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from decimal import Context, Decimal
from fractions import Fraction
from typing import Annotated, Any, get_args

from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic.fields import FieldInfo
from pydantic_core import CoreSchema, core_schema

_NUMBER = re.compile(
    r"(?P<mantissa>[+-]?(?:\d+\.?\d*|\.\d+))(?:[eE](?P<exponent>[+-]?\d{1,3}))?(?:/(?P<divisor>\d+))?", re.ASCII
)
_FRACTION = re.compile(r"-?\d{1,1000}(/[1-9]\d{0,999})?", re.ASCII)
_MAX_TEXT = 1000
"""Longest text taken, in characters: exact arithmetic on an endless number would take endless time."""

MANY_ZEROS = 5
"""A whole number that ends with this many zeros or more is written with an exponent."""
_FAITHFUL = Context(prec=20)
"""A 64-bit float needs 17 decimal digits; the other 3 are a margin for one multiplication by a unit."""


@dataclass(frozen=True, slots=True)
class Dimension:
    """A physical dimension. units: size of each unit in SI (rain rate: in m/h); the first is preferred in output."""

    name: str
    units: Mapping[str, Fraction]
    example: str
    only_read: frozenset[str] = frozenset()
    """Units that are understood when read and never written."""


_PREFIXES = {"G": 9, "M": 6, "k": 3, "": 0, "c": -2, "m": -3, "u": -6, "\u00b5": -6, "\u03bc": -6, "n": -9, "p": -12}
"""Powers of ten; micro is u, the micro sign of keyboards, or the Greek letter."""
_SMALL = ("u", "\u00b5", "\u03bc", "n")


def _si(unit: str, *prefixes: str) -> dict[str, Fraction]:
    return {prefix + unit: Fraction(10) ** _PREFIXES[prefix] for prefix in prefixes}


_ALL = (
    Dimension("time", _si("s", "", "m", *_SMALL, "p"), "10 us"),
    Dimension("age", {"d": Fraction(86400), "h": Fraction(3600), "s": Fraction(1)}, "90 d"),
    Dimension("frequency", _si("Hz", "", "k", "M", "G"), "100 kHz"),
    Dimension("length", _si("m", "", "k", "c", "m", *_SMALL), "30 m"),
    Dimension("power", _si("W", "", "m", "u"), "50 mW"),
    Dimension("voltage", _si("V", "", "m"), "10 V"),
    Dimension(
        "inverse length",
        {"/m": Fraction(1), "1/m": Fraction(1), "/km": Fraction(1, 10**3), "1/km": Fraction(1, 10**3)},
        "0.05 /m",
        frozenset({"/km", "1/km"}),
    ),
    Dimension("angle", {**_si("rad", "", "m"), "deg": Fraction(math.pi) / 180}, "3 deg"),
    Dimension("illuminance", {"lx": Fraction(1), "lux": Fraction(1), "klx": Fraction(10**3)}, "200 lx"),
    Dimension("ratio", {"ppm": Fraction(1, 10**6), "%": Fraction(1, 100), "ppb": Fraction(1, 10**9)}, "20 ppm"),
    Dimension("speed", {**_si("m/s", "", "m"), "km/h": Fraction(1000, 3600)}, "1.5 m/s"),
    Dimension("rain rate", _si("m/h", "", "m"), "20 mm/h"),
    Dimension("count rate", _si("cps", "", "k", "M"), "20 cps"),
    Dimension("data rate", _si("B/s", "", "k", "M", "G"), "400 MB/s"),
    Dimension("rate", {"/s": Fraction(1), "1/s": Fraction(1), "/ms": Fraction(10**3)}, "5 /s", frozenset({"/ms"})),
    Dimension("acceleration", {"/s2": Fraction(1), "/ms2": Fraction(10**6)}, "1e6 /s2", frozenset({"/ms2"})),
)

DIMENSIONS: Mapping[str, Dimension] = {dimension.name: dimension for dimension in _ALL}
"""The dimensions of the project's config files by name."""


def parse_quantity(text: object, dimension: str) -> float:
    """The number in SI units that a text such as "10 us" means (ratio: 1 for 100 %; rain rate: m/h). dimension: a key
    of `DIMENSIONS`.

    Correctly rounded: "0.1 us" gives the float 1e-07. Raises ValueError, with a message of one line, for text of
    another form and for numbers that no float can hold.
    """
    exact = parse_exact(text, dimension)
    try:
        value = float(exact)
    except OverflowError:
        raise ValueError(f"{_shown(text)} is too large, beyond what 64-bit floats hold") from None
    if value == 0 and exact != 0:
        raise ValueError(f"{_shown(text)} is too small, below what 64-bit floats hold")
    return value


def parse_exact(text: object, dimension: str) -> Fraction:
    """Parse as `parse_quantity` does, but exactly and without bounds. Both accept fractions ("100000/3 Hz"). Raises
    ValueError for text of another form."""
    known = DIMENSIONS[dimension]
    like = f'write the {known.name} with a unit, like "{known.example}"'
    if not isinstance(text, str):
        raise ValueError(f"{_shown(text)} has no unit; {like}")
    stripped = text.strip()
    match = _NUMBER.match(stripped) if len(stripped) <= _MAX_TEXT else None
    if match is None:
        raise ValueError(f"{_shown(text)} is no number; {like}")
    unit = stripped[match.end() :].strip()
    if not unit:
        raise ValueError(f"{_shown(text)} has no unit; {like}")
    if unit not in known.units:
        raise ValueError(f"{_shown(text)}: {_shown(unit)} is no unit of {known.name}; use {', '.join(known.units)}")
    divisor = int(match["divisor"] or 1)
    if divisor == 0:
        raise ValueError(f"{_shown(text)} divides by zero; {like}")
    return Fraction(f"{match['mantissa']}e{match['exponent'] or 0}") / divisor * known.units[unit]


def parse_fraction(text: object) -> Fraction:
    """Parse a fraction of whole numbers, such as "100000/3" or "-5". Raises ValueError for anything else, and for a
    number of more than 1000 digits: `Fraction` alone would read "1e999999999", which takes minutes and gigabytes."""
    if not isinstance(text, str) or _FRACTION.fullmatch(text) is None:
        raise ValueError(f"{_shown(text)} is no fraction of whole numbers")
    return Fraction(text)


def format_quantity(value: float | Fraction, dimension: str) -> str:
    """A text with a unit that reads back to exactly `value`, a number in SI units. dimension: a key of `DIMENSIONS`.
    Raises ValueError if `value` is not finite.

    Prefers, in this order: a number without exponent; a number between 0.1 and 1000; the shortest text, where the first
    unit of the dimension may take one character more; that first unit; a number of at least 1.
    """
    known = DIMENSIONS[dimension]
    if not math.isfinite(value):
        raise ValueError(f"{value} is no {known.name}")
    exact = Fraction(value)
    if exact == 0:
        return f"0 {next(iter(known.units))}"
    numbers = {unit: exact / scale for unit, scale in known.units.items() if unit not in known.only_read}
    texts = {unit: f"{_shortest(number)} {unit}" for unit, number in numbers.items()}
    first = next(iter(texts))
    faithful = [unit for unit, text in texts.items() if _means(text, value, dimension)]

    def awkwardness(unit: str) -> tuple[bool, bool, int, bool, bool]:
        text, size = texts[unit], abs(numbers[unit])
        return "e" in text.split()[0], not 0.1 <= size < 1000, len(text) - (unit == first), unit != first, size < 1

    if faithful:
        return texts[min(faithful, key=awkwardness)]
    unit, scale = next(iter(known.units.items()))
    number = exact / scale
    if isinstance(value, Fraction):
        return f"{number.numerator}/{number.denominator} {unit}"
    return f"{_FAITHFUL.divide(Decimal(number.numerator), Decimal(number.denominator)):e} {unit}"


def _shortest(number: Fraction) -> str:
    try:
        text = repr(float(number)).removesuffix(".0")
    except OverflowError:
        return "inf"
    digits = text.rstrip("0")
    zeros = len(text) - len(digits)
    return f"{digits}e{zeros}" if zeros >= MANY_ZEROS and "." not in text and "e" not in text else text


def _means(text: str, value: float | Fraction, dimension: str) -> bool:
    parse: Callable[[object, str], float | Fraction] = parse_exact if isinstance(value, Fraction) else parse_quantity
    try:
        return parse(text, dimension) == value
    except ValueError:
        return False


def _shown(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:36]}...{text[-1]}"


IN_NAMES: Mapping[str, str] = {
    "time": "s",
    "age": "s",
    "frequency": "hz",
    "length": "m",
    "power": "w",
    "voltage": "v",
    "inverse length": "per_m",
    "angle": "rad",
    "illuminance": "lux",
    "ratio": "",
    "speed": "m_per_s",
    "rain rate": "m_per_h",
    "count rate": "cps",
    "data rate": "bytes_per_s",
    "rate": "per_s",
    "acceleration": "per_s2",
}
"""Unit of each dimension as names in code have it: `power_w`. A ratio has none."""


def dimension_of(field: FieldInfo) -> str | None:
    """Name of the dimension of a config's field if that is a quantity or, like `Seconds | None`, may be one; else
    None."""
    marks = [mark for part in get_args(field.annotation) for mark in get_args(part)]
    return next((mark.dimension for mark in (*field.metadata, *marks) if isinstance(mark, _Text)), None)


@dataclass(frozen=True, slots=True)
class _Text:
    """Tells pydantic that a field is text with a unit in files and a number in code."""

    dimension: str
    exact: bool = False

    def written(self, value: float | Fraction) -> str:
        """The text that stands for the number in a file."""
        return format_quantity(value, self.dimension)

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        def parse(text: object) -> float | Fraction:
            value = parse_quantity(text, self.dimension)  # also bounds what is taken as an exact value
            return parse_exact(text, self.dimension) if self.exact else value

        serialization = core_schema.plain_serializer_function_ser_schema(self.written, when_used="json")
        return core_schema.no_info_plain_validator_function(parse, serialization=serialization)

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        known = DIMENSIONS[self.dimension]
        description = f"{known.name} with its unit ({', '.join(known.units)})"
        return {"type": "string", "description": description, "examples": [known.example]}


Seconds = Annotated[float, _Text("time")]
Age = Annotated[float, _Text("age")]
"""An age, in seconds in code: "90 d" is 7776000."""
Hertz = Annotated[float, _Text("frequency")]
ExactHertz = Annotated[Fraction, _Text("frequency", exact=True)]
Metres = Annotated[float, _Text("length")]
Watts = Annotated[float, _Text("power")]
Volts = Annotated[float, _Text("voltage")]
PerMetre = Annotated[float, _Text("inverse length")]
Radians = Annotated[float, _Text("angle")]
Lux = Annotated[float, _Text("illuminance")]
Ppm = Annotated[float, _Text("ratio")]
"""A plain ratio in code: "20 ppm" is 2e-05."""
MetresPerSecond = Annotated[float, _Text("speed")]
MetresPerHour = Annotated[float, _Text("rain rate")]
CountsPerSecond = Annotated[float, _Text("count rate")]
PerSecond = Annotated[float, _Text("rate")]
PerSecondSquared = Annotated[float, _Text("acceleration")]
"""Acceleration of a scanner's command, whose full range is -1 to 1, in 1/s2."""
BytesPerSecond = Annotated[float, _Text("data rate")]
