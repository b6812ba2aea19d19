"""Numbers in messages and tables: as many digits as are known, never as a power of ten."""

import numpy as np


def digits(value: float, count: int = 3) -> str:
    """A number with so many digits that count: 1234.5 is '1230', 0.000012345 is '0.0000123'; '-' for nan."""
    if not np.isfinite(value):
        return "-" if np.isnan(value) else f"{value:g}"
    value = value + 0.0  # -0 is 0
    return np.format_float_positional(value, precision=count, unique=False, fractional=False, trim="-")


def condition_text(condition: float) -> str:
    """A condition number, which matters by its powers of ten: '3.1e+07'; 'inf' where nothing is determined."""
    return f"{condition:.1e}" if np.isfinite(condition) else "inf"


def in_mm(length_m: float) -> str:
    """A length in millimetres, for a table whose head says so."""
    return digits(1e3 * length_m)


def mm(length_m: float) -> str:
    """A length in a text, in millimetres."""
    return f"{in_mm(length_m)} mm"
