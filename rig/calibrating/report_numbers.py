"""Figures of a report with their units, in as many digits as are known."""

import numpy as np

from calibration.digits import in_mm

_UNITS = {
    "angle": ("mrad", 1e3), "cone": ("mrad", 1e3), "bow": ("mrad/rad^2", 1e3),
    "offset_0": ("mm", 1e3), "offset": ("mm/rad^{order}", 1e3),
    "lag": ("us", 1e6), "row_delay": ("ns/row", 1e9),
}  # fmt: skip
"""Of the model's terms (`calibration.model.parameters`), and how many of it SI's is. A command has none."""


def measured(name: str, value: float, sd: float) -> tuple[str, str, str]:
    """Value and standard deviation of a model's term, to the second digit of the latter, and their unit."""
    first = name.split("/", maxsplit=1)[0]
    kind, _, order = first.rpartition("_") if first[-1].isdigit() else (first, "", "")
    unit, times = next((_UNITS[key] for key in (first, kind, kind.split("_")[0]) if key in _UNITS), ("", 1.0))
    value, sd, unit = value * times, sd * times, unit.format(order=order)
    if not (np.isfinite(value) and np.isfinite(sd) and sd > 0):
        return (f"{value:.4g}" if np.isfinite(value) else "-"), "-", unit
    digits = max(0, 1 - int(np.floor(np.log10(sd))))
    return f"{value:.{digits}f}", f"{sd:.{digits}f}", unit


def in_mm_with_sign(length_m: float) -> str:
    """A length that goes one way or the other, in millimetres: '+3.1'. For a table whose head says so."""
    return f"+{in_mm(length_m)}" if length_m > 0 else in_mm(length_m)
